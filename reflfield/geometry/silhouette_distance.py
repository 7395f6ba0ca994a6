"""Signed distance to the outline of an anti-aliased silhouette."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from reflfield.errors import GeometryError, InputError
from reflfield.util.validation import check_shape

Array = NDArray[np.float64]

# Half length of the piece of straight outline that one crossing stands for, pixels:
# crossings are one row (or column) apart, at most the diagonal of a pixel along the outline.
_HALF_PIECE = 0.75

# Squares of distances below this, pixels, are exact in single precision.
EXACT_PX = 1024

# Within this distance of the outline, pixels, distances are measured to its pieces;
# beyond, to the nearest crossing (an error of at most _HALF_PIECE^2 / 2 / distance).
_FINE_BAND = 4.0


@dataclass(frozen=True, eq=False)
class SignedDistance:
    """Distance to the outline of one silhouette, sampled at pixel centres.

    Parameters
    ----------
    stored : (height, width) float32, or Path
        Pixels; positive inside the object; or the file (npy) that holds them.
    outline : (n, 2) float64
        Sub-pixel points of the outline, continuous pixel coordinates.
    rim : (k, 2) float64
        Points on the border of the image at pixels that the object covers.
    """

    stored: NDArray[np.float32] | Path
    outline: Array
    rim: Array

    @property
    def values(self) -> NDArray[np.float32]:
        """Distances (height, width), pixels; of a file, no more in memory than is looked at."""
        if isinstance(self.stored, Path):
            distances: NDArray[np.float32] = np.load(self.stored, mmap_mode="r")
            return distances
        return self.stored

    def moved_to(self, path: Path) -> SignedDistance:
        """The same distances, kept in a file (npy) instead of in memory."""
        np.save(path, self.values)
        return replace(self, stored=path)

    @property
    def leaves_image(self) -> bool:
        """True if the object touches the border of the image.

        What lies outside the frame is then unknown instead of empty.
        """
        return len(self.rim) > 0

    def at(self, pixels: Array) -> Array:
        """Signed distance at continuous pixel coordinates (n, 2), anywhere.

        Outside the frame the answer continues with slope 1: downwards (empty) if the
        object is in the frame as a whole, upwards (unknown, so nothing is carved) if not.
        NaN where a coordinate is.
        """
        out = np.full(len(pixels), np.nan)
        _look_up(np.asarray(self.values), pixels, self.leaves_image, out)
        return out


@numba.njit(cache=True, nogil=True)
def _look_up(values: Any, pixels: Any, leaves_image: bool, out: Any) -> None:
    """`SignedDistance.at`: bilinear between the centres of pixels; `out` is NaN before."""
    height, width = values.shape
    for n in range(len(pixels)):
        x, y = pixels[n, 0], pixels[n, 1]
        if np.isnan(x) or np.isnan(y):
            continue
        in_x, in_y = min(max(x, 0.0), float(width)), min(max(y, 0.0), float(height))
        beyond = np.hypot(x - in_x, y - in_y)
        column = min(max(in_x - 0.5, 0.0), width - 1.0)
        row = min(max(in_y - 0.5, 0.0), height - 1.0)
        c, r = min(int(column), max(width - 2, 0)), min(int(row), max(height - 2, 0))
        c_next, r_next = min(c + 1, width - 1), min(r + 1, height - 1)
        fx, fy = column - c, row - r
        upper = (1.0 - fx) * values[r, c] + fx * values[r, c_next]
        lower = (1.0 - fx) * values[r_next, c] + fx * values[r_next, c_next]
        inside = (1.0 - fy) * upper + fy * lower
        if not leaves_image:
            out[n] = inside - beyond
        elif beyond > 0.0:
            out[n] = beyond
        else:
            # Continuous across the border: emptiness fades to "unknown" within the frame.
            to_border = min(in_x, in_y, width - in_x, height - in_y)
            out[n] = max(inside, -to_border)


def signed_distance(
    silhouette: NDArray[np.floating], name: str = "silhouette"
) -> SignedDistance:
    """Signed distance to the outline, to a few hundredths of a pixel.

    The outline crosses between two neighbouring pixels whose coverages lie on either
    side of one half. Along a row the coverages of a straight edge add up to its position,
    exactly for every slope up to 45 degrees (columns serve the steeper ones); where the
    pixels beside do not run from full to empty (thin parts), the crossing is
    interpolated linearly. Distances are measured to short straight pieces of outline
    through these crossings.

    Parameters
    ----------
    silhouette : (height, width) float
        Coverage in [0, 1].
    name : str
        Quoted in messages.

    Returns
    -------
    SignedDistance

    Raises
    ------
    GeometryError
        If nothing, or everything, is covered.
    InputError
        If a value is not in [0, 1].

    Examples
    --------
    An edge at x = 2.25, a quarter into the third pixel:

    >>> coverage = np.tile([1.0, 1.0, 0.25, 0.0, 0.0], (5, 1))
    >>> signed_distance(coverage).values[2]
    array([ 1.75,  0.75, -0.25, -1.25, -2.25], dtype=float32)
    """
    coverage = _checked(silhouette, name)
    covered = coverage >= 0.5
    points, normals = _outline(coverage)
    values = _coarse_distance(covered)
    near = np.abs(values) <= _FINE_BAND
    row, col = np.nonzero(near)
    centres: Array = np.stack([col, row], axis=1).astype(np.float64) + 0.5
    values[near] = np.where(covered[near], 1.0, -1.0) * _distance_to_pieces(
        centres, points, normals
    )
    return SignedDistance(values, points, _rim_points(covered))


def _checked(silhouette: NDArray[np.floating], name: str) -> NDArray[np.floating]:
    coverage = np.asarray(silhouette)
    check_shape(name, coverage, (None, None))
    if not ((coverage >= 0.0) & (coverage <= 1.0)).all():
        raise InputError(
            f"{name}: expected coverage in [0, 1], received {coverage.min():.4g} .. "
            f"{coverage.max():.4g}; divide 8-bit silhouettes by 255"
        )
    share = float((coverage >= 0.5).mean())
    if share in (0.0, 1.0):
        seen = "no" if share == 0.0 else "every"
        raise GeometryError(
            f"{name}: expected the outline of an object, received {seen} pixel covered; "
            "check the silhouette or leave the view out"
        )
    return coverage


def _coarse_distance(covered: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Signed distance of pixel centres to the boundary between pixels, about half a pixel."""
    inside, outside = (
        _repeatable(
            cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        )
        for part in (covered, ~covered)
    )
    half = np.float32(0.5)
    return np.where(covered, inside - half, half - outside)


def _repeatable(distance: NDArray[np.floating]) -> NDArray[np.float32]:
    """Distances between pixels, whose squares are whole numbers, rounded correctly.

    The last bit of OpenCV's depends on where in memory its arrays lie; that of a hull must not.
    Squares of far ones are no longer told apart in single precision: an eighth of a pixel is.
    """
    near = np.sqrt(np.rint(distance * distance))
    far = np.rint(8 * distance) / 8
    return np.asarray(np.where(distance < EXACT_PX, near, far), np.float32)


def _rim_points(covered: NDArray[np.bool_]) -> Array:
    """Points on the border of the frame beside covered pixels, (k, 2)."""
    height, width = covered.shape
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    return np.concatenate(
        [
            np.stack([x, np.zeros(width)], axis=1)[covered[0]],
            np.stack([x, np.full(width, float(height))], axis=1)[covered[-1]],
            np.stack([np.zeros(height), y], axis=1)[covered[:, 0]],
            np.stack([np.full(height, float(width)), y], axis=1)[covered[:, -1]],
        ]
    )


def _outline(coverage: NDArray[np.floating]) -> tuple[Array, Array]:
    """Points of the outline and unit normals into the object, both (n, 2) as (x, y)."""
    along_x, along_y = _crossings(coverage), _crossings(coverage.T)
    points = np.concatenate([along_x[0], along_y[0][:, ::-1]])
    normals = np.concatenate([along_x[1], along_y[1][:, ::-1]])
    return points, normals


def _slopes(
    coverage: NDArray[np.floating], row: NDArray[np.intp], col: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Sobel's derivatives along and across the rows at some pixels, (n,).

    Derivative of a 3 x 3 neighbourhood; the pixel's own box filter is too narrow.
    """
    rows = [np.clip(row + step, 0, coverage.shape[0] - 1) for step in (-1, 0, 1)]
    cols = [np.clip(col + step, 0, coverage.shape[1] - 1) for step in (-1, 0, 1)]
    beside = np.array([[coverage[r, c] for c in cols] for r in rows], dtype=np.float64)
    along, across = beside[:, 2] - beside[:, 0], beside[2] - beside[0]
    return 2.0 * along[1] + (along[0] + along[2]), 2.0 * across[1] + (across[0] + across[2])


def _crossings(coverage: NDArray[np.floating]) -> tuple[Array, Array]:
    """Crossings of the level one half between horizontal neighbours.

    Where the outline is nearer to horizontal, the vertical neighbours measure it better
    and are left to do so.
    """
    covered = coverage >= 0.5
    row, col = np.nonzero(covered[:, :-1] != covered[:, 1:])
    left, right = _slopes(coverage, row, col), _slopes(coverage, row, col + 1)
    normal: Array = np.stack([left[0] + right[0], left[1] + right[1]], axis=1)
    length = np.hypot(*normal.T)
    # Where slopes cancel (a line one pixel wide) the two pixels still tell the direction.
    flat = length < 1e-6
    normal[flat] = np.stack(
        [np.sign(coverage[row, col + 1] - coverage[row, col])[flat], np.zeros(flat.sum())],
        axis=1,
    )
    normal /= np.where(flat, 1.0, length)[:, None]
    steep = np.abs(normal[:, 0]) >= np.sqrt(0.5) - 0.05
    row, col, normal = row[steep], col[steep], normal[steep]
    x = _edge_position(coverage, row, col)
    return np.stack([x, row + 0.5], axis=1), normal


def _edge_position(
    coverage: NDArray[np.floating], row: NDArray[np.intp], col: NDArray[np.intp]
) -> Array:
    """Position of the outline between pixel centres `col` and `col + 1`."""
    last = coverage.shape[1] - 1
    window: Array = np.stack(
        [coverage[row, np.clip(col + step, 0, last)] for step in (-1, 0, 1, 2)], axis=1
    ).astype(np.float64)
    falling = window[:, 1] > window[:, 2]
    ordered = np.where(falling[:, None], window, window[:, ::-1])
    full_to_empty = (ordered[:, 0] > 0.99) & (ordered[:, 3] < 0.01)
    # Four pixels from full to empty: their sum is the length of the covered part.
    length = ordered.sum(axis=1)
    summed = np.where(falling, col - 1.0 + length, col + 3.0 - length)
    before, after = window[:, 1], window[:, 2]
    interpolated = col + 0.5 + (0.5 - before) / (after - before)
    return np.where(full_to_empty, np.clip(summed, col, col + 2.0), interpolated)


def _distance_to_pieces(centres: Array, points: Array, normals: Array) -> Array:
    """Distance of pixel centres to the nearest straight pieces of outline."""
    n_nearest = min(4, len(points))
    _, index = KDTree(points).query(centres, k=n_nearest)
    index = index.reshape(len(centres), n_nearest)
    offset = centres[:, None, :] - points[index]
    across = (offset * normals[index]).sum(axis=2)
    along = np.abs(offset[..., 0] * normals[index, 1] - offset[..., 1] * normals[index, 0])
    return np.hypot(across, np.maximum(along - _HALF_PIECE, 0.0)).min(axis=1)
