"""Why a silhouette contradicts the others: mistakes that are tried, and the one that fits.

Masks are inverted, shifted, mirrored, scaled or those of another view; poses follow another
convention. Each mistake is undone in turn; it explains the contradiction if silhouettes and
hull agree far better then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.errors import ReflfieldError
from reflfield.geometry.bounding_box import robust_bounds
from reflfield.geometry.cones import View, measured_views
from reflfield.geometry.contradictions import CONTRADICTION, Verdict, judge
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.ray_scene import RayScene

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Pixels along the longer side of the images in which hull and silhouettes are compared.
OVERLAP_PIXELS = 256

# A mistake explains a contradiction if, undone, silhouette and hull overlap so well (the
# hull of a few views is larger than the object) ...
_GOOD_OVERLAP = 0.7
# ... and so much better than before. The first of explanations that are equally good within
# the second number is named: they are in the order of how often one meets them.
_BETTER = 0.15
_EQUALLY_GOOD = 0.02

# Views, evenly spread over all, in which a mistake common to all is looked for.
_VIEWS_COMPARED = 32

_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Explanation:
    """A mistake that explains a contradiction.

    Parameters
    ----------
    kind : str
        Such as "inverted" or "shifted".
    words : str
        For messages.
    before, after : float
        Overlap (intersection over union) with the hull of the others as it is, and with the
        mistake undone.
    """

    kind: str
    words: str
    before: float
    after: float


def compared_pixels(camera: Camera) -> tuple[slice, Array, tuple[int, int]]:
    """Every k-th row and column of an image, so that about 256 remain along a side.

    Returns
    -------
    rows : slice
        Of rows and of columns.
    pixels : (n, 2) float64
        Centres of the pixels kept.
    shape : tuple of int
        Rows and columns kept.
    """
    step = max(1, round(max(camera.width, camera.height) / OVERLAP_PIXELS))
    some = slice(step // 2, None, step)
    rows, cols = np.arange(camera.height)[some] + 0.5, np.arange(camera.width)[some] + 0.5
    row, col = np.meshgrid(rows, cols, indexing="ij")
    return some, np.stack([col.ravel(), row.ravel()], axis=1), row.shape


def silhouette_of(scene: RayScene, camera: Camera) -> Bool:
    """Pixels, every k-th, in which a camera sees a surface."""
    _, pixels, shape = compared_pixels(camera)
    hit: Bool = np.isfinite(scene.pixel_depths(camera, pixels)).reshape(shape)
    return hit


def explain_view(
    camera: Camera,
    silhouette: NDArray[np.floating],
    others: Mesh,
    swapped: Sequence[tuple[str, NDArray[np.floating]]] = (),
) -> Explanation | None:
    """The mistake that makes one view contradict the hull of the others.

    Parameters
    ----------
    camera : Camera
    silhouette : (height, width) float
        Of the view.
    others : Mesh
        Hull of the other views.
    swapped : sequence of (str, (height, width) float)
        Names and silhouettes of further views that contradict the rest.

    Returns
    -------
    Explanation or None
        None if nothing that was tried fits far better.
    """
    scene = RayScene(others)
    some, _, _ = compared_pixels(camera)
    shown = np.asarray(silhouette)[some, some] >= 0.5
    expected = silhouette_of(scene, camera)
    before = overlap(shown, expected)
    tried = [*_mask_mistakes(shown, expected)]
    for name, other in swapped:
        if np.shape(other) == np.shape(silhouette):
            fit = overlap(np.asarray(other)[some, some] >= 0.5, expected)
            tried.append(("swapped", f"the silhouette of view {name!r} fits it", fit))
    for kind, words, pose in _pose_mistakes(camera):
        moved = replace(camera, camera_from_world=pose)
        tried.append((kind, words, overlap(shown, silhouette_of(scene, moved))))
    return _best(tried, before)


def overlap(first: Bool, second: Bool) -> float:
    """Intersection over union."""
    return float((first & second).sum() / max((first | second).sum(), 1))


def _best(tried: list[tuple[str, str, float]], before: float) -> Explanation | None:
    top = max(after for _, _, after in tried)
    if top < _GOOD_OVERLAP or top < before + _BETTER:
        return None
    kind, words, after = next(entry for entry in tried if entry[2] >= top - _EQUALLY_GOOD)
    return Explanation(kind, words, before, after)


def _mask_mistakes(shown: Bool, expected: Bool) -> Iterator[tuple[str, str, float]]:
    """Mistakes of a mask, in words, with the overlap when they are undone."""
    yield "inverted", "it is inverted (white must mean object)", overlap(~shown, expected)
    down, right = _shift(shown, expected)
    moved = _moved(shown, 1.0, down, right)
    yield (
        "shifted",
        f"it is shifted by {-right} columns and {-down} rows",
        overlap(moved, expected),
    )
    for kind, turned in (
        ("mirrored", shown[:, ::-1]),
        ("upside down", shown[::-1]),
        ("turned by 180 degrees", shown[::-1, ::-1]),
    ):
        yield kind, f"it is {kind}", overlap(turned, expected)
    scale = float(np.sqrt(max(expected.sum(), 1) / max(shown.sum(), 1)))
    moved = _moved(shown, scale, *(_centre(expected) - scale * _centre(shown)))
    words = (
        f"it is {1.0 / scale:.2f} times as large as it should be (a mask of another size, or "
        "another focal length)"
    )
    yield "scaled", words, overlap(moved, expected)


def _shift(shown: Bool, expected: Bool) -> tuple[int, int]:
    """Rows and columns by which one image is to be moved to lie on another."""
    height, width = (2 * n for n in shown.shape)
    spectrum = np.fft.rfft2(expected, (height, width)) * np.conj(
        np.fft.rfft2(shown, (height, width))
    )
    peak = int(np.fft.irfft2(spectrum, (height, width)).argmax())
    down, right = divmod(peak, width)
    return (
        down - height if down > height // 2 else down,
        right - width if right > width // 2 else right,
    )


def _centre(picture: Bool) -> Array:
    """Mean row and column of the covered pixels."""
    where = np.argwhere(picture)
    return where.mean(axis=0) if len(where) else np.zeros(2)


def _moved(picture: Bool, scale: float, down: float, right: float) -> Bool:
    """Image scaled about its first pixel, then moved."""
    matrix = np.array([[scale, 0.0, right], [0.0, scale, down]])
    height, width = picture.shape
    return np.asarray(
        cv2.warpAffine(picture.astype(np.float32), matrix, (width, height)) >= 0.5
    )


def _pose_mistakes(camera: Camera) -> Iterator[tuple[str, str, Array]]:
    """Other conventions that a pose may follow, with the pose read by them."""
    pose = camera.camera_from_world
    inverse = _inverse(pose)
    axes = "its camera axes are OpenGL's (+Y up, +Z back) read as OpenCV's, or the reverse"
    transposed = "its pose is camera-to-world read as world-to-camera, or the reverse"
    yield "camera axes", axes, _AXES @ pose
    yield "inverse pose", transposed, inverse
    both = f"{transposed}, with the camera axes of OpenGL for OpenCV's"
    yield "inverse pose and camera axes", both, _AXES @ inverse
    yield "inverse pose and camera axes", both, inverse @ _AXES


def _inverse(pose: Array) -> Array:
    """Inverse of a rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


# ---------------------------------------------------------------- all views


def explain_all(
    cameras: Sequence[Camera],
    silhouettes: Sequence[NDArray[np.floating]],
    before: float,
    scratch: Path | None = None,
) -> Explanation | None:
    """The mistake, common to all views, that makes them contradict each other.

    Parameters
    ----------
    cameras : sequence of Camera
    silhouettes : sequence of (height, width) float
    before : float
        Median share of the silhouettes that the hull covers as they are.
    scratch : Path, optional
        Folder for files in which distances are kept instead of in memory.

    Returns
    -------
    Explanation or None

    Notes
    -----
    What all views have in common shows in some of them: of many, 32 are compared, and the
    share that is covered as they are is theirs.
    """
    if len(cameras) > _VIEWS_COMPARED:
        some = np.linspace(0, len(cameras) - 1, _VIEWS_COMPARED).astype(int)
        cameras = [cameras[view] for view in some]
        silhouettes = [silhouettes[view] for view in some]
        before = _agreement(cameras, silhouettes, scratch)
    tried: list[tuple[str, str, Sequence[Camera], Sequence[NDArray[np.floating]]]]
    inverted = "all are inverted (white must mean object)"
    tried = [("inverted", inverted, cameras, Inverted(silhouettes))]
    conventions = [list(_pose_mistakes(camera)) for camera in cameras]
    for number, (kind, words, _) in enumerate(conventions[0]):
        moved = [
            replace(camera, camera_from_world=poses[number][2])
            for camera, poses in zip(cameras, conventions, strict=True)
        ]
        plural = words.replace("its camera axes", "the camera axes").replace(
            "its pose is camera-to-world", "the poses are camera-to-world"
        )
        tried.append((kind, plural, moved, silhouettes))
    for kind, words, some_cameras, some_silhouettes in tried:
        after = _agreement(some_cameras, some_silhouettes, scratch)
        if after >= 1.0 - CONTRADICTION and after >= before + 2.0 * CONTRADICTION:
            return Explanation(kind, words, before, after)
    return None


@dataclass(frozen=True, eq=False)
class Inverted(Sequence[NDArray[np.floating]]):
    """Silhouettes with object and backdrop exchanged, each when it is asked for."""

    silhouettes: Sequence[NDArray[np.floating]]

    def __len__(self) -> int:
        return len(self.silhouettes)

    def __getitem__(self, view: Any) -> Any:
        return 1.0 - np.asarray(self.silhouettes[view])


def _agreement(
    cameras: Sequence[Camera],
    silhouettes: Sequence[NDArray[np.floating]],
    scratch: Path | None,
) -> float:
    """Median share of the silhouettes that the others are consistent with; 0 without a hull.

    Views that the object leaves exclude little and agree with anything: with most of them
    nothing is explained.
    """
    own = nullcontext(None) if scratch is None else TemporaryDirectory(dir=scratch)
    with own as folder:
        try:
            views = measured_views(cameras, silhouettes, Path(folder) if folder else None)
        except ReflfieldError:
            return 0.0
        if np.mean([view.outline.leaves_image for view in views]) > 0.5:
            return 0.0
        verdict = examine(views)
    return 0.0 if verdict is None else 1.0 - float(np.median(verdict.uncovered))


def examine(
    views: Sequence[View], bounds: tuple[Sequence[float], Sequence[float]] | None = None
) -> Verdict | None:
    """What the views say about each other; None if they bound no body at all."""
    box = robust_bounds(views) if bounds is None else np.array(bounds, dtype=np.float64)
    return None if box is None else judge(views, box[0], box[1])
