"""Pixels as sums of texels: Jacobian, adjoint, and a planted change that steps find."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from reflfield.field.half_vector import (
    DIFFUSE_NODES,
    LOBE_NODES,
    N_DIFFERENCE,
    half_angles,
)
from reflfield.field.half_vector_evaluation import evaluate_half_vector
from reflfield.fitting.image_fit import _changed, frames_with, image_step, pixel_rows
from reflfield.fitting.pixel_kernels import HALF_ANGLE
from reflfield.fitting.pixel_system import (
    Linearisation,
    ViewPixels,
    linearisation_shapes,
    linearised,
    normal_product,
)
from reflfield.fitting.texel_graph import TexelGraph
from tests.fitting.conftest import random_model, unit

N_TEXELS, N_LIGHTS, N_PIXELS = 30, 12, 60


def smooth_model(rng, n=N_TEXELS):
    """One broad lobe: the tables bend little between nodes."""
    model = random_model(rng, n, 1)
    layer = np.exp(-((half_angles() / np.radians(40)) ** 2)).ravel()
    lobes = np.tile(layer, N_DIFFERENCE)[None, :, None].repeat(3, 2)
    table = np.ones(DIFFUSE_NODES, np.float32)
    return replace(model, lobes=lobes.astype(np.float32), diffuse_table=table)


def pixels_of(rng, model, n_pixels=N_PIXELS):
    """A view whose pixels are means of three texels, as the model shows them."""
    n = model.n_texels
    entry = np.stack([rng.permutation(n)[:3] for _ in range(n_pixels)])
    view = ViewPixels(
        texels=np.arange(n, dtype=np.int32),
        first=np.arange(0, 3 * n_pixels + 1, 3),
        entry=entry.ravel().astype(np.int32),
        share=rng.dirichlet(np.ones(3), n_pixels).ravel().astype(np.float32),
        values=np.zeros((n_pixels, N_LIGHTS, 3), np.float32),
        at_least=np.zeros((n_pixels, N_LIGHTS, 3), np.bool_),
        views=unit(rng, n),
        lights=unit(rng, n, N_LIGHTS),
    )
    return replace(view, values=shown(model, view))


def shown(model, view):
    n = len(view.texels)
    samples = np.zeros((n, N_LIGHTS, 3), np.float32)
    for j in range(N_LIGHTS):
        out = np.zeros((n, 3), np.float32)
        evaluate_half_vector(*model.arrays, view.texels, view.views, view.lights[:, j], out)
        samples[:, j] = out
    weighted = samples[view.entry] * view.share[:, None, None]
    return np.add.reduceat(weighted, view.first[:-1])


def zeros(view, model):
    return [np.zeros(s, np.float32) for s in linearisation_shapes(view, model.n_lobes)]


def graph_of(n):
    return TexelGraph(n, np.stack([np.arange(n - 1), np.arange(1, n)], axis=1))


def test_derivatives_are_those_of_finite_differences(small_rng):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    system = linearised(view, model, zeros(view, model)).system
    n_unknowns = 3 + model.n_lobes + 3
    for unknown in range(n_unknowns):
        step = np.zeros((N_TEXELS, n_unknowns))
        step[:, unknown] = HALF_ANGLE
        ahead, behind = shown(_changed(model, step), view), shown(_changed(model, -step), view)
        by_hand = (ahead - behind) / (2 * HALF_ANGLE)
        # A x at a unit change of one unknown of every texel, from the stored derivatives.
        parts = np.concatenate(
            [
                system.diffuse[:, :, None, None] * np.eye(3),
                np.moveaxis(system.others, 1, 2),
            ],
            axis=2,
        )[:, :, unknown]
        weighted = parts[view.entry] * view.share[:, None, None]
        derivatives = np.add.reduceat(weighted, view.first[:-1])
        # The same step, as tables have kinks at their nodes: rounding of singles over it, and
        # of an angle from its tangent.
        np.testing.assert_allclose(derivatives, by_hand, atol=2e-3 * np.abs(by_hand).max())


def test_the_normal_matrix_of_pixels_is_symmetric_and_positive(small_rng, rounding):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    system = linearised(view, model, zeros(view, model)).system
    a, b = small_rng.normal(size=(2, N_TEXELS, 7)).astype(np.float32)
    image_a, image_b = normal_product(view, system, a), normal_product(view, system, b)
    # Seven numbers of each texel.
    size = np.linalg.norm(image_a) * np.linalg.norm(b)
    products = rounding(np.float32, operations=7, scale=size)
    assert np.vdot(image_a, b) == pytest.approx(np.vdot(a, image_b), abs=products)
    assert np.vdot(a, image_a) > 0


def test_right_side_is_the_adjoint_of_the_weighted_residual(small_rng, rounding):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    values = view.values * np.float32(1.1)
    start = linearised(replace(view, values=values), model, zeros(view, model))
    direction = small_rng.normal(size=start.right.shape)
    direction[:, 4:] = 0  # linear in the coefficients: A x is exact
    moved = replace(
        model,
        diffuse=(model.diffuse + direction[:, :3]).astype(np.float32),
        weights=(model.weights + direction[:, 3:4]).astype(np.float32),
    )
    along = (shown(moved, view) - shown(model, view)).astype(np.float64)
    expected = np.vdot(along, start.system.weight * (values - view.values))
    # Seven numbers of each texel, and the difference of what is shown.
    size = np.linalg.norm(direction) * np.linalg.norm(start.right)
    products = rounding(np.float32, operations=8, scale=size)
    assert np.vdot(direction, start.right) == pytest.approx(expected, abs=products)


def test_pixels_not_measured_and_unlit_do_not_count(small_rng):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    values = view.values.copy()
    values[3], values[5, 2, 1] = np.nan, np.nan
    start = linearised(replace(view, values=values), model, zeros(view, model))
    assert isinstance(start.system, Linearisation)
    assert not start.system.weight[3].any()
    assert start.system.weight[5, 2, 1] == 0
    assert start.count == values.size - 3 * N_LIGHTS - 1
    assert np.isfinite(start.right).all()


@pytest.mark.parametrize(("bound", "informs"), [(1.2, True), (0.8, False)])
def test_saturated_pixels_count_only_where_the_model_is_darker(small_rng, bound, informs):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    clipped = np.zeros(view.values.shape, np.bool_)
    clipped[::2] = True
    values = np.where(clipped, view.values * np.float32(bound), np.float32(np.nan))
    known = replace(view, values=values)
    bounds = replace(known, at_least=clipped)
    as_bounds, as_values = (linearised(v, model, zeros(v, model)) for v in (bounds, known))
    expected = as_values.system.weight if informs else np.zeros_like(values)
    np.testing.assert_array_equal(as_bounds.system.weight, expected)
    assert as_bounds.count == (clipped.sum() if informs else 0)
    assert as_bounds.right.any() == informs


def test_texels_that_are_saturated_wherever_they_are_seen_are_not_darker_than_that(small_rng):
    model = smooth_model(small_rng)
    begin = replace(model, diffuse=np.full_like(model.diffuse, 0.3))
    bright = np.zeros(N_TEXELS, np.bool_)
    bright[::5] = True
    truth = replace(begin, diffuse=np.where(bright[:, None], np.float32(3), begin.diffuse))
    views = [pixels_of(small_rng, truth) for _ in range(6)]
    level = np.float32(1.5 * max(shown(begin, view).max() for view in views))

    def darker_than_seen(as_bounds):
        """Mean over clipped values of how much darker they are fitted than their limit."""
        fitted, limits = [], []
        for view in views:
            of_bright = np.logical_or.reduceat(bright[view.entry], view.first[:-1])
            clipped = of_bright[:, None, None] & (view.values >= level)
            values = np.where(of_bright[:, None, None], np.float32(np.nan), view.values)
            if as_bounds:
                values[clipped] = level
            fitted.append(replace(view, values=values, at_least=clipped & as_bounds))
            limits.append(clipped)
        current = begin
        with ThreadPoolExecutor(2) as pool:
            for _ in range(3):
                normals = truth.frames[:, 2]
                step = image_step(fitted, current, graph_of(N_TEXELS), normals, pool)
                current = step.model
        n_clipped = sum(clipped.sum() for clipped in limits)
        assert step.n_bounds == (n_clipped if as_bounds else 0)
        # About half of those that are fitted to their limit lie a little below it.
        assert step.n_unmet < 0.6 * n_clipped
        shades = [shown(current, v)[clipped] for v, clipped in zip(views, limits, strict=True)]
        return np.maximum(1 - np.concatenate(shades) / level, 0).mean()

    left_out, bounded = darker_than_seen(False), darker_than_seen(True)
    assert left_out > 0.3
    assert bounded < 0.1


def test_steps_find_colours_and_normals_that_were_changed(small_rng):
    truth = smooth_model(small_rng)
    truth = replace(
        truth, diffuse=np.full_like(truth.diffuse, 0.5), weights=np.ones_like(truth.weights)
    )
    views = [pixels_of(small_rng, truth) for _ in range(6)]
    change = np.zeros((N_TEXELS, 7))
    change[:, :3] = 0.1
    change[:, 4:6] = 0.05 * small_rng.normal(size=(N_TEXELS, 2))
    model = _changed(truth, change)
    with ThreadPoolExecutor(2) as pool:
        for _ in range(3):
            step = image_step(views, model, graph_of(N_TEXELS), truth.frames[:, 2], pool)
            model = step.model

    def error(m):
        cosine = (m.frames[:, 2] * truth.frames[:, 2]).sum(axis=1)
        return np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()

    assert error(model) < 0.2 * error(_changed(truth, change))
    assert np.abs(model.diffuse - truth.diffuse).mean() < 0.02
    assert (step.information > 0).all()


def test_where_nothing_is_seen_neighbours_become_more_alike(small_rng):
    """Priors alone: colours, weights and the bending of normals against the surface's."""
    model = smooth_model(small_rng)
    surface = model.frames[:, 2].astype(np.float64)
    view = pixels_of(small_rng, model)
    unseen = replace(view, values=np.full_like(view.values, np.nan))
    change = np.zeros((N_TEXELS, 7))
    change[:, 4:6] = 0.03 * small_rng.normal(size=(N_TEXELS, 2))
    uneven = _changed(model, change)
    graph = graph_of(N_TEXELS)
    with ThreadPoolExecutor(1) as pool:
        step = image_step([unseen], uneven, graph, surface, pool).model

    def roughness(values):
        return float(np.sum(values * (graph.laplacian() @ values)))

    for name in ("diffuse", "weights"):
        assert roughness(getattr(step, name)) < 0.9 * roughness(getattr(uneven, name))
    bent = [roughness(one.frames[:, 2] - surface) for one in (uneven, step)]
    assert bent[1] < 0.9 * bent[0]


def test_a_step_does_not_depend_on_the_number_of_threads(small_rng):
    model = smooth_model(small_rng)
    views = [pixels_of(small_rng, model) for _ in range(3)]
    begin = replace(model, diffuse=0.8 * model.diffuse)
    models = []
    for n in (1, 3):
        with ThreadPoolExecutor(n) as pool:
            step = image_step(views, begin, graph_of(N_TEXELS), model.frames[:, 2], pool)
        models.append(step.model)
    for name in ("frames", "diffuse", "weights"):
        np.testing.assert_array_equal(getattr(models[0], name), getattr(models[1], name))


@pytest.mark.parametrize("level", [0.0, 1e6])
def test_black_and_glaring_pixels_leave_finite_coefficients(small_rng, level):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    view = replace(view, values=np.full_like(view.values, level))
    with ThreadPoolExecutor(1) as pool:
        stepped = image_step([view], model, graph_of(N_TEXELS), model.frames[:, 2], pool).model
    for name in ("frames", "diffuse", "weights"):
        assert np.isfinite(getattr(stepped, name)).all()
    assert stepped.diffuse.min() >= 0
    assert stepped.weights.min() >= 0


def test_rows_of_pixels_show_what_the_pixels_do(small_rng, rounding):
    model = smooth_model(small_rng)
    view = pixels_of(small_rng, model)
    rows = pixel_rows([view], 10_000, 0)
    assert rows.n_rows == N_PIXELS * N_LIGHTS
    entries = np.zeros((len(rows.texel), 3), np.float32)
    evaluate_half_vector(*model.arrays, rows.texel, rows.views, rows.lights, entries)
    sums = np.add.reduceat(entries * rows.share[:, None], rows.first[:-1])
    np.testing.assert_allclose(sums, rows.values, rtol=rounding(np.float32))


def test_frames_are_rotations(small_rng, rounding):
    frames = frames_with(small_rng.normal(size=(9, 3)), small_rng.normal(size=(9, 3)))
    gram = frames @ np.swapaxes(frames, 1, 2)
    assert np.abs(gram - np.eye(3)).max() < rounding(np.float32)
    assert (np.linalg.det(frames) > 0).all()


def test_lobes_have_the_nodes_of_the_model():
    assert N_DIFFERENCE * half_angles().size == LOBE_NODES
