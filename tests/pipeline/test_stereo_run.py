"""A run of a patterned bowl under one light: stereo carves it before charts are made."""

from dataclasses import replace

import cv2
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
from reflfield.pipeline.hollows import CARVED, SHARE, has_common_lights, has_neighbours
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.report import SURFACE_VIEWS, surface_views
from reflfield.tradeoff.work_counts import counts_of

SCENE = {
    "name": "patterned_bowl",
    "effects": ["antialiasing", "near_lights", "shadows"],
    "object": {"preset": "bowl", "radius": 0.08},
    "material": {"type": "lambert", "albedo": {"type": "image", "file": "pattern.png"}},
    "cameras": {
        "preset": "rings",
        "elevations_deg": [5, 40, 70],
        "counts": [12, 10, 6],
        "offsets_deg": [0, 9, 0],
        "distance": 0.8,
        "extent": 0.22,
        "width": 80,
        "height": 80,
    },
    "lights": {"preset": "rings", "elevations_deg": [70], "counts": [1], "distance": 2.0},
    "truth": {"points": 20},
}
OPTIONS = PipelineOptions(hull=HullOptions(resolution=96, n_triangles=8000))


@pytest.fixture(scope="module")
def bowl(made_once):
    """Folder of the capture. Read only."""

    def fill(folder):
        coarse = np.random.default_rng(0).integers(60, 256, (48, 96, 3), np.uint8)
        source = folder.parent / "pattern_source"
        source.mkdir()
        cv2.imwrite(str(source / "pattern.png"), cv2.resize(coarse, (384, 192)))
        write_capture(parse_scene(SCENE, folder=source), folder)

    return made_once("patterned_bowl", fill)[0]


def run(bowl, out, options=OPTIONS, **others):
    capture = open_capture(bowl)
    return stages.run(capture, out, options, resources=Resources(2), until="atlas", **others)


@pytest.fixture(scope="module")
def context(bowl, tmp_path_factory):
    return run(bowl, tmp_path_factory.mktemp("patterned"))


def off_truth(bowl, mesh):
    """Mean distance of a mesh to the true one, metres."""
    true = read_ply(bowl / "truth" / "mesh.ply")
    distance = hull_distance((mesh.vertices, mesh.faces), (true.vertices, true.faces))
    return np.abs(distance.signed).mean()


def test_base_mesh_is_the_bowl(context, bowl):
    assert off_truth(bowl, results.hull_mesh(context)) > 0.005
    # Pixels of 2.8 mm, voxels of 1.7.
    assert off_truth(bowl, results.base_mesh(context)) < 0.0014
    assert context.stages.record("hollows").counts[SHARE] > 0.3


def test_report_shows_hull_and_surface(context):
    views = list(surface_views(context))
    assert len(views) == SURFACE_VIEWS
    differences = []
    for view in views:
        assert view.photograph.shape[:2] == view.hull.shape == view.surface.shape
        both = np.isfinite(view.hull) & np.isfinite(view.surface)
        differences.append(np.abs(view.hull - view.surface)[both].mean())
    # The hull has a lid where the bowl is hollow, which views from above show.
    assert max(differences) > 0.05


def test_same_hull_shows_no_views(bowl, tmp_path):
    options = replace(OPTIONS, hull=replace(OPTIONS.hull, hollows=False))
    filled = run(bowl, tmp_path, options)
    assert filled.stages.record("hollows") is None
    assert list(surface_views(filled)) == []


def test_neighbours_are_asked_for_and_planned(context):
    assert has_neighbours(context)
    assert not has_common_lights(context)
    counts = counts_of(context, share=0.3)
    assert counts.patches
    # 28 views of 80 x 80 pixels, less than fits.
    assert counts.patch_pixels == pytest.approx(0.3 * 28 * 80**2)  # the default, for rounding
    few = replace(context, hold_out=HoldOut(views=24, lights=0))
    assert not has_neighbours(few)


def test_what_is_carved_follows_from_the_photographs(context, bowl, tmp_path):
    other = run(bowl, tmp_path, hold_out=HoldOut(views=2, lights=0))
    assert other.stages.record("hollows").key != context.stages.record("hollows").key
    assert (other.stages.root / "hollows" / CARVED).is_file()
