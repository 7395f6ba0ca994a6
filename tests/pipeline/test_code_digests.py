"""Digests of code: all that is imported counts, comments and places do not."""

import ast
import importlib
import shutil
import sys
from pathlib import Path

import pytest

from reflfield.pipeline import code_digests
from reflfield.pipeline.code_digests import code_digest, modules_of
from tests.test_layers import imports_of

ROOT = Path(code_digests.__file__).parents[1]
FILES = {
    "__init__": '"""Nothing."""\n',
    "stage": "from toy.parts import one\nimport os\n\n\ndef run():\n"
    '    """Value."""\n    return one.value()\n',
    "parts/__init__": "",
    "parts/one": "from toy import (\n    two,  # 2\n)\n\n\ndef value():\n    return two.N\n",
    "two": "'Two.'\nN = 2\nKNOWN = {'a', 'b', 'c'}\n",
    "apart": "import toy.stage\n",
}


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A package of its own: function that edits a module, or moves it all."""
    place = tmp_path / "toy"

    def forget():
        for name in [n for n in sys.modules if n.partition(".")[0] == "toy"]:
            del sys.modules[name]
        importlib.invalidate_caches()
        for cached in ("code_digest", "_imported", "_module_digest", "_source", "_file"):
            getattr(code_digests, cached).cache_clear()

    def edit(name, text):
        path = (place / name).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        forget()

    for name, text in FILES.items():
        edit(name, text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield edit
    forget()


def test_imports_are_followed_inside_the_package(toy):
    expected = ["toy", "toy.parts", "toy.parts.one", "toy.stage", "toy.two"]
    assert modules_of("toy.stage") == expected


@pytest.mark.parametrize(
    ("name", "text", "same"),
    [
        ("two", "'Two.'\nN = 3\nKNOWN = {'a', 'b', 'c'}\n", False),
        ("two", "'Two.'\nN = 2\nKNOWN = {'a', 'b', 'd'}\n", False),
        ("two", f"{FILES['two']}\n\n\ndef new():\n    return 1\n", False),
        ("stage", FILES["stage"].replace("import os", "import re"), False),
        ("parts/one", FILES["parts/one"].replace("two.N", "two.N + 0"), False),
        ("two", '"""Said."""\n\n# of it\nN = 2  # two\n\nKNOWN = {"a", "b", "c"}\n', True),
        ("stage", FILES["stage"].replace("Value.", "What it is.\n\n    Always.\n    "), True),
        ("apart", "import toy.stage\n\nN = 1\n", True),
    ],
)
def test_what_counts(toy, name, text, same):
    before = code_digest("toy.stage")
    toy(name, text)
    assert (code_digest("toy.stage") == before) == same


def test_the_place_does_not_count(toy, tmp_path, monkeypatch):
    before = code_digest("toy.stage")
    (tmp_path / "elsewhere").mkdir()
    shutil.move(tmp_path / "toy", tmp_path / "elsewhere" / "toy")
    monkeypatch.syspath_prepend(str(tmp_path / "elsewhere"))
    for cached in ("code_digest", "_imported", "_module_digest", "_source", "_file"):
        getattr(code_digests, cached).cache_clear()
    importlib.invalidate_caches()
    assert code_digest("toy.stage") == before


def test_imports_are_those_of_the_parser():
    """Of every module of the package; the digest finds them in the text."""
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        package = module if parts[-1] == "__init__" else module.rpartition(".")[0]
        parsed = {each.module for each in imports_of(ast.parse(path.read_text()), package)}
        names = parsed | {name.rpartition(".")[0] for name in parsed}
        inside = {name for name in names if name.partition(".")[0] == "reflfield"}
        # Words that look like an import inside a string may be one more.
        assert set(code_digests._imported(module)) >= {
            name for name in inside if code_digests._file(name) is not None
        }, module
