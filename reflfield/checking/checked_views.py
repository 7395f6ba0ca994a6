"""Silhouettes and cameras at the reduced size in which they are compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture, check_matches
from reflfield.capture.image_files import read_coverage
from reflfield.capture.segmentation import silhouette_from_photographs
from reflfield.checking.photograph_statistics import MEAN_PIXELS, PhotographSet, reduced
from reflfield.errors import CaptureError, GeometryError, InputError
from reflfield.geometry.cones import View
from reflfield.geometry.silhouette_distance import signed_distance
from reflfield.options import available_cores
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import track

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CheckedView:
    """A view with its silhouette.

    Parameters
    ----------
    number : int
        Of the camera in the capture.
    camera : Camera
        Of images of the silhouette's size.
    coverage : (rows, columns) float32
    origin : str
        "file", "alpha" or "photographs".
    cone : View
    """

    number: int
    camera: Camera
    coverage: Float32
    origin: str
    cone: View

    @property
    def name(self) -> str:
        """Of the camera."""
        return self.camera.id


@dataclass(frozen=True, eq=False)
class UnusableView:
    """A view whose silhouette cannot be used, and why."""

    number: int
    words: str


def checked_views(
    capture: Capture, photographs: PhotographSet
) -> Iterator[CheckedView | UnusableView]:
    """Silhouettes of all views that have photographs or a silhouette file, in all cores."""
    numbers = [
        number
        for number in range(capture.n_views)
        if capture.silhouettes[number] is not None or number in photographs.means
    ]
    with thread_pool(available_cores()) as pool:
        views = pool.map(lambda number: _checked_view(capture, number, photographs), numbers)
        yield from track(views, len(numbers), "silhouettes")


def _checked_view(
    capture: Capture, number: int, photographs: PhotographSet
) -> CheckedView | UnusableView:
    try:
        coverage, origin = _coverage(capture, number, photographs)
        camera = at_size(capture.cameras[number], coverage.shape)
        outline = signed_distance(coverage, f"silhouette of view {camera.id!r}")
    except (InputError, GeometryError) as error:
        return UnusableView(number, str(error))
    return CheckedView(number, camera, coverage, origin, View(camera, outline))


def at_size(camera: Camera, shape: tuple[int, ...]) -> Camera:
    """The camera of reduced images.

    Examples
    --------
    >>> camera = Camera.look_at([0, 0, 2], up=[0, 1, 0], width=100, height=80)
    >>> small = at_size(camera, (20, 25))
    >>> small.width, small.height, round(small.fl_x / camera.fl_x, 6), small.cx
    (25, 20, 0.25, 12.5)
    """
    height, width = shape[:2]
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fl_x=camera.fl_x * x,
        fl_y=camera.fl_y * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
    )


def _coverage(capture: Capture, number: int, photographs: PhotographSet) -> tuple[Float32, str]:
    """Coverage of a view at reduced size, and where it is from."""
    camera, path = capture.cameras[number], capture.silhouettes[number]
    coverage = read_coverage(path) if path is not None else capture.read_alpha(number)
    if coverage is None:
        mean = photographs.means[number]
        return silhouette_from_photographs([mean], name=f"view {camera.id!r}"), "photographs"
    what = path if path is not None else f"alpha of the photographs of {camera.id!r}"
    check_matches(what, camera, coverage.shape[1], coverage.shape[0])
    if not (coverage > 0.5).any():
        raise CaptureError(
            f"{what}: empty silhouette: no pixel of view {camera.id!r} is covered; white must "
            "mean object"
        )
    origin = "file" if path is not None else "alpha"
    return np.clip(reduced(coverage, MEAN_PIXELS), 0, 1), origin
