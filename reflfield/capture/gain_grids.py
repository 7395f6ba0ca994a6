r"""Gain grids: what the values of a photograph are multiplied by, from place to place.

A grid holds gains :math:`g_{rc}` at evenly spaced nodes, row 0 at the top and column 0 at the
left of the image. Between them they are interpolated bilinearly. A pixel whose centre lies
:math:`u` columns and :math:`v` rows of the grid from node 0, 0, with
:math:`c = \lfloor u \rfloor, s = u - c, r = \lfloor v \rfloor, t = v - r`, has

.. math::

    g = (1-t)\,[(1-s)\,g_{rc} + s\,g_{r,c+1}] + t\,[(1-s)\,g_{r+1,c} + s\,g_{r+1,c+1}]

and the radiance :math:`g\,(P / t_P - D / t_D)`, dark frame :math:`D` taken off before. Samples,
silhouettes and comparisons all read this product. What is saturated or too dark stays so. Only
the nodes are kept; the gains of the pixels are made while a photograph is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.documents import number, number_array
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# More nodes than any measured grid has (256 x 256), so that reading one stays cheap.
MOST_NODES = 65_536
# Products with radiances up to 1e29 stay finite in single precision; squares of distances in
# millimetres, which a grid may hold, lie well inside.
LEAST_GAIN, LARGEST_GAIN = 1e-9, 1e9
EDGES = ("left", "top", "right", "bottom")
# Pixels may lie this share of the distance of two nodes outside of the outermost nodes.
OVERHANG = 0.5
# Rows of an image for which gains are made at once.
ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class GainGrid:
    """Gains at evenly spaced places of an image.

    Parameters
    ----------
    left, top, right, bottom : float
        Pixel coordinates of the outermost nodes: 0, 0 is the top left corner of the image,
        the centre of its first pixel is 0.5, 0.5.
    values : tuple of tuple of float
        Gains of each row of nodes, from left to right, the top row first; at least two rows of
        two. A sequence of sequences becomes that.

    Raises
    ------
    CaptureError
        If there are too few or too many nodes, rows of different lengths, a gain outside of
        `LEAST_GAIN` to `LARGEST_GAIN`, or edges in another order.

    Examples
    --------
    Between two nodes, 4 pixels apart:

    >>> grid = GainGrid(0.5, 0.5, 4.5, 1.5, ((1.0, 3.0), (1.0, 3.0)))
    >>> grid.at(np.array([0.5, 2.5, 3.5]), np.array([1.0]))
    array([[1. , 2. , 2.5]], dtype=float32)
    """

    left: float
    top: float
    right: float
    bottom: float
    values: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        for name in EDGES:
            object.__setattr__(self, name, number(getattr(self, name), name))
        for low, high in (("left", "right"), ("top", "bottom")):
            if not getattr(self, low) < getattr(self, high):
                raise CaptureError(
                    f"{low}, {high}: expected {low} < {high} in pixels, received "
                    f"{getattr(self, low)} and {getattr(self, high)}; exchange them"
                )
        object.__setattr__(self, "values", _checked_values(self.values))

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance of neighbouring nodes along x and y, pixels."""
        rows, columns = len(self.values), len(self.values[0])
        return (self.right - self.left) / (columns - 1), (self.bottom - self.top) / (rows - 1)

    def at(self, x: Array, y: Array) -> Float32:
        """Gains at all pairs of coordinates x (w,) and y (h,), (h, w) float32.

        Outside of the grid they are those of its nearest edge.
        """
        nodes = np.array(self.values)
        left, along_x = _between(x, self.left, self.spacing[0], nodes.shape[1])
        upper, along_y = _between(y, self.top, self.spacing[1], nodes.shape[0])
        across = nodes[:, left] * (1 - along_x) + nodes[:, left + 1] * along_x
        below = across[upper + 1] * along_y[:, None]
        return (across[upper] * (1 - along_y[:, None]) + below).astype(np.float32)

    def multiply(self, image: Float32, what: str) -> Float32:
        """Multiply an image (h, w, 3) by the gains of its pixels, in place; return it.

        Raises
        ------
        CaptureError
            As `check_covers`.
        """
        height, width = image.shape[:2]
        self.check_covers(width, height, what)
        x, y = (np.arange(n, dtype=np.float64) + 0.5 for n in (width, height))
        for first in range(0, height, ROWS_AT_ONCE):
            rows = slice(first, first + ROWS_AT_ONCE)
            image[rows] *= self.at(x, y[rows])[..., None]
        return image

    def check_covers(self, width: int, height: int, what: str) -> None:
        """Demand that the nodes lie around all pixels, but for `OVERHANG` of their distance.

        Parameters
        ----------
        width, height : int
            Of the image, pixels.
        what : str
            File or photograph, named in messages.

        Raises
        ------
        CaptureError
        """
        sizes = ("left", "right", width), ("top", "bottom", height)
        for (low, high, size), spacing in zip(sizes, self.spacing, strict=True):
            first, last = getattr(self, low), getattr(self, high)
            if max(first - 0.5, size - 0.5 - last) > OVERHANG * spacing:
                raise CaptureError(
                    f"{what}: gain: expected nodes around all pixels, {low} 0.5 and {high} "
                    f"{size - 0.5} of {width} x {height}, received {first:.6g} and "
                    f"{last:.6g}; measure gains over the whole image, or crop the photographs"
                )


def gain_grid(entry: Mapping[str, Any], what: str) -> GainGrid:
    """The gain grid that a description states.

    Parameters
    ----------
    entry : mapping
        ``left``, ``top``, ``right``, ``bottom``, ``values`` of `GainGrid`.
    what : str
        File and entry, named in messages.

    Raises
    ------
    CaptureError
        If keys are missing or others are there, or as `GainGrid`.

    Examples
    --------
    >>> entry = {"left": 0, "top": 0, "right": 8, "bottom": 6, "values": [[1, 2], [1, 0]]}
    >>> gain_grid(entry, "capture.json: gain")
    Traceback (most recent call last):
    reflfield.errors.CaptureError: capture.json: gain: values[1][1]: expected a gain of ...
    """
    keys = {*EDGES, "values"}
    if not isinstance(entry, Mapping) or set(entry) != keys:
        received = sorted(entry) if isinstance(entry, Mapping) else entry
        raise CaptureError(
            f"{what}: expected the keys {', '.join((*EDGES, 'values'))}, received "
            f"{quoted(received)}; add what is missing, remove others"
        )
    try:
        return GainGrid(**entry)
    except CaptureError as error:
        raise CaptureError(f"{what}: {error}") from error


def gain_entry(grid: GainGrid) -> dict[str, Any]:
    """The entry of a description that `gain_grid` reads."""
    edges: dict[str, Any] = {name: getattr(grid, name) for name in EDGES}
    return edges | {"values": [list(row) for row in grid.values]}


def check_node_count(rows: int, columns: int) -> None:
    """Refuse grids that nothing can be interpolated in, or that are too large.

    Raises
    ------
    CaptureError
    """
    if rows < 2 or columns < 2:
        raise CaptureError(
            f"values: expected at least 2 rows of 2 gains, received {rows} x {columns}; "
            "repeat the row or column, or state a constant factor in the light's intensity"
        )
    if rows * columns > MOST_NODES:
        raise CaptureError(
            f"values: expected at most {MOST_NODES:,} gains, received {rows:,} x {columns:,}; "
            "leave out rows and columns: between them gains are interpolated"
        )


def _checked_values(values: Any) -> tuple[tuple[float, ...], ...]:
    rows = values if isinstance(values, list | tuple) else []
    columns = len(rows[0]) if rows and isinstance(rows[0], list | tuple) else 0
    check_node_count(len(rows), columns)
    for i, row in enumerate(rows):
        if not isinstance(row, list | tuple) or len(row) != columns:
            raise CaptureError(
                f"values[{i}]: expected {columns} gains as the first row has, received "
                f"{quoted(row)}; all rows have the same length"
            )
    gains = number_array([list(row) for row in rows], [(len(rows), columns)], "values")
    bad = np.argwhere(~((gains >= LEAST_GAIN) & (gains <= LARGEST_GAIN)))
    if len(bad):
        row, column = bad[0]
        raise CaptureError(
            f"values[{row}][{column}]: expected a gain of {LEAST_GAIN:g} to {LARGEST_GAIN:g}, "
            f"received {gains[row, column]:g}; what is not lit at all needs a mask, not a gain"
        )
    return tuple(tuple(row) for row in gains.tolist())


def _between(
    coordinates: Array, first: float, spacing: float, n_nodes: int
) -> tuple[NDArray[np.intp], Array]:
    """Index of the node before each coordinate, and the share of the way to the next."""
    place = np.clip((coordinates - first) / spacing, 0, n_nodes - 1)
    before = np.minimum(place.astype(np.intp), n_nodes - 2)
    return before, place - before
