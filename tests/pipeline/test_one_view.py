"""One view under many lights: frames are true normals, and the field shows held-out lights."""

from dataclasses import replace

import numpy as np
import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.capture.readers import open_capture
from reflfield.field.file import open_field
from reflfield.options import HoldOut, Resources
from reflfield.pipeline import results, stages
from reflfield.pipeline.comparison import comparison_of
from reflfield.pipeline.pipeline_options import PipelineOptions

SCENE = {
    "base_geometry": "plane",
    "effects": ["near_lights", "shadows"],
    "object": {"preset": "relief"},
    "material": {"preset": "gold"},
    "cameras": {
        "preset": "rti",
        "model": "orthographic",
        "extent": 0.18,
        "width": 40,
        "height": 40,
    },
    "lights": {"preset": "rti", "n": 60, "max_inclination_deg": 75, "distance": 0.5},
    "image": {"samples_per_side": 1, "edge_samples_per_side": 1},
}


@pytest.fixture(scope="module")
def relief(tmp_path_factory):
    """Simulated gold relief, and its run up to the comparison."""
    folder = tmp_path_factory.mktemp("relief")
    write_capture(parse_scene(SCENE), folder / "capture")
    usual = PipelineOptions()
    samples = replace(usual.compression.samples, rounds=2, iterations=6)
    options = replace(usual, compression=replace(usual.compression, samples=samples))
    return stages.run(
        open_capture(folder / "capture"),
        folder / "out",
        options,
        hold_out=HoldOut(lights=4),
        resources=Resources(workers=1),
        until="comparison",
    )


def test_normals_are_those_of_the_relief(relief):
    field, texels = open_field(results.field_file(relief)), results.texels(relief)
    camera = relief.training.cameras[0]
    column, row = camera.project(texels.position)[0].astype(int).T
    truth = np.load(relief.capture.root / "truth" / "views" / f"{camera.id}.npz")["normal"]
    cosines = np.einsum("nd,nd->n", field.local_from_world[:, 2], truth[row, column])
    errors = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    # Pixels at steps of the relief mix two normals; the rest is right within a degree.
    assert np.median(errors) < 1.0
    lean = np.degrees((field.local_from_world[:, 2] - truth[row, column]).mean(axis=0)[:2])
    assert np.abs(lean).max() < 0.5
    base = np.degrees(np.arccos(np.clip(truth[row, column][:, 2], -1, 1)))
    assert errors.mean() < 0.25 * base.mean()


def test_texels_are_fitted_in_one_pass(relief):
    names = [record.name for record in relief.stages.records]
    assert "completion" not in names  # which only the search for frames needs
    assert relief.stages.record("compression").counts["clusters"] == 16
    assert relief.stages.record("compression").counts["components"] == 12
    counts = relief.stages.record("compression").counts
    assert counts["texels fitted"] == len(results.measured_texels(relief))


def test_held_out_lights_are_shown(relief):
    comparison = comparison_of(relief, "heldout")
    # Measured 26 dB; a mean texture reaches 18.
    assert comparison.mean["psnr_ldr"] > 23


def test_counts_that_are_stated_are_kept(relief):
    options = PipelineOptions()
    stated = replace(options, compression=replace(options.compression, n_components=3))
    context = replace(relief, options=stated)
    assert context.options.compression.components == 3
    assert context.options.compression.clusters == 16
