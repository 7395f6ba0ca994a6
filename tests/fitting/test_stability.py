"""Hard cases of the fit to photographs: directions, pixels and texels at their ends.

The kernels compute in float32, tangents in float64; for normals see
test_surface_stability.py.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reflfield.field.half_vector import (
    DIFFUSE_NODES,
    LEAST_COSINE,
    LOBE_NODES,
    SKEW_NODES,
    HalfVectorModel,
)
from reflfield.field.half_vector_batches import (
    empty_batch,
    lobe_place,
    place_batch,
    put_pairs,
)
from reflfield.field.half_vector_evaluation import evaluate_half_vector
from reflfield.fitting.image_fit import (
    LARGEST_TILT,
    LARGEST_TURN,
    _changed,
    image_step,
)
from reflfield.fitting.pixel_kernels import HALF_ANGLE
from reflfield.fitting.pixel_system import linearised, normal_product
from reflfield.fitting.robust_weights import HUBER, squared_weight
from reflfield.fitting.tangents import turned_to_long_axes
from reflfield.fitting.texel_graph import TexelGraph
from reflfield.fitting.texel_sample_fit import fit_to_samples, solve_coefficients
from reflfield.sphere.hemisphere import softened_cosine
from tests.fitting.conftest import frames_about, random_model, unit
from tests.fitting.test_image_fit import (
    N_TEXELS,
    graph_of,
    pixels_of,
    shown,
    smooth_model,
    zeros,
)
from tests.fitting.test_texel_sample_fit import block_of, blocks_of, without_samples

pytestmark = pytest.mark.stability
SINGLE = np.float32
EPS = float(np.finfo(np.float32).eps)
SEARCH = settings(max_examples=60, deadline=None)
COMPONENTS = st.one_of(
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e-7, -1e-7, 1e-30]), st.floats(-1, 1, width=32)
)


def unit_vector(components):
    vector = np.array(components, np.float64)
    length = np.linalg.norm(vector)
    return (vector / length if length > 1e-3 else np.array([0.0, 0, 1])).astype(np.float32)


def white(n=1):
    """A model that is 1 wherever tables are read: lobes, diffuse table, colours."""
    return HalfVectorModel(
        frames=np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)),
        diffuse=np.ones((n, 3), np.float32),
        weights=np.ones((n, 1), np.float32),
        lobes=np.ones((1, LOBE_NODES, 3), np.float32),
        skews=np.zeros((1, SKEW_NODES, 3), np.float32),
        diffuse_table=np.ones(DIFFUSE_NODES, np.float32),
    )


def lobe_corners(model, view, light):
    """First node of a pair of directions in the lobes, and the weights of eight corners."""
    batch = empty_batch()
    put_pairs(0, 1, np.zeros(1, np.int32), model.frames, view[None], light[None], batch)
    place_batch(batch)
    node, shares = lobe_place(0, batch)
    return int(node), [float(share) for share in shares]


def sample(model, view, light):
    out = np.zeros((1, 3), np.float32)
    texel = np.zeros(1, np.int32)
    evaluate_half_vector(*model.arrays, texel, view[None], light[None], out)
    return out[0]


def test_samples_of_any_directions_are_bounded(bounded):
    model, values, lowest, sums = white(), [0.0], [0.0], [0.0]

    @SEARCH
    @given(*[COMPONENTS] * 6)
    def search(x, y, z, a, b, c):
        view, light = unit_vector([x, y, z]), unit_vector([a, b, c])
        for towards in (view, light, -light):  # also the same and opposite directions
            value = sample(model, towards, light)
            assert np.isfinite(value).all()
            values.append(value.max())
            lowest.append(value.min())
            node, weights = lobe_corners(model, towards, light)
            assert min(weights) >= 0
            assert 0 <= node < LOBE_NODES
            sums.append(abs(sum(weights) - 1))

    search()
    about = {"case": "grazing and opposite directions", "dtype": SINGLE}
    # V = 1 / (l + v - l v) at both least cosines.
    largest = 1 / (2 * LEAST_COSINE - LEAST_COSINE**2)
    bounded.at_most(
        values,
        1 + float(largest),
        quantity="sample of a white model",
        source="1 for the colour and V at the least cosines .05 for the lobe",
        **about,
    )
    bounded.at_least(
        lowest,
        0.0,
        quantity="least sample of a white model",
        source="nothing subtracts",
        **about,
    )
    bounded.at_most(
        sums,
        16 * EPS,
        quantity="sum of a lobe's weights less 1",
        source="eight products of three: 16 eps",
        **about,
    )


@pytest.mark.parametrize("cosine_light", [0.01, 0.03, 0.2])
@pytest.mark.parametrize("cosine_view", [0.01, 0.1, 0.9])
def test_grazing_samples_are_those_of_the_formula(cosine_light, cosine_view, bounded):
    """Both cosines of V are at least .05, that of the light's own factor is not."""
    light = np.array([np.sqrt(1 - cosine_light**2), 0, cosine_light], np.float32)
    view = np.array([0, np.sqrt(1 - cosine_view**2), cosine_view], np.float32)
    least_light, least_view = (max(c, 0.05) for c in (cosine_light, cosine_view))
    spread = 1 / (least_light + least_view - least_light * least_view)
    expected = softened_cosine(np.array(cosine_light)) * (1 + spread)
    bounded.at_most(
        np.abs(sample(white(), view, light) / expected - 1),
        64 * EPS,
        case="grazing and opposite directions",
        quantity="relative departure from s (a B + V S T), cosines from .01",
        source="some dozen roundings of float32: 64 eps",
        dtype=SINGLE,
    )


def test_the_lobe_is_continuous_across_the_zenith(small_rng, bounded):
    """The azimuth of the half vector is undefined there, its place in the table is not."""
    model = replace(random_model(small_rng, 1, 1), frames=white().frames)
    light = unit_vector([0.3, -0.2, 1.0])
    mirrored = (light * [-1, -1, 1]).astype(np.float32)
    centre = sample(model, mirrored, light)
    steps = 10.0 ** np.arange(-8, -3)
    errors = []
    for step in steps:
        for angle in np.arange(8) * np.pi / 4:
            aside = np.array([np.cos(angle), np.sin(angle), 0.0]) * step
            near = sample(model, unit_vector(mirrored + aside), light)
            # Nodes are .96 degrees apart at the centre; angles come from cosines near 1.
            nodes = (step + np.sqrt(2 * EPS)) / np.radians(0.96)
            errors.append(np.abs(near - centre).max() / nodes)
    bounded.at_most(
        errors,
        4.0 * float(centre.max()),
        case="half vector at the zenith",
        quantity="change per node, steps from 1e-8 radians and the root of 2 eps",
        source="heights of neighbouring nodes, both axes and both layers",
        dtype=SINGLE,
    )


@pytest.mark.parametrize("level", [0.0, 1e-6, 1e6, 1e12])
def test_one_step_at_black_and_glaring_pixels_is_bounded(small_rng, level, bounded):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    view = replace(view, values=np.full_like(view.values, level))
    with ThreadPoolExecutor(1) as pool:
        step = image_step([view], model, graph_of(N_TEXELS), model.frames[:, 2], pool)
    case = "black and glaring pixels"
    assert np.isfinite(step.model.diffuse).all()
    assert np.isfinite(step.residual)
    bounded.at_least(
        min(step.model.diffuse.min(), step.model.weights.min()),
        0.0,
        case=case,
        quantity="least coefficient after a step",
        source="coefficients are not negative",
        dtype=SINGLE,
    )
    gram = step.model.frames @ np.swapaxes(step.model.frames, 1, 2)
    bounded.at_most(
        np.abs(gram - np.eye(3)),
        8 * EPS,
        case=case,
        quantity="departure of frames from rotations",
        source="computed in float64, stored in float32: 8 eps",
        dtype=SINGLE,
    )


def test_weights_of_any_residual_are_those_of_huber(bounded):
    pulls = [0.0]

    @SEARCH
    @given(
        st.one_of(st.just(0.0), st.floats(0, np.float32(1e12), width=32)),
        st.one_of(st.just(0.0), st.floats(0, np.float32(1e12), width=32)),
    )
    def search(observed, predicted):
        observed, predicted = np.float32(observed), np.float32(predicted)
        squared = float(squared_weight(observed, predicted, HUBER))
        assert np.isfinite(squared)
        assert squared >= 0
        # The pull of a residual is at most Huber's bound times its weight.
        weight = 0.45 / (0.5 * (float(observed) + float(predicted)) + 0.003) ** 0.58
        pulls.append(squared * abs(float(observed) - float(predicted)) / weight)

    search()
    bounded.at_most(
        pulls,
        float(HUBER) * (1 + 64 * EPS),
        case="black and glaring pixels",
        quantity="pull of one value over its weight, values to 1e12",
        source="Huber's bound",
        dtype=SINGLE,
    )


def test_coefficients_of_any_samples_are_not_negative(small_rng, bounded):
    model, lowest, largest = random_model(small_rng, 6), [1.0], [0.0]
    block = block_of(small_rng, model)

    @settings(max_examples=30, deadline=None)
    @given(st.sampled_from([-1e6, -1.0, 0.0, 1e-9, 1.0, 1e6]), st.integers(0, 2**31))
    def search(scale, seed):
        rng = np.random.default_rng(seed)
        values = scale * rng.standard_normal(block.values.shape)
        hidden = rng.random(values.shape) < rng.uniform(0, 1)
        values = np.where(hidden, np.nan, values).astype(np.float32)
        with ThreadPoolExecutor(1) as pool:
            fit, residual = solve_coefficients(
                blocks_of(replace(block, values=values)), model, pool
            )
        assert np.isfinite(residual)
        both = np.concatenate([fit.diffuse, fit.weights], axis=1)
        lowest.append(both.min())
        largest.append(both.max() / max(1.0, np.nanmax(np.abs(values), initial=0.0)))

    search()
    bounded.at_least(
        lowest,
        0.0,
        case="coefficients that would be negative",
        quantity="least coefficient of any samples",
        source="a non-negative least squares",
        dtype=SINGLE,
    )
    bounded.at_most(
        largest,
        1e3,
        case="any samples",
        quantity="largest coefficient over the largest sample",
        source="a thousandth is what the ridge weighs beside one sample",
        dtype=SINGLE,
    )


def test_texels_without_samples_show_the_usual(small_rng, bounded):
    model = random_model(small_rng, 5)
    block = without_samples(block_of(small_rng, model), 2)
    with ThreadPoolExecutor(1) as pool:
        fit, _ = solve_coefficients(blocks_of(block), model, pool)
    usual = np.concatenate([model.diffuse.mean(axis=0), np.median(model.weights, axis=0)])
    bounded.at_most(
        np.abs(np.concatenate([fit.diffuse[2], fit.weights[2]]) / usual - 1),
        1e-3,
        case="texels without samples",
        quantity="relative departure from the usual coefficients",
        source="coordinate descent stops at a thousandth",
        dtype=SINGLE,
    )


def test_saturated_pixels_that_are_bright_enough_change_nothing(small_rng, bounded):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    limits = replace(
        view, values=view.values * np.float32(0.5), at_least=np.ones_like(view.at_least)
    )
    start = linearised(limits, model, zeros(limits, model))
    bounded.at_most(
        np.abs(start.right),
        0.0,
        case="saturated pixels",
        quantity="pull of bounds that are met",
        source="a bound from below says nothing against more",
        dtype=SINGLE,
    )


def test_steps_of_any_size_turn_frames_by_little(small_rng, bounded):
    model = random_model(small_rng, 8, 1)
    tilts, turns, errors = [0.0], [0.0], [0.0]

    @SEARCH
    @given(st.integers(-12, 12), st.integers(0, 2**31))
    def search(exponent, seed):
        rng = np.random.default_rng(seed)
        change = 10.0**exponent * rng.standard_normal((8, 7))
        frames = _changed(model, change).frames.astype(np.float64)
        before = model.frames.astype(np.float64)
        cosine = np.clip((frames[:, 2] * before[:, 2]).sum(axis=1), -1, 1)
        tilts.append(np.arccos(cosine).max())
        x, y = (np.einsum("nd,nd->n", frames[:, 0], before[:, i]) for i in (0, 1))
        turns.append(np.abs(np.arctan2(y, x)).max())
        errors.append(np.abs(frames @ np.swapaxes(frames, 1, 2) - np.eye(3)).max())

    search()
    about = {"case": "steps that are too long", "dtype": SINGLE}
    bounded.at_most(
        tilts,
        # The step is along the tangent; arccos near 1 has the root of eps.
        np.arctan(LARGEST_TILT) + 1e-3,
        quantity="tilt of one step, radians",
        source=".08 a step, and the root of eps of float32",
        **about,
    )
    bounded.at_most(
        turns,
        LARGEST_TURN + LARGEST_TILT**2,
        quantity="turn of one step, radians",
        source=".15 a step, and the square of the tilt",
        **about,
    )
    bounded.at_most(
        errors,
        8 * EPS,
        quantity="departure of frames from rotations",
        source="computed in float64, stored in float32: 8 eps",
        **about,
    )


def test_one_light_per_view_is_fitted(small_rng, bounded):
    """Photographs of which each has a light of its own: no product of views and lights."""
    truth = smooth_model(small_rng, 20)
    block = block_of(small_rng, truth)
    own = block.view == block.light % 6
    row = np.repeat(np.arange(20), np.diff(block.first))[own]
    first = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=20))])
    few = replace(
        block,
        first=first,
        view=block.view[own],
        light=block.light[own],
        values=block.values[own],
        camera=block.camera[own],
    )
    begin = replace(truth, diffuse=np.full_like(truth.diffuse, 0.5))
    with ThreadPoolExecutor(1) as pool:
        _, residuals = fit_to_samples(blocks_of(few), begin, pool, 3, 3e-4)
    bounded.at_most(
        residuals[-1] / residuals[0],
        0.5,
        case="one light per view",
        quantity="weighted residual after 3 rounds over that before",
        source="what rounds make of all pairs of a known material",
        dtype=SINGLE,
    )


def test_derivatives_of_pixels_are_those_of_differences(small_rng, bounded):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    system = linearised(view, model, zeros(view, model)).system
    parts = [system.diffuse[:, :, None, None] * np.eye(3), np.moveaxis(system.others, 1, 2)]
    parts, errors = np.concatenate(parts, axis=2), []
    for unknown in range(7):
        step = np.zeros((N_TEXELS, 7))
        step[:, unknown] = HALF_ANGLE
        ahead, behind = shown(_changed(model, step), view), shown(_changed(model, -step), view)
        by_hand = (ahead - behind) / (2 * HALF_ANGLE)
        weighted = parts[:, :, unknown][view.entry] * view.share[:, None, None]
        derivatives = np.add.reduceat(weighted, view.first[:-1])
        errors.append(np.abs(derivatives - by_hand).max() / np.abs(by_hand).max())
    bounded.at_most(
        errors,
        2e-3,
        case="derivatives of pixels",
        quantity="difference from central differences, over the largest",
        source="rounding of singles over a step of .008, and an angle from its tangent",
        dtype=SINGLE,
    )


def test_the_normal_matrix_is_symmetric_in_single_precision(small_rng, bounded):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    system = linearised(view, model, zeros(view, model)).system
    errors = []
    for _ in range(20):
        a, b = small_rng.normal(size=(2, N_TEXELS, 7)).astype(np.float32)
        one, other = normal_product(view, system, a), normal_product(view, system, b)
        energy = np.sqrt(float(np.vdot(a, one)) * float(np.vdot(b, other)))
        errors.append(abs(float(np.vdot(one, b)) - float(np.vdot(a, other))) / energy)
    bounded.at_most(
        errors,
        1e3 * EPS,
        case="the normal matrix of pixels",
        quantity="(Ax, y) - (x, Ay) over the energies",
        source="sums of about a thousand products in float32",
        dtype=SINGLE,
    )


def test_tangents_of_any_moments_are_frames(small_rng, bounded):
    frames, errors = frames_about(small_rng, 7), [0.0]
    graph = TexelGraph(7, np.stack([np.arange(6), np.arange(1, 7)], axis=1))

    @SEARCH
    @given(st.integers(-150, 150), st.integers(0, 6), st.integers(0, 2**31))
    def search(exponent, smoothing, seed):
        rng = np.random.default_rng(seed)
        moments = 10.0**exponent * rng.standard_normal((7, 5))
        moments[:, [0, 2]] = np.abs(moments[:, [0, 2]])
        moments[rng.random(7) < 0.5] = 0.0  # round lobes, and texels that no light reaches
        turned = turned_to_long_axes(frames, moments, graph, smoothing)
        errors.append(np.abs(turned @ np.swapaxes(turned, 1, 2) - np.eye(3)).max())
        errors.append(np.abs(turned[:, 2] - frames[:, 2]).max())

    search()
    bounded.at_most(
        errors,
        8 * EPS,
        case="highlights without a long axis",
        quantity="departure of frames from rotations, normals unchanged",
        source="computed in float64, stored in float32: 8 eps",
        dtype=SINGLE,
    )


def test_directions_of_the_tests_are_unit_vectors(small_rng):
    assert np.abs(np.linalg.norm(unit(small_rng, 9), axis=1) - 1).max() < 4 * EPS
