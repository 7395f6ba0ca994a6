"""Digests of code: what a module computes changes with it and with the modules that it imports.

Imports are followed in the text, inside the package alone; other packages are told apart by
their versions. Modules are compiled, and the result is hashed without line numbers and
docstrings, so that comments, layout and the place of the installation do not matter.
"""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from types import CodeType
from typing import Any

IMPORT = re.compile(
    r"^\s*from\s+(?P<base>[\w.]+)\s+import\s+(?:\((?P<many>[^)]*)\)|(?P<few>[^\n]*))"
    r"|^\s*import\s+(?P<whole>[^\n]+)",
    re.MULTILINE,
)
COMMENT = re.compile(r"#[^\n]*")
# What of a code object decides on what it does; not its file, its lines or its docstring.
FIELDS = (
    *("co_name", "co_code", "co_names", "co_varnames", "co_freevars", "co_cellvars"),
    *("co_flags", "co_argcount", "co_posonlyargcount", "co_kwonlyargcount"),
)


@lru_cache(maxsize=64)
def code_digest(module: str) -> str:
    """SHA-256 of the code of a module and of all of its package that it imports.

    Parameters
    ----------
    module : str
        Such as ``reflfield.pipeline.hull``.

    Returns
    -------
    str
        64 hexadecimal digits, the same wherever the package is installed.

    Notes
    -----
    A module counts as a whole: a stage is computed again rather too often than too seldom. The
    packages that modules stand in, imported along with them, do not count unless they are
    imported themselves.
    """
    total = hashlib.sha256()
    for name in modules_of(module):
        total.update(f"{name} {_module_digest(name)}\n".encode())
    return total.hexdigest()


def modules_of(module: str) -> list[str]:
    """Names of a module and of all modules of its package that it imports, sorted."""
    known: set[str] = set()
    left = [module]
    while left:
        name = left.pop()
        if name not in known:
            known.add(name)
            left.extend(_imported(name))
    return sorted(known)


@lru_cache(maxsize=1024)
def _imported(module: str) -> frozenset[str]:
    """Modules of the same package that one imports itself."""
    package = module.partition(".")[0]
    names: set[str] = set()
    for match in IMPORT.finditer(_source(module)):
        if match["whole"]:
            names.update(part.split()[0] for part in match["whole"].split(","))
        else:
            listed = COMMENT.sub("", match["many"] or match["few"]).split(",")
            parts = [part.split()[0] for part in listed if part.split()]
            names.update([match["base"], *(f"{match['base']}.{part}" for part in parts)])
    inside = (name for name in names if name.partition(".")[0] == package)
    return frozenset(name for name in inside if _file(name) is not None)


@lru_cache(maxsize=1024)
def _module_digest(module: str) -> str:
    code = compile(_source(module), module, "exec", dont_inherit=True, optimize=2)
    return hashlib.sha256(_described(code).encode()).hexdigest()


def _described(value: Any) -> str:
    """Text of a constant or a code object; sets in the order of their texts."""
    if isinstance(value, CodeType):
        said = [repr(getattr(value, name)) for name in FIELDS]
        return f"({' '.join([*said, *map(_described, value.co_consts)])})"
    if isinstance(value, tuple):
        return f"({','.join(map(_described, value))})"
    if isinstance(value, frozenset):
        return f"{{{','.join(sorted(map(_described, value)))}}}"
    return repr(value)


@lru_cache(maxsize=1024)
def _source(module: str) -> str:
    path = _file(module)
    return "" if path is None else path.read_text(encoding="utf-8")


@lru_cache(maxsize=4096)
def _file(module: str) -> Path | None:
    """File of a module; None if it is none, but a name inside one."""
    package, *rest = module.split(".")
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return None
    base = Path(spec.submodule_search_locations[0], *rest)
    for path in (base / "__init__.py", base.with_suffix(".py") if rest else base):
        if path.is_file():
            return path
    return None
