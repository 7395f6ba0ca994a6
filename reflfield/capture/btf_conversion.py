"""A ``.btf`` container as a native capture: linear EXR images of a flat sample."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.btf import Btf, Float32
from reflfield.capture.capture import PLANE
from reflfield.capture.documents import MAX_PHOTOGRAPHS
from reflfield.capture.image_writing import write_exr
from reflfield.capture.native import FILE_NAME, FORMAT, VERSION
from reflfield.capture.native_writing import camera_entry
from reflfield.capture.rectified_samples import LEAST_COSINE, rectified_camera
from reflfield.errors import InputError
from reflfield.util.files import filling
from reflfield.util.progress import track

LARGEST_HALF = 6e4
# Samples of so few texels have all images of a view in one file.
MOST_TEXELS_TOGETHER = 64
FOLDER = "photographs"


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
    order = np.argsort(-btf.views[:, 2], kind="stable")
    views = [int(view) for view in order if btf.views[view, 2] > LEAST_COSINE]
    lights = np.flatnonzero(btf.lights[:, 2] > LEAST_COSINE).tolist()
    n_images = len(views) * len(lights)
    if not 1 <= n_images <= MAX_PHOTOGRAPHS:
        raise InputError(
            f"{name}: expected 1 to {MAX_PHOTOGRAPHS:,} images of views and lights above the "
            f"sample, received {len(views)} x {len(lights)}"
        )
    size = (btf.width, btf.height)
    document: dict[str, Any] = {
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
    }  # fmt: skip
    together = btf.width * btf.height <= MOST_TEXELS_TOGETHER
    write = _write_layers if together else _write_images
    with filling(out) as partial:
        (partial / FOLDER).mkdir()
        document["photographs"] = [
            entry
            for i, view in enumerate(track(views, len(views), "writing views"))
            for entry in write(i, [btf.image(view, light) for light in lights], partial)
        ]
        text = json.dumps(document, indent=1) + "\n"
        (partial / FILE_NAME).write_text(text, encoding="utf-8")
    return n_images


def _write_images(view: int, images: list[Float32], folder: Path) -> list[Any]:
    """One file for each light; entries of the photographs."""
    entries = []
    for light, image in enumerate(images):
        name = f"{FOLDER}/v{view:03d}_l{light:03d}.exr"
        write_exr(folder / name, _stored(image))
        entries.append({"camera": f"v{view:03d}", "light": f"l{light:03d}", "file": name})
    return entries


def _write_layers(view: int, images: list[Float32], folder: Path) -> list[Any]:
    """One file for a view, a layer for each light; entries of the photographs."""
    name = f"{FOLDER}/v{view:03d}.exr"
    layers = [f"l{light:03d}" for light in range(len(images))]
    channels = [f"{layer}.{channel}" for layer in layers for channel in "RGB"]
    write_exr(folder / name, _stored(np.concatenate(images, axis=2)), channels)
    return [
        {"camera": f"v{view:03d}", "light": layer, "file": name, "layer": layer}
        for layer in layers
    ]


def _stored(image: Float32) -> NDArray[Any]:
    """As half floats where they are large enough."""
    return image.astype(np.float16) if np.abs(image).max(initial=0) < LARGEST_HALF else image
