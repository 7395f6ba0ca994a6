"""An amphora that lights itself up: its shadows are not black, and the field knows it."""

import json

import numpy as np
import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.field.file import open_field

AMPHORA = {
    "name": "amphora",
    "object": {"preset": "amphora"},
    "material": {"preset": "grey_card", "albedo": 0.8},
    "effects": ["shadows", "near_lights", "interreflection"],
    "cameras": {
        "preset": "rings",
        "elevations_deg": [-20, 25, 60],
        "counts": [3, 4, 4],
        "offsets_deg": [0, 30, 0],
        "distance": 0.8,
        "target": [0, 0, 0.1],
        "extent": 0.3,
        "width": 40,
        "height": 40,
    },
    "lights": {
        "preset": "rings",
        "elevations_deg": [15, 50],
        "counts": [7, 4],
        "distance": 0.9,
        "target": [0, 0, 0.1],
    },
    "image": {"samples_per_side": 2, "edge_samples_per_side": 2},
    "heldout": {"frames": 4},
    "truth": {"points": 0, "per_view": False},
}


@pytest.fixture(scope="module")
def amphora(tmp_path_factory):
    return write_capture(parse_scene(AMPHORA), tmp_path_factory.mktemp("amphora") / "capture")


def test_light_that_the_object_sends_to_itself_is_found(
    amphora, tmp_path, reflfield, tiny_options
):
    found = {}
    for enabled in ("true", "false"):
        out = tmp_path / enabled
        outcome = reflfield(
            *(
                "run",
                amphora,
                "-o",
                out,
                "--config",
                tiny_options,
                "--hold-out",
                "views=1,lights=1",
            ),
            *(
                "--set",
                f"indirect.enabled={enabled}",
                "--set",
                "hull.resolution=48",
                "--set",
                "relighting.samples_per_pixel=4",
            ),
            *("--set", "comparison.without_alignment=false"),
            *("--set", "comparison.rate_distortion=false"),
        )
        assert outcome.status == 0, outcome.err
        unseen = json.loads((out / "stages/comparison/field/truth.json").read_text())
        found[enabled] = unseen["mean"]["psnr_ldr"]
        assert open_field(out / "field.rfld").indirect.is_black == (enabled == "false")
    # So coarse a field has larger errors; .39 dB when this was written.
    assert found["true"] > found["false"] + 0.2
    record = json.loads((tmp_path / "true/stages/indirect/stage.json").read_text())
    stored = np.load(tmp_path / "true/stages/visibility/visibility.npz")
    in_shadow = stored["views"].sum(axis=1) @ (~stored["lights"]).sum(axis=1)
    assert record["counts"]["samples in shadow"] == in_shadow
