"""Silhouettes of many views: who contradicts whom is found among some others of each."""

from dataclasses import replace

import numpy as np
import pytest
import rigs

from reflfield.checking.checked_views import CheckedView
from reflfield.checking.outline_agreement import outline_agreement
from reflfield.checking.silhouette_findings import contradiction_findings
from reflfield.geometry.bounding_box import robust_bounds
from reflfield.geometry.cones import measured_views
from reflfield.geometry.explanations import explain_all

N_VIEWS, WRONG = 130, {3, 44, 45, 101}


@pytest.fixture(scope="module")
def rig():
    cameras = rigs.cameras(N_VIEWS, size=64, zoom=1.4)
    return cameras, [rigs.lobed_silhouette(camera) for camera in cameras]


def verdict_of(cameras, silhouettes):
    views = measured_views(cameras, silhouettes)
    return outline_agreement(views, *robust_bounds(views)).verdict()


def test_good_outlines_of_many_views_agree(rig):
    verdict = verdict_of(*rig)
    assert verdict.agree
    assert verdict.outliers == ()


def test_wrong_masks_among_many_are_the_ones_set_aside(rig):
    cameras, silhouettes = rig
    shifted = [np.roll(s, 6, axis=1) if i in WRONG else s for i, s in enumerate(silhouettes)]
    verdict = verdict_of(cameras, shifted)
    assert verdict.agree
    assert set(verdict.outliers) == WRONG


def test_a_convention_of_many_poses_is_recognised_in_some(rig):
    cameras, silhouettes = rig
    read_wrongly = [
        replace(camera, camera_from_world=np.linalg.solve(camera.camera_from_world, np.eye(4)))
        for camera in cameras
    ]
    why = explain_all(read_wrongly, silhouettes, 0.0)
    assert why is not None
    assert why.kind == "inverse pose"
    assert explain_all(cameras, silhouettes, 1.0) is None


def without_a_dark_part(silhouette, rng):
    """Silhouette that misses some of its lower edge, as where that is as dark as the rest."""
    rows = np.flatnonzero(silhouette.any(axis=1))
    lost = silhouette.copy()
    lost[rows[-1] - rng.integers(3, 6) :] = 0
    return lost


def checked(cameras, masks, origin):
    cones = measured_views(cameras, masks)
    return [
        CheckedView(i, cone.camera, mask.astype(np.float32), origin, cone)
        for i, (cone, mask) in enumerate(zip(cones, masks, strict=True))
    ]


@pytest.mark.parametrize(
    ("origin", "severity"), [("photographs", "warning"), ("file", "error")]
)
def test_masks_that_miss_dark_parts_are_doubted_before_the_cameras(rig, rng, origin, severity):
    cameras, silhouettes = rig
    masks = [without_a_dark_part(silhouette, rng) for silhouette in silhouettes]
    (finding, *_), shape = contradiction_findings(None, checked(cameras, masks, origin), {})
    assert finding.severity == severity
    assert ("made from photographs" in finding.kind) == (origin == "photographs")
    if origin == "photographs":
        assert shape.mesh is not None


def test_made_masks_that_have_nothing_in_common_are_an_error_of_the_masks_first(rig, rng):
    cameras, silhouettes = (items[:20] for items in rig)
    masks = [
        np.roll(s, rng.integers(-14, 15, 2), axis=(0, 1)).astype(s.dtype) for s in silhouettes
    ]
    (finding, *_), _ = contradiction_findings(None, checked(cameras, masks, "photographs"), {})
    assert (finding.kind, finding.severity) == ("masks made from photographs", "error")
