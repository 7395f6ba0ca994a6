"""Files and functions are short enough to be read at one go."""

import ast
from statistics import median

import pytest

from tests.test_layers import ROOT, modules

FILE, FUNCTION, MEDIAN = 500, 80, 12
FOLDERS = ("reflfield", "capture_sim", "tests", "examples")


def functions(source):
    """Lines of each function without its docstring, by name."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            text = node.body[0] if ast.get_docstring(node) is not None else None
            without = text.end_lineno - text.lineno + 1 if text else 0
            yield node.name, node.end_lineno - node.lineno + 1 - without


@pytest.mark.parametrize("folder", FOLDERS)
def test_files_and_functions_are_short(folder):
    sources = {path: (ROOT / path).read_text(encoding="utf-8") for path in modules(folder)}
    lengths = {path: source.count("\n") for path, source in sources.items()}
    assert {path: n for path, n in lengths.items() if n > FILE} == {}
    counted = [(path, *one) for path, source in sources.items() for one in functions(source)]
    assert [one for one in counted if one[2] > FUNCTION] == []
    assert median(n for _, _, n in counted) <= MEDIAN


def test_docstrings_do_not_count():
    source = 'def f():\n    """One.\n\n    Two.\n    """\n    return 1\n\n\ndef g(): ...\n'
    assert list(functions(source)) == [("f", 2), ("g", 1)]
