"""A capture into a field, and the field under a light and from a side never photographed.

    python examples/process_and_relight.py CAPTURE OUT

Writes everything that ``reflfield run`` writes, and OUT/novel.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

import reflfield as rf


def novel_camera(field: rf.Field, size: int) -> rf.Camera:
    """Look at the object from slightly above, from a side that no rig is likely to have."""
    low, high = field.mesh.bounds
    centre, radius = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low)
    aside = np.cross(field.up, [0.62, 0.31, 0.72])
    position = centre + 6 * radius * (aside / np.linalg.norm(aside) + 0.3 * field.up)
    return rf.Camera.look_at(position, centre, field.up, width=size, height=size, fov_deg=23.5)


def encoded(image: np.ndarray) -> Image.Image:
    """Picture of an image with coverage: bright parts of the object are nearly white."""
    radiance, coverage = image[..., :3], image[..., 3]
    brightest = max(float(np.percentile(radiance[coverage > 0.5], 99.5)), 1e-9)
    shown = np.clip(radiance / brightest, 0.0, 1.0) ** (1 / 2.2)
    return Image.fromarray((255 * shown).round().astype(np.uint8))


def main() -> None:
    """Parse, run, render."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--config", type=Path, help="options in TOML")
    parser.add_argument("--size", type=int, default=400, help="side of the picture, pixels")
    arguments = parser.parse_args()

    options = rf.read_options(arguments.config)
    result = rf.reconstruct(
        arguments.capture, arguments.out, options=options, until="compression"
    )
    field = result.field
    camera = novel_camera(field, arguments.size)
    above = camera.centre + 0.5 * np.linalg.norm(camera.centre) * field.up
    image = field.render(camera, rf.DirectionalLight(above, np.pi), alpha=True)
    picture = arguments.out / "novel.png"
    encoded(image).save(picture)
    print(picture)


if __name__ == "__main__":
    main()
