"""A matt ball under a dome that lights it from above only, lit from elsewhere.

What a texel of it shows, over the light's cosine, is the same in all directions: whatever the
field says of views and lights that the dome does not have can be compared with that.
"""

import copy

import numpy as np
import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.field.evaluation import evaluate
from reflfield.field.file import open_field
from reflfield.sphere.hemisphere import softened_cosine

from .conftest import SCENE

ALBEDO = 0.6
BALL = copy.deepcopy(SCENE) | {
    "name": "matt ball",
    "material": {"type": "lambert", "albedo": ALBEDO},
    "heldout": {"photographs": 0},
    "truth": {"points": 0, "per_view": False},
}
BALL["cameras"] |= {"elevations_deg": [10, 35, 65], "counts": [4, 4, 2]}
BALL["lights"] |= {"elevations_deg": [52, 70, 90], "counts": [6, 4, 1]}


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return write_capture(parse_scene(BALL), tmp_path_factory.mktemp("ball") / "capture")


def directions(rng, n):
    """Local ones at random over the upper hemisphere, (n, 3) float32; none grazes."""
    towards = rng.normal(size=(n, 3))
    towards[:, 2] = np.abs(towards[:, 2]) + 0.15
    return (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)


def shown_beyond(ball, out, reflfield, options, *settings):
    """Field of a run, and what texels of it show under lights and from views at random."""
    words = [word for setting in settings for word in ("--set", setting)]
    outcome = reflfield(
        *("run", ball, "-o", out, "--config", options, "--until", "compression", *words)
    )
    assert outcome.status == 0, outcome.err
    field, rng, n = open_field(out / "field.rfld"), np.random.default_rng(0), 200_000
    texels = rng.integers(0, field.n_texels, n).astype(np.int32)
    views, lights = directions(rng, n), directions(rng, n)
    to_world = field.local_from_world[texels]
    world = [np.einsum("nij,ni->nj", to_world, towards) for towards in (views, lights)]
    return field, texels, lights, evaluate(field, texels, *world)


@pytest.mark.parametrize("fit", ["samples", "grid"])
def test_no_texel_glows_or_is_black_under_lights_and_from_views_that_the_dome_lacks(
    ball, tmp_path, reflfield, tiny_options, fit
):
    """Shares of the truth.

    Before texels were bounded: 7.2 at most of samples, 19 of the grid, 11 % of the texels above
    1.5. Before pairs of nodes that no texel shows were filled, of both: 10 % of the directions
    below a quarter.
    """
    field, texels, lights, shown = shown_beyond(
        *(ball, tmp_path / "out", reflfield, tiny_options), f"compression.fit='{fit}'"
    )
    shown /= softened_cosine(lights[:, 2])[:, None]
    share = (shown * np.pi / ALBEDO).max(axis=1)
    brightest = np.zeros(field.n_texels)
    np.maximum.at(brightest, texels, share)
    # 2.6 of the grid and, of one texel or two whose samples insist, 3.4 of the samples on one
    # processor and 5.5 on another, whose sums differ in their last bits. The bound is 2.7 times
    # the mean of the cluster, which as coarse a model keeps within a tenth of the truth.
    assert np.sort(brightest)[-3] < 4
    assert brightest.max() < 6.5
    assert (brightest > 2.7 * 1.1).mean() < 0.003
    # 2.4, 5.9 and 7.6 % of the samples: the frames' common rotation about the normal is
    # arbitrary, and with it how the coarse grid lies to the few lights. 11 % without the bound.
    assert (brightest > 1.5).mean() < 0.09
    assert (share < 0.25).mean() < 0.05


@pytest.mark.parametrize("fit", ["samples", "grid"])
def test_no_texel_glows_where_shadows_are_kept(ball, tmp_path, reflfield, tiny_options, fit):
    """Of a texel that the dome lights at a grazing angle alone the brightest sample is a tenth
    of what it shows when lit from its front, so that is no bound; the brightest of all is one.
    """
    field, texels, _, shown = shown_beyond(
        *(ball, tmp_path / "out", reflfield, tiny_options),
        *(f"compression.fit='{fit}'", "resampling.visibility='kept'"),
    )
    assert field.visibility == "kept"
    brightest = np.zeros(field.n_texels)
    np.maximum.at(brightest, texels, shown.max(axis=1) * np.pi / ALBEDO)
    # 2.5 of the samples and 2.0 of the grid when this was written; the mean of a cluster is
    # within a tenth of the truth.
    assert brightest.max() < 2.7 * 1.1
    assert (brightest > 1.5).mean() < 0.01
