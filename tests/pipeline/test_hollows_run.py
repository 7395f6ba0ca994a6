"""A run of a simulated clay bowl: its hollow is carved before charts are made."""

from dataclasses import replace

import numpy as np
import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.capture.readers import open_capture
from reflfield.geometry.mesh import read_ply
from reflfield.geometry.visual_hull import HullOptions
from reflfield.metrics.hull_distance import hull_distance
from reflfield.options import HoldOut, Resources
from reflfield.pipeline import results, stages
from reflfield.pipeline.hollows import CARVED, SHARE, has_common_lights
from reflfield.pipeline.pipeline_options import PipelineOptions

SCENE = {
    "name": "clay_bowl",
    "effects": ["antialiasing", "near_lights", "shadows"],
    "object": {"preset": "bowl", "radius": 0.08},
    "material": {"preset": "matte_clay"},
    "cameras": {
        "preset": "rings",
        "elevations_deg": [-20, 0, 35, 65, 90],
        "counts": [3, 4, 6, 5, 1],
        "offsets_deg": [0, 20, 0, 15, 0],
        "distance": 0.8,
        "extent": 0.22,
        "width": 56,
        "height": 56,
    },
    "lights": {
        "preset": "rings",
        "elevations_deg": [10, 45, 75],
        "counts": [4, 4, 3],
        "offsets_deg": [10, 30, 0],
        "distance": 0.6,
    },
    "truth": {"points": 20},
}
OPTIONS = PipelineOptions(hull=HullOptions(resolution=96, n_triangles=8000))


@pytest.fixture(scope="module")
def bowl(made_once):
    """Folder of the capture. Read only."""

    def fill(folder):
        write_capture(parse_scene(SCENE), folder)

    return made_once("clay_bowl", fill)[0]


def run(bowl, out, options=OPTIONS, hold_out=None):
    capture = open_capture(bowl)
    return stages.run(
        capture, out, options, hold_out=hold_out, resources=Resources(2), until="atlas"
    )


@pytest.fixture(scope="module")
def context(bowl, tmp_path_factory):
    return run(bowl, tmp_path_factory.mktemp("bowl"))


def off_truth(context, bowl, mesh):
    """Mean distance of a mesh to the true one, metres."""
    true = read_ply(bowl / "truth" / "mesh.ply")
    distance = hull_distance((mesh.vertices, mesh.faces), (true.vertices, true.faces))
    return np.abs(distance.signed).mean()


def test_base_mesh_is_the_bowl_and_the_hull_stays(context, bowl):
    hull, base = results.hull_mesh(context), results.base_mesh(context)
    assert off_truth(context, bowl, hull) > 0.005
    # Pixels of 4 mm, voxels of 1.7.
    assert off_truth(context, bowl, base) < 0.001
    assert context.stages.record("hollows").counts[SHARE] > 0.5
    # Charts hold positions in single precision.
    assert results.atlas(context).mesh.volume == pytest.approx(base.volume, rel=1e-6)


def test_hollows_stay_filled_where_the_option_says_so(bowl, tmp_path):
    options = replace(OPTIONS, hull=replace(OPTIONS.hull, hollows=False))
    context = run(bowl, tmp_path, options)
    assert context.stages.record("hollows") is None
    assert results.base_mesh(context) is results.hull_mesh(context)


def test_what_is_carved_follows_from_the_photographs(context, bowl, tmp_path):
    other = run(bowl, tmp_path, hold_out=HoldOut(views=1, lights=1))
    assert other.stages.record("hollows").key != context.stages.record("hollows").key
    assert (other.stages.root / "hollows" / CARVED).is_file()


def test_few_lights_are_not_compared(context):
    few = replace(context, hold_out=HoldOut(views=0, lights=4))
    assert has_common_lights(context)
    assert not has_common_lights(few)
