"""Hard cases of the surface from normals: units, seams, and normals that tell nothing.

All in float64.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reflfield.fitting.normal_integration import (
    FittedNormals,
    confidence_of,
    integrated_displacements,
)
from reflfield.fitting.texel_graph import TexelGraph, texel_graph
from tests.fitting.test_normal_integration import bumps, plane

pytestmark = pytest.mark.stability


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e6])
def test_displacements_scale_with_the_unit_of_length(scale, bounded):
    moves = []
    for unit_of_length in (1.0, scale):
        positions, up, graph = plane(unit_of_length)
        _, normals = bumps(positions, unit_of_length)
        fitted = FittedNormals(positions, up, normals, np.ones(len(up)))
        moves.append(
            integrated_displacements(fitted, graph, np.zeros(len(up))) / unit_of_length
        )
    bounded.at_most(
        np.abs(moves[1] - moves[0]).max() / np.abs(moves[0]).max(),
        1e-4,
        case="any unit of length",
        quantity="relative change of displacements, 1e-6 to 1e6",
        source="equations solved to 1e-6, over ties of some thousandths",
    )


def test_texels_of_two_charts_at_one_point_move_as_one(bounded):
    positions, up, _ = plane()
    height, normals = bumps(positions)
    twice = np.append(np.arange(len(up)), 100)
    i, j = texel_graph(positions, up).pairs.T
    pairs = np.stack([np.append(i, 100), np.append(j, len(up))], axis=1)
    graph = TexelGraph(len(twice), pairs)
    fitted = FittedNormals(positions[twice], up[twice], normals[twice], np.ones(len(twice)))
    moves = integrated_displacements(fitted, graph, np.zeros(len(twice)))
    bounded.at_most(
        abs(moves[-1] - moves[100]) / np.abs(height).max(),
        0.05,
        case="texels at one point",
        quantity="parting of two texels over the depth",
        source="one edge of ten times the stiffness against one tie",
    )


def test_normals_without_information_move_nothing(bounded):
    positions, up, graph = plane()
    _, normals = bumps(positions)
    confidence = confidence_of(np.zeros(len(up)))
    fitted = FittedNormals(positions, up, normals, confidence)
    bounded.at_most(
        np.abs(integrated_displacements(fitted, graph, np.zeros(len(up)))),
        0.0,
        case="normals that nothing determines",
        quantity="largest displacement",
        source="no weight: only ties to the hull are left",
    )


def test_moves_out_of_the_hull_are_held(bounded):
    positions, up, graph = plane()
    height, normals = bumps(positions)
    fitted = FittedNormals(positions, up, normals, np.ones(len(up)))
    moves = integrated_displacements(fitted, graph, np.zeros(len(up)))
    bounded.at_most(
        moves.max() / np.abs(height).max(),
        0.15,
        case="moves out of the hull",
        quantity="largest move outwards over the depth",
        source="outward ties weigh 50 times those inwards: the root of 1 / 50",
    )


def test_displacements_of_any_normals_are_bounded(small_rng, bounded):
    positions, up, graph = plane()
    largest = [0.0]

    @settings(max_examples=15, deadline=None)
    @given(st.floats(0, 3), st.integers(0, 2**31))
    def search(spread, seed):
        rng = np.random.default_rng(seed)
        normals = up + spread * rng.standard_normal(up.shape)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        normals[rng.random(len(up)) < 0.1] *= -1  # some point into the object
        information = 10.0 ** rng.uniform(-12, 12, len(up)) * (rng.random(len(up)) < 0.8)
        fitted = FittedNormals(positions, up, normals, confidence_of(information))
        moves = integrated_displacements(fitted, graph, rng.random(len(up)))
        assert np.isfinite(moves).all()
        largest.append(np.abs(moves).max())

    search()
    bounded.at_most(
        largest,
        24.0,
        case="any normals",
        quantity="largest displacement, edges of a plane of 24 x 24",
        source="ties outweigh slopes of 1 over the width of the plane",
    )
