r"""Reader of near-light photometric stereo sets: ``light.mat`` and ``camera.mat``.

As of Quéau, Durix, Wu, Cremers, Lauze and Durou, *LED-based photometric stereo* (2018): ``K``
is the camera's matrix; ``S`` the positions of the lamps in its frame (x right, y down, z
forward), ``Dir`` their principal directions, ``Phi`` their intensities in three channels, and
``mu`` the exponents of :math:`I(\theta) = \Phi \cos^\mu \theta`. Photographs lie beside, in the
order of their names; PNG files that state no colour are linear.

The plane of the capture is put at the depth where the beams of the lamps come closest to each
other, parallel to the image: nothing else is known of the object.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.described_items import camera_of_matrix, described_light
from reflfield.capture.documents import check_counts
from reflfield.capture.fixed_view import (
    fixed_view_capture,
    linear_unless_stated,
    photographs_beside,
)
from reflfield.capture.image_files import image_size
from reflfield.capture.lights import Light
from reflfield.capture.matlab_files import read_matlab
from reflfield.capture.paths import NamedFiles
from reflfield.errors import CaptureError

Array = NDArray[np.float64]

FILE_NAME, CAMERA_NAME = "light.mat", "camera.mat"
# Our plane's axes (y up, z to the camera) seen from the camera's.
_FLIP = np.diag([1.0, -1.0, -1.0])


def is_near_light_mat(path: Path) -> bool:
    """Whether a file has the camera's beside it."""
    return path.name == FILE_NAME and path.with_name(CAMERA_NAME).is_file()


def read_near_light_mat(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a near-light photometric stereo set.

    Parameters
    ----------
    description : Path
        ``light.mat``, beside ``camera.mat`` and the photographs or a folder of them.
    follow_links : bool
        Whether symbolic links may lead out of its folder.

    Returns
    -------
    Capture
        One perspective camera above the plane z = 0, spotlights.

    Raises
    ------
    CaptureError
        If a file is damaged or lacks an array, or the number of photographs is another one.
    """
    shapes = {"S": (None, 3), "Dir": (None, 3), "Phi": (None, 3), "mu": (None, 1)}
    arrays = read_matlab(description, shapes)
    matrix = read_matlab(description.with_name(CAMERA_NAME), {"K": (3, 3)})
    missing = sorted((set(shapes) | {"K"}) - set(arrays) - set(matrix))
    counts = {len(array) for array in arrays.values()}
    if missing or len(counts) != 1:
        raise CaptureError(
            f"{description}: expected S, Dir, Phi and mu of one length, and K in "
            f"{CAMERA_NAME}, received {', '.join(missing) or 'other lengths'}"
            f"{' missing' if missing else ''}"
        )
    check_counts(str(description), 1, counts.pop(), len(arrays["S"]))
    files = NamedFiles(description, follow_links=follow_links)
    view = photographs_beside(description, files, len(arrays["S"]))
    depth = _depth(arrays["S"], arrays["Dir"], description)
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = _FLIP, depth
    camera = _camera(matrix["K"], pose, image_size(view.photographs[0]), description)
    return fixed_view_capture(
        view,
        _lights(arrays, depth, description),
        files,
        camera=camera,
        format="near-light",
        details=[
            f"near lights of {description}: {len(view.photographs)} lamps",
            f"photographs in {view.photographs[0].parent}, {view.photographs[0].name} first",
        ],
        notes=[
            f"{description}: the plane of the capture lies {depth:.4g} units before the "
            "camera, where the beams of the lamps meet"
        ],
        reading=linear_unless_stated(view.photographs[0]),
    )


def _camera(matrix: Array, pose: Array, size: tuple[int, int], description: Path) -> Camera:
    what = f"{description.with_name(CAMERA_NAME)}: K"
    below = matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[0, 1], matrix[2, 2] - 1
    if np.abs(below).max() > 1e-6:
        raise CaptureError(
            f"{what}: expected a camera matrix without skew, received {matrix.tolist()}"
        )
    # MATLAB counts pixels from 1.
    return camera_of_matrix(what, matrix, size, pose, counts_from=1)


def _depth(positions: Array, directions: Array, description: Path) -> float:
    """Depth of the point nearest to all beams."""
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    if not (lengths > 0).all():
        raise CaptureError(f"{description}: Dir: expected directions that are not zero")
    beams = directions / lengths
    across = np.eye(3) - beams[:, :, None] * beams[:, None, :]
    right = np.einsum("nij,nj->i", across, positions)
    depth = float(np.linalg.lstsq(across.sum(axis=0), right, rcond=1e-9)[0][2])
    if not depth > 0:
        raise CaptureError(
            f"{description}: expected beams that meet before the camera (z forward), received "
            f"a depth of {depth:.4g}; are the axes x right, y down, z forward?"
        )
    return depth


def _lights(arrays: dict[str, Array], depth: float, description: Path) -> list[Light]:
    positions = (arrays["S"] - [0.0, 0.0, depth]) @ _FLIP
    directions = arrays["Dir"] @ _FLIP
    return [
        described_light(
            f"{description}: lamp {i}",
            "spot",
            position=positions[i],
            direction=directions[i],
            intensity=arrays["Phi"][i],
            exponent=float(arrays["mu"][i, 0]),
            cone_angle=np.pi / 2,
            falloff_angle=np.pi / 2,
        )
        for i in range(len(positions))
    ]
