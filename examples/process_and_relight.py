"""A capture into a field, and the field under a light and from a side never photographed.

    python examples/process_and_relight.py CAPTURE OUT

Writes everything that ``reflfield run`` writes, and OUT/novel.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.image_writing import write_png
from reflfield.capture.lights import Light
from reflfield.capture.readers import open_capture
from reflfield.field.file import open_field
from reflfield.options import read_toml, with_tables
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.stages import run
from reflfield.render.exposure import encoded_picture
from reflfield.render.renderer import render


def novel_camera(positions: np.ndarray, up: np.ndarray, size: int) -> Camera:
    """Look at the object from slightly above, from a side that no rig is likely to have."""
    centre = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    radius = np.linalg.norm(positions - centre, axis=1).max()
    aside = np.cross(up, [0.62, 0.31, 0.72])
    position = centre + 6 * radius * (aside / np.linalg.norm(aside) + 0.3 * up)
    pose = looking_at(position, centre, up)
    focal, middle = 2.4 * size, 0.5 * size
    return Camera("novel", "opencv", size, size, focal, focal, middle, middle, pose)


def main() -> None:
    """Parse, run, render."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--config", type=Path, help="options in TOML")
    parser.add_argument("--size", type=int, default=400, help="side of the picture, pixels")
    arguments = parser.parse_args()

    capture = open_capture(arguments.capture)
    tables = read_toml(arguments.config) if arguments.config else {}
    options = with_tables(PipelineOptions(), tables)
    run(capture, arguments.out, options, last="compression")

    field = open_field(arguments.out / "field.rfld")
    camera = novel_camera(field.positions, capture.up, arguments.size)
    towards_light = camera.centre + 0.5 * np.linalg.norm(camera.centre) * capture.up
    light = Light(
        "sun",
        "directional",
        direction=towards_light / np.linalg.norm(towards_light),
        intensity=np.full(3, np.pi),
    )
    rendering = render(field, camera, light)
    brightest = np.percentile(rendering.image[rendering.coverage > 0.5], 99.5)
    picture = arguments.out / "novel.png"
    write_png(picture, encoded_picture(rendering.image, 1.0 / max(float(brightest), 1e-9)))
    print(picture)


if __name__ == "__main__":
    main()
