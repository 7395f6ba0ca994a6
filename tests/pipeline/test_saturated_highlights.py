"""How far a field is below what saturated photographs say at least."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_files import read_image
from reflfield.capture.image_writing import write_png
from reflfield.capture.readers import open_capture
from reflfield.field.file import open_field
from reflfield.options import read_toml, with_tables
from reflfield.pipeline.cache import WARNINGS, StageRecord
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.saturated_highlights import MET, saturation_counts, shortfalls


@pytest.fixture(scope="module")
def clipped(tiny_capture, tmp_path_factory):
    """The tiny capture in 8 bits, its brightest values cut off; radiance in units of white."""
    folder = tmp_path_factory.mktemp("clipped") / "capture"
    shutil.copytree(tiny_capture, folder, ignore=shutil.ignore_patterns("truth", "*.exr"))
    images = {p.stem: read_image(p) for p in (tiny_capture / "photographs").glob("*.exr")}
    lit = np.concatenate([image[image > 0] for image in images.values()])
    white = float(np.quantile(lit, 0.7))  # matt shading is cut off, not highlights alone
    for name, image in images.items():
        codes = np.rint(255 * encode_srgb(np.clip(image / white, 0, 1)))
        write_png(folder / "photographs" / f"{name}.png", codes.astype(np.uint8))
    document = json.loads((folder / "capture.json").read_text())
    document.pop("truth", None)
    document["photographs"] = {"pattern": "photographs/{camera}_{light}.png"}
    for light in document["lights"]:
        light["intensity"] = (np.array(light["intensity"]) / white).tolist()
    (folder / "capture.json").write_text(json.dumps(document))
    return open_capture(folder)


@pytest.fixture
def context(finished, clipped, tiny_options, context_of):
    """The run of the photographs that are not clipped, with those that are."""
    return context_of(
        clipped, finished.folder, with_tables(PipelineOptions(), read_toml(tiny_options))
    )


def all_shortfalls(context):
    field = open_field(context.out / "field.rfld")
    return np.concatenate(list(shortfalls(context, field)))


def under_weaker_lights(context, factor):
    """The same photographs under lights of less intensity: all bounds are higher."""
    lights = tuple(
        replace(light, intensity=light.intensity / factor) for light in context.capture.lights
    )
    return replace(context, capture=replace(context.capture, lights=lights))


def test_a_field_of_whole_highlights_meets_most_bounds(context):
    ratios = all_shortfalls(context)
    assert len(ratios) > 50
    assert np.median(ratios) > 0.98


def test_shortfall_is_in_proportion_to_the_bound(context):
    ratios = all_shortfalls(context)
    weak = all_shortfalls(under_weaker_lights(context, 8.0))
    # Lights are stored in double, samples in single precision.
    np.testing.assert_allclose(weak, np.maximum(ratios / 8, 1e-3), rtol=1e-5)


def test_shortfall_is_told_where_values_are_saturated(context):
    dim = under_weaker_lights(context, 8.0)
    field = open_field(context.out / "field.rfld")
    assert saturation_counts(dim, field) == {}
    counts = {"values saturated": 900, "values measured": 9000}
    dim.stages.records.append(StageRecord("observations", "", 0.0, 0, 0, counts))
    said = saturation_counts(dim, field)
    below = all_shortfalls(dim) < MET
    assert said["of those the field is darker at"] == below.sum() > 0
    (line,) = said[WARNINGS]
    assert line.startswith("highlights: 900 saturated values were left out of the fit")
    factor = said["bound over the field there, median"]
    assert 2 < factor < 8.2  # the photographs are at least at the bound
    assert f"at least {factor:.1f} times as bright" in line
