"""Reader of LLFF's ``poses_bounds.npy``: one row of 17 numbers for each photograph.

A row holds a 3 x 5 matrix row by row, and two bounds of depth. Its columns are the directions
in the world of the camera's down, right and back axes, the camera's position, and height, width
and focal length of the image in pixels. The principal point is the centre of the image. Rows
belong to the files in ``images`` in the order of their names; these may be reduced.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.calibrated_views import View, capture_of_views
from reflfield.capture.cameras import LONGEST_SIDE, OPENCV, Camera, not_rigid_because
from reflfield.capture.capture import Capture
from reflfield.capture.described_items import described_camera
from reflfield.capture.documents import LARGEST_COORDINATE, MAX_PHOTOGRAPHS
from reflfield.capture.names import IMAGE_SUFFIXES
from reflfield.capture.view_folders import view_folders
from reflfield.errors import CaptureError
from reflfield.util.files import load_array
from reflfield.util.quoting import quoted

FILE_NAME = "poses_bounds.npy"
N_NUMBERS = 17


def read_llff(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a capture from ``poses_bounds.npy``.

    Parameters
    ----------
    description : Path
        The file, beside ``images`` and, where there are masks, ``masks``.
    follow_links : bool
        Whether symbolic links may lead out of its folder.

    Returns
    -------
    Capture
        Of one constant, unknown light.

    Raises
    ------
    CaptureError
        If the file is no such array, or the number of photographs is another one.
    """
    rows = _rows(description)
    folders = view_folders(description, follow_links=follow_links)
    where = folders.root / folders.images
    names = sorted(p.name for p in where.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    if len(names) != len(rows):
        raise CaptureError(
            f"{description}: expected one row for each photograph in {where}, received "
            f"{len(rows)} rows for {len(names)} photographs; keep those that were calibrated"
        )
    views = [
        View(name, _camera(row, f"{description}: photograph {quoted(name)}"))
        for name, row in zip(names, rows, strict=True)
    ]
    return capture_of_views(
        views,
        folders,
        format="llff",
        details=[
            f"LLFF's {description}: {len(rows)} rows in the order of the files' names",
            f"photographs in {where}",
            "one constant, unknown light; where the object turned and the lights stood still, "
            "their directions are needed (lights.csv)",
        ],
    )


def _rows(description: Path) -> NDArray[np.float64]:
    array = load_array(description, 8 * N_NUMBERS * MAX_PHOTOGRAPHS, CaptureError)
    if array.ndim != 2 or array.shape[1] != N_NUMBERS or array.dtype.kind != "f":
        raise CaptureError(
            f"{description}: expected an array of floats, n x {N_NUMBERS}, received "
            f"{array.dtype} {array.shape}"
        )
    rows = array.astype(np.float64)
    if not (np.abs(rows) <= LARGEST_COORDINATE).all():  # False for NaN
        raise CaptureError(
            f"{description}: expected finite numbers of at most {LARGEST_COORDINATE:g}, "
            "received others; calibrate again"
        )
    return rows


def _camera(row: NDArray[np.float64], what: str) -> Camera:
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4]
    sides = (round(float(width)), round(float(height)))
    if not all(1 <= side <= LONGEST_SIDE for side in sides):
        raise CaptureError(
            f"{what}: expected height and width of 1 to {LONGEST_SIDE} pixels in the last "
            f"column, received {height} and {width}"
        )
    down, right, back, position = matrix[:, :4].T
    pose = np.eye(4)
    pose[:3, :3] = right, down, -back
    fault = not_rigid_because(pose)
    if fault:
        raise CaptureError(
            f"{what}: expected the axes down, right and back of a rotation, received {fault}"
        )
    pose[:3, 3] = -pose[:3, :3] @ position
    return described_camera(
        what,
        kind=OPENCV,
        width=sides[0],
        height=sides[1],
        fl_x=focal,
        fl_y=focal,
        cx=sides[0] / 2,
        cy=sides[1] / 2,
        camera_from_world=pose,
    )
