"""Functions on finer nodes: the same functions, and sharper ones after a fit."""

import numpy as np
import pytest

from reflfield.errors import ShapeError
from reflfield.field.clustered_model import (
    MAX_TABLE_BYTES,
    ClusteredModel,
    on_refined_grid,
    refined_sides,
)
from reflfield.sphere.hemisphere import HemisphereGrid


def model_on(rng, view_side, light_side, n_clusters=2, n_components=1):
    width = 3 * (n_components + 1)
    table = rng.standard_normal((n_clusters, view_side**2, light_side**2, width))
    return ClusteredModel(
        np.zeros(4, np.int32),
        np.zeros((4, n_components), np.float32),
        table.astype(np.float32),
        np.tile(np.eye(n_components), (n_clusters, 1, 1)),
    )


def values(model, sides, directions):
    """(n_clusters, n, n, width): the functions at all pairs of directions."""
    out = model.table
    for axis, side in enumerate(sides, start=1):
        nodes, weights = HemisphereGrid(side).taps(directions)
        at_nodes = np.take(out, nodes, axis=axis)
        shape = [1] * at_nodes.ndim
        shape[axis : axis + 2] = weights.shape
        out = (at_nodes * weights.reshape(shape)).sum(axis=axis + 1)
    return out


@pytest.mark.parametrize(("sides", "finer"), [((5, 3), (9, 5)), ((1, 5), (1, 13))])
def test_functions_stay_where_old_nodes_are_new_ones(sides, finer, rng, rounding):
    model = model_on(rng, *sides)
    directions = HemisphereGrid(8).directions
    refined = on_refined_grid(model, finer)
    assert refined.table.dtype == np.float32
    np.testing.assert_allclose(
        values(refined, finer, directions),
        values(model, sides, directions),
        atol=rounding(np.float32, 32),
    )


def test_the_same_sides_change_nothing(rng, rounding):
    model = model_on(rng, 5, 7)
    refined = on_refined_grid(model, (5, 7))
    np.testing.assert_allclose(refined.table, model.table, atol=rounding(np.float32))


def test_a_direction_that_does_not_vary_cannot_begin_to(rng):
    with pytest.raises(ShapeError, match="does not vary"):
        on_refined_grid(model_on(rng, 1, 5), (3, 9))


@pytest.mark.parametrize("n_functions", [1, 56, 176, 10_000])
@pytest.mark.parametrize("sides", [(7, 7), (11, 7), (13, 13), (1, 13), (1, 1), (6, 6)])
def test_finer_sides_grow_alike_within_the_bytes(sides, n_functions):
    view, light = refined_sides(sides, n_functions, 2.0)
    assert view >= sides[0]
    assert light >= sides[1]
    if (view, light) != sides:
        assert 12 * n_functions * view**2 * light**2 <= MAX_TABLE_BYTES
        for new, old in zip((view, light), sides, strict=True):
            assert new <= 2 * old - 1
            assert (new - old) % 2 == 0
    assert refined_sides(sides, n_functions, 1.0) == sides
