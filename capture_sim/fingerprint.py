"""Fingerprints of scenes: whether a capture that was begun is the one that is wanted."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np

from capture_sim.model import Blocks
from capture_sim.stopwatch import Stopwatch


def fingerprint(value: Any) -> str:
    """Digest of a value and of the simulator's own source.

    Parameters
    ----------
    value : object
        Made of dataclasses, mappings, sequences, sets, arrays, functions with their
        closures, and what `repr` tells apart. Stopwatches and sizes of blocks count as
        nothing: no file depends on them.

    Returns
    -------
    str
        64 hexadecimal digits; equal for equal values.

    Examples
    --------
    >>> fingerprint({"a": np.arange(3)}) == fingerprint({"a": np.arange(3)})
    True
    >>> fingerprint({"a": np.arange(3)}) == fingerprint({"a": np.arange(3.0)})
    False
    """
    digest = hashlib.sha256(_source())
    for part in _parts(value):
        # Lengths keep the borders between parts.
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


@cache
def _source() -> bytes:
    """Digest of the source of this package: other code may draw other images."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.digest()


def _parts(value: Any) -> list[bytes]:
    """Bytes that tell a value from others, part by part."""
    name = [type(value).__name__.encode()]
    if isinstance(value, Stopwatch | Blocks):
        return name
    if isinstance(value, np.ndarray):
        return [*name, str((value.dtype, value.shape)).encode(), value.tobytes()]
    if is_dataclass(value) and not isinstance(value, type):
        inside: list[Any] = [(f.name, getattr(value, f.name)) for f in fields(value)]
    elif isinstance(value, Mapping):
        inside = list(value.items())
    elif isinstance(value, set | frozenset):
        inside = sorted(value, key=repr)
    elif isinstance(value, list | tuple):
        inside = list(value)
    elif isinstance(value, FunctionType):
        cells = value.__closure__ or ()
        inside = [value.__qualname__, [cell.cell_contents for cell in cells]]
    else:
        return [*name, repr(value).encode()]
    return [*name, str(len(inside)).encode(), *(p for item in inside for p in _parts(item))]
