"""Imports run one way: each package uses only those before it, none hides in a function."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]

# From the ground up. A package may import itself and any package above it.
PACKAGES = (
    "errors",
    "util",
    "options",
    "sphere",
    "factorization",
    "capture",
    "geometry",
    "observations",
    "alignment",
    "field",
    "render",
    "fitting",
    "metrics",
    "viewer",
    "export",
    "report",
    "checking",
    "calibration",
    "pipeline",
    "tradeoff",
    "api",
    "demo",
    "reproduction",
    "flags",
    "cli",
    "__main__",
)
# Commands import what they need when they run, so that --help answers at once and Ctrl-C
# is heard while libraries are imported.
IMPORTS_LATE = {
    *(path.relative_to(ROOT) for path in (ROOT / "reflfield/cli").glob("*.py")),
    Path("reflfield/__main__.py"),
    Path("capture_sim/__main__.py"),
}


class Import(NamedTuple):
    line: int
    module: str  # absolute, dotted
    inside_function: bool


def imports_of(tree: ast.AST, package: str, inside: bool = False) -> Iterator[Import]:
    """All imports of a module; relative ones made absolute."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (Import(node.lineno, alias.name, inside) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join(parts if node.level else [])
            module = ".".join(filter(None, (base, node.module)))
            # "from package import name" names the package only among the imported names.
            yield from (
                Import(node.lineno, f"{module}.{alias.name}", inside) for alias in node.names
            )
        function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        yield from imports_of(node, package, inside or function)


def modules(package: str) -> list[Path]:
    return sorted(path.relative_to(ROOT) for path in (ROOT / package).rglob("*.py"))


def imports_in(path: Path) -> list[Import]:
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return list(imports_of(tree, ".".join(path.parent.parts)))


def package_of(path: Path) -> str:
    return Path(path.parts[1]).stem


def breaches(package: str, imports: list[Import]) -> list[Import]:
    """Imports of packages that come later than `package`."""
    allowed = PACKAGES[: PACKAGES.index(package) + 1]
    return [
        one
        for one in imports
        if one.module.startswith("reflfield.")
        and (name := one.module.split(".")[1]) in PACKAGES
        and name not in allowed
    ]


def test_every_package_has_its_place():
    present = {package_of(path) for path in modules("reflfield")} - {"__init__"}
    assert present == set(PACKAGES)


@pytest.mark.parametrize("package", ["reflfield", "capture_sim"])
def test_a_module_name_occurs_once(package):
    names = [path.stem for path in modules(package) if path.stem != "__init__"]
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_earlier_packages(package):
    crossing = {
        str(path): breaches(package, imports_in(path))
        for path in modules("reflfield")
        if package_of(path) == package
    }
    assert {path: bad for path, bad in crossing.items() if bad} == {}


def test_the_package_itself_imports_no_package():
    """But for type checkers: names are imported when they are first used."""
    tree = ast.parse((ROOT / "reflfield/__init__.py").read_text(encoding="utf-8"))
    tree.body = [node for node in tree.body if not isinstance(node, ast.If)]
    at_once = {one.module.split(".")[0] for one in imports_of(tree, "reflfield")}
    assert at_once == {"importlib", "typing"}


@pytest.mark.parametrize(
    ("package", "other"), [("reflfield", "capture_sim"), ("capture_sim", "reflfield")]
)
def test_pipeline_and_simulator_share_no_code(package, other):
    crossing = {
        str(path): one
        for path in modules(package)
        for one in imports_in(path)
        if one.module.split(".")[0] == other
    }
    assert crossing == {}


@pytest.mark.parametrize("package", ["reflfield", "capture_sim"])
def test_no_import_hides_inside_a_function(package):
    hidden = {
        f"{path}:{one.line}": one.module
        for path in modules(package)
        if path not in IMPORTS_LATE
        for one in imports_in(path)
        if one.inside_function
    }
    assert hidden == {}


def prints(tree: ast.AST) -> list[int]:
    """Lines that call print, or that use the module which writes to the terminal."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id == "print"
        )
        or (isinstance(node, ast.ImportFrom) and node.module == "reflfield.util.terminal")
    ]


def test_only_commands_print():
    """The library tells through logging and progress; scripts that it exports are programs."""
    printing = {
        str(path): lines
        for path in modules("reflfield")
        if package_of(path) != "cli"
        and path != Path("reflfield/util/terminal.py")
        and path.parts[2:3] not in [("mitsuba_scene",), ("blender_scene",)]
        and (lines := prints(ast.parse((ROOT / path).read_text(encoding="utf-8"))))
    }
    assert printing == {}


def test_the_check_of_printing_sees_what_it_must():
    source = "print(1)\nfrom reflfield.util.terminal import say\n'print(2)'\n"
    assert sorted(prints(ast.parse(source))) == [1, 2]


def test_the_check_sees_what_it_must():
    source = (
        "from reflfield.field import evaluation\n"
        "from reflfield import render\n"
        "from ..pipeline.stages import run\n"
        "def later():\n"
        "    import reflfield.cli\n"
    )
    imports = list(imports_of(ast.parse(source), "reflfield.field"))
    assert [one.module for one in imports] == [
        "reflfield.field.evaluation",
        "reflfield.render",
        "reflfield.pipeline.stages.run",
        "reflfield.cli",
    ]
    assert [one.inside_function for one in imports] == [False, False, False, True]
    assert [one.line for one in breaches("field", imports)] == [2, 3, 5]
