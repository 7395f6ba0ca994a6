"""A ``.btf`` container as a native capture: linear EXR images of a flat sample."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from reflfield.capture.btf import Btf
from reflfield.capture.capture import PLANE
from reflfield.capture.documents import MAX_PHOTOGRAPHS
from reflfield.capture.image_writing import write_exr
from reflfield.capture.native import FILE_NAME, FORMAT, VERSION
from reflfield.capture.native_writing import camera_entry
from reflfield.capture.rectified_samples import rectified_camera
from reflfield.errors import InputError
from reflfield.util.files import filling
from reflfield.util.progress import track

LARGEST_HALF = 6e4


def write_btf_samples(btf: Btf, out: Path, name: str) -> int:
    """Write a native capture of a table: one image for each view and light.

    Views and lights below the sample have no image. Light gives an irradiance of 1 on a
    surface that faces it.

    Parameters
    ----------
    btf : Btf
    out : Path
        A folder that is new or empty.
    name : str
        Of the capture.

    Returns
    -------
    int
        Number of images.

    Raises
    ------
    InputError
        If there are too many images, or no view is above the sample.
    """
    views = np.flatnonzero(btf.views[:, 2] > 1e-3)
    views = views[np.argsort(-btf.views[views, 2], kind="stable")]
    lights = np.flatnonzero(btf.lights[:, 2] > 1e-3)
    n_images = len(views) * len(lights)
    if not 1 <= n_images <= MAX_PHOTOGRAPHS:
        raise InputError(
            f"{name}: expected 1 to {MAX_PHOTOGRAPHS:,} images of views and lights above the "
            f"sample, received {len(views)} x {len(lights)}"
        )
    size = (btf.width, btf.height)
    document = {
        "format": FORMAT, "version": VERSION, "name": name, "base_geometry": PLANE,
        "up": [0, 1, 0],
        "cameras": [
            camera_entry(rectified_camera(btf.views[v], size, name), f"v{i:03d}", None)
            for i, v in enumerate(views)
        ],
        "lights": [
            {"id": f"l{i:03d}", "type": "directional",
             "direction": btf.lights[light].tolist(), "irradiance": [1, 1, 1]}
            for i, light in enumerate(lights)
        ],
        "photographs": {"pattern": "photographs/{camera}_{light}.exr"},
    }  # fmt: skip
    with filling(out) as partial:
        (partial / "photographs").mkdir()
        for i, view in enumerate(track(views, len(views), "writing views")):
            for j, light in enumerate(lights):
                image = btf.image(int(view), int(light))
                half = bool(np.abs(image).max(initial=0) < LARGEST_HALF)
                path = partial / "photographs" / f"v{i:03d}_l{j:03d}.exr"
                write_exr(path, image.astype(np.float16) if half else image)
        text = json.dumps(document, indent=1) + "\n"
        (partial / FILE_NAME).write_text(text, encoding="utf-8")
    return n_images
