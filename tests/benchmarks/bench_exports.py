"""Exports of a field in software that is not this project's, beside the field.

    BLENDER_PYTHON=bpyenv/bin/python BTF_HH=btf.hh python tests/benchmarks/bench_exports.py \
        demo/field.rfld --pictures pictures

Blender's Cycles draws `blender` (``BLENDER_PYTHON`` names a Python with the package ``bpy``)
from three sides, 256 x 256 pixels, 64 samples each, direct light of one sun: relative L2 and
brightness off the edges of object and shadows. OpenImageIO reads `exr`, btf.hh
(``BTF_HH``) reads `btf`: largest and relative difference from the field. What is absent is left
out, saying so. Writes results/exports.json.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]

import numpy as np  # noqa: E402
import OpenImageIO  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402
from PIL import Image  # noqa: E402

from reflfield.capture.cameras import Camera  # noqa: E402
from reflfield.capture.encoding import encode_srgb  # noqa: E402
from reflfield.export.formats import export_field  # noqa: E402
from reflfield.export.texture_layers import texture_layers  # noqa: E402
from reflfield.field.evaluation import evaluate  # noqa: E402
from reflfield.field.file import open_field  # noqa: E402
from tests.export.blender_images import blender_python, compared  # noqa: E402
from tests.export.btf_hh import missing, read_by_btf_hh  # noqa: E402

SIDES = (
    ((0.9, -0.3, 0.35), (0.6, -0.6, 0.7)),
    ((-0.5, -0.9, 0.4), (0.3, -0.7, 0.9)),
    ((0.2, 0.9, 0.6), (-0.7, 0.6, 0.8)),
)
FOV_DEG, DIAGONALS, SIZE = 26, 2.2, 256
PAIRS = np.array([[0, 60], [60, 130], [100, 20], [140, 75]])  # views and lights of the dome


def encoded(image, white):
    """8-bit picture of a linear image."""
    return np.rint(255 * np.asarray(encode_srgb(np.clip(image / white, 0, 1)))).astype("u1")


def in_blender(field, folder):
    """Rows of figures, and pictures: Blender's, the field's, five times their difference."""
    export_field(field, folder / "blender", "blender")
    low, high = field.positions.min(axis=0), field.positions.max(axis=0)
    centre, diagonal = (low + high) / 2, np.linalg.norm(high - low)
    for side, towards in SIDES:
        place = centre + DIAGONALS * diagonal * np.array(side) / np.linalg.norm(side)
        camera = Camera.look_at(place, centre, width=SIZE, height=SIZE, fov_deg=FOV_DEG)
        shown = compared(field, folder / "blender", folder, camera, FOV_DEG, towards)
        white = np.percentile(shown.wanted[shown.inside], 99.5)
        off = 0.5 + 5 * (shown.drawn - shown.wanted) * shown.inside[..., None] / white
        grey = np.rint(255 * np.clip(off, 0, 1)).astype("u1")
        pair = [encoded(image, white) for image in (shown.drawn, shown.wanted)]
        row = {"relative difference": round(shown.relative, 4)}
        for name, ratio in zip(("red", "green", "blue"), shown.ratios, strict=True):
            row[f"{name} over the field's"] = round(float(ratio), 3)
        yield row, np.concatenate([*pair, grey], axis=1)


def in_image_readers(field, folder):
    """Row of figures, and the normals as OpenImageIO reads them."""
    export_field(field, folder / "layers.exr", "exr")
    layers = texture_layers(field)
    buffer = OpenImageIO.ImageBuf(str(folder / "layers.exr"))
    names, pixels = buffer.spec().channelnames, buffer.get_pixels(OpenImageIO.FLOAT)
    texels = field.texel_of_pixel
    off = [
        np.abs(pixels[..., names.index(name)][texels >= 0] - values[texels[texels >= 0]]).max()
        for name, values in layers.items()
    ]
    normals = pixels[..., [names.index(f"normal.{axis}") for axis in "XYZ"]]
    row = {"layers": len(names), "largest difference": float(np.max(off))}
    return row, np.rint(127.5 * (normals + 1)).astype("u1")


def in_btf_hh(field, folder):
    """Row of figures, and pictures: btf.hh's above the field's."""
    export_field(field, folder / "field.btf", "btf")
    read = read_by_btf_hh(folder / "field.btf", folder, PAIRS)
    covered = field.texel_of_pixel >= 0
    texels = field.texel_of_pixel[covered]
    frames = field.local_from_world[texels]
    wanted = np.zeros_like(read.images)
    for image, pair in zip(wanted, PAIRS, strict=True):
        world = [np.einsum("j,njk->nk", read.lights[k], frames).astype("f4") for k in pair]
        image[covered] = evaluate(field, texels, *world)
    shown = np.where(covered[..., None], read.images, 0)
    off = np.linalg.norm(shown - wanted) / np.linalg.norm(wanted)
    row = {"pairs of directions": len(PAIRS), "relative difference": round(float(off), 6)}
    white = np.percentile(wanted, 99.5)
    lines = [np.concatenate(encoded(images, white), axis=1) for images in (shown, wanted)]
    return row, np.concatenate(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("field", type=Path)
    parser.add_argument("--pictures", type=Path, default=Path("pictures"))
    arguments = parser.parse_args()
    arguments.pictures.mkdir(parents=True, exist_ok=True)
    field = open_field(arguments.field)
    modules = [
        f"reflfield.export.{name}" for name in ("blender", "texture_layers", "btf_samples")
    ]
    results = Results("exports", "Exports in other software", modules)

    def say(name, row, picture):
        results.add(row)
        results.say()
        Image.fromarray(picture).save(arguments.pictures / f"{name}.png")

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        results.table("`exr` in OpenImageIO")
        say("exr", *in_image_readers(field, folder))
        if missing() is None:
            results.table("`btf` in btf.hh")
            say("btf", *in_btf_hh(field, folder))
        else:
            print(f"btf: left out, {missing()}")
        if blender_python() is None:
            print("blender: left out, needs BLENDER_PYTHON")
        else:
            results.table("`blender` in Cycles, from three sides")
            for k, (row, picture) in enumerate(in_blender(field, folder)):
                say(f"blender_{k}", row, picture)
    print(results.write())


if __name__ == "__main__":
    main()
