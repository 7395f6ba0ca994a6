r"""A surface from normals: displacements of texels along the normals of the hull.

Displacements x minimise

.. math:: \sum_{ij} w_{ij} \rho\Big(\frac{(p_i - p_j) \cdot n_{ij}}{\ell_{ij}}\Big)
          + \frac{1}{e^2} \sum_i (\lambda + \lambda_a a_i + \lambda_o [x_i > 0]) x_i^2
          + \frac{\mu}{e^2} \|L x\|^2,

:math:`p_i = q_i + x_i g_i` the moved texels, g the hull's normals, :math:`n_{ij}` the mean of
the fitted normals of two neighbours, :math:`\ell_{ij}` their distance, e its mean, L the
graph's Laplacian, :math:`\rho` Huber's function. Anchors a are near 1 where a silhouette
touches the hull and the fitted normal is perpendicular to its ray: there the hull lies on the
object. Nowhere does it lie inside of it, so that moves outwards are tied firmly.

References
----------
D. Nehab et al., "Efficiently combining positions and normals for precise 3D geometry",
SIGGRAPH 2005.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from reflfield.capture.cameras import Camera
from reflfield.errors import GeometryError
from reflfield.fitting.texel_graph import TexelGraph
from reflfield.geometry.silhouette_distance import SignedDistance
from reflfield.util.blas_threads import thread_pool

Array = NDArray[np.float64]

# Ties of a texel to the hull, of an anchored one besides and of one that would move outwards,
# and of neighbours' displacements.
TIE, ANCHOR_TIE, OUTWARD_TIE, SMOOTHNESS = 0.002, 0.05, 0.1, 0.02
# Slopes beyond this count in proportion, found in so many rounds.
HUBER, ROUNDS = 0.1, 4
# Relative residual to which the equations of each round are solved, and those of the last: the
# weights of one round need no more than that.
ROUND_TOLERANCE, LAST_TOLERANCE = 1e-2, 1e-5
# Cosine between normal and ray, and distance of the outline in pixels, at which an anchor has
# fallen to 1/e; farther outlines than the last anchor nothing.
ANCHOR_COSINE, ANCHOR_PIXELS, FARTHEST_PIXELS = 0.05, 0.5, 0.75
# Share of the median information at which a normal counts by half.
HALF_INFORMATION = 0.2
# Edges count as at least this share of the mean length.
SHORTEST_EDGE = 0.1
# Texels that move a vertex.
TEXELS_PER_VERTEX = 6


@dataclass(frozen=True, eq=False)
class FittedNormals:
    """Texels of the hull and the normals that a fit has found.

    Parameters
    ----------
    positions, base : (n, 3) float64
        Points of the hull, metres, and its normals.
    normals : (n, 3) float64
        Of the fit.
    confidence : (n,) float64
        0 to 1: how much a normal counts.
    """

    positions: Array
    base: Array
    normals: Array
    confidence: Array


def confidence_of(information: Array) -> Array:
    """Weights from 0 to 1 of normals by how well they are determined.

    Examples
    --------
    >>> confidence_of(np.array([0.0, 0.2, 1.0, 1.0])).round(2).tolist()
    [0.0, 0.5, 0.83, 0.83]
    """
    positive = information[information > 0]
    if not len(positive):
        return np.zeros_like(information)
    share = information / np.median(positive)
    return np.asarray(share / (share + HALF_INFORMATION))


def silhouette_anchors(
    cameras: Sequence[Camera],
    distance_of: Callable[[int], SignedDistance | None],
    positions: Array,
    normals: Array,
    workers: int = 1,
) -> Array:
    """How surely each point of the hull lies on the object, (n,) in 0 to 1.

    Parameters
    ----------
    cameras : sequence of Camera
    distance_of : callable
        Distance to the outline of a view, asked for once; None where it shows none.
    positions, normals : (n, 3) float64
    workers : int
        Threads; the anchors do not depend on their number.
    """

    def of_view(view: int) -> tuple[NDArray[np.intp], Array]:
        camera, distance = cameras[view], distance_of(view)
        if distance is None:
            return np.zeros(0, np.intp), np.zeros(0)
        pixels, depth = camera.project(positions)
        usable = np.isfinite(pixels).all(axis=1) & (depth > 0)
        away = np.full(len(positions), np.inf)
        away[usable] = np.abs(distance.at(pixels[usable]))
        near = np.flatnonzero(away < FARTHEST_PIXELS)
        towards = camera.view_directions(positions[near])
        cosine = np.einsum("nd,nd->n", towards, normals[near])
        return near, np.exp(
            -((cosine / ANCHOR_COSINE) ** 2) - (away[near] / ANCHOR_PIXELS) ** 2
        )

    anchors = np.zeros(len(positions))
    with thread_pool(workers) as pool:
        for near, sure in pool.map(of_view, range(len(cameras))):
            anchors[near] = np.maximum(anchors[near], sure)
    return anchors


def integrated_displacements(fitted: FittedNormals, graph: TexelGraph, anchors: Array) -> Array:
    """Displacements (n,) of texels along the hull's normals, metres.

    Parameters
    ----------
    fitted : FittedNormals
    graph : TexelGraph
    anchors : (n,) float64

    Returns
    -------
    (n,) float64

    Raises
    ------
    GeometryError
        If texels have no neighbours.
    """
    if not len(graph.pairs):
        raise GeometryError("graph: expected neighbouring texels, received none")
    slopes, target, edge = _slopes(fitted, graph)
    i, j = graph.pairs.T
    weight = np.minimum(fitted.confidence[i], fitted.confidence[j])
    bending = graph.laplacian()
    smooth = csr_array(bending @ bending * (SMOOTHNESS / edge**2))
    x = np.zeros(len(fitted.positions))
    for number in range(ROUNDS):
        tie = (TIE + ANCHOR_TIE * anchors + OUTWARD_TIE * (x > 0)) / edge**2
        size = np.abs(slopes @ x - target)
        robust = weight * np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
        matrix = csr_array(slopes.T @ diags_array(robust) @ slopes + smooth + diags_array(tie))
        right = slopes.T @ (robust * target)
        scale = diags_array(1.0 / matrix.diagonal())
        # Ties of some thousandths of what an edge weighs: some hundred steps.
        tolerance = ROUND_TOLERANCE if number < ROUNDS - 1 else LAST_TOLERANCE
        x, _ = cg(matrix, right, x0=x, rtol=tolerance, maxiter=1000, M=scale)
    return np.asarray(x)


def _slopes(fitted: FittedNormals, graph: TexelGraph) -> tuple[csr_array, Array, float]:
    """Slope of every edge against its normal, as matrix of displacements and negated start."""
    i, j = graph.pairs.T
    normal = fitted.normals[i] + fitted.normals[j]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    step = fitted.positions[i] - fitted.positions[j]
    length = np.linalg.norm(step, axis=1)
    # Texels of two charts may lie at one point: such an edge has no slope, and ties the two.
    length = np.maximum(length, SHORTEST_EDGE * length.mean())
    rows = np.arange(len(i))
    entries = np.concatenate(
        [
            np.einsum("nd,nd->n", fitted.base[i], normal) / length,
            -np.einsum("nd,nd->n", fitted.base[j], normal) / length,
        ]
    )
    at = (np.concatenate([rows, rows]), np.concatenate([i, j]))
    matrix = csr_array(coo_array((entries, at), shape=(len(i), graph.n_texels)))
    target = -np.einsum("nd,nd->n", step, normal) / length
    return matrix, target, float(length.mean())


def moved_vertices(vertices: Array, positions: Array, moves: Array) -> Array:
    """Vertices (k, 3) moved as the texels (n, 3) around them are.

    Parameters
    ----------
    vertices : (k, 3) float64
        Those at one place stay at one place.
    positions, moves : (n, 3) float64
        Texels before, and how they move.

    Examples
    --------
    >>> texels = np.array([[0.0, 0, 0], [1, 0, 0]])
    >>> moved_vertices(np.array([[0.5, 0, 0]]), texels, np.array([[0.0, 0, 1], [0, 0, 3]]))
    array([[0.5, 0. , 2. ]])
    """
    count = min(TEXELS_PER_VERTEX, len(positions))
    distance, near = cKDTree(positions).query(vertices, k=range(1, count + 1))
    width = np.maximum(distance[:, [min(2, count - 1)]], 1e-300)
    weight = np.exp(-((distance / width) ** 2))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.asarray(vertices + np.einsum("kn,knd->kd", weight, moves[near]))
