"""A held-out photograph of a run, and beside it the same camera and light from the field.

    python examples/photograph_and_relit.py demo/capture demo examples/vase.png --number 2

Arguments are the capture, the folder of a run that has held photographs of it out, and the
picture to write. Both images have one exposure and are enlarged alike.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image

import reflfield as rf

GAP = 8  # pixels between the two images


def encoded(image: np.ndarray, brightest: float) -> Image.Image:
    """Picture of linear radiance, in sRGB."""
    linear = np.clip(image / brightest, 0.0, 1.0)
    curve = np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
    return Image.fromarray((255 * curve).round().astype(np.uint8))


def side_by_side(capture_path: Path, run: Path, number: int, size: int) -> Image.Image:
    """Photograph and rendered image of one held-out view and light."""
    capture, field = rf.open_capture(capture_path), rf.open_field(run / "field.rfld")
    name = json.loads((run / "metrics.json").read_text())["images"][number]["name"]
    index = [photograph.name for photograph in capture.photographs].index(name)
    described = capture.photographs[index]
    photograph = capture.read_photograph(index)
    rendered = field.render(capture.cameras[described.camera], capture.lights[described.light])
    brightest = float(np.percentile(photograph.max(axis=2), 99.5))
    images = [
        encoded(image, brightest).resize((size, size), Image.LANCZOS)
        for image in (photograph, rendered)
    ]
    both = Image.new("RGB", (2 * size + GAP, size), "white")
    for place, image in zip((0, size + GAP), images, strict=True):
        both.paste(image, (place, 0))
    return both


def main() -> None:
    """Parse, render, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("run", type=Path, help="folder of the results")
    parser.add_argument("picture", type=Path, help="file to write")
    parser.add_argument("--number", type=int, default=0, help="of the held-out photograph")
    parser.add_argument("--size", type=int, default=360, help="side of each image, pixels")
    arguments = parser.parse_args()
    both = side_by_side(arguments.capture, arguments.run, arguments.number, arguments.size)
    both.save(arguments.picture)
    print(arguments.picture)


if __name__ == "__main__":
    main()
