"""Grids on the upper hemisphere and their interpolation.

One interpolation serves resampling, refinement, fitting and rendering: a
function of direction lives on ``side * side`` nodes of the equal-area
concentric map (Shirley and Chiu, "A low distortion map between disk and
square", JGT 1997, followed by Lambert's equal-area lift of the disk), and is
bilinear in the square, four taps a direction. The first and last rows and
columns of nodes lie on the horizon, so the map has no seam.

Directions below the horizon are read at the horizon below or above them (same
azimuth): the caller decides whether such samples count.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.util.validation import check_shape

QUARTER_PI = np.pi / 4
# Half of the step by which the taps' positions are differenced, radians: well below the
# six degrees between nodes, well above the rounding of float32.
HALF_STEP = np.deg2rad(0.25)
# Directions this close to the frame's horizon are left out: a step could take them below.
LOWEST_Z = float(np.sin(np.deg2rad(1.0)))


@numba.njit(cache=True, nogil=True, inline="always")
def square_from_xyz(x: float, y: float, z: float) -> tuple[float, float]:
    """Concentric square coordinates in [-1, 1] of one direction."""
    # Lambert: disk radius sqrt(1 - z) on the hemisphere; the azimuth is that of (x, y).
    radius = np.sqrt(max(1.0 - max(z, 0.0), 0.0))
    if abs(x) < 1e-12 and abs(y) < 1e-12:
        return 0.0, 0.0
    if abs(x) >= abs(y):
        u = radius if x >= 0.0 else -radius
        return u, u * np.arctan(y / x) / QUARTER_PI
    v = radius if y >= 0.0 else -radius
    return v * np.arctan(x / y) / QUARTER_PI, v


@numba.njit(cache=True, nogil=True, inline="always")
def first_tap(coordinate: float, side: int) -> tuple[int, float]:
    """Lower node and the share of the upper one, for a coordinate in [-1, 1]."""
    position = (coordinate + 1.0) * 0.5 * (side - 1)
    lower = min(max(int(position), 0), side - 2)
    return lower, min(max(position - lower, 0.0), 1.0)


@numba.njit(cache=True, nogil=True)
def _taps(
    directions: NDArray[np.floating],
    side: int,
    nodes: NDArray[np.int32],
    weights: NDArray[np.float32],
) -> None:
    for i in range(directions.shape[0]):
        u, v = square_from_xyz(directions[i, 0], directions[i, 1], directions[i, 2])
        column, s = first_tap(u, side)
        row, t = first_tap(v, side)
        first = row * side + column
        nodes[i, 0] = first
        nodes[i, 1] = first + 1
        nodes[i, 2] = first + side
        nodes[i, 3] = first + side + 1
        weights[i, 0] = (1.0 - s) * (1.0 - t)
        weights[i, 1] = s * (1.0 - t)
        weights[i, 2] = (1.0 - s) * t
        weights[i, 3] = s * t


def direction_from_square(square: NDArray[np.floating]) -> NDArray[np.float64]:
    """Directions of concentric square coordinates; inverse of `square_from_xyz`.

    Parameters
    ----------
    square : (n, 2) float
        Coordinates in [-1, 1].

    Returns
    -------
    (n, 3) float64
        Unit vectors with z >= 0.

    Raises
    ------
    ShapeError
        If the shape is not (n, 2).

    Examples
    --------
    Half of the square's area holds half of the solid angle, z >= 1/2:

    >>> float(direction_from_square(np.array([[0.5 ** 0.5, 0.0]]))[0, 2].round(12))
    0.5
    """
    check_shape("square", square, (None, 2))
    u, v = np.asarray(square, dtype=np.float64).T
    along_u = np.abs(u) >= np.abs(v)
    radius = np.where(along_u, u, v)
    safe = np.where(radius == 0.0, 1.0, radius)
    angle = np.where(along_u, QUARTER_PI * v / safe, 2 * QUARTER_PI - QUARTER_PI * u / safe)
    z = 1.0 - radius**2
    # radius carries the sign, so opposite sides of the square need no cases.
    horizontal = radius * np.sqrt(np.maximum(2.0 - radius**2, 0.0))
    return np.stack([horizontal * np.cos(angle), horizontal * np.sin(angle), z], axis=1)


@dataclass(frozen=True)
class HemisphereGrid:
    """Nodes on the upper hemisphere with bilinear interpolation.

    Parameters
    ----------
    side : int
        Nodes along each side of the square, at least 2; ``side**2`` in all. A
        grid of `side` 1 has the zenith alone and interpolates a constant; it
        stands for a direction that does not vary (one light, one view).

    Raises
    ------
    InputError
        If `side` is below 1.

    Examples
    --------
    >>> grid = HemisphereGrid(3)
    >>> nodes, weights = grid.taps(np.array([[0.0, 0.0, 1.0]]))
    >>> int(nodes[0, np.argmax(weights[0])]), float(weights.sum())
    (4, 1.0)
    """

    side: int

    def __post_init__(self) -> None:
        if self.side < 1:
            raise InputError(f"side: expected at least 1 node, received {self.side}")

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return self.side**2

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """(n_nodes, 3) unit vectors of the nodes, index ``row * side + column``."""
        if self.side == 1:
            return np.array([[0.0, 0.0, 1.0]])
        axis = np.linspace(-1.0, 1.0, self.side)
        v, u = np.meshgrid(axis, axis, indexing="ij")
        return direction_from_square(np.stack([u.ravel(), v.ravel()], axis=1))

    @cached_property
    def solid_angles(self) -> NDArray[np.float64]:
        """(n_nodes,) integrals of the nodes' hat functions; they sum to 2 pi."""
        if self.side == 1:
            return np.array([2 * np.pi])
        share = np.full(self.side, 1.0 / (self.side - 1))
        share[[0, -1]] *= 0.5
        return 2 * np.pi * np.outer(share, share).ravel()

    def taps(
        self, directions: NDArray[np.floating]
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Nodes and weights whose sum interpolates at the directions.

        Parameters
        ----------
        directions : (n, 3) float
            Unit vectors in the frame of the grid.

        Returns
        -------
        nodes : (n, 4) int32
        weights : (n, 4) float32
            Non-negative, each row sums to 1.

        Raises
        ------
        ShapeError
            If the shape is not (n, 3).
        """
        check_shape("directions", directions, (None, 3))
        nodes = np.zeros((len(directions), 4), np.int32)
        weights = np.zeros((len(directions), 4), np.float32)
        if self.side == 1:
            weights[:, 0] = 1.0
        else:
            _taps(directions, self.side, nodes, weights)
        return nodes, weights


# Half width, as a cosine, of the band around the horizon in which the light's cosine is
# rounded off (4.6 degrees): frames are known to a few degrees, so a light just below a
# texel's horizon may still reach it.
HORIZON_SOFTNESS = 0.08


@numba.njit(cache=True, nogil=True, inline="always")
def softened_cosine_of(z: float) -> float:
    """Scalar `softened_cosine` for use in kernels."""
    if z >= HORIZON_SOFTNESS:
        return z
    if z <= -HORIZON_SOFTNESS:
        return 0.0
    return (z + HORIZON_SOFTNESS) ** 2 / (4.0 * HORIZON_SOFTNESS)


def softened_cosine(z: NDArray[np.floating]) -> NDArray[np.floating]:
    r"""Cosine of the light with a rounded foot at the horizon.

    .. math:: s(z) = z \;(z \ge w), \quad (z + w)^2 / 4w \;(|z| < w), \quad 0 \;(z \le -w)

    Once continuously differentiable. Fields hold samples divided by it: a sample
    includes the light's cosine, whose cube root has infinite slope at the horizon and
    would be lost between nodes.

    Parameters
    ----------
    z : ndarray of float
        Cosine of the angle between light and normal.

    Returns
    -------
    ndarray of float
        Not negative.

    Examples
    --------
    >>> softened_cosine(np.array([0.5, 0.0, -0.08]))
    array([0.5 , 0.02, 0.  ])
    """
    foot = (np.clip(z, -HORIZON_SOFTNESS, HORIZON_SOFTNESS) + HORIZON_SOFTNESS) ** 2
    return np.where(z >= HORIZON_SOFTNESS, z, foot / (4.0 * HORIZON_SOFTNESS))


@numba.njit(cache=True, nogil=True)
def place_directions(
    directions: NDArray[np.float64],
    frame: NDArray[np.float64],
    side: int,
    nodes: NDArray[np.int64],
    places: NDArray[np.float64],
) -> None:
    """First node (-1 below the horizon), shares s and t, and their six derivatives."""
    local, other = np.zeros(3), np.zeros(3)
    scale = 0.5 * (side - 1) / (2.0 * HALF_STEP)
    for i in range(directions.shape[0]):
        for k in range(3):
            local[k] = (
                frame[k, 0] * directions[i, 0]
                + frame[k, 1] * directions[i, 1]
                + frame[k, 2] * directions[i, 2]
            )
        if side == 1:
            nodes[i] = 0
            places[i] = 0.0
            continue
        if local[2] < LOWEST_Z:
            nodes[i] = -1
            continue
        u, v = square_from_xyz(local[0], local[1], local[2])
        column, places[i, 0] = first_tap(u, side)
        row, places[i, 1] = first_tap(v, side)
        nodes[i] = row * side + column
        for k in range(3):
            # Turning by w about axis k moves d by w x d.
            a, b = (k + 1) % 3, (k + 2) % 3
            other[0], other[1], other[2] = local[0], local[1], local[2]
            other[a], other[b] = (
                local[a] - HALF_STEP * local[b],
                local[b] + HALF_STEP * local[a],
            )
            u1, v1 = square_from_xyz(other[0], other[1], other[2])
            other[a], other[b] = (
                local[a] + HALF_STEP * local[b],
                local[b] - HALF_STEP * local[a],
            )
            u0, v0 = square_from_xyz(other[0], other[1], other[2])
            places[i, 2 + k] = (u1 - u0) * scale
            places[i, 5 + k] = (v1 - v0) * scale
