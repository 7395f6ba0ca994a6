"""Arrays of a field as few bytes: differences, planes of equal weight, LZMA.

What LZMA's adaptive binary models code well are bytes of one kind in a row, most of them small:
columns one after the other, signs folded into the lowest bit, high bytes apart from
low ones. Its parameters are fixed but for the context bits `lc`, of which the best is taken and
noted; the dictionary follows from the size, so that a file cannot ask for memory.
"""

from __future__ import annotations

import lzma
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Context bits that are tried.
CONTEXT_BITS = (0, 3)
LARGEST_DICTIONARY = 1 << 24
SMALLEST_DICTIONARY = 1 << 12

# "none": as it is. "delta": differences down the rows. "fresh": distance from the first index
# not used before, 0 for that index itself: small where triangles follow their neighbours.
FILTERS = ("none", "delta", "fresh")
# Arrays that are smooth down their rows, whose differences are smaller; those that are not here
# are packed both ways, and the better one is kept.
KNOWN_FILTERS = {"faces": "fresh", "texel_of_pixel": "delta", "turns": "none"}
TRIED_FILTERS = ("none", "delta")
# Of an array that is larger than this, ways are tried on the first rows, of so many bytes, and
# repetitions are looked for over a short distance, in the processor's cache: coefficients of
# 6 MB take a quarter of the time and half a percent more bytes, frames of 3 MB half and one.
LARGE_BYTES, SAMPLE_BYTES = 2 << 20, 1 << 19
SHORT_DISTANCE = 1 << 16


@dataclass(frozen=True)
class PackedArray:
    """Bytes of an array with what they were packed by."""

    content: bytes
    filter: str
    context_bits: int


def packed_array(name: str, array: NDArray[Any]) -> PackedArray:
    """Pack one of a field's arrays, in the better of the ways that are tried for it."""
    filters = (KNOWN_FILTERS[name],) if name in KNOWN_FILTERS else TRIED_FILTERS
    if array.dtype.kind == "f" or array.shape[0] < 2:
        filters = ("none",)
    if array.nbytes <= LARGE_BYTES:
        return _best_packed(array, filters, CONTEXT_BITS)
    # Each way takes a second for a megabyte: they are tried on some of the rows.
    rows = max(2, len(array) * SAMPLE_BYTES // array.nbytes)
    best = _best_packed(array[:rows], filters, CONTEXT_BITS)
    return _best_packed(array, (best.filter,), (best.context_bits,))


def _best_packed(
    array: NDArray[Any], filters: Sequence[str], context_bits: Sequence[int]
) -> PackedArray:
    ways = [PackedArray(pack(array, f, n), f, n) for f in filters for n in context_bits]
    return min(ways, key=lambda packed: len(packed.content))


def pack(array: NDArray[Any], filter_name: str, context_bits: int) -> bytes:
    """Bytes of an array.

    Parameters
    ----------
    array : ndarray
        Integers or float32.
    filter_name : {"none", "delta", "fresh"}
    context_bits : int
        One of `CONTEXT_BITS`; which packs better depends on the array.

    Returns
    -------
    bytes

    Examples
    --------
    >>> content = pack(np.arange(1000, dtype=np.int32), "delta", 0)
    >>> len(content) < 60
    True
    >>> unpack(content, np.dtype("int32"), (1000,), "delta", 0)[-3:]
    array([997, 998, 999], dtype=int32)
    """
    raw = _planes(_filtered(array, filter_name))
    (how,) = _lzma(len(raw), context_bits)
    if len(raw) > LARGE_BYTES:
        how["dict_size"] = min(how["dict_size"], SHORT_DISTANCE)
    return lzma.compress(raw, lzma.FORMAT_RAW, filters=[how])


def unpack(
    content: bytes,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    filter_name: str,
    context_bits: int,
) -> NDArray[Any]:
    """Array of `pack`'s bytes; nothing is allocated on the word of `shape`.

    Raises
    ------
    ValueError
        If the bytes are not those of such an array.
    """
    size = prod(shape) * dtype.itemsize
    if context_bits not in CONTEXT_BITS or filter_name not in FILTERS:
        raise ValueError(f"expected a known filter, received {filter_name!r}, {context_bits}")
    decoder = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_lzma(size, context_bits))
    try:
        # One byte more than promised is enough to notice a false promise.
        raw = decoder.decompress(content, max_length=size + 1)
    except lzma.LZMAError as error:
        raise ValueError(f"the packed bytes are damaged ({error})") from error
    if len(raw) != size:
        raise ValueError(f"expected {size} bytes for shape {shape}, received {len(raw)}")
    coded = _from_planes(raw, _coded(dtype, filter_name), shape)
    return _unfiltered(coded.view(dtype), filter_name)


def _lzma(size: int, context_bits: int) -> list[dict[str, int]]:
    dictionary = int(np.clip(size, SMALLEST_DICTIONARY, LARGEST_DICTIONARY))
    return [
        {
            "id": lzma.FILTER_LZMA2,
            "preset": 9 | lzma.PRESET_EXTREME,
            "dict_size": dictionary,
            "lc": context_bits,
            "lp": 0,
            "pb": 0,
        }
    ]


def _planes(array: NDArray[Any]) -> bytes:
    """First bytes of all numbers, column by column, then their second bytes, and so on."""
    if array.dtype.kind == "i":
        bits = array.dtype.itemsize * 8
        array = ((array << 1) ^ (array >> (bits - 1))).astype(f"u{array.dtype.itemsize}")
    columns = np.ascontiguousarray(_by_column(array), array.dtype.newbyteorder("<"))
    return columns.view(np.uint8).reshape(-1, array.dtype.itemsize).T.tobytes()


def _from_planes(raw: bytes, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    planes = np.frombuffer(raw, np.uint8).reshape(dtype.itemsize, prod(shape))
    stored = np.dtype(f"u{dtype.itemsize}") if dtype.kind == "i" else dtype
    values = np.ascontiguousarray(planes.T).view(stored.newbyteorder("<")).ravel()
    values = values.astype(stored)
    if dtype.kind == "i":
        values = (values >> 1).astype(dtype) ^ -(values & 1).astype(dtype)
    columns = values.reshape(shape[1:] + shape[:1])
    return np.ascontiguousarray(np.moveaxis(columns, -1, 0))


def _by_column(array: NDArray[Any]) -> NDArray[Any]:
    """First axis last: what varies along it follows in a row."""
    return np.moveaxis(array, 0, -1)


def _coded(dtype: np.dtype[Any], filter_name: str) -> np.dtype[Any]:
    """Type of the numbers that are split into planes."""
    return np.dtype(f"i{dtype.itemsize}") if filter_name == "delta" else dtype


def _filtered(array: NDArray[Any], filter_name: str) -> NDArray[Any]:
    if filter_name == "delta":
        # Unsigned differences wrap around; as signed ones they are small.
        steps = np.diff(array, axis=0, prepend=np.zeros_like(array[:1]))
        return steps.view(_coded(array.dtype, filter_name))
    if filter_name == "fresh":
        flat = array.ravel()
        return (_first_unused(flat) - flat).astype(array.dtype).reshape(array.shape)
    return array


def _unfiltered(array: NDArray[Any], filter_name: str) -> NDArray[Any]:
    if filter_name == "delta":
        return np.cumsum(array, axis=0, dtype=array.dtype)
    if filter_name == "fresh":
        # A code of zero or less goes to an index not used before, and beyond.
        codes = array.ravel()
        after = np.cumsum(np.where(codes <= 0, 1 - codes, 0), dtype=array.dtype)
        before = np.concatenate([np.zeros(1, array.dtype), after[:-1]])
        return (before - codes).reshape(array.shape)
    return array


def _first_unused(indices: NDArray[Any]) -> NDArray[Any]:
    """Before each index, the least that is above all earlier ones."""
    highest = np.maximum.accumulate(indices, dtype=np.int64) + 1
    return np.concatenate([[0], highest[:-1]])
