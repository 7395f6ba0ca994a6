"""Photographs into texture space: one apparent BRDF sample per texel, view and light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.lights import Light
from reflfield.capture.model import Capture
from reflfield.checks import check_shape
from reflfield.errors import InputError
from reflfield.observations.store import (
    Location,
    chunk_shape,
    create_samples,
    is_written,
    open_samples,
)
from reflfield.scheduling import Blocks

Floats = NDArray[np.float32]
# Largest half float; a mirror-like peak beyond it is held there.
HALF_MAX = 65504.0
# Bytes for the photographs that are held at a time.
BUDGET = 256 << 20
# Lights sampled together: the pixel positions are worked out once for all of them.
LIGHTS_AT_ONCE = 32


@numba.njit(cache=True, nogil=True)
def _sample_bilinear(images: Floats, pixels: NDArray[np.float64], out: Floats) -> None:
    n_images, height, width, _ = images.shape
    for i in range(len(pixels)):
        # Pixel centres lie at half-integers; samples beyond the rim read the rim.
        x = min(max(pixels[i, 0] - 0.5, 0.0), width - 1.0)
        y = min(max(pixels[i, 1] - 0.5, 0.0), height - 1.0)
        column, row = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        s, t = np.float32(x - column), np.float32(y - row)
        right, below = min(column + 1, width - 1), min(row + 1, height - 1)
        for j in range(n_images):
            for c in range(3):
                upper = (1 - s) * images[j, row, column, c] + s * images[j, row, right, c]
                lower = (1 - s) * images[j, below, column, c] + s * images[j, below, right, c]
                out[i, j, c] = (1 - t) * upper + t * lower


def sample_bilinear(images: Floats, pixels: NDArray[np.float64]) -> Floats:
    """Values of images at pixel positions.

    Parameters
    ----------
    images : (n_images, h, w, 3) float32
        Linear radiance.
    pixels : (n, 2) float64
        x and y; the centre of the top-left pixel is (0.5, 0.5). Beyond the image, the rim.

    Returns
    -------
    (n, n_images, 3) float32

    Raises
    ------
    ShapeError
        If a shape is wrong.
    InputError
        If a pixel is NaN: the camera does not image that point.

    Examples
    --------
    >>> ramp = np.zeros((1, 1, 3, 3), np.float32)
    >>> ramp[0, 0] = [[0.0], [1.0], [2.0]]
    >>> float(sample_bilinear(ramp, np.array([[1.25, 0.5]]))[0, 0, 0])
    0.75
    """
    check_shape("images", images, (None, None, None, 3))
    check_shape("pixels", pixels, (None, 2))
    absent = np.isnan(pixels).any(axis=1)
    if absent.any():
        raise InputError(
            f"pixels: expected numbers, received NaN in row {int(absent.argmax())}; "
            "leave out points that the camera does not image"
        )
    out = np.zeros((len(pixels), len(images), 3), np.float32)
    _sample_bilinear(
        np.ascontiguousarray(images, np.float32), np.ascontiguousarray(pixels, np.float64), out
    )
    return out


def facing_irradiance(lights: tuple[Light, ...], positions: NDArray[np.floating]) -> Floats:
    """Irradiance (n, n_lights, 3) that a surface facing each light gets; 1 if unknown."""
    points = np.asarray(positions, np.float64)
    return np.stack([light.irradiance(points) for light in lights], axis=1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Projection:
    """Photographs and the texels that they are projected onto.

    Parameters
    ----------
    capture : Capture
        Photographs, cameras and lights.
    positions : (n_texels, 3) float
        Points of the surface, metres.
    visible : (n_texels, n_views) bool
        True where the camera sees the texel; other samples are zero.
    location : Path or str
        Store to write.
    budget : int
        Bytes for the photographs held at a time. The samples do not depend on it.
    """

    capture: Capture
    positions: NDArray[np.floating]
    visible: NDArray[np.bool_]
    location: Location
    budget: int = BUDGET

    def __post_init__(self) -> None:
        check_shape("positions", self.positions, (None, 3))
        check_shape("visible", self.visible, (len(self.positions), self.capture.n_views))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Texels, views and lights."""
        return len(self.positions), self.capture.n_views, self.capture.n_lights

    def views_of_chunks(self) -> list[range]:
        """Views whose samples are written together."""
        step = chunk_shape(*self.shape)[1]
        n_views = self.capture.n_views
        return [range(i, min(i + step, n_views)) for i in range(0, n_views, step)]


def project_photographs(projection: Projection, blocks: Blocks, at_once: int = 1) -> None:
    """Write the samples of all texels: radiance divided by the light's irradiance.

    Parameters
    ----------
    projection : Projection
    blocks : Blocks
        Who does it, a few views at a time; what an interrupted run has written is kept.
    at_once : int
        Threads for whose blocks there is memory: a block takes the samples of its views and
        `Projection.budget`.

    Raises
    ------
    CaptureError
        If a photograph cannot be read.
    ShapeError
        If shapes disagree.

    Notes
    -----
    Every photograph is read once.
    """
    create_samples(projection.location, *projection.shape)
    blocks.map(
        "projecting photographs",
        project_views,
        projection,
        projection.views_of_chunks(),
        intact=has_views,
        at_once=at_once,
    )


def project_views(projection: Projection, views: range) -> dict[str, NDArray[Any]]:
    """Write the samples of a few views; gives the number of photographs read."""
    points = np.asarray(projection.positions, np.float64)
    n_lights = projection.capture.n_lights
    block = np.zeros((len(points), len(views), n_lights, 3), np.float16)
    n_read = 0
    for i, view in enumerate(views):
        seen = np.flatnonzero(projection.visible[:, view])
        for lights, values in _view_samples(
            projection.capture, view, points[seen], projection.budget
        ):
            block[seen[:, None], i, lights] = values
            n_read += len(lights)
    store = open_samples(projection.location)
    store[:, views.start : views.stop] = block
    return {"photographs": np.array(n_read)}


def has_views(projection: Projection, views: range) -> bool:
    """Whether the store holds the samples of some views, whole."""
    store = open_samples(projection.location)
    return is_written(store, (slice(None), slice(views.start, views.stop)))


def _view_samples(
    capture: Capture, view: int, points: NDArray[np.float64], budget: int
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.float16]]]:
    """Samples of one view, some lights at a time: (lights, (n_points, n, 3))."""
    pixels, _ = capture.cameras[view].project(points)
    photographed = np.flatnonzero(capture.photograph_index[view] >= 0)
    camera = capture.cameras[view]
    # A photograph with the copies made of it while reading, and its samples.
    each = 12 * (3 * camera.width * camera.height + 4 * len(points))
    together = int(np.clip(budget // max(each, 1), 1, LIGHTS_AT_ONCE))
    for lights in np.array_split(photographed, max(1, -(-len(photographed) // together))):
        if not len(lights):
            continue
        indices = capture.photograph_index[view, lights]
        images = np.stack([capture.read_photograph(int(i)) for i in indices])
        irradiance = facing_irradiance(tuple(capture.lights[i] for i in lights), points)
        # A light may have no blue, a spot may miss a texel: nothing is learned there.
        lit = irradiance > 0
        values = sample_bilinear(images, pixels) / np.where(lit, irradiance, 1.0)
        values = np.clip(np.where(lit, values, 0.0), -HALF_MAX, HALF_MAX)
        yield lights, values.astype(np.float16)


def directions_of(
    capture: Capture, positions: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unit directions from each texel to all cameras and all lights, world frame.

    Returns
    -------
    views : (n, n_views, 3) float32
    lights : (n, n_lights, 3) float32
        Of an unknown light, world +Z: its direction does not enter.
    """
    points = np.asarray(positions, np.float64)
    views = np.stack([camera.view_directions(points) for camera in capture.cameras], axis=1)
    lights = np.stack([light.directions(points) for light in capture.lights], axis=1)
    return views.astype(np.float32), lights.astype(np.float32)


def pairs_photographed(capture: Capture) -> NDArray[np.bool_]:
    """(n_views, n_lights) True where a photograph exists."""
    return capture.photograph_index >= 0
