r"""Correlation at all rotations of a coarse grid, from the low degrees.

The grid is made of orbits: with R it holds h R g for all half turns h, g about the axes
(the group of four, 1 included). In real harmonics :math:`\Delta^j(h)` is diagonal with
entries +-1, so the coefficients fall into 4 x 4 classes by the signs of their row and
column, and

.. math:: C(h R g) = \sum_{p,q} \chi_p(h)\, \chi_q(g)\, V_{pq}(R),

where :math:`V_{pq}` sums the coefficients of one class. One orbit of 16 rotations thus costs
as much as one rotation, and a Walsh-Hadamard transform of 16 values.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from reflfield.sphere.wigner import block_offsets, rotation_blocks

# Degrees 0 .. 5 vary over about 70 degrees; 2,048 rotations lie 18 degrees apart.
COARSE_DEGREES = 6
COARSE_ORBITS = 128
ORBIT = 16
# Half turns about no axis, z, x and y, as quaternions (w, x, y, z). The order makes the
# characters the rows of a Walsh-Hadamard matrix.
HALF_TURNS = np.array([[1.0, 0, 0, 0], [0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]])
RELAXATION_STEPS = 40
# A maximum below this share of the way from the mean to the highest is not kept.
LOWEST_SHARE = 0.4
NEVER = -3e38


@dataclass(frozen=True, eq=False)
class CoarseGrid:
    """Nearly uniform rotations with what the coarse step needs of them.

    Parameters
    ----------
    rotations : (16 n, 3, 3) float64
        Orbit by orbit of half turns, n rotations each.
    columns : (k,) int64
        Coefficients of the low degrees, class by class.
    starts : (17,) int64
        First column of each class.
    blocks : tuple of 16 (k_class, n) float
        Real Wigner matrix elements of one rotation per orbit.
    neighbours : (16 n, 10) int32
        Nearest other rotations.
    allowed : (16 n,) bool
        False where the tilt is too large.
    """

    rotations: NDArray[np.float64]
    columns: NDArray[np.int64]
    starts: NDArray[np.int64]
    blocks: tuple[NDArray[np.floating], ...]
    neighbours: NDArray[np.int32]
    allowed: NDArray[np.bool_]


def _product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion products, (w, x, y, z) last."""
    w, v = a[..., :1], a[..., 1:]
    w2, v2 = b[..., :1], b[..., 1:]
    vector = w * v2 + w2 * v + np.cross(v, v2)
    return np.concatenate([w * w2 - np.sum(v * v2, axis=-1, keepdims=True), vector], axis=-1)


def _orbits(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4, n, 4): h q g for all half turns."""
    return _product(_product(HALF_TURNS[:, None, None], q), HALF_TURNS[:, None])


@lru_cache(maxsize=4)
def orbit_representatives(n_orbits: int) -> NDArray[np.float64]:
    r"""Quaternions whose orbits together cover all rotations evenly, (n, 4).

    Super-Fibonacci rotations, then steps of decreasing length along the repulsion
    :math:`\sum 1 / |q - q'|^8` of all members of all orbits.

    References
    ----------
    M. Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", CVPR 2022.

    Examples
    --------
    >>> orbit_representatives(8).shape
    (8, 4)
    """
    s = np.arange(n_orbits) + 0.5
    r, big_r = np.sqrt(s / n_orbits), np.sqrt(1.0 - s / n_orbits)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    parts = [big_r * np.cos(beta), r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta)]
    q = np.stack(parts, axis=1)
    itself = np.arange(n_orbits)
    for step in np.linspace(0.05, 0.001, RELAXATION_STEPS):
        others = _orbits(q).reshape(-1, 4)
        cosine = q @ others.T
        # q and -q are one rotation.
        squares = np.maximum(2.0 - 2.0 * np.abs(cosine), 1e-6)
        pull = np.sign(cosine) * squares**-5
        pull[itself, itself] = 0.0
        force = -pull @ others
        force -= np.sum(force * q, axis=1, keepdims=True) * q
        q = q + step * force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-300)
        q /= np.linalg.norm(q, axis=1, keepdims=True)
    return q


def _classes(n_degrees: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Coefficients sorted by class, and where each class starts."""
    half_turns = Rotation.from_quat(HALF_TURNS[1:3], scalar_first=True).as_matrix()
    flat = rotation_blocks(half_turns, n_degrees)
    offsets = block_offsets(n_degrees)
    labels = []
    for j in range(n_degrees):
        blocks = flat[:, offsets[j] : offsets[j + 1]].reshape(2, 2 * j + 1, 2 * j + 1)
        negative = np.diagonal(blocks, axis1=1, axis2=2) < 0
        character = negative[0] + 2 * negative[1]
        labels.append((4 * character[:, None] + character[None, :]).ravel())
    label = np.concatenate(labels)
    starts = np.concatenate([[0], np.cumsum(np.bincount(label, minlength=ORBIT))])
    return np.argsort(label, kind="stable"), starts


@lru_cache(maxsize=8)
def coarse_grid(
    n_degrees: int, n_orbits: int, max_tilt: float | None, dtype: str
) -> CoarseGrid:
    """Grid of 16 n_orbits rotations.

    Parameters
    ----------
    n_degrees : int
        Low degrees used.
    n_orbits : int
    max_tilt : float or None
        Largest tilt of z that is allowed, radians. Rotations a little beyond are kept, tilted
        back to it, so that maxima at the limit have a start.
    dtype : {"float32", "float64"}
        Of the blocks.

    Examples
    --------
    >>> coarse_grid(3, 8, None, "float32").rotations.shape
    (128, 3, 3)
    """
    one = orbit_representatives(n_orbits)
    q = _orbits(one).reshape(-1, 4)
    columns, starts = _classes(n_degrees)
    matrices = Rotation.from_quat(one, scalar_first=True).as_matrix()
    blocks = rotation_blocks(matrices, n_degrees).T[columns].astype(dtype)
    rotations = Rotation.from_quat(q, scalar_first=True).as_matrix()
    allowed = np.ones(len(q), bool)
    if max_tilt is not None:
        spacing = (2.0 * np.pi**2 / len(q)) ** (1 / 3) * 2.0
        allowed = rotations[:, 2, 2] >= np.cos(min(max_tilt + spacing, np.pi))
        rotations = tilted_back(rotations, max_tilt)
    tree = cKDTree(np.concatenate([q, -q]))
    nearest = tree.query(q, k=11)[1][:, 1:] % len(q)
    return CoarseGrid(
        rotations,
        columns,
        starts,
        tuple(np.ascontiguousarray(blocks[a:b]) for a, b in pairwise(starts)),
        np.ascontiguousarray(nearest, dtype=np.int32),
        allowed,
    )


def tilted_back(rotations: NDArray[np.float64], max_tilt: float) -> NDArray[np.float64]:
    """Rotations, rotated about a horizontal axis until z is tilted by at most `max_tilt`.

    Examples
    --------
    >>> upright = tilted_back(np.diag([1.0, -1, -1])[None], np.pi / 2)
    >>> bool(abs(upright[0, 2, 2]) < 1e-12)
    True
    """
    z = rotations[:, :, 2]
    excess = np.maximum(np.arccos(np.clip(z[:, 2], -1, 1)) - max_tilt, 0.0)
    axis = np.stack([z[:, 1], -z[:, 0], np.zeros(len(z))], axis=1)
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    axis = np.where(length > 0, axis / np.where(length > 0, length, 1), [1.0, 0.0, 0.0])
    return Rotation.from_rotvec(axis * excess[:, None]).as_matrix() @ rotations


@numba.njit(cache=True, nogil=True)
def _is_maximum(row: NDArray[np.floating], g: int, neighbours: NDArray[np.int32]) -> bool:
    """Whether no neighbour is higher; of equal ones the first counts."""
    for other in neighbours:
        if row[other] > row[g] or (row[other] == row[g] and other < g):
            return False
    return True


@numba.njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
def _largest(row: NDArray[np.floating]) -> float:
    largest = row[0]
    for k in range(row.shape[0]):
        largest = max(largest, row[k])
    return largest


@numba.njit(cache=True, nogil=True)
def _highest_maxima(
    row: NDArray[np.floating],
    lowest: float,
    neighbours: NDArray[np.int32],
    peaks: NDArray[np.int32],
) -> None:
    """The highest local maxima of one row above `lowest`, best first; -1: fewer."""
    n_peaks = peaks.shape[0]
    peaks[:] = -1
    for g in range(row.shape[0]):
        v = row[g]
        if v < lowest:
            continue
        last = peaks[n_peaks - 1]
        if (last >= 0 and v <= row[last]) or not _is_maximum(row, g, neighbours[g]):
            continue
        p = n_peaks - 1
        while p > 0 and (peaks[p - 1] < 0 or row[peaks[p - 1]] < v):
            peaks[p] = peaks[p - 1]
            p -= 1
        peaks[p] = g


@numba.njit(cache=True, nogil=True)
def _hadamard(planes: NDArray[np.floating], i: int, row: NDArray[np.floating]) -> None:
    """Values of all orbit members from those of the 16 classes, into `row`."""
    n = planes.shape[2]
    for c in range(ORBIT):
        part = row[c * n : (c + 1) * n]
        plane = planes[c, i]
        for k in range(n):
            part[k] = plane[k]
    half = 1
    while half < ORBIT:
        for c in range(ORBIT):
            if c & half == 0:
                low, high = row[c * n : (c + 1) * n], row[(c + half) * n : (c + half + 1) * n]
                for k in range(n):
                    a, b = low[k], high[k]
                    low[k], high[k] = a + b, a - b
        half *= 2


@numba.njit(cache=True, nogil=True)
def _peaks(
    planes: NDArray[np.floating],
    mean: NDArray[np.floating],
    allowed: NDArray[np.bool_],
    neighbours: NDArray[np.int32],
    peaks: NDArray[np.int32],
    heights: NDArray[np.float64],
) -> None:
    row = np.zeros(ORBIT * planes.shape[2], planes.dtype)
    everywhere = np.all(allowed)
    for i in range(planes.shape[1]):
        _hadamard(planes, i, row)
        if not everywhere:
            for g in range(row.shape[0]):
                if not allowed[g]:
                    row[g] = NEVER
        heights[i] = _largest(row)
        lowest = mean[i] + LOWEST_SHARE * (heights[i] - mean[i])
        _highest_maxima(row, min(lowest, heights[i]), neighbours, peaks[i])


def coarse_peaks(
    series: NDArray[np.floating], n_degrees: int, n_peaks: int, max_tilt: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Highest local maxima of each series on the coarse grid.

    Parameters
    ----------
    series : (n, k) float
        See `reflfield.alignment.correlation.spectrum`.
    n_degrees : int
        Degrees that the series has.
    n_peaks : int
        Maxima wanted.
    max_tilt : float or None
        Radians.

    Returns
    -------
    rotations : (n, n_peaks, 3, 3) float64
        NaN where there are fewer.
    heights : (n,) float64
        Highest value.
    """
    grid = coarse_grid(
        min(n_degrees, COARSE_DEGREES), COARSE_ORBITS, max_tilt, str(series.dtype)
    )
    low = series[:, grid.columns]
    planes = np.zeros((ORBIT, len(series), COARSE_ORBITS), series.dtype)
    for c, block in enumerate(grid.blocks):
        if len(block):
            np.matmul(low[:, grid.starts[c] : grid.starts[c + 1]], block, out=planes[c])
    peaks = np.full((len(series), n_peaks), -1, np.int32)
    heights = np.zeros(len(series))
    _peaks(planes, series[:, 0], grid.allowed, grid.neighbours, peaks, heights)
    rotations = np.where(peaks[:, :, None, None] >= 0, grid.rotations[peaks], np.nan)
    return rotations, heights
