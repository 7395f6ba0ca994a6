"""Overexposed photographs: the field is nearer to those that are not clipped."""

import json
import os
import shutil
import tomllib

import numpy as np
import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_files import read_image
from reflfield.capture.image_writing import write_png
from reflfield.capture.readers import open_capture
from reflfield.field.file import open_field
from reflfield.observations import image_projection
from reflfield.options import HoldOut, with_tables
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.stages import run
from reflfield.render.relit_photographs import relight_photographs
from tests.tiny_dome import ball_scene

# Matt, so that what is clipped under one light is not under another.
SCENE = ball_scene(
    "overexposed",
    {"preset": "grey_card", "albedo": 0.8},
    n_lights=(6, 4),
    truth={"points": 0, "per_view": False},
)
# A quarter of the lit values are brighter.
WHITE = 0.2


@pytest.fixture(scope="module")
def exposed(tmp_path_factory):
    """Folder of the capture as it was simulated: nothing is clipped. Read only."""
    return write_capture(parse_scene(SCENE), tmp_path_factory.mktemp("exposed") / "capture")


@pytest.fixture(scope="module")
def clipped(exposed, tmp_path_factory):
    """The same capture as 8-bit files of one exposure; radiance in units of their white."""
    folder = tmp_path_factory.mktemp("clipped") / "capture"
    shutil.copytree(exposed, folder, copy_function=os.link)
    path = folder / "capture.json"
    document = json.loads(path.read_text())
    document.pop("truth", None)
    document["photographs"] = {"pattern": "photographs/{camera}_{light}.png"}
    for source in (folder / "photographs").glob("*.exr"):
        encoded = encode_srgb(np.clip(read_image(source) / WHITE, 0, 1))
        write_png(source.with_suffix(".png"), np.rint(255 * encoded).astype(np.uint8))
    for light in document["lights"]:
        light["intensity"] = (np.array(light["intensity"]) / WHITE).tolist()
    path.unlink()
    path.write_text(json.dumps(document))
    return open_capture(folder)


def error_of(clipped, exposed, tiny_options, folder):
    """Root mean square of the field's error on an unseen photograph that is not clipped."""
    options = with_tables(PipelineOptions(), tomllib.loads(tiny_options.read_text()))
    context = run(
        clipped, folder, options, hold_out=HoldOut(views=1, lights=1), until="compression"
    )
    held_out, unclipped = context.held_out, open_capture(exposed)
    field, squares = open_field(folder / "field.rfld"), []
    for _ in relight_photographs(field, held_out, folder / "relit"):
        pass
    for photograph in held_out.photographs:
        index = [p.name for p in unclipped.photographs].index(photograph.name)
        shown = read_image(folder / "relit" / f"{photograph.name}.exr") * WHITE
        squares.append((shown - unclipped.read_photograph(index)) ** 2)
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.slow
def test_field_of_clipped_photographs_is_nearer_to_those_that_are_not(
    clipped, exposed, tiny_options, tmp_path, monkeypatch
):
    arguments = clipped, exposed, tiny_options
    left_out = error_of(*arguments, tmp_path / "left-out")
    monkeypatch.setattr(image_projection, "NOT_MEASURED", ("dark",))
    is_dark = np.array([kind == "dark" for kind in image_projection.VALUE_KINDS])
    monkeypatch.setattr(image_projection, "IS_GAP", is_dark)
    counted = error_of(*arguments, tmp_path / "counted")
    print(left_out, counted)
    assert left_out < 0.9 * counted
