"""Every tolerance in the tests follows from a rule or says where it comes from.

The rule is that of the fixture ``rounding`` (``conftest.py``): safety x eps x operations x
condition x scale. A literal number as a tolerance needs a comment that gives its source, in
its statement or on the line above; so does one that is given to several tests by a name.
"""

import ast
import io
import tokenize
from pathlib import Path

TESTS = Path(__file__).parent
TOLERANCES = {"atol", "rtol", "abs", "rel", "abs_tol", "rel_tol"}
LARGEST_ROUNDING = 1e-3  # larger bounds of comparisons are the tests' claims, not tolerances


def is_number(node):
    """Whether an expression is made of literals alone and is not zero."""
    named = any(isinstance(part, ast.Name | ast.Attribute) for part in ast.walk(node))
    values = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant)]
    return not named and any(isinstance(value, int | float) and value for value in values)


def lines_of_tolerances(tree):
    """Lines on which a literal number serves as a tolerance."""
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg in TOLERANCES and is_number(node.value):
            yield node.value.lineno
        if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.Lt | ast.LtE):
            bound = node.comparators[0]
            small = isinstance(bound, ast.Constant) and isinstance(bound.value, float)
            if small and 0 < bound.value <= LARGEST_ROUNDING:
                yield bound.lineno


def lines_of_reasons(text, tree):
    """Lines of the statements that have a comment in them or on the line above."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    comments = {token.start[0] for token in tokens if token.type == tokenize.COMMENT}
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt) and not hasattr(node, "body"):
            lines = range(node.lineno, node.end_lineno + 1)
            if comments.intersection([node.lineno - 1, *lines]):
                yield from lines


def without_reason(text):
    """Lines of a test file with a literal tolerance whose source is not given."""
    tree = ast.parse(text)
    return sorted(set(lines_of_tolerances(tree)) - set(lines_of_reasons(text, tree)))


def test_every_literal_tolerance_has_its_reason_beside_it():
    files = sorted(path for path in TESTS.rglob("test_*.py") if path.parts[-2] != "benchmarks")
    found = {str(path.relative_to(TESTS)): without_reason(path.read_text()) for path in files}
    assert {name: lines for name, lines in found.items() if lines} == {}


def test_what_counts_as_a_reason():
    assert without_reason("assert x == approx(1, abs=1e-6)\n") == [1]
    assert without_reason("assert abs(x) < 1e-6\n") == [1]
    assert without_reason("# six decimals\nassert x == approx(1, abs=1e-6)\n") == []
    assert without_reason("assert abs(x) < 1e-6  # float32\n") == []
    assert without_reason("assert x == approx(1, abs=8 * rounding)\nassert y < 0.5\n") == []
