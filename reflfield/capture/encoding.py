"""How stored values follow from linear ones: sRGB, powers, and tables of measured pairs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.documents import csv_rows
from reflfield.errors import InputError
from reflfield.util.files import read_bytes
from reflfield.util.late_import import LateImport

interpolate: Any = LateImport("scipy.interpolate")

Float32 = NDArray[np.float32]

LINEAR = "linear"
SRGB = "srgb"
# Exponents that a camera or a display may have.
GAMMA_RANGE = (0.1, 10.0)
LARGEST_TABLE_BYTES = 1 << 20
# Pairs that a table may have: one for each code of 16 bits.
MOST_PAIRS = 1 << 16
PAIR_SUFFIXES = (".csv", ".vset")
REMEDY = "expected linear, srgb, gamma=NUMBER or a file of pairs (.csv)"


def decode_srgb(encoded: ArrayLike) -> NDArray[np.floating[Any]]:
    r"""Linear values of sRGB-encoded ones (IEC 61966-2-1), both in [0, 1].

    :math:`c / 12.92` up to 0.04045, else :math:`((c + 0.055) / 1.055)^{2.4}`.

    Examples
    --------
    >>> decode_srgb([0.0, 0.5, 1.0]).round(4)
    array([0.   , 0.214, 1.   ])
    """
    values = _floating(encoded)
    curved = ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(values <= 0.04045, values / 12.92, curved).astype(values.dtype)


def encode_srgb(linear: ArrayLike) -> NDArray[np.floating[Any]]:
    """sRGB-encoded values of linear ones, clipped to [0, 1]; inverse of `decode_srgb`.

    Examples
    --------
    >>> encode_srgb([0.0, 0.214, 1.0, 7.0]).round(3)
    array([0. , 0.5, 1. , 1. ])
    """
    values = np.clip(_floating(linear), 0.0, 1.0)
    curved = 1.055 * np.maximum(values, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(values <= 0.0031308, values * 12.92, curved).astype(values.dtype)


@dataclass(frozen=True)
class Encoding:
    """A curve from stored values (1 is the largest code of an integer file) to linear ones.

    Parameters
    ----------
    name : str
        "linear", "srgb", "gamma" or "table".
    gamma : float
        Exponent of "gamma": linear = stored ** gamma.
    pairs : tuple of (stored, linear)
        Of "table", both increasing. Between them a monotone cubic, below the first one down
        to (0, 0), above the last one its slope goes on (those values are no measurements).

    Examples
    --------
    >>> Encoding("gamma", gamma=2.0).decode(np.array([0.5], np.float32))
    array([0.25], dtype=float32)
    """

    name: str
    gamma: float = 1.0
    pairs: tuple[tuple[float, float], ...] = ()

    @property
    def top(self) -> float:
        """Stored value above which the curve is not known; infinity except for tables."""
        return self.pairs[-1][0] if self.pairs else math.inf

    def decode(self, stored: Float32) -> Float32:
        """Linear values; negative ones of float files mirror the curve.

        Parameters
        ----------
        stored : (...) float32

        Returns
        -------
        (...) float32
        """
        if self.name == LINEAR:
            return stored
        size = np.abs(stored)
        if self.name == SRGB:
            linear = decode_srgb(size)
        elif self.name == "gamma":
            linear = size ** np.float32(self.gamma)
        else:
            linear = self._from_table(size)
        return np.copysign(linear, stored).astype(np.float32)

    def _from_table(self, size: Float32) -> NDArray[np.floating[Any]]:
        curve, (last, value) = self._curve, self.pairs[-1]
        slope = float(curve.derivative()(last))
        beyond = value + slope * (size - last)
        return np.where(size > last, beyond, curve(np.minimum(size, last)))

    @cached_property
    def _curve(self) -> Any:
        points = self.pairs if self.pairs[0][0] == 0 else ((0.0, 0.0), *self.pairs)
        return interpolate.PchipInterpolator(*np.array(points, np.float64).T)


def parse_encoding(text: str, find: Callable[[str], Path] = Path) -> Encoding:
    """The encoding that a description or an option names.

    Parameters
    ----------
    text : str
        ``linear``, ``srgb``, ``gamma=2.2`` or the name of a file of pairs (`read_pairs`).
    find : callable, optional
        Gives the path of a file's name.

    Returns
    -------
    Encoding

    Raises
    ------
    InputError
        If it is none of these or the file cannot be used.

    Examples
    --------
    >>> parse_encoding("gamma=2.2")
    Encoding(name='gamma', gamma=2.2, pairs=())
    """
    if text in (LINEAR, SRGB):
        return Encoding(text)
    if text.startswith("gamma="):
        return _power(text)
    if Path(text).suffix.lower() not in PAIR_SUFFIXES:
        raise InputError(f"encoding: {REMEDY}, received {text!r}")
    return read_pairs(find(text))


def _power(text: str) -> Encoding:
    try:
        gamma = float(text.removeprefix("gamma="))
    except ValueError:
        gamma = math.nan
    low, high = GAMMA_RANGE
    if not low <= gamma <= high:
        raise InputError(f"encoding: expected gamma={low:g} .. {high:g}, received {text!r}")
    return Encoding("gamma", gamma=gamma)


def read_pairs(path: Path) -> Encoding:
    """The encoding that a file of measured pairs describes.

    Parameters
    ----------
    path : Path
        Lines ``encoded,linear``; a first line of words may name the columns, in either order
        (``encoded``, ``linear``). Encoded values up to 1 are shares of the largest code, up to
        255 codes of 8 bits, above that of 16. Or a ``.vset`` of Kintsugi3D, whose lines
        ``e LINEAR ENCODED`` count.

    Returns
    -------
    Encoding

    Raises
    ------
    InputError
        Naming the file and the line that is no pair, or if fewer than two are there, they do
        not increase, or are negative.
    """
    text = read_bytes(path, LARGEST_TABLE_BYTES).decode("utf-8-sig", errors="replace")
    if path.suffix.lower() == ".vset":
        words = [line.split()[1:] for line in text.splitlines() if line.split()[:1] == ["e"]]
        rows = [_numbers(path, row[::-1]) for row in words]
    else:
        rows = _csv_rows(path, text)
    pairs = sorted(rows)
    if not 2 <= len(pairs) <= MOST_PAIRS:
        raise InputError(f"{path}: expected 2 to {MOST_PAIRS} pairs, received {len(pairs)}")
    table = np.array(pairs, np.float64)
    rises = (np.diff(table, axis=0) > 0).all() and (table >= 0).all() and table[-1, 0] <= 65535
    if not rises or (table[0, 0] == 0) != (table[0, 1] == 0):
        raise InputError(
            f"{path}: expected pairs encoded,linear of which both increase from 0 on, received "
            f"{pairs[:3]}"
        )
    top = table[-1, 0]
    table[:, 0] /= 1 if top <= 1 else 255 if top <= 255 else 65535
    return Encoding("table", pairs=tuple((float(a), float(b)) for a, b in table))


def _csv_rows(path: Path, text: str) -> list[tuple[float, float]]:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    rows = csv_rows(path, lines)
    heading = [word.lower() for word in rows[0]] if rows else []
    named = sorted(heading) == ["encoded", "linear"]
    step = -1 if named and heading[0] == "linear" else 1
    return [_numbers(path, row[::step]) for row in rows[named:]]


def _numbers(path: Path, row: list[str]) -> tuple[float, float]:
    try:
        encoded, linear = (float(word) for word in row)
    except ValueError:
        encoded = linear = math.nan
    if not (math.isfinite(encoded) and math.isfinite(linear)):
        raise InputError(f"{path}: expected a pair encoded,linear, received {','.join(row)!r}")
    return encoded, linear


def _floating(values: ArrayLike) -> NDArray[np.floating[Any]]:
    array = np.asarray(values)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)
