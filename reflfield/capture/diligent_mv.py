r"""Reader of DiLiGenT-MV: ``Calib_Results.mat`` beside one folder for each view.

``KK`` is the camera's matrix, ``Rc_1``, ``Tc_1`` the pose of view 1 (OpenCV axes, pixel centres
at whole numbers, as of Bouguet's toolbox). Each folder ``view_01`` holds its photographs, named
in ``filenames.txt``, ``mask.png``, and in ``light_directions.txt`` and
``light_intensities.txt`` the lights in the frame of the camera (x right, y up, z to it).
PNG files that state no colour are linear. The rotations of the published sets are not
orthogonal by up to .4 %; what is left over belongs to the lens: :math:`K R = K' R'` with an
orthogonal :math:`R'`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.calibrated_views import View, assembled_capture
from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.described_items import camera_of_matrix, described_light
from reflfield.capture.fixed_view import FixedView, linear_unless_stated
from reflfield.capture.image_files import image_size
from reflfield.capture.light_lists import (
    DIRECTIONS,
    directions_of,
    intensities_beside,
    listed_view,
)
from reflfield.capture.matlab_files import read_matlab
from reflfield.capture.paths import NamedFiles
from reflfield.errors import CaptureError
from reflfield.util.late_import import LateImport

linalg: Any = LateImport("scipy.linalg")

Array = NDArray[np.float64]

FILE_NAME = "Calib_Results.mat"
_VIEW = re.compile(r"view_(\d{1,4})")
# Skew that is left of rotations that are not orthogonal, in pixels per pixel: a tenth of a
# pixel at the border of the published images.
LARGEST_SKEW = 2e-4


def is_diligent_mv(path: Path) -> bool:
    """Whether a calibration has folders of views with their lights beside it."""
    return any((folder / DIRECTIONS).is_file() for folder in path.parent.glob("view_*"))


def read_diligent_mv(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a multi-view photometric stereo set.

    Parameters
    ----------
    description : Path
        ``Calib_Results.mat``.
    follow_links : bool
        Whether symbolic links may lead out of its folder.

    Returns
    -------
    Capture
        Directional lights; those of one direction in the world are one.

    Raises
    ------
    CaptureError
        If a view has no pose, a file is damaged, or counts differ.
    """
    root = description.parent
    named = [(_VIEW.fullmatch(folder.name), folder) for folder in sorted(root.glob("view_*"))]
    folders = {
        int(view[1]): folder
        for view, folder in named
        if view is not None and (folder / DIRECTIONS).is_file()
    }
    shapes: dict[str, tuple[int | None, ...]] = {"KK": (3, 3)}
    for number in folders:
        shapes |= {f"Rc_{number}": (3, 3), f"Tc_{number}": (3, 1)}
    arrays = read_matlab(description, shapes)
    if missing := sorted(set(shapes) - set(arrays)):
        raise CaptureError(
            f"{description}: expected KK, and Rc_N and Tc_N of each folder view_N, received "
            f"none of {', '.join(missing[:5])}; remove the folders of other views"
        )
    views: list[View] = []
    paths: list[Path] = []
    masks: list[Path | None] = []
    for number, folder in folders.items():
        pose = np.column_stack([arrays[f"Rc_{number}"], arrays[f"Tc_{number}"]])
        files = NamedFiles(folder / DIRECTIONS, follow_links=follow_links)
        of_view, shown = _views(files, arrays["KK"], pose)
        views += of_view
        paths += shown.photographs
        masks += [shown.mask] * len(shown.photographs)
    return assembled_capture(
        *(views, paths, masks, NamedFiles(description, follow_links=follow_links)),
        format="diligent-mv",
        details=[
            f"DiLiGenT-MV {description}: {len(folders)} views with lights in their own frames, "
            "files taken as linear",
        ],
        reading=linear_unless_stated(paths[0]),
    )


def _views(files: NamedFiles, matrix: Array, pose: Array) -> tuple[list[View], FixedView]:
    """Photographs of one view, each with the camera and its light."""
    directions = directions_of(files.description)
    intensities, _ = intensities_beside(files.root, len(directions))
    shown = listed_view(files, len(directions))
    camera = _camera(matrix, pose, image_size(shown.photographs[0]), files.description)
    world = (directions * [1.0, -1.0, -1.0]) @ camera.rotation
    views = [
        View(
            path.name,
            camera,
            described_light(
                str(files.description), "directional", direction=direction, intensity=intensity
            ),
        )
        for path, direction, intensity in zip(
            shown.photographs, world, intensities, strict=True
        )
    ]
    return views, shown


def _camera(matrix: Array, pose: Array, size: tuple[int, int], description: Path) -> Camera:
    """Camera of ``K [R t]`` whose R may be a little off a rotation."""
    what = f"{description.parent}: pose in {FILE_NAME}"
    lens, rotation = linalg.rq(matrix @ pose[:, :3])
    signs = np.sign(np.diag(lens)) + (np.diag(lens) == 0)
    lens, rotation = lens * signs, signs[:, None] * rotation
    if not lens[2, 2] > 1e-9 or np.linalg.det(rotation) < 0:
        raise CaptureError(f"{what}: expected a camera, received a singular or mirrored matrix")
    translation = np.linalg.solve(lens, matrix @ pose[:, 3])
    lens = lens / lens[2, 2]
    if abs(lens[0, 1]) > LARGEST_SKEW * lens[0, 0] or abs(matrix[0, 1]) > 1e-6 * matrix[0, 0]:
        raise CaptureError(
            f"{what}: expected a camera without skew, received one of {lens[0, 1]:.4g} pixels; "
            "is R a rotation?"
        )
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, translation
    return camera_of_matrix(what, lens, size, camera_from_world)
