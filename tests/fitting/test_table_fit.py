"""Fit of the tables: adjoint operators, planted tables, normal form."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from reflfield.field.half_vector import (
    DIFFUSE_NODES,
    LOBE_NODES,
    N_DIFFERENCE,
    SKEW_NODES,
    SKEW_RINGS,
    half_angles,
)
from reflfield.field.half_vector_evaluation import evaluate_half_vector
from reflfield.fitting import table_fit
from reflfield.fitting.table_fit import (
    FREE_SKEWS,
    TableRows,
    fit_tables,
    normalised_tables,
)
from reflfield.fitting.table_kernels import add_skew_system
from tests.fitting.conftest import random_model, unit


def shown(model, rows):
    """What a model gives for the rows."""
    entries = np.zeros((len(rows.texel), 3), np.float32)
    evaluate_half_vector(*model.arrays, rows.texel, rows.views, rows.lights, entries)
    return np.add.reduceat(entries * rows.share[:, None], rows.first[:-1])


def random_rows(rng, model, n_rows, per_row=3):
    n = n_rows * per_row
    rows = TableRows(
        first=np.arange(0, n + 1, per_row),
        texel=rng.integers(0, model.n_texels, n).astype(np.int32),
        share=rng.dirichlet(np.ones(per_row), n_rows).ravel().astype(np.float32),
        views=unit(rng, n),
        lights=unit(rng, n),
        values=np.zeros((n_rows, 3), np.float32),
        at_least=np.zeros((n_rows, 3), np.bool_),
    )
    return replace(rows, values=shown(model, rows))


def system_of(model, rows, pool):
    linearised = table_fit._linearised(rows, model, pool)
    ties = table_fit._lobe_ties(rows.n_rows, model, 1e-3)
    return table_fit._TableSystem(linearised, model, ties, 0.1, 0.01, pool)


def test_the_normal_matrix_is_symmetric_and_positive(small_rng):
    model = random_model(small_rng)
    rows = random_rows(small_rng, model, 200)
    with ThreadPoolExecutor(2) as pool:
        system = system_of(model, rows, pool)
        a, b = (
            (
                small_rng.normal(size=(LOBE_NODES, model.n_lobes, 3)),
                small_rng.normal(size=DIFFUSE_NODES),
            )
            for _ in range(2)
        )
        image_a, image_b = system.product(*a), system.product(*b)
    # Sums of some thousand products in singles.
    assert table_fit._dot(image_a, b) == pytest.approx(table_fit._dot(a, image_b), rel=1e-4)
    assert table_fit._dot(a, image_a) > 0


def test_rows_that_the_model_explains_leave_no_gradient(small_rng):
    model = random_model(small_rng)
    rows = random_rows(small_rng, model, 300)
    with ThreadPoolExecutor(1) as pool:
        system = replace(system_of(model, rows, pool), diffuse_tie=0.0, ridge=0.0)
        system = replace(system, lobe_ties=0 * system.lobe_ties)
        lobes = np.ascontiguousarray(np.moveaxis(model.lobes, 0, 1))
        right, image = system.right_side(), system.product(lobes, model.diffuse_table)
    scale = np.abs(right[0]).max()
    np.testing.assert_allclose(image[0], right[0], atol=1e-4 * scale)
    np.testing.assert_allclose(image[1], right[1], atol=1e-4 * np.abs(right[1]).max())


def test_planted_tables_explain_rows_after_the_fit(small_rng):
    model = random_model(small_rng, n=40)
    smooth = np.exp(-np.linspace(0, 3, LOBE_NODES))[None, :, None].astype(np.float32)
    truth = replace(model, lobes=np.repeat(np.repeat(smooth, 2, 0), 3, 2))
    rows = random_rows(small_rng, truth, 4000)
    begin = replace(truth, lobes=np.full_like(truth.lobes, 0.2))
    with ThreadPoolExecutor(2) as pool:
        fit = fit_tables(rows, begin, pool, smoothness=1e-7, iterations=40)
    before = np.abs(shown(begin, rows) - rows.values).mean()
    # Nodes jump by e^3 from layer to layer, which no smoothness likes.
    assert np.abs(shown(fit, rows) - rows.values).mean() < 0.15 * before
    assert fit.lobes.min() >= 0
    assert fit.diffuse_table.min() > 0


def test_tables_do_not_depend_on_the_number_of_threads(small_rng):
    model = random_model(small_rng)
    rows = random_rows(small_rng, model, 100)
    begin = replace(model, lobes=0.5 * model.lobes)
    lobes = []
    for n in (1, 3):
        with ThreadPoolExecutor(n) as pool:
            lobes.append(fit_tables(rows, begin, pool, iterations=3).lobes)
    np.testing.assert_array_equal(lobes[0], lobes[1])


def test_values_that_were_not_measured_do_not_count(small_rng):
    model = random_model(small_rng)
    rows = random_rows(small_rng, model, 100)
    values = rows.values.copy()
    values[::2, 1] = np.nan
    begin = replace(model, lobes=0.5 * model.lobes)
    with ThreadPoolExecutor(1) as pool:
        fit = fit_tables(replace(rows, values=values), begin, pool, iterations=3)
    assert np.isfinite(fit.lobes).all()


def test_tables_reach_what_saturated_values_are_known_to_reach(small_rng):
    """A highlight of ten degrees that no value shows but as white."""
    model = random_model(small_rng, n=40, n_lobes=1)
    model = replace(model, diffuse_table=np.ones_like(model.diffuse_table))
    layer = np.exp(-((half_angles() / np.radians(10)) ** 2)).ravel()
    peak = np.tile(layer, N_DIFFERENCE)[None, :, None].repeat(3, 2).astype(np.float32)
    begin = replace(model, lobes=0.05 + 0 * peak, weights=np.ones_like(model.weights))
    truth = replace(begin, lobes=np.float32(20) * peak + begin.lobes)
    rows = random_rows(small_rng, truth, 4000, per_row=1)
    level = np.float32(1.2 * shown(begin, rows).max())
    clipped = rows.values >= level
    dim = np.where(clipped, np.float32(np.nan), shown(begin, rows))
    darker = {}
    with ThreadPoolExecutor(2) as pool:
        for bounds in (False, True):
            values = np.where(clipped & bounds, level, dim)
            fit = begin
            for _ in range(3):
                some = replace(rows, values=values, at_least=clipped & bounds)
                fit = fit_tables(some, fit, pool, smoothness=1e-4)
            darker[bounds] = np.maximum(1 - shown(fit, rows)[clipped] / level, 0).mean()
    assert darker[False] > 0.2
    assert darker[True] < 0.3 * darker[False]


def test_the_normal_form_changes_no_sample(small_rng, rounding):
    model = random_model(small_rng)
    rows = random_rows(small_rng, model, 50)
    normalised = normalised_tables(model)
    singles = rounding(np.float32)
    assert normalised.diffuse_table.mean() == pytest.approx(1, rel=singles)
    assert np.mean(normalised.weights**2, axis=0) == pytest.approx(np.ones(2), rel=singles)
    # Two roundings of singles more.
    np.testing.assert_allclose(shown(normalised, rows), rows.values, rtol=1e-5)


def test_no_rows_leave_the_model_as_it_is(small_rng):
    model = random_model(small_rng)
    rows = random_rows(small_rng, model, 4)
    none = TableRows(
        np.zeros(1, np.int64), rows.texel[:0], rows.share[:0], rows.views[:0],
        rows.lights[:0], rows.values[:0], rows.at_least[:0],
    )  # fmt: skip
    assert fit_tables(none, model, ThreadPoolExecutor(1)) is model


def test_entries_of_one_row_are_corners_of_their_own(small_rng):
    """Rows of one entry reuse its corners for the adjoint, rows of several cannot."""
    model = random_model(small_rng)
    together = random_rows(small_rng, model, 50, per_row=1)
    lobes = small_rng.normal(size=(LOBE_NODES, model.n_lobes, 3))
    table = small_rng.normal(size=DIFFUSE_NODES)
    n = len(together.texel)
    twice = TableRows(
        first=np.arange(0, 2 * n + 1, 2),
        texel=np.repeat(together.texel, 2),
        share=np.repeat(together.share, 2) / 2,
        views=np.repeat(together.views, 2, axis=0),
        lights=np.repeat(together.lights, 2, axis=0),
        values=together.values,
        at_least=together.at_least,
    )
    with ThreadPoolExecutor(1) as pool:
        one, two = (system_of(model, r, pool).product(lobes, table) for r in (together, twice))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(b, a, atol=1e-5 * np.abs(a).max())


def skewed_truth(rng, n_lobes=2):
    """Gaussian lobes of two widths on one texel, skewed; rows of single samples."""
    angle = half_angles().ravel()
    lobes = [np.exp(-((angle / np.radians(w)) ** 2)) for w in (40.0, 20.0)[:n_lobes]]
    of_layers = np.tile(np.stack(lobes), (1, N_DIFFERENCE))[..., None]
    model = replace(
        random_model(rng, n=8, n_lobes=n_lobes),
        lobes=np.repeat(of_layers, 3, axis=2).astype(np.float32),
        diffuse_table=np.ones(DIFFUSE_NODES, np.float32),
    )
    skews = np.zeros_like(model.skews)
    skews[:, FREE_SKEWS] = np.array([-0.6, 0.0, 0.3], np.float32)
    return normalised_tables(replace(model, skews=skews))


@pytest.mark.parametrize("per_row", [1, 3])
def test_normal_equations_of_skews_are_those_of_their_derivatives(small_rng, per_row):
    """A row is linear in the skews: its derivatives are differences, of any size."""
    model = random_model(small_rng, n_lobes=2)
    model = replace(model, skews=np.zeros_like(model.skews))
    rows = random_rows(small_rng, model, 60, per_row)
    values = shown(model, rows) + small_rng.normal(0, 0.05, (60, 3)).astype(np.float32)
    values[::7, 1] = np.nan
    rows = replace(rows, values=values)
    tables = (np.ascontiguousarray(np.moveaxis(model.lobes, 0, 1)), model.diffuse_table)
    n = model.n_lobes * SKEW_NODES
    out = np.zeros((3, n, n)), np.zeros((3, n))
    with ThreadPoolExecutor(1) as pool:
        linearised = table_fit._linearised(rows, model, pool)
    add_skew_system(
        *(rows.first, rows.texel, linearised.taps, linearised.rings, linearised.factor),
        *((rows.values, linearised.weight), (model.diffuse, model.weights), tables, out),
    )
    derivatives = np.zeros((n, 60, 3))
    for i in range(n):
        skews = np.zeros((model.n_lobes * SKEW_NODES, 3), np.float32)
        skews[i] = 0.5
        changed = replace(model, skews=skews.reshape(model.skews.shape))
        derivatives[i] = (shown(changed, rows) - shown(model, rows)) / 0.5
    residual = np.where(linearised.weight > 0, values - shown(model, rows), 0)
    for c in range(3):
        weighted = derivatives[..., c] * linearised.weight[:, c]
        matrix = out[0][c] + out[0][c].T - np.diag(np.diag(out[0][c]))
        size = np.abs(weighted @ derivatives[..., c].T).max()
        # Differences of numbers in singles.
        np.testing.assert_allclose(
            matrix, weighted @ derivatives[..., c].T, rtol=0, atol=1e-4 * size
        )
        right = weighted @ residual[:, c]
        np.testing.assert_allclose(out[1][c], right, rtol=0, atol=1e-4 * np.abs(right).max())


def test_planted_skews_are_recovered(small_rng, monkeypatch):
    monkeypatch.setattr(table_fit, "SKEW_TIE", 1e-6)
    truth = skewed_truth(small_rng, 1)
    rows = random_rows(small_rng, truth, 30_000, per_row=1)
    begin = replace(truth, skews=np.zeros_like(truth.skews))
    errors = []
    with ThreadPoolExecutor(2) as pool:
        for _ in range(7):
            errors.append(np.sqrt(np.mean((shown(begin, rows) - rows.values) ** 2)))
            begin = fit_tables(rows, begin, pool, smoothness=1e-6)
    assert errors[-1] < 0.05 * errors[0]
    # Nodes that rows are about: neither near the axis nor where lights graze.
    skew = begin.skews[0].reshape(N_DIFFERENCE, SKEW_RINGS, 3)[1:4, 2:5]
    # What the rows leave open, the ties between nodes fill: observed .011.
    np.testing.assert_allclose(skew, np.broadcast_to([-0.6, 0.0, 0.3], skew.shape), atol=0.03)
    assert not begin.skews[:, ~FREE_SKEWS].any()


def test_the_equations_of_skews_are_those_of_a_dense_least_squares(small_rng, rounding):
    model = random_model(small_rng, n=6)
    rows = random_rows(small_rng, replace(model, diffuse=model.diffuse * 1.1), 300)
    n = model.n_lobes * SKEW_NODES
    unskewed = replace(model, skews=np.zeros_like(model.skews))
    at_zero, columns = shown(unskewed, rows), np.zeros((rows.n_rows, n, 3))
    for x in range(n):
        skews = np.zeros((n, 3), np.float32)
        skews[x] = 1
        one = replace(model, skews=skews.reshape(model.skews.shape))
        columns[:, x] = shown(one, rows) - at_zero
    with ThreadPoolExecutor(1) as pool:
        linearised = table_fit._linearised(rows, model, pool)
        lobes = np.ascontiguousarray(np.moveaxis(model.lobes, 0, 1))
        solved = table_fit._skews(linearised, model, (lobes, model.diffuse_table), pool)
    free = np.tile(FREE_SKEWS, model.n_lobes)
    prior = np.kron(np.eye(model.n_lobes), table_fit.SKEW_PRIOR)
    prior *= table_fit.SKEW_TIE * rows.n_rows / SKEW_NODES
    for c in range(3):
        a, w = columns[:, free, c], linearised.weight[:, c].astype(np.float64)
        matrix = a.T @ (w[:, None] * a) + prior[np.ix_(free, free)]
        right = a.T @ (w * (rows.values - at_zero)[:, c])
        exact = np.clip(np.linalg.solve(matrix, right), -0.95, 0.95)
        condition = np.linalg.cond(matrix)
        assert condition < 1e4
        # Differences of singles make the columns here.
        tolerance = rounding(np.float32, condition=condition)
        np.testing.assert_allclose(solved.reshape(n, 3)[free, c], exact, rtol=0, atol=tolerance)


def test_a_narrow_highlight_does_not_lift_the_dark(small_rng):
    """The dark is fitted to what it is, though the nodes beside the peak would swing below."""
    angle = half_angles().ravel()
    peak = 20 * np.exp(-((angle / np.radians(3.0)) ** 2)) + 1e-4
    truth = random_model(small_rng, n=4, n_lobes=1)
    truth = replace(
        truth,
        diffuse=np.full_like(truth.diffuse, 1e-4),
        weights=np.ones_like(truth.weights),
        lobes=np.tile(peak, (1, N_DIFFERENCE))[..., None].repeat(3, 2).astype(np.float32),
        skews=np.zeros_like(truth.skews),
    )
    rows = random_rows(small_rng, truth, 20_000, per_row=1)
    begin = replace(truth, lobes=np.full_like(truth.lobes, 0.05))
    with ThreadPoolExecutor(2) as pool:
        for _ in range(4):
            begin = fit_tables(rows, begin, pool)
    dark = rows.values.mean(axis=1) < 1e-3  # ten times the floor of the peak
    assert dark.mean() > 0.3
    lifted = shown(begin, rows)[dark].mean() / rows.values[dark].mean()
    assert lifted < 2.0
