"""Cameras of a capture, corrected by its silhouettes, and what that gained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.calibration.photograph_agreement import photographs_differ
from reflfield.calibration.pose_adjustment import PoseAdjustment, adjust_poses
from reflfield.calibration.tangent_planes import TangentPlanes, convex_outlines
from reflfield.capture.cameras import ORTHOGRAPHIC, Camera
from reflfield.capture.capture import PLANE, Capture
from reflfield.checking.checked_views import at_size
from reflfield.checking.photograph_statistics import reduced
from reflfield.errors import GeometryError, InputError
from reflfield.geometry.cones import View, measured_views
from reflfield.geometry.specks import without_specks
from reflfield.geometry.visual_hull import HullOptions, visual_hull
from reflfield.util.progress import track

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Pixels of the longer side of silhouettes, and voxels of hulls that are compared.
LONGEST_SIDE, HULL_VOXELS = 1024, 96
# Fewer views do not tell six numbers of each.
FEWEST_VIEWS = 5
# Overlap with the hull that must be gained for corrected poses to be kept.
LEAST_GAIN = 1e-3
# Factor by which photographs may differ more for that: their details tell of poses what masks
# that are drawn badly do not.
MOST_LOST = 1.05


@dataclass(frozen=True)
class Agreement:
    """How well silhouettes and poses agree.

    Parameters
    ----------
    gap_px : float
        Root mean square distance between the planes that outlines of pairs of views touch,
        pixels of silhouettes of at most 1024 along a side.
    hull_overlap, least_hull_overlap : float
        Intersection over union of the silhouettes and those of their hull, mean and least of
        all views; 0 where there is no common hull.
    photographs_differ : float
        Median difference of the logarithms of luminance of points of the hull from view to
        view; 0 where there is no common hull.
    """

    gap_px: float
    hull_overlap: float
    least_hull_overlap: float
    photographs_differ: float


@dataclass(frozen=True)
class MovedCamera:
    """By how much a camera was moved: degrees, and the unit of the capture."""

    camera: str
    rotation_deg: float
    shift: float


@dataclass(frozen=True, eq=False)
class CameraCorrection:
    """Corrected cameras.

    Parameters
    ----------
    cameras : tuple of Camera
        Those of the capture where nothing was gained.
    moved : tuple of MovedCamera
    before, after : Agreement
        `after` is that of the corrected poses, whether they are kept or not.
    is_kept : bool
        Whether silhouettes overlap with their hull by `LEAST_GAIN` more than before, and
        photographs do not differ by `MOST_LOST` more on it.
    """

    cameras: tuple[Camera, ...]
    moved: tuple[MovedCamera, ...]
    before: Agreement
    after: Agreement
    is_kept: bool

    def lines(self) -> list[str]:
        """What was changed and gained, in words."""
        rotations, shifts = (
            np.array([[moved.rotation_deg, moved.shift] for moved in self.moved]).reshape(-1, 2)
        ).T
        one, other = self.before, self.after
        lines = [
            f"outlines: {one.gap_px:.2f} -> {other.gap_px:.2f} pixels apart (rms)",
            f"overlap with the hull: {one.hull_overlap:.4f} -> {other.hull_overlap:.4f} "
            f"(least {one.least_hull_overlap:.4f} -> {other.least_hull_overlap:.4f})",
            f"photographs differ on the hull by {100 * one.photographs_differ:.2f} -> "
            f"{100 * other.photographs_differ:.2f} % (median)",
        ]
        if self.is_kept:
            return [
                f"cameras: {len(self.moved)} moved, by up to {rotations.max():.2f} degrees "
                f"(median {np.median(rotations):.2f}) and {shifts.max():.3g} "
                f"(median {np.median(shifts):.3g})",
                *lines,
            ]
        why = (
            "corrected poses would gain nothing"
            if other.hull_overlap <= one.hull_overlap + LEAST_GAIN
            else "corrected poses fit silhouettes, but photographs worse; check the masks"
        )
        return [f"cameras: as described; {why}", *lines]

    def entry(self) -> dict[str, Any]:
        """The same for a JSON file."""
        return {
            "kept": self.is_kept,
            "before": vars(self.before),
            "after": vars(self.after),
            "moved": [vars(moved) for moved in self.moved],
        }


def correct_cameras(capture: Capture) -> CameraCorrection:
    """Correct the poses of the cameras of a capture by its silhouettes.

    Lens and focal length stay. A motion or scaling of all cameras together shows in no
    silhouette: of that the corrections hold as little as they can.

    Raises
    ------
    InputError
        If the capture is flat, has fewer than `FEWEST_VIEWS` views, or an orthographic camera.
    GeometryError
        If a silhouette is empty, or no two views can be compared.
    """
    _check(capture)
    views, silhouettes = small_views(capture)
    cameras = [view.camera for view in views]
    poses = np.array([camera.camera_from_world for camera in cameras])
    planes = TangentPlanes.of(convex_outlines(views), poses)
    if not planes.weight.any():
        raise GeometryError(
            "silhouettes: expected some views that see the whole object from different sides, "
            "received none; correct the poses by other means"
        )
    adjustment = adjust_poses(planes, poses, _distances(cameras))
    before = _agreement(adjustment.rms_before, cameras, silhouettes, capture)
    corrected = _with_poses(cameras, adjustment)
    after = _agreement(adjustment.rms_after, corrected, silhouettes, capture)
    is_kept = after.hull_overlap > before.hull_overlap + LEAST_GAIN and (
        before.hull_overlap == 0
        or after.photographs_differ <= MOST_LOST * before.photographs_differ
    )
    return CameraCorrection(
        _with_poses(capture.cameras, adjustment) if is_kept else capture.cameras,
        _moved(cameras, adjustment) if is_kept else (),
        before,
        after,
        is_kept,
    )


def _check(capture: Capture) -> None:
    if capture.base_geometry == PLANE:
        raise InputError("cameras: expected silhouettes of an object, received a flat sample")
    if capture.n_views < FEWEST_VIEWS:
        raise InputError(
            f"cameras: expected at least {FEWEST_VIEWS} views, whose outlines tell poses, "
            f"received {capture.n_views}"
        )
    parallel = [camera.id for camera in capture.cameras if camera.kind == ORTHOGRAPHIC]
    if parallel:
        raise InputError(
            f"cameras: expected perspective cameras, received the orthographic {parallel[0]!r}"
        )


def small_views(capture: Capture) -> tuple[list[View], Sequence[Any]]:
    """Views and their silhouettes, at most `LONGEST_SIDE` along a side, without specks."""
    cameras, silhouettes = [], []
    for number in track(range(capture.n_views), capture.n_views, "reading silhouettes"):
        coverage = np.clip(reduced(capture.read_silhouette(number), LONGEST_SIDE), 0, 1)
        cameras.append(at_size(capture.cameras[number], coverage.shape))
        silhouettes.append(coverage)
    views, clean, _ = without_specks(measured_views(cameras, silhouettes), silhouettes)
    return views, clean


def _distances(cameras: Sequence[Camera]) -> Array:
    """Of the cameras to the point nearest to all their optical axes."""
    ahead = np.array([camera.forward for camera in cameras])
    centres = np.array([camera.centre for camera in cameras])
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    middle = np.linalg.lstsq(
        across.sum(axis=0), (across @ centres[..., None]).sum(axis=0)[:, 0], rcond=1e-6
    )[0]
    distances: Array = np.linalg.norm(centres - middle, axis=1)
    return distances


def _with_poses(cameras: Sequence[Camera], adjustment: PoseAdjustment) -> tuple[Camera, ...]:
    return tuple(
        replace(camera, camera_from_world=pose)
        for camera, pose in zip(cameras, adjustment.camera_from_world, strict=True)
    )


def _moved(cameras: Sequence[Camera], adjustment: PoseAdjustment) -> tuple[MovedCamera, ...]:
    return tuple(
        MovedCamera(
            camera.id,
            float(np.degrees(np.linalg.norm(rotation))),
            float(np.linalg.norm(corrected.centre - camera.centre)),
        )
        for camera, corrected, rotation in zip(
            cameras, _with_poses(cameras, adjustment), adjustment.rotations, strict=True
        )
    )


def _agreement(
    gap_px: float, cameras: Sequence[Camera], silhouettes: Sequence[Any], capture: Capture
) -> Agreement:
    # No view is left out: wrong poses shall count.
    options = HullOptions(resolution=HULL_VOXELS, tolerance=0)
    try:
        mesh, report = visual_hull(cameras, silhouettes, options)
    except GeometryError:
        return Agreement(gap_px, 0.0, 0.0, 0.0)
    overlap = report.overlap
    poses = zip(capture.cameras, cameras, strict=True)
    whole = tuple(replace(c, camera_from_world=small.camera_from_world) for c, small in poses)
    differ = photographs_differ(replace(capture, cameras=whole), mesh)
    return Agreement(gap_px, float(overlap.mean()), float(overlap.min()), differ)
