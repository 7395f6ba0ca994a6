"""Words of code, messages and pages: terms of the field, names that say what they hold."""

import ast
import re

import pytest

from tests.test_layers import ROOT, modules

PACKAGES = ("reflfield", "capture_sim")
# Names that say how a value came about and not what it is.
VAGUE = {"found", "taken", "given", "got"}
# Words that once stood for standard terms, and where an old name is still accepted.
OLD_TERMS = re.compile(
    r"\b(unroot|rooted|fineness|coarseness|crumbs?|hopeful|climbs?|climbing|"
    r"least_news|nothing new|no say|speaks? for|of the (clock|processor)|standalone)\b",
    re.IGNORECASE,
)
ACCEPTED = {("reflfield/options.py", "coarseness"), ("reflfield/options.py", "fineness")}
FLAG = re.compile(r"(?<![\w-])--[a-z][\w-]+")
# Commands of other programs, which messages may name with their flags.
OTHER_PROGRAMS = re.compile(r"`dask worker --memory-limit`")
# Modules whose messages are those of commands.
OF_COMMANDS = ("reflfield/cli/", "reflfield/flags.py")
LOGGED = {"debug", "info", "warning", "error"}


def vague_names(tree):
    """Lines on which a variable or argument has a vague name."""
    for node in ast.walk(tree):
        if (isinstance(node, ast.Name) and node.id in VAGUE) or (
            isinstance(node, ast.arg) and node.arg in VAGUE
        ):
            yield node.lineno


def flags_in_messages(tree):
    """Flags of commands in the text of errors and of what is logged."""
    for node in ast.walk(tree):
        called = node.func if isinstance(node, ast.Call) else None
        is_log = isinstance(called, ast.Attribute) and called.attr in LOGGED
        if isinstance(node, ast.Raise) or is_log:
            parts = (part.value for part in ast.walk(node) if isinstance(part, ast.Constant))
            text = "".join(part for part in parts if isinstance(part, str))
            yield from FLAG.findall(OTHER_PROGRAMS.sub("", text))


def in_modules(package, look):
    """What a function finds in the modules of a package, by their paths."""
    results = {}
    for path in modules(package):
        results[path.as_posix()] = list(look(ast.parse((ROOT / path).read_text())))
    return {path: result for path, result in results.items() if result}


@pytest.mark.parametrize("package", PACKAGES)
def test_variables_say_what_they_hold(package):
    assert in_modules(package, vague_names) == {}


def test_errors_and_logs_name_arguments_not_flags():
    """The simulator has commands alone, and no public functions."""
    flags = in_modules("reflfield", flags_in_messages)
    assert {p: f for p, f in flags.items() if not p.startswith(OF_COMMANDS)} == {}


def test_old_terms_are_gone():
    texts = [ROOT / "README.md"]
    texts += [
        p for top in PACKAGES for p in (ROOT / top).rglob("*") if p.suffix in (".py", ".md")
    ]
    left = {
        (path.relative_to(ROOT).as_posix(), match.group().lower())
        for path in texts
        for match in OLD_TERMS.finditer(path.read_text())
    }
    assert left - ACCEPTED == set()


def test_the_checks_see_what_they_must():
    source = (
        "def f(given):\n    found = given\n    raise ValueError(f'x: {found}; use `--x-y`')\n"
        "log.warning('start `dask worker --memory-limit` again, --zz')\n"
    )
    assert sorted(vague_names(ast.parse(source))) == [1, 2, 2, 3]
    assert list(flags_in_messages(ast.parse(source))) == ["--x-y", "--zz"]
    assert OLD_TERMS.findall("the fineness has no say")
