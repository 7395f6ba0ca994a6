r"""Calibrated lamps of relight's documented ``.dome``: the entries of ``lightsCalibration``.

Each entry corrects the photograph of one lamp. Its coefficients multiply radiance, as the table
of relight's documentation has it, and as its program multiplies pixels by ``ledAdjust``:

.. math::

    R' = R\,w\,g(x, y) \quad\text{or}\quad R' = R\,w\,a\,d^2

with ``whiteBalance`` :math:`w` (RGB), ``intensity`` :math:`a`, and the ``spatialCalibration``
:math:`g`, a grid of ``rows`` times ``cols`` values, ``width`` times ``height`` millimetres
large and centred on the image, the first value at its top left, bilinear between. The grid
includes the factor of the distance, and ``intensity`` does not count beside it. The
documentation writes the second formula with :math:`1/d^2`; that is how the light falls off,
and the program multiplies by :math:`d^2` (``ImageSet::compensateIntensity``).

:math:`R'` is the photograph as all lamps alike would have lit it, so :math:`1/(w\,a)` is what
this lamp gives: it becomes the light's intensity, and the photographs stay as they are. Where
there is a grid, it becomes the photograph's gain, and the light has the irradiance
:math:`1/w` at all distances. Cosines are not touched: grids of the light on a card that lies in
the image plane also hold the cosine there and have to be multiplied by it first.

References
----------
.. [1] Visual Computing Lab, ISTI-CNR, relight, "Dome configuration file format",
   relightlab/docs/formats/dome.html (lengths are millimetres; the earlier dome.md has
   centimetres, which only scales all).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.documents import number, number_array
from reflfield.capture.gain_grids import (
    LARGEST_GAIN,
    LEAST_GAIN,
    GainGrid,
    check_node_count,
)
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

Array = NDArray[np.float64]

KEY = "lightsCalibration"
GRID_KEY = "spatialCalibration"
MILLIMETRE = 1e-3
_GRID_KEYS = {"width", "height", "rows", "cols", "intensity"}
# Grids of which the logarithms fall with those of the squared distance at least this steeply
# look like light that was measured: a correction of the distance alone rises by 1.
MEASURED_LIGHT = -0.5


@dataclass(frozen=True)
class SpatialGrid:
    """Corrections on a grid over the image plane.

    Parameters
    ----------
    width, height : float
        Between the outermost values, metres.
    values : tuple of tuple of float
        Rows of corrections, the top row first.
    """

    width: float
    height: float
    values: tuple[tuple[float, ...], ...]

    def in_image(self, camera: Camera, what: str) -> GainGrid:
        """The same grid in the pixels of an orthographic camera that looks down on it.

        Raises
        ------
        CaptureError
            If it does not cover the image (`GainGrid.check_covers`).
        """
        x, y = self.width / 2 * camera.fl_x, self.height / 2 * camera.fl_y
        edges = camera.cx - x, camera.cy - y, camera.cx + x, camera.cy + y
        grid = GainGrid(*edges, self.values)
        try:
            grid.check_covers(camera.width, camera.height, what)
        except CaptureError as error:
            image = camera.width / camera.fl_x, camera.height / camera.fl_y
            raise CaptureError(
                f"{what}: expected a grid that covers the image, {image[0] / MILLIMETRE:.4g} x "
                f"{image[1] / MILLIMETRE:.4g} mm, received {self.width / MILLIMETRE:.4g} x "
                f"{self.height / MILLIMETRE:.4g} mm; correct imageWidth, measure a larger "
                "grid, or crop the photographs"
            ) from error
        return grid

    def places(self) -> Array:
        """World positions (rows * cols, 3) of the values on the plane z = 0, metres."""
        rows, columns = len(self.values), len(self.values[0])
        x = np.linspace(-self.width / 2, self.width / 2, columns)
        y = np.linspace(self.height / 2, -self.height / 2, rows)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return np.column_stack([grid, np.zeros(len(grid))])


@dataclass(frozen=True)
class LampCalibration:
    """What one entry says of its lamp.

    Parameters
    ----------
    white_balance : (3,) float64
        Factors of red, green and blue.
    intensity : float
        Factor of all three.
    grid : SpatialGrid, optional
        Factors over the image.
    """

    white_balance: Array = field(default_factory=lambda: np.ones(3))
    intensity: float = 1.0
    grid: SpatialGrid | None = None

    @property
    def strength(self) -> Array:
        """What the lamp gives relative to others, (3,) float64: one over the factors."""
        factor = self.white_balance * (self.intensity if self.grid is None else 1.0)
        return np.asarray(1 / factor, np.float64)


def lamp_calibrations(entries: Any, n_lights: int, what: str) -> list[LampCalibration]:
    """The calibrations of all lamps.

    Parameters
    ----------
    entries : object
        Value of ``lightsCalibration``.
    n_lights : int
    what : str
        File and key, named in messages.

    Raises
    ------
    CaptureError
        If there are more or fewer entries than lights, some have a grid and others do not, or
        a value is no positive number.

    Examples
    --------
    >>> red = {"whiteBalance": {"r": 0.5, "g": 1, "b": 1}, "intensity": 2}
    >>> lamp_calibrations([red], 1, "a.dome: lightsCalibration")[0].strength
    array([1. , 0.5, 0.5])
    """
    if not isinstance(entries, list) or len(entries) != n_lights:
        received = len(entries) if isinstance(entries, list) else quoted(entries)
        raise CaptureError(
            f"{what}: expected a list of one entry for each of {n_lights} lights, received "
            f"{received}; add those that are missing, {{}} for a lamp without corrections"
        )
    calibrations = [_calibration(entry, f"{what}[{i}]") for i, entry in enumerate(entries)]
    with_grid = [calibration.grid is not None for calibration in calibrations]
    if any(with_grid) and not all(with_grid):
        raise CaptureError(
            f"{what}[{with_grid.index(False)}]: expected a {GRID_KEY} as other lights have, "
            "received none; grids include the distance in a unit of their own, so nothing "
            "relates lamps with and without one: measure all, or remove all"
        )
    return calibrations


def notes_on_grids(
    calibrations: Sequence[LampCalibration], positions: Array, what: str
) -> tuple[str, ...]:
    """Notes on factors that count for nothing, and on grids that fall with the distance.

    Parameters
    ----------
    calibrations : sequence of LampCalibration
    positions : (n_lights, 3) float64
        Of the lamps, metres.
    what : str
        File and key, named in the notes.
    """
    pairs = [(c, p) for c, p in zip(calibrations, positions, strict=True) if c.grid is not None]
    notes = []
    unused = [c.intensity for c, _ in pairs if c.intensity != 1]
    if unused:
        notes.append(
            f"{what}: intensity of {len(unused)} lights not used: beside a {GRID_KEY} it does "
            "not count"
        )
    slopes = [_slope(c.grid, p) for c, p in pairs if c.grid is not None]
    if slopes and float(np.median(slopes)) < MEASURED_LIGHT:
        notes.append(
            f"{what}: the {GRID_KEY} of most lights is smaller where the lamp is farther, as "
            "light is and no correction of it; photographs are multiplied by it: if it is what "
            "was measured, write its reciprocals"
        )
    return tuple(notes)


def _slope(grid: SpatialGrid, position: Array) -> float:
    """Slope of the logarithm of corrections over that of the squared distance of the lamp."""
    squared = np.square(grid.places() - position).sum(axis=1)
    farther = np.log(squared) - np.log(squared).mean()
    values = np.log(np.array(grid.values)).ravel()
    spread = float(farther @ farther)
    # A lamp straight above is equally far from all: of it nothing follows.
    return float(farther @ values) / spread if spread > 1e-6 * len(values) else 0.0


def _calibration(entry: Any, what: str) -> LampCalibration:
    known = {"whiteBalance", "intensity", GRID_KEY}
    _check_entry(entry, known, set(), what)
    balance = entry.get("whiteBalance", {"r": 1, "g": 1, "b": 1})
    _check_entry(balance, set("rgb"), set("rgb"), f"{what}.whiteBalance")
    factors = [_factor(balance[name], f"{what}.whiteBalance.{name}") for name in "rgb"]
    grid = entry.get(GRID_KEY)
    return LampCalibration(
        np.array(factors),
        _factor(entry.get("intensity", 1), f"{what}.intensity"),
        None if grid is None else _grid(grid, f"{what}.{GRID_KEY}"),
    )


def _grid(entry: Any, what: str) -> SpatialGrid:
    _check_entry(entry, _GRID_KEYS, _GRID_KEYS, what)
    size = {name: number(entry[name], f"{what}.{name}") for name in _GRID_KEYS - {"intensity"}}
    for name, value in size.items():
        if not value > 0 or (name in ("rows", "cols") and value != int(value)):
            kind = "a whole number" if name in ("rows", "cols") else "a length in millimetres"
            raise CaptureError(
                f"{what}.{name}: expected {kind} above 0, received {quoted(entry[name])}"
            )
    rows, columns = int(size["rows"]), int(size["cols"])
    try:
        check_node_count(rows, columns)
    except CaptureError as error:
        raise CaptureError(f"{what}: {error}") from error
    listed = entry["intensity"]
    if not isinstance(listed, list) or len(listed) != rows * columns:
        received = len(listed) if isinstance(listed, list) else quoted(listed)
        raise CaptureError(
            f"{what}.intensity: expected a list of {rows} x {columns} = {rows * columns} "
            f"numbers (rows times cols), received {received}; correct rows and cols"
        )
    values = number_array(listed, [(rows * columns,)], f"{what}.intensity")
    bad = np.flatnonzero(~((values >= LEAST_GAIN) & (values <= LARGEST_GAIN)))
    if len(bad):
        _factor(float(values[bad[0]]), f"{what}.intensity[{bad[0]}]")
    nodes = tuple(tuple(row) for row in values.reshape(rows, columns).tolist())
    return SpatialGrid(size["width"] * MILLIMETRE, size["height"] * MILLIMETRE, nodes)


def _check_entry(entry: Any, known: set[str], required: set[str], what: str) -> None:
    """Demand an object with some keys."""
    keys = set(entry) if isinstance(entry, Mapping) else None
    if keys is None or not required <= keys <= known:
        received = quoted(entry) if keys is None else quoted(sorted(keys))
        words = "all of " if required else "keys of "
        raise CaptureError(
            f"{what}: expected an object with {words}{', '.join(sorted(known))}, received "
            f"{received}"
        )


def _factor(value: Any, what: str) -> float:
    factor = number(value, what)
    if not LEAST_GAIN <= factor <= LARGEST_GAIN:
        raise CaptureError(
            f"{what}: expected a factor of {LEAST_GAIN:g} to {LARGEST_GAIN:g}, received "
            f"{factor:g}; leave out photographs without light"
        )
    return factor
