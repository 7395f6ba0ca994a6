"""Coefficients and tangents from samples: planted ones found, none negative, few samples."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from reflfield.field.half_vector import half_angles
from reflfield.field.half_vector_evaluation import evaluate_half_vector
from reflfield.fitting.tangents import with_tangents_along_highlights
from reflfield.fitting.texel_graph import TexelGraph, texel_graph
from reflfield.fitting.texel_sample_fit import (
    MOST_SAMPLES,
    SampleBlock,
    SampleBlocks,
    fit_to_samples,
    sample_block,
    solve_coefficients,
    start_model,
    with_start_colors,
)
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.texel_samples import TexelSamples
from tests.fitting.conftest import frames_about, random_model, unit

N_VIEWS, N_LIGHTS = 6, 12


def block_of(rng, model, texels=None, views=None, lights=None):
    """All samples of all texels of a model, in one block."""
    texels = np.arange(model.n_texels) if texels is None else texels
    n, k = len(texels), N_VIEWS * N_LIGHTS
    views = unit(rng, n, N_VIEWS) if views is None else views
    lights = unit(rng, n, N_LIGHTS) if lights is None else lights
    view, light = (x.ravel() for x in np.mgrid[:N_VIEWS, :N_LIGHTS])
    row = np.repeat(np.arange(n), k)
    view, light = np.tile(view, n), np.tile(light, n)
    values = np.zeros((n * k, 3), np.float32)
    evaluate_half_vector(
        *model.arrays,
        texels[row].astype(np.int32),
        views[row, view],
        lights[row, light],
        values,
    )
    return SampleBlock(
        texels=texels,
        first=np.arange(0, n * k + 1, k),
        view=view.astype(np.int16),
        light=light.astype(np.int16),
        values=values,
        views=views,
        lights=lights,
        camera=view.astype(np.int16),
    )


def blocks_of(*blocks):
    return SampleBlocks(lambda n: blocks[n], len(blocks), 1 << 30)


def without_samples(block, row):
    """The block with no sample of one texel."""
    kept = np.ones(len(block.view), bool)
    kept[block.first[row] : block.first[row + 1]] = False
    counts = np.diff(block.first)
    counts[row] = 0
    return replace(
        block,
        first=np.concatenate([[0], np.cumsum(counts)]),
        view=block.view[kept],
        light=block.light[kept],
        values=block.values[kept],
        camera=block.camera[kept],
    )


def test_planted_coefficients_are_found(small_rng):
    truth = random_model(small_rng, 20)
    block = block_of(small_rng, truth)
    begin = replace(truth, diffuse=0 * truth.diffuse + 0.5, weights=0 * truth.weights + 0.5)
    with ThreadPoolExecutor(2) as pool:
        for _ in range(3):
            begin, _ = solve_coefficients(blocks_of(block), begin, pool, tie=1e-9)
    # The factor 1.0001 on the diagonal, times the condition of two random lobes: observed 9.
    np.testing.assert_allclose(begin.diffuse, truth.diffuse, atol=50 * 1e-4)
    np.testing.assert_allclose(begin.weights, truth.weights, atol=50 * 1e-4)  # the same


def test_coefficients_are_never_negative(small_rng):
    model = random_model(small_rng, 20)
    block = block_of(small_rng, model)
    noise = small_rng.normal(size=block.values.shape).astype(np.float32)
    with ThreadPoolExecutor(1) as pool:
        fit, _ = solve_coefficients(
            blocks_of(replace(block, values=block.values * 0.1 + noise)), model, pool
        )
    assert fit.diffuse.min() >= 0
    assert fit.weights.min() >= 0
    assert (fit.weights == 0).any()


def test_texels_without_samples_get_the_usual_coefficients(small_rng):
    model = random_model(small_rng, 5)
    block = without_samples(block_of(small_rng, model), 2)
    with ThreadPoolExecutor(1) as pool:
        fit, _ = solve_coefficients(blocks_of(block), model, pool)
        colored = with_start_colors(blocks_of(block), model, pool)
    # The factor 1.0001 on the diagonal.
    np.testing.assert_allclose(fit.diffuse[2], model.diffuse.mean(axis=0), rtol=1.5e-4)
    assert np.isfinite(colored.diffuse).all()


@pytest.mark.parametrize("n_lobes", [1, 3])
def test_rounds_explain_samples_of_a_known_material(small_rng, n_lobes):
    truth = start_model(frames_about(small_rng, 40), 1)
    shine = np.exp(-((half_angles() / np.radians(20)) ** 2)).ravel()
    lobes = np.tile(shine, 6)[None, :, None].repeat(3, 2).astype(np.float32)
    diffuse = small_rng.uniform(0.1, 0.5, (40, 3)).astype(np.float32)
    truth = replace(truth, diffuse=diffuse, lobes=lobes)
    blocks = blocks_of(block_of(small_rng, truth))
    with ThreadPoolExecutor(2) as pool:
        model = with_start_colors(blocks, start_model(truth.frames, n_lobes), pool)
        fit, residuals = fit_to_samples(blocks, model, pool, 4, 3e-4)
    assert residuals[-1] < 0.5 * residuals[0]
    assert fit.lobes.min() >= 0


def test_tangents_turn_to_the_long_axis_of_highlights(small_rng):
    # A lobe twice as long along x; the frames that are given are turned at random.
    truth = start_model(np.tile(np.eye(3, dtype=np.float32), (30, 1, 1)), 1)
    axis = np.linspace(-1, 1, 33)
    shine = np.exp(-(axis[None, :] ** 2 / 0.5 + axis[:, None] ** 2 / 0.1)).ravel()
    lobes = np.tile(shine, 6)[None, :, None].repeat(3, 2).astype(np.float32)
    truth = replace(truth, lobes=lobes)
    block = block_of(small_rng, truth)
    angle = small_rng.uniform(-1, 1, 30)
    turned = np.zeros((30, 3, 3), np.float32)
    turned[:, 0] = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    turned[:, 2] = [0, 0, 1]
    turned[:, 1] = np.cross(turned[:, 2], turned[:, 0])
    round_lobe = np.exp(-(axis[None, :] ** 2 + axis[:, None] ** 2) / 0.25).ravel()
    lobes = np.tile(round_lobe, 6)[None, :, None].repeat(3, 2).astype(np.float32)
    graph = TexelGraph(30, np.stack([np.arange(29), np.arange(1, 30)], axis=1))
    with ThreadPoolExecutor(2) as pool:
        turned_back = with_tangents_along_highlights(
            blocks_of(block), replace(truth, frames=turned, lobes=lobes), graph, pool
        )
    off = np.degrees(np.arccos(np.clip(np.abs(turned_back.frames[:, 0, 0]), 0, 1)))
    assert np.median(off) < 5
    np.testing.assert_array_equal(turned_back.frames[:, 2], turned[:, 2])


def test_blocks_beyond_the_budget_are_read_again(small_rng):
    block = block_of(small_rng, random_model(small_rng))
    reads = []

    def read(n):
        reads.append(n)
        return block

    kept, dropped = SampleBlocks(read, 1, 1 << 30), SampleBlocks(read, 1, 1)
    for blocks in (kept, kept, dropped, dropped):
        assert blocks[0] is block
    assert reads == [0, 0, 0]


def test_a_graph_joins_texels_that_face_the_same_way():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0, 0.1]])
    normals = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1]])
    graph = texel_graph(points, normals)
    assert graph.pairs.tolist() == [[0, 1], [1, 2]]
    assert graph.all_around(np.array([True, True, False, True])).tolist() == [
        True, False, False, True,
    ]  # fmt: skip
    np.testing.assert_allclose(graph.laplacian() @ np.ones(4), 0)


def test_all_around_is_true_where_all_neighbours_are(small_rng):
    positions = small_rng.random((60, 3))
    graph = texel_graph(positions, np.tile([0.0, 0, 1], (60, 1)))
    true = small_rng.random((60, 19)) < 0.8
    near = graph.adjacency.toarray() > 0
    expected = true & np.array([true[row].all(axis=0) for row in near])
    assert 0 < expected.sum() < true.sum()
    np.testing.assert_array_equal(graph.all_around(true), expected)
    # Each pair once, the lower number first.
    pairs = graph.pairs.tolist()
    assert all(low < high for low, high in pairs)
    assert len({tuple(pair) for pair in pairs}) == len(pairs) == near.sum() / 2
    assert sorted(pairs) == pairs


def test_texels_on_both_sides_of_a_sharp_edge_are_no_neighbours():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, -1]])
    normals = np.array([[0.0, 0, 1], [0, 0, 1], [1, 0, 0]])
    assert texel_graph(points, normals).pairs.tolist() == [[0, 1]]


@pytest.mark.parametrize("photographed", ["each view under a light of its own", "all pairs"])
def test_samples_keep_their_directions_however_few_pairs_were_photographed(
    small_rng, photographed
):
    n, k = 5, 12
    table = (
        np.eye(k, dtype=bool)[::-1] if photographed != "all pairs" else np.ones((k, k), bool)
    )
    pairs = PhotographedPairs.of_table(table)
    samples = TexelSamples(
        samples=small_rng.random((n, len(pairs), 3)).astype(np.float32),
        views=unit(small_rng, n, k),
        lights=unit(small_rng, n, k),
        view_seen=small_rng.random((n, k)) < 0.4,
        light_seen=small_rng.random((n, k)) < 0.8,
        pairs=pairs,
        unit=2.0,
    )
    reliable = small_rng.random((n, k)) < 0.9
    block = sample_block(np.arange(n), samples, reliable, 4.0)
    row = np.repeat(np.arange(n), np.diff(block.first))
    expected = [
        (t, i, p)
        for t in range(n)
        for p, (i, j) in enumerate(zip(pairs.view, pairs.light, strict=True))
        if samples.view_seen[t, i] and samples.light_seen[t, j] and reliable[t, j]
    ]
    t, view, photograph = np.transpose(expected)
    np.testing.assert_array_equal(row, t)
    np.testing.assert_array_equal(block.camera, view)
    np.testing.assert_array_equal(block.values, samples.samples[t, photograph] / 2)
    np.testing.assert_array_equal(block.views[row, block.view], samples.views[t, view])
    light = pairs.light[photograph]
    np.testing.assert_array_equal(block.lights[row, block.light], samples.lights[t, light])
    if photographed != "all pairs":
        assert block.views.shape[1] == np.diff(block.first).max() < k


def many_samples(rng, n, n_views, n_lights, seen=1.0):
    """Samples of texels that many photographs show, each with a value of its own."""
    pairs = PhotographedPairs.product(n_views, n_lights)
    values = np.arange(n * len(pairs), dtype=np.float32).reshape(n, len(pairs), 1)
    return TexelSamples(
        samples=np.repeat(values, 3, axis=2),
        views=unit(rng, n, n_views),
        lights=unit(rng, n, n_lights),
        view_seen=rng.random((n, n_views)) < seen,
        light_seen=np.ones((n, n_lights), bool),
        pairs=pairs,
        unit=1.0,
    )


def test_many_samples_of_a_texel_are_thinned_out_evenly(small_rng):
    n, side = 12, 70
    samples = many_samples(small_rng, n, side, side, seen=0.7)
    reliable = np.ones((n, side), bool)
    block = sample_block(np.arange(100, 100 + n), samples, reliable, 1.0)
    counts = np.diff(block.first)
    # Draws of about 3430 with a probability of .3: four deviations of 27.
    assert np.abs(counts - MOST_SAMPLES).max() < 110
    # As many of each view and of each light: of some 12 * 1024 in 70, four deviations of 13.
    for place, seen in ((block.view, samples.view_seen), (block.light, reliable)):
        drawn = np.bincount(place, minlength=side) / seen.sum(axis=0)
        assert drawn.std() < 1.6 * np.sqrt(drawn.mean())
    # Other ones of each texel: a pair that one has, another has by chance.
    chosen = np.zeros((n, side * side), bool)
    row = np.repeat(np.arange(n), counts)
    chosen[row, block.values[:, 0].astype(np.int64) % (side * side)] = True
    both = (chosen[0] & chosen[1]).sum() / chosen[0].sum()
    # .7 seen, .3 drawn: .21, four deviations of .013.
    assert abs(both - 0.21) < 0.05


def test_thinning_depends_on_texel_and_photograph_alone(small_rng):
    samples = many_samples(small_rng, 4, 60, 60)
    reliable = np.ones((4, 60), bool)
    whole = sample_block(np.arange(4), samples, reliable, 1.0)
    names = ("samples", "views", "lights", "view_seen", "light_seen")
    part = replace(samples, **{name: getattr(samples, name)[2:] for name in names})
    alone = sample_block(np.arange(2, 4), part, reliable[2:], 1.0)
    np.testing.assert_array_equal(whole.values[whole.first[2] :], alone.values)


def test_few_samples_are_all_kept(small_rng):
    samples = many_samples(small_rng, 3, 16, 64)
    block = sample_block(np.arange(3), samples, np.ones((3, 64), bool), 1.0)
    assert np.diff(block.first).tolist() == [MOST_SAMPLES] * 3
