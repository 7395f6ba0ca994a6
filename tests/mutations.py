"""Planted faults in the numeric packages, and which of them the packages' tests find.

    python tests/mutations.py                     # all faults; table and mutations.json
    python tests/mutations.py --only wigner gauss # those whose module's name has one of these
    python tests/mutations.py --list

Each fault, of `data/mutations.toml`, is one exact replacement of text. It is planted in a copy
of the repository in a temporary folder, never in the working tree, and only the tests of its
module run there. A fault that no test finds survives: the tests lack something. Exit status 1
where one survives.
`test_mutations.py` holds that every text still occurs exactly once.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT))

from tests.test_layers import imports_of  # noqa: E402

# Seconds that the tests of one fault may take; a fault that makes a loop endless is found.
LONGEST = 400
# Folders of the copy besides what Python files need.
COPIED = ("reflfield", "capture_sim", "tests", "examples", "pyproject.toml", "README.md")
KILLED, SURVIVED, BROKEN = "killed", "survived", "tests fail without the fault"


class Fault(NamedTuple):
    """A replacement of text, what kind of slip it is, and the tests that should find it."""

    module: str  # below reflfield/, without suffix
    kind: str
    text: str
    planted: str
    tests: tuple[str, ...]

    @property
    def path(self) -> Path:
        """Of the module, below the root."""
        return Path("reflfield", f"{self.module}.py")


def read_faults(path: Path = HERE / "data" / "mutations.toml") -> list[Fault]:
    """Faults of a file: modules, each with its tests and replacements."""
    return [
        Fault(
            module["name"],
            fault["kind"],
            fault["text"],
            fault["planted"],
            tuple(f"tests/{test}" for test in module["tests"]),
        )
        for module in tomllib.loads(path.read_text(encoding="utf-8"))["module"]
        for fault in module["fault"]
    ]


FAULTS = read_faults()


# --- the copy ---------------------------------------------------------------------------------


def copy_tree(folder: Path) -> None:
    """Copy what the tests need into a folder, caches of compiled kernels included."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            ignored = shutil.ignore_patterns("*.pyc", "results", ".hypothesis")
            shutil.copytree(source, folder / name, ignore=ignored)
        else:
            shutil.copy2(source, folder / name)


def module_of(dotted: str, root: Path) -> Path | None:
    """Module that an imported name is of, below the root; None where there is none."""
    parts = dotted.split(".")
    for end in range(len(parts), 0, -1):
        path = Path(*parts[:end])
        for candidate in (path.with_suffix(".py"), path / "__init__.py"):
            if (root / candidate).is_file():
                return candidate
    return None


def importers(module: str, root: Path = ROOT) -> set[Path]:
    """Modules of the package that import one, directly or through others, and itself."""
    direct = {}
    for path in (root / "reflfield").rglob("*.py"):
        name = path.relative_to(root)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imported = imports_of(tree, ".".join(name.parent.parts))
        direct[name] = {module_of(one.module, root) for one in imported}
    reached: set[Path] = set()
    more = {Path("reflfield", f"{module}.py")}
    while more:
        reached |= more
        more = {path for path, imported in direct.items() if imported & reached} - reached
    return reached


def forget_compiled(folder: Path, module: str) -> None:
    """Remove kernels that may hold code of a module: numba does not look where it came from."""
    for path in importers(module, folder):
        for cached in (folder / path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ic]"):
            cached.unlink()


def run_tests(
    folder: Path, tests: tuple[str, ...], longest: float | None = LONGEST
) -> tuple[bool, str]:
    """Whether the tests pass in a folder, and the first that fails."""
    words = ["-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", "--no-header"]
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    environment.setdefault("REFLFIELD_DATA", str(ROOT.parent / "shared" / "data"))
    try:
        done = subprocess.run(
            [sys.executable, *words, "--hypothesis-seed=0", *tests],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=longest,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False, f"not done after {longest} s"
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    first = failed[0].split(" - ")[0].partition(" ")[2] if failed else ""
    if done.returncode == 0:
        return True, ""
    if done.returncode != 1:
        # 2 and more: nothing was tested, as where a name is misspelt.
        raise RuntimeError(f"{' '.join(tests)}: {done.stdout[-800:]}{done.stderr[-400:]}")
    return False, first


def tried(fault: Fault, clean: Path) -> dict[str, object]:
    """Plant a fault in a copy of the clean copy and run its tests; what came of it."""
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="fault-") as name:
        folder = Path(name) / "tree"
        shutil.copytree(clean, folder)
        path = folder / fault.path
        text = path.read_text(encoding="utf-8")
        assert text.count(fault.text) == 1, f"{fault.path}: {fault.text!r}"
        path.write_text(text.replace(fault.text, fault.planted), encoding="utf-8")
        forget_compiled(folder, fault.module)
        passed, first = run_tests(folder, fault.tests)
    return {
        "module": fault.module,
        "kind": fault.kind,
        "text": fault.text,
        "planted": fault.planted,
        "outcome": SURVIVED if passed else KILLED,
        "by": first,
        "seconds": round(time.perf_counter() - begin, 1),
    }


def all_tried(faults: list[Fault], clean: Path) -> Iterator[dict[str, object]]:
    """Results of all faults; tests that fail without a fault are an error."""
    sound: set[tuple[str, ...]] = set()
    for fault in faults:
        if fault.tests not in sound:
            passed, first = run_tests(clean, fault.tests, longest=None)
            if not passed:
                raise SystemExit(f"{first}: {BROKEN}")
            sound.add(fault.tests)
        yield tried(fault, clean)


def main() -> int:
    """Try faults, print a line for each, and write all; 1 where one survives."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="parts of modules' names")
    parser.add_argument("--list", action="store_true", help="name the faults and end")
    parser.add_argument("-o", "--output", type=Path, default=Path("mutations.json"))
    options = parser.parse_args()
    wanted = [f for f in FAULTS if not options.only or any(o in f.module for o in options.only)]
    if options.list:
        for fault in wanted:
            print(f"{fault.module:38} {fault.kind:18} {fault.text!r} -> {fault.planted!r}")
        return 0
    results = []
    with tempfile.TemporaryDirectory(prefix="clean-") as name:
        copy_tree(Path(name))
        for number, result in enumerate(all_tried(wanted, Path(name)), start=1):
            results.append(result)
            place, seconds = f"{number}/{len(wanted)}", f"{result['seconds']:6} s"
            cells = (result["module"], result["kind"], result["by"])
            print(f"{place:>6}  {result['outcome']:9}{seconds}  " + "  ".join(map(str, cells)))
            sys.stdout.flush()
            options.output.write_text(json.dumps(results, indent=1) + "\n")
    survivors = [one for one in results if one["outcome"] == SURVIVED]
    print(f"{len(results)} faults, {len(results) - len(survivors)} found; {options.output}")
    for one in survivors:
        print(f"survived: {one['module']}: {one['text']!r} -> {one['planted']!r}")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
