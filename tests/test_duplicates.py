"""No six lines of code stand twice in a package.

Imports, docstrings, comments and heads of functions do not count, nor lines of brackets alone.
"""

import ast
from collections import defaultdict

import pytest

from tests.test_layers import ROOT, modules

LENGTH = 6
# Pairs of files, and the reason.
ALLOWED = {
    (
        "reflfield/field/basis.py",
        "reflfield/field/coefficients.py",
    ): "the loop over a view's samples; what it adds up differs",
}


def left_out(tree):
    """Numbers of the lines that do not count."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            first = min(part.lineno for part in (node, *node.decorator_list))
            yield from range(first, node.body[0].lineno)
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_text or isinstance(node, ast.Import | ast.ImportFrom):
            yield from range(node.lineno, node.end_lineno + 1)


def code_lines(source):
    """(number, text) of each line that counts."""
    without = set(left_out(ast.parse(source)))
    for number, line in enumerate(source.splitlines(), 1):
        text = line.strip()
        if number not in without and text[:1] != "#" and any(map(str.isalnum, text)):
            yield number, text


def repeated(sources):
    """Places (file, line) of six lines that stand elsewhere too, by those lines.

    Parameters
    ----------
    sources : dict
        Texts by names of files.
    """
    places = defaultdict(list)
    for name, source in sources.items():
        lines = list(code_lines(source))
        for first in range(len(lines) - LENGTH + 1):
            run = tuple(text for _, text in lines[first : first + LENGTH])
            if len(set(run)) > LENGTH // 2:  # not one line again and again
                places[run].append((name, lines[first][0]))
    return {run: where for run, where in places.items() if len(where) > 1}


@pytest.mark.parametrize("package", ["reflfield", "capture_sim"])
def test_no_six_lines_stand_twice(package):
    sources = {path.as_posix(): (ROOT / path).read_text() for path in modules(package)}
    places = [
        where
        for where in repeated(sources).values()
        if tuple(sorted({name for name, _ in where})) not in ALLOWED
    ]
    assert places == []


def test_the_check_sees_what_it_must():
    body = [f"    value_{i} = {i}" for i in range(LENGTH)]
    one = ["def one(a):", '    """Say one.', "", "    More.", '    """', *body]
    other = ["import os", "def other(", "    b,", "):", "    # Why.", *body[:3], "", *body[3:]]
    places = repeated({"a.py": "\n".join(one), "b.py": "\n".join(other)})
    assert list(places.values()) == [[("a.py", 6), ("b.py", 6)]]
    # Five lines, and six of a docstring, are no duplicate.
    shorter = [*one[:-1], "    pass"]
    assert repeated({"a.py": "\n".join(one), "b.py": "\n".join(shorter)}) == {}
    text = ['"""', *body, '"""']
    assert repeated({"a.py": "\n".join(text), "b.py": "\n".join(text)}) == {}


def test_the_weights_of_luminance_stand_once():
    holding = [p for p in modules("reflfield") if "(0.2126, " in (ROOT / p).read_text()]
    holding += [p for p in modules("reflfield") if "[0.2126, " in (ROOT / p).read_text()]
    assert [path.name for path in holding] == ["color_spaces.py"]


def test_ply_files_are_written_in_one_place():
    writers = [
        p.name for p in modules("reflfield") if "element vertex" in (ROOT / p).read_text()
    ]
    assert writers == ["mesh.py"]
