"""Mean over the texels of a BTF, as the paper SparseBTF (2023) publishes it: a sample of 1 x 1.

``NAME_mean_std.bin`` holds, as doubles, means and deviations of a third of log Y + log U + log
V for each view (rows) and light (columns), the light's cosine included; ``xyz_loc.bin`` the
directions, x, y, z and a number of each in four rows. The value of a nearly grey material
follows: exp(3 mean).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reflfield.capture.btf import MOST_DIRECTIONS, SUFFIX, Btf
from reflfield.errors import CaptureError
from reflfield.util.files import read_bytes

DIRECTIONS, PATTERN = "xyz_loc.bin", "*_mean_std.bin"


def holds_btf(path: Path) -> bool:
    """Whether a path is a BTF container or a folder of means, not a capture."""
    means = (path / DIRECTIONS).is_file() and any(path.glob(PATTERN))
    return means or path.suffix.lower() == SUFFIX


def read_btf_means(folder: Path) -> Btf:
    """Read the means in a folder as a sample of one texel.

    Raises
    ------
    CaptureError
        If there are means of several materials, or their number is not that of the
        directions, squared, twice.
    """
    files = sorted(folder.glob(PATTERN))
    if len(files) != 1:
        raise CaptureError(f"{folder}: expected one {PATTERN}, received {len(files)}")
    places = np.frombuffer(read_bytes(folder / DIRECTIONS, 32 * MOST_DIRECTIONS, CaptureError))
    content = read_bytes(files[0], 16 * MOST_DIRECTIONS**2, CaptureError)
    n = len(places) // 4
    if n == 0 or len(places) != 4 * n or len(content) != 16 * n * n:
        raise CaptureError(
            f"{files[0]}: expected means and deviations of {n} x {n} directions, "
            f"{16 * n * n:,} bytes, received {len(content):,}"
        )
    means = np.frombuffer(content).reshape(2, n, n)[0]
    directions = places.reshape(4, n)[:3].T
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    if not (np.isfinite(means).all() and (np.abs(lengths - 1) < 0.01).all()):
        raise CaptureError(f"{folder}: expected finite means and unit directions")
    table = np.repeat(np.exp(3 * means.reshape(1, -1)), 3, axis=1)
    unit = directions / lengths
    return Btf(1, 1, unit, unit, True, ((None, table),), lambda stored: stored)
