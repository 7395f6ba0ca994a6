"""Figures 9 and 10 of the paper: an object from its reflectance field.

The paper's vase is not public. A vase of glaze, paint and brushed gold is simulated on a dome
of so many cameras and lamps, and processed as in the paper: visual hull, completion, alignment
in 16 clusters, local PCA of 16 x 10. Photographs of two cameras and two lamps are kept apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.api.captures import open_capture
from reflfield.api.fields import Field
from reflfield.api.reconstruction import Result, reconstruct
from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.demo import simulate
from reflfield.options import HoldOut, Resources
from reflfield.render.environment_map import EnvironmentMap
from reflfield.render.exposure import ExposureMeter, encoded_picture
from reflfield.report.page import (
    Cell,
    Figure,
    Panel,
    Section,
    Table,
    encode_picture,
    format_bytes,
)
from reflfield.report.pictures import directions_coloured, fitted, texture
from reflfield.util.files import replacing

SCENE = """
description = "the paper's job at {directions} x {directions} photographs"
effects = ["antialiasing", "near_lights", "shadows"]
[object]
preset = "vase"
[material]
preset = "painted_vase"
[cameras]
preset = "{rig}"
{count}
target = [0.0, 0.0, 0.1]
distance = 1.0
extent = 0.25
width = {pixels}
height = {pixels}
[lights]
preset = "{rig}"
{count}
target = [0.0, 0.0, 0.1]
distance = 1.0
[heldout]
photographs = 4
[truth]
per_view = false
points = {points}
"""
# Rigs that have so many cameras and lamps.
DOMES = {81: "ubo81", 151: "bonn151"}
HELD_OUT = HoldOut(views=2, lights=2)
# Clusters, components, and what else the paper says of its compression (section 5.3).
OPTIONS: dict[str, Any] = {
    "alignment": {"n_clusters": 16},
    "compression": {
        "model": "clustered",
        "fit": "grid",
        "n_clusters": 16,
        "n_components": 10,
    },
    "resampling": {"visibility": "kept"},
    "comparison": {"without_alignment": True},
}
# Pixels of the pictures under an environment, and where its cameras stand.
SIDE, AZIMUTHS, DISTANCE, HEIGHT = 256, (0.0, 2.1, 4.2), 0.45, 0.25
# Largest side of the normal map.
MAP_SIDE = 512
CENTRE = (0.0, 0.0, 0.1)
SKY_ROWS = 16


def scene_text(directions: int, pixels: int, n_points: int = 100) -> str:
    """Scene of the simulator with so many cameras and as many lamps.

    Parameters
    ----------
    directions : int
        Cameras, and lamps.
    pixels : int
        Side of the photographs.
    n_points : int
        Points of the surface whose true samples are written.

    Examples
    --------
    >>> scene_text(151, 256).count('preset = "bonn151"')
    2
    """
    count = "" if directions in DOMES else f"n = {directions}\nmax_inclination_deg = 75"
    rig = DOMES.get(directions, "fibonacci")
    return SCENE.format(
        directions=directions, rig=rig, count=count, pixels=pixels, points=n_points
    )


def make_object(folder: Path, directions: int, pixels: int, workers: int) -> Result:
    """Simulate the vase and process it; what is there already is used again."""
    capture = folder / "capture"
    if not (capture / "capture.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        scene = scene_text(directions, pixels)
        with replacing(folder / "scene.toml") as partial:
            partial.write_text(scene, encoding="utf-8")
        simulate(capture, workers, str(folder / "scene.toml"))
    return reconstruct(
        capture,
        folder / "run",
        hold_out=HELD_OUT,
        options=OPTIONS,
        resources=Resources(workers=workers),
    )


def figure_9(result: Result, capture: Path, directions: int) -> Section:
    """Normal map, a held-out photograph, and the same from the compressed field."""
    field, size = result.field, (result.folder / "field.rfld").stat().st_size
    normals = texture(field.normals, field.stored.texel_of_pixel)
    picture = fitted(directions_coloured(np.nan_to_num(normals)), MAP_SIDE)
    panels = [Panel(encode_picture(picture), "normals of the local frames, as the atlas")]
    panels += _held_out(result, open_capture(capture))
    mean = result.metrics["mean"]
    counts = {record.name: record.counts for record in result.stages}["comparison"]
    unaligned = float(counts["heldout PSNR without alignment, dB"])
    rows: list[tuple[Cell, ...]] = [
        ("the paper's vase", "151 x 151", "22 MB", None, None),
        (
            "here",
            f"{directions} x {directions}",
            format_bytes(size),
            float(mean["psnr_ldr"]),
            float(mean["ssim"]),
        ),
        ("here, not aligned, as large", None, None, unaligned, None),
    ]
    table = Table(
        ("object", "photographs", "size", "held-out PSNR, dB", "SSIM"),
        tuple(rows),
        "Local PCA of 16 clusters and 10 components",
    )
    caption = (
        "In the paper the difference to the uncompressed rendering is hardly noticeable, apart "
        "from a small color degradation and artifacts at the handle. Here the photograph was "
        "held out: the field has not seen its camera or its lamp."
    )
    return Section(
        "Figure 9: the vase from its compressed field",
        "Normals from reflectance alone, and the rendering beside the photograph.",
        (Figure(tuple(panels), caption, min_width=240), table),
    )


def figure_10(field: Field) -> Section:
    """The vase under an environment from several sides."""
    sky = EnvironmentMap(evening_sky())
    images = [field.render(_camera(a), environment=sky, alpha=True) for a in AZIMUTHS]
    meter = ExposureMeter()
    for image in images:
        meter.add(image[..., :3], image[..., 3])
    panels = tuple(
        Panel(encode_picture(encoded_picture(image[..., :3], meter.exposure)), f"view {i + 1}")
        for i, image in enumerate(images)
    )
    caption = (
        "A low sun, a blue sky and brown ground, made for this page; the paper's light "
        "probes are photographs."
    )
    return Section(
        "Figure 10: image-based lighting",
        "Arbitrary viewpoints under arbitrary lighting.",
        (Figure(panels, caption, min_width=240),),
    )


def evening_sky() -> NDArray[np.float32]:
    """Radiance (rows, 2 rows, 3) of a sky with a low sun over dark ground.

    Examples
    --------
    >>> evening_sky().shape
    (16, 32, 3)
    """
    elevation = np.pi / 2 - np.pi * (np.arange(SKY_ROWS) + 0.5) / SKY_ROWS
    azimuth = 2 * np.pi * (np.arange(2 * SKY_ROWS) + 0.5) / (2 * SKY_ROWS)
    up = np.sin(elevation)[:, None, None]
    blue, horizon, ground = np.array([[0.2, 0.4, 0.9], [0.9, 0.6, 0.4], [0.12, 0.08, 0.05]])
    sky = np.where(up > 0, horizon + np.sqrt(np.abs(up)) * (blue - horizon), ground)
    radiance = np.repeat(sky, 2 * SKY_ROWS, axis=1)
    away = (elevation[:, None] - 0.5) ** 2 + (azimuth - 1.2) ** 2
    sun = np.exp(-away / 0.02)[..., None] * np.array([30.0, 22.0, 12.0])
    return (radiance + sun).astype(np.float32)


def _camera(azimuth: float) -> Camera:
    position = (
        DISTANCE * np.cos(azimuth),
        DISTANCE * np.sin(azimuth),
        HEIGHT,
    )
    return Camera.look_at(position, target=CENTRE, width=SIDE, height=SIDE)


def _held_out(result: Result, capture: Capture) -> list[Panel]:
    """The first held-out photograph, and the same camera and lamp from the field."""
    names = [photograph.name for photograph in capture.photographs]
    index = names.index(result.metrics["images"][0]["name"])
    described, photograph = capture.photographs[index], capture.read_photograph(index)
    rendered = result.field.render(
        capture.cameras[described.camera], capture.lights[described.light]
    )
    meter = ExposureMeter()
    meter.add(photograph, photograph.max(axis=2) > 0)
    return [
        Panel(encode_picture(encoded_picture(image, meter.exposure)), label)
        for image, label in (
            (photograph, "photograph that was held out"),
            (rendered, "from the compressed field"),
        )
    ]
