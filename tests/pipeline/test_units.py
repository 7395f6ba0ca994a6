"""Units and origins: the same pictures, whatever lengths, intensities and offsets are in."""

import json
import os
import shutil
import tomllib

import numpy as np
import pytest

from reflfield.capture.image_files import read_image
from reflfield.capture.readers import open_capture
from reflfield.field.file import open_field
from reflfield.options import HoldOut, with_tables
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.stages import run
from reflfield.render.relit_photographs import relight_photographs

# East, north and height of a survey, metres.
SURVEY = (4.4e5, 1e7, 2345.0)


@pytest.fixture(scope="module")
def pictures(tiny_capture, tiny_options, tmp_path_factory):
    """Function from units to what the field makes of four photographs, one of them held out.

    With one cluster: of a ball of one material two would be told apart by rounding.
    """
    tables = tomllib.loads(tiny_options.read_text())
    tables["compression"]["n_clusters"] = 1
    options = with_tables(PipelineOptions(), tables)

    def make(length=1.0, intensity=1.0, offset=(0.0, 0.0, 0.0)):
        folder = tmp_path_factory.mktemp("units")
        shutil.copytree(tiny_capture, folder / "capture", copy_function=os.link)
        path = folder / "capture" / "capture.json"
        document = json.loads(path.read_text())
        document.pop("truth", None)
        for camera in document["cameras"]:
            pose = np.array(camera["camera_from_world"])
            pose[:3, 3] = length * pose[:3, 3] - pose[:3, :3] @ offset
            camera["camera_from_world"] = pose.tolist()
        for light in document["lights"]:
            light["position"] = (length * np.array(light["position"]) + offset).tolist()
            light["intensity"] = (intensity * np.array(light["intensity"])).tolist()
        path.unlink()
        path.write_text(json.dumps(document))
        capture = open_capture(folder / "capture")
        out = folder / "out"
        run(capture, out, options, hold_out=HoldOut(views=1, lights=1), until="compression")
        measured = capture.subset([0, 5], [1, 3])
        for _ in relight_photographs(
            open_field(out / "field.rfld"), measured, folder / "relit"
        ):
            pass
        names = [photograph.name for photograph in measured.photographs]
        return np.stack([read_image(folder / "relit" / f"{name}.exr") for name in names])

    return make


@pytest.fixture(scope="module")
def usual(pictures):
    images = pictures()
    assert images.max() > 0.05
    return images


@pytest.mark.stability
@pytest.mark.parametrize(
    ("units", "tolerance"),
    [
        # Powers of two change no digit but in functions that are not exact to the last one.
        pytest.param({"intensity": 2.0**-42}, 1e-3, marks=pytest.mark.slow),
        pytest.param({"length": 2.0**-21}, 1e-3, marks=pytest.mark.slow),
        # Halves round samples otherwise, by 2^-11; two rounds on so coarse grids pass that on
        # to highlights, .03 when this was written.
        ({"intensity": 1e12, "length": 1e6}, 0.05),
        # Whether angles about the normals were known once depended on such roundings.
        ({"intensity": 1.3}, 0.05),
        # Vertices are rounded to a millionth of the ball's radius, and charts are made anew.
        ({"offset": SURVEY}, 0.05),
    ],
    ids=["dim", "small", "bright-large", "other roundings", "survey"],
)
def test_pictures_do_not_depend_on_units(pictures, usual, units, tolerance):
    """Root mean square of the difference over that of the pictures."""
    error = np.sqrt(np.mean((pictures(**units) - usual) ** 2) / np.mean(usual**2))
    assert error < tolerance
