"""Surfaces from normals: known heights, anchors, what has no normals stays."""

import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.errors import GeometryError
from reflfield.fitting.normal_integration import (
    FittedNormals,
    confidence_of,
    integrated_displacements,
    moved_vertices,
    silhouette_anchors,
)
from reflfield.fitting.texel_graph import TexelGraph, texel_graph
from reflfield.geometry.silhouette_distance import signed_distance

SIDE = 24


def plane(scale=1.0):
    """Texels of a flat hull one apart, and their graph."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float64)
    positions = np.stack([x.ravel(), y.ravel(), np.zeros(SIDE**2)], axis=1)
    up = np.tile([0.0, 0, 1], (SIDE**2, 1))
    return positions * scale, up, texel_graph(positions, up)


def bumps(positions, scale=1.0):
    """Heights of some hollows, whose rims touch the hull, and the normals of their surface."""
    x, y = positions.T[:2] / scale
    k = 2 * np.pi / SIDE
    height = 0.5 * np.sin(2 * k * x) * np.cos(k * y) - 0.5
    slope_x = k * np.cos(2 * k * x) * np.cos(k * y)
    slope_y = -0.5 * k * np.sin(2 * k * x) * np.sin(k * y)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=1)
    return height * scale, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_known_heights_are_found_in_any_unit(scale):
    positions, up, graph = plane(scale)
    height, normals = bumps(positions, scale)
    fitted = FittedNormals(positions, up, normals, np.ones(len(up)))
    moves = integrated_displacements(fitted, graph, np.zeros(len(up)))
    # Ties draw hollows 12 texels long towards the hull, by some hundredths.
    assert np.corrcoef(moves, height)[0, 1] > 0.98
    assert np.abs(moves - height).max() < 0.25 * np.abs(height).max()


def test_the_surface_stays_inside_of_the_hull():
    positions, up, graph = plane()
    height, normals = bumps(positions)
    fitted = FittedNormals(positions, up, normals, np.ones(len(up)))
    moves = integrated_displacements(fitted, graph, np.zeros(len(up)))
    # Of heights about zero half would be outside, by as much.
    assert moves.max() < 0.15 * np.abs(height).max()


def test_normals_of_the_hull_move_nothing():
    positions, up, graph = plane()
    fitted = FittedNormals(positions, up, up, np.ones(len(up)))
    assert not integrated_displacements(fitted, graph, np.zeros(len(up))).any()


def test_normals_that_nothing_determines_move_nothing():
    positions, up, graph = plane()
    _, normals = bumps(positions)
    fitted = FittedNormals(positions, up, normals, np.zeros(len(up)))
    assert not integrated_displacements(fitted, graph, np.zeros(len(up))).any()


def test_anchors_hold_the_surface_to_the_hull():
    positions, up, graph = plane()
    _, normals = bumps(positions)
    fitted = FittedNormals(positions, up, normals, np.ones(len(up)))
    free = integrated_displacements(fitted, graph, np.zeros(len(up)))
    held = integrated_displacements(fitted, graph, np.ones(len(up)))
    assert np.abs(held).mean() < np.abs(free).mean()


def test_texels_at_one_point_move_as_one():
    """As those of two charts may: an edge without length divided by nothing before."""
    positions, up, _ = plane()
    height, normals = bumps(positions)
    twice = np.concatenate([np.arange(SIDE**2), [100]])
    positions, up, normals = positions[twice], up[twice], normals[twice]
    i, j = texel_graph(positions, up).pairs.T
    graph = TexelGraph(len(twice), np.stack([np.append(i, 100), np.append(j, SIDE**2)], axis=1))
    fitted = FittedNormals(positions, up, normals, np.ones(len(up)))
    moves = integrated_displacements(fitted, graph, np.zeros(len(up)))
    assert np.isfinite(moves).all()
    assert abs(moves[-1] - moves[100]) < 0.05 * np.abs(height).max()
    assert np.abs(moves[:-1] - height).max() < 0.25 * np.abs(height).max()


def test_texels_without_neighbours_are_refused():
    fitted = FittedNormals(*(np.zeros((2, 3)) for _ in range(3)), np.ones(2))
    with pytest.raises(GeometryError, match="expected neighbouring texels"):
        integrated_displacements(fitted, TexelGraph(2, np.zeros((0, 2), int)), np.zeros(2))


def test_anchors_stand_where_an_outline_touches_a_rim():
    pose = np.eye(4)
    camera = Camera("v", "orthographic", 20, 20, 1.0, 1.0, 10.0, 10.0, pose)
    coverage = np.zeros((20, 20))
    coverage[5:15, 5:15] = 1
    # On the outline with a normal across the ray; facing the camera; far inside.
    pixel = np.array([[15.0, 10.0], [15.0, 10.0], [10.0, 10.0]])
    points = np.concatenate([pixel - 10.0, [[1.0], [1], [1]]], axis=1)
    normals = np.array([[1.0, 0, 0], [0, 0, -1], [1, 0, 0]])
    distances = [signed_distance(coverage), None]
    anchors = silhouette_anchors([camera, camera], distances.__getitem__, points, normals)
    assert anchors[0] > 0.9
    assert anchors[1] < 1e-100  # exp(-(1 / .05)^2), of a cosine of 1
    assert anchors[2] == 0


def test_confidence_without_information_is_zero():
    assert not confidence_of(np.zeros(3)).any()


def test_vertices_at_one_place_move_together(rng):
    texels, moves = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    vertex = rng.normal(size=(1, 3))
    moved = moved_vertices(np.repeat(vertex, 2, axis=0), texels, moves)
    np.testing.assert_array_equal(moved[0], moved[1])
