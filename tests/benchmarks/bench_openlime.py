"""Exported RTI as OpenLIME draws it, beside what was decoded here and what the field shows.

    OPENLIME=openlime.js python tests/benchmarks/bench_openlime.py plate=out/field.rfld

``OPENLIME`` names OpenLIME's script, which is not shipped here: ``dist/js/openlime.js`` of
https://github.com/cnr-isti-vclab/openlime. Needs Chromium and Playwright. The first light is
one of the export's grid, the others lie between its lights.
Images are compared as 8 bits, sRGB-encoded, over all pixels; normals with ``normals.exr``.
``--pictures FOLDER`` keeps what OpenLIME drew. Writes results/openlime.json.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]

import numpy as np  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402
from PIL import Image  # noqa: E402
from playwright.sync_api import sync_playwright  # noqa: E402

from reflfield.capture.encoding import encode_srgb  # noqa: E402
from reflfield.capture.lights import DirectionalLight  # noqa: E402
from reflfield.export.rti import view_camera, write_rti  # noqa: E402
from reflfield.field.file import open_field  # noqa: E402
from reflfield.metrics.frame_errors import angle_deg  # noqa: E402
from reflfield.render.camera_rays import FieldSurface  # noqa: E402
from reflfield.render.renderer import render  # noqa: E402
from tests.export.openlime import openlime_images, openlime_script  # noqa: E402
from tests.export.test_rti import shown, written_normals  # noqa: E402
from tests.viewer.conftest import FLAGS, NAMES  # noqa: E402

LIGHTS = np.array([[0.0, 0.0], [0.5, 0.2], [-0.6, 0.3], [0.2, -0.7], [-0.3, -0.3]])


def field_image(field, camera, light, white):
    """What the field shows under a light of the image's axes, encoded, 0 to 255."""
    towards = light @ (camera.camera_from_world[:3, :3] * [[1.0], [-1.0], [-1.0]])
    image = render(field, camera, DirectionalLight(towards, np.pi)).image
    return 255 * np.asarray(encode_srgb(np.clip(image / white, 0, 1)))


def psnr(images, wanted):
    """Peak signal over the difference, in dB, of values up to 255."""
    return 20 * np.log10(255 / np.sqrt(np.mean((images - wanted) ** 2)))


def drawn(browser, folder, mode, lights):
    """Images that OpenLIME draws of a folder."""
    with tempfile.TemporaryDirectory() as work:
        return openlime_images(browser, folder, Path(work) / mode, lights, mode)


def measured(browser, name, path, pictures):
    """Row of one field."""
    field = open_field(path)
    camera = view_camera(FieldSurface(field))
    lights = np.column_stack([LIGHTS, np.sqrt(1 - (LIGHTS**2).sum(axis=1))])
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "rti"
        notes = write_rti(folder, field)
        white = float(re.search(r"radiance of (\S+)", notes[0])[1])
        images = drawn(browser, folder, "light", LIGHTS)
        normals = drawn(browser, folder, "normals", LIGHTS[:1])[0]
        decoded = 255 * np.clip([shown(folder, light) for light in lights], 0, 1)
        truth = written_normals(folder)
    if pictures:
        pictures.mkdir(parents=True, exist_ok=True)
        every = np.concatenate([*images, normals], axis=1)
        Image.fromarray(every).save(pictures / f"{name}.png")
    wanted = [field_image(field, camera, light, white) for light in lights]
    each = [psnr(*pair) for pair in zip(images, wanted, strict=True)]
    off = angle_deg((normals / 127.5 - 1).reshape(-1, 3), truth.reshape(-1, 3))
    return {
        "field": name,
        "pixels": f"{camera.width} x {camera.height}",
        "most from our decoding, of 255": round(float(np.abs(images - decoded).max()), 3),
        "from the field, mean PSNR, dB": round(float(np.mean(each)), 1),
        "worst light, dB": round(float(np.min(each)), 1),
        "normals, mean degrees": round(float(off.mean()), 2),
        "normals, most degrees": round(float(off.max()), 2),
    }


def named(text):
    """NAME=FILE."""
    name, _, path = text.rpartition("=")
    return name or Path(path).resolve().parent.name, Path(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("fields", type=named, nargs="+", metavar="NAME=FIELD")
    parser.add_argument("--pictures", type=Path)
    arguments = parser.parse_args()
    if openlime_script() is None:
        sys.exit("OPENLIME: expected the path of OpenLIME's script, which is not shipped here")
    results = Results("openlime", "RTI in OpenLIME", ["reflfield.export.rti"])
    results.table("Fields")
    path = next(filter(None, map(shutil.which, NAMES)))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        for name, field in arguments.fields:
            row = measured(browser, name, field, arguments.pictures)
            results.add(row)
            print(json.dumps(row), flush=True)
        browser.close()
    print(results.write())


if __name__ == "__main__":
    main()
