r"""Reader of tensor files, the container of the RGL material database.

Layout, little-endian: ``tensor_file\0``, u8 major, u8 minor, u32 number of
fields; per field u16 length and name, u16 rank, u8 type, u64 offset,
u64 shape[rank]. Nothing is allocated before it is known to lie in the file.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.errors import scene_error

MAGIC = b"tensor_file\0"
# Ten times what the largest published material needs.
LARGEST_FILE = 2**30
MOST_FIELDS, HIGHEST_RANK = 256, 8
TYPES = dict(
    enumerate(
        ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8"), start=1
    )
)


def read_tensor_file(path: Path) -> dict[str, NDArray[Any]]:
    """Fields of a tensor file by name.

    Parameters
    ----------
    path : Path
        File of the RGL material database (``.bsdf``) or of the same container.

    Returns
    -------
    dict of str to ndarray
        Read-only arrays of the stored type and shape.

    Raises
    ------
    SceneError
        If the file is missing, is not a tensor file of version 1.0, is truncated,
        or names sizes that do not fit in it.

    References
    ----------
    J. Dupuy and W. Jakob, "An adaptive parameterization for efficient material
    acquisition and rendering", ACM TOG 37(6), 2018, and its published reader.
    """
    if not path.is_file():
        raise scene_error(str(path), "a tensor file", "no such file", "check the path")
    if path.stat().st_size > LARGEST_FILE:
        raise scene_error(str(path), f"at most {LARGEST_FILE} bytes", str(path.stat().st_size))
    cursor = _Cursor(path)
    if cursor.bytes(len(MAGIC)) != MAGIC:
        raise scene_error(str(path), "a tensor file", "another first line", "use a .bsdf file")
    if (version := cursor.unpack("<BB")) != (1, 0):
        raise scene_error(str(path), "tensor file version (1, 0)", version)
    (n_fields,) = cursor.unpack("<I")
    if n_fields > MOST_FIELDS:
        raise scene_error(str(path), f"at most {MOST_FIELDS} fields", n_fields, "not intact")
    return dict(_field(cursor) for _ in range(n_fields))


class _Cursor:
    """Position in the bytes of a file that refuses to leave them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content = path.read_bytes()
        self._position = 0

    def bytes(self, length: int) -> bytes:
        part = self.content[self._position : self._position + length]
        if len(part) < length:
            raise scene_error(
                str(self.path), f"{length} more bytes", len(part), "truncated file"
            )
        self._position += length
        return part

    def unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(layout, self.bytes(struct.calcsize(layout)))


def _field(cursor: _Cursor) -> tuple[str, NDArray[Any]]:
    (length,) = cursor.unpack("<H")
    name = cursor.bytes(length).decode("ascii", errors="replace")
    rank, kind, offset = cursor.unpack("<HBQ")
    what = f"{cursor.path}: field {name!r}"
    if rank > HIGHEST_RANK or kind not in TYPES:
        raise scene_error(what, f"rank <= {HIGHEST_RANK} and a known type", (rank, kind))
    shape = cursor.unpack(f"<{rank}Q")
    dtype = np.dtype(TYPES[kind])
    n_values = math.prod(shape)  # Python integers: absurd sizes cannot wrap around
    if offset + n_values * dtype.itemsize > len(cursor.content):
        raise scene_error(
            what, f"data within {len(cursor.content)} bytes", str(shape), "truncated file"
        )
    return name, np.frombuffer(cursor.content, dtype, n_values, offset).reshape(shape)
