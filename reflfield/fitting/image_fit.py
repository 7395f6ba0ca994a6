r"""Coefficients, weights and frames of all texels, fitted to all photographs at once.

A Gauss-Newton step minimises over changes x of the diffuse colours, the weights of the lobes
and three rotations of every texel

.. math:: \sum_p w_p \Big(y_p - \sum_j s_{pj} f(x_j)\Big)^2 + \text{priors},

p a pixel under a light, s the shares of the texels under it (`fitting.pixel_system`). It is
solved by conjugate gradients, preconditioned by the diagonal, stopped early. Priors, in units
of the median diagonal: neighbours have like colours (not across edges of colour), like weights
and normals that bend as those of the surface do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array

from reflfield.field.half_vector import HalfVectorModel
from reflfield.fitting.pixel_kernels import N_ROTATIONS, add_rows
from reflfield.fitting.pixel_system import (
    PixelStart,
    ViewPixels,
    linearisation_shapes,
    linearised,
    normal_product,
)
from reflfield.fitting.table_fit import TableRows
from reflfield.fitting.texel_graph import TexelGraph

Floats = NDArray[np.float32]
Array = NDArray[np.float64]
Allocate = Callable[[tuple[int, ...]], Floats]

ITERATIONS = 14
# Ranges of texels whose sums are taken side by side.
TEXEL_RANGES = 8
# Largest tilt of a normal and turn about it of one step, radians.
LARGEST_TILT, LARGEST_TURN = 0.08, 0.15
# Strengths of the priors over the median diagonal: differences of colours, weights, normals
# and turns between neighbours (of six), and of the normal to that of the surface.
COLOR_TIE, WEIGHT_TIE, NORMAL_TIE, TURN_TIE = 0.1, 0.5, 1.0, 0.3
SURFACE_TIE, RIDGE = 0.02, 1e-3
NEIGHBOURS = 6.0
# Relative difference of colours that weakens the ties of colours and of weights by half.
COLOR_EDGE, WEIGHT_EDGE = 0.15, 0.3
# Turns whose diagonal is smaller than this share of the tilts' are held by it.
LEAST_TURN = 0.02


@dataclass(frozen=True, eq=False)
class ImageFit:
    """What a step has found.

    Parameters
    ----------
    model : HalfVectorModel
    information : (n_texels,) float64
        Diagonal of the tilts: how well each normal is determined.
    residual : float
        Root mean square of the weighted residuals before the step.
    n_bounds, n_unmet : int
        Saturated values, and those that the model was darker than before the step.
    """

    model: HalfVectorModel
    information: Array
    residual: float
    n_bounds: int = 0
    n_unmet: int = 0


@dataclass(frozen=True, eq=False)
class _Priors:
    """Quadratic ties between neighbours, for changes of the unknowns (n, 3 + K + 3)."""

    colors: csr_array
    weights: Sequence[csr_array]
    normals: csr_array
    turns: csr_array
    ridge: Array
    binormal: Array
    tangent: Array

    def product(self, x: NDArray[np.floating]) -> Array:
        """Matrix of the priors times changes."""
        n_lobes = len(self.weights)
        y = self.ridge * x
        y[:, :3] += self.colors @ x[:, :3]
        for k, tie in enumerate(self.weights):
            y[:, 3 + k] += tie @ x[:, 3 + k]
        tilt = x[:, 3 + n_lobes : 5 + n_lobes]
        y[:, 3 + n_lobes : 5 + n_lobes] += self._tilts(self.normals @ self._moved(tilt))
        y[:, 5 + n_lobes] += self.turns @ x[:, 5 + n_lobes]
        return y

    def _moved(self, tilt: NDArray[np.floating]) -> Array:
        """Change of the normal by rotations about tangent and binormal."""
        return np.asarray(tilt[:, [0]] * self.binormal - tilt[:, [1]] * self.tangent)

    def _tilts(self, moved: Array) -> Array:
        """Adjoint of `_moved`."""
        along_binormal = (moved * self.binormal).sum(axis=1)
        return np.stack([along_binormal, -(moved * self.tangent).sum(axis=1)], axis=1)

    def gradient(self, model: HalfVectorModel, surface_normals: Array) -> Array:
        """Minus the gradient at the model, (n, 3 + K + 3)."""
        n_lobes = len(self.weights)
        y = np.zeros((model.n_texels, 3 + n_lobes + N_ROTATIONS))
        y[:, :3] = -(self.colors @ model.diffuse)
        for k, tie in enumerate(self.weights):
            y[:, 3 + k] = -(tie @ model.weights[:, k])
        away = self.normals @ (model.frames[:, 2] - surface_normals)
        y[:, 3 + n_lobes : 5 + n_lobes] = -self._tilts(away)
        return y

    def diagonal(self) -> Array:
        """About the diagonal of the matrix."""
        n_lobes = len(self.weights)
        y = np.tile(self.ridge, (len(self.tangent), 1))
        y[:, :3] += self.colors.diagonal()[:, None]
        for k, tie in enumerate(self.weights):
            y[:, 3 + k] += tie.diagonal()
        y[:, 3 + n_lobes :] += self.normals.diagonal()[:, None]
        return y


def _priors(model: HalfVectorModel, graph: TexelGraph, diagonal: Array) -> _Priors:
    """Priors in units of the median diagonal of what is measured."""
    i, j = graph.pairs.T
    color = model.diffuse.astype(np.float64)
    least = 6e-3 * color.mean() + 1e-9
    both = np.maximum((color[i] + color[j]).sum(axis=1), least)
    step = np.abs(color[i] - color[j]).sum(axis=1) / both
    of_color, of_weight = (1 / (1 + (step / edge) ** 2) for edge in (COLOR_EDGE, WEIGHT_EDGE))
    n_lobes = model.n_lobes
    median = np.array(
        [np.median(column[column > 0]) if (column > 0).any() else 1.0 for column in diagonal.T]
    )
    tilt = median[3 + n_lobes]
    median[-1] = max(median[-1], LEAST_TURN * median[-2])
    weight_laplacian = graph.laplacian(of_weight)
    flat = graph.laplacian()
    return _Priors(
        colors=graph.laplacian(of_color) * (COLOR_TIE * median[:3].mean() / NEIGHBOURS),
        weights=[
            weight_laplacian * (WEIGHT_TIE * median[3 + k] / NEIGHBOURS) for k in range(n_lobes)
        ],
        normals=csr_array(
            flat * (NORMAL_TIE * tilt / NEIGHBOURS)
            + eye_array(model.n_texels) * (SURFACE_TIE * tilt)
        ),
        turns=flat * (TURN_TIE * median[-1] / NEIGHBOURS),
        ridge=RIDGE * median,
        binormal=model.frames[:, 1].astype(np.float64),
        tangent=model.frames[:, 0].astype(np.float64),
    )


def image_step(
    views: Sequence[ViewPixels],
    model: HalfVectorModel,
    graph: TexelGraph,
    surface_normals: Array,
    pool: ThreadPoolExecutor,
    allocate: Allocate = lambda shape: np.zeros(shape, np.float32),
) -> ImageFit:
    """One Gauss-Newton step on coefficients, weights and frames of all texels.

    Parameters
    ----------
    views : sequence of ViewPixels
    model : HalfVectorModel
    graph : TexelGraph
    surface_normals : (n_texels, 3) float64
        Whose bending the normals share.
    pool : ThreadPoolExecutor
        Threads; the step does not depend on their number.
    allocate : callable
        Gives single-precision arrays for derivatives: zeros in memory or in a file.

    Returns
    -------
    ImageFit
    """

    def start(view: ViewPixels) -> PixelStart:
        shapes = linearisation_shapes(view, model.n_lobes)
        return linearised(view, model, [allocate(shape) for shape in shapes])

    starts = list(pool.map(start, views))
    shape = (model.n_texels, 3 + model.n_lobes + N_ROTATIONS)
    right = _scattered(views, [s.right for s in starts], shape, pool)
    diagonal = _scattered(views, [s.diagonal for s in starts], shape, pool)
    priors = _priors(model, graph, diagonal)

    def product(x: Array) -> Array:
        single = x.astype(np.float32)
        parts = pool.map(
            lambda view, s: normal_product(view, s.system, single[view.texels]), views, starts
        )
        return _scattered(views, list(parts), shape, pool) + priors.product(x)

    right += priors.gradient(model, np.asarray(surface_normals, np.float64))
    change = _conjugate_gradients(product, right, diagonal + priors.diagonal())
    n_values = max(sum(s.count for s in starts), 1)
    return ImageFit(
        model=_changed(model, change),
        information=diagonal[:, 3 + model.n_lobes : 5 + model.n_lobes].mean(axis=1),
        residual=float(np.sqrt(sum(s.squares for s in starts) / n_values)),
        n_bounds=sum(view.n_bounds for view in views),
        n_unmet=sum(
            int(np.count_nonzero(s.system.weight[view.at_least]))
            for view, s in zip(views, starts, strict=True)
        ),
    )


def _scattered(
    views: Sequence[ViewPixels],
    parts: Sequence[Floats],
    shape: tuple[int, int],
    pool: ThreadPoolExecutor,
) -> Array:
    """Sum of the views' parts, in their order; some of the texels in each thread."""
    total = np.zeros(shape)
    edges = np.linspace(0, shape[0], TEXEL_RANGES + 1).astype(np.int32)
    cuts = [np.searchsorted(view.texels, edges) for view in views]

    def add(number: int) -> None:
        for view, part, cut in zip(views, parts, cuts, strict=True):
            some = slice(cut[number], cut[number + 1])
            add_rows(view.texels[some], part[some], total)

    list(pool.map(add, range(TEXEL_RANGES)))
    return total


def _conjugate_gradients(
    product: Callable[[Array], Array], right: Array, diagonal: Array
) -> Array:
    """Change after some steps from zero."""
    floor = np.finfo(np.float32).tiny
    scale = 1.0 / np.maximum(diagonal, floor)
    x, residual = np.zeros_like(right), right
    scaled = scale * residual
    direction, energy = scaled, float(np.vdot(residual, scaled))
    for _ in range(ITERATIONS):
        image = product(direction)
        curvature = float(np.vdot(direction, image))
        if not curvature > 0:
            break
        step = energy / curvature
        x = x + step * direction
        residual = residual - step * image
        scaled = scale * residual
        before, energy = energy, float(np.vdot(residual, scaled))
        direction = scaled + (energy / before) * direction
        if not energy > 0:
            break
    return x


def _changed(model: HalfVectorModel, change: Array) -> HalfVectorModel:
    """Model after a step, coefficients not negative, rotations bounded."""
    n_lobes = model.n_lobes
    tilt = change[:, 3 + n_lobes : 5 + n_lobes]
    length = np.linalg.norm(tilt, axis=1, keepdims=True)
    tilt = tilt * np.minimum(1.0, LARGEST_TILT / np.maximum(length, 1e-9))
    turn = np.clip(change[:, [5 + n_lobes]], -LARGEST_TURN, LARGEST_TURN)
    x, y, z = np.moveaxis(model.frames.astype(np.float64), 1, 0)
    normal = z + tilt[:, [0]] * y - tilt[:, [1]] * x
    return replace(
        model,
        diffuse=np.maximum(model.diffuse + change[:, :3], 0).astype(np.float32),
        weights=np.maximum(model.weights + change[:, 3 : 3 + n_lobes], 0).astype(np.float32),
        frames=frames_with(normal, np.cos(turn) * x - np.sin(turn) * y),
    )


def frames_with(normals: Array, tangents: NDArray[np.floating]) -> Floats:
    """Right-handed frames (n, 3, 3) with these normals, tangents as near as possible."""
    normal = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    tangent = tangents - (tangents * normal).sum(axis=1, keepdims=True) * normal
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    return np.stack([tangent, np.cross(normal, tangent), normal], axis=1).astype(np.float32)


def pixel_rows(views: Sequence[ViewPixels], most: int, seed: int) -> TableRows:
    """Rows for the fit of tables: at most about so many pixels under a light, at random."""
    total = sum(view.n_used for view in views)
    rng = np.random.default_rng(seed)
    share = min(1.0, most / max(total, 1))
    parts = [_rows_of(view, share, rng) for view in views]
    counts, texel, weight, towards, lights, values, at_least = (
        np.concatenate(arrays) for arrays in zip(*parts, strict=True)
    )
    return TableRows(
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        texel=texel.astype(np.int32),
        share=weight,
        views=towards,
        lights=lights,
        values=values,
        at_least=at_least,
    )


def _rows_of(
    view: ViewPixels, share: float, rng: np.random.Generator
) -> tuple[NDArray[Any], ...]:
    """Entries of each drawn value; texel, share, directions of every entry; values, bounds."""
    pixel, light = np.nonzero(~np.isnan(view.values).all(axis=2))
    drawn = rng.random(len(pixel)) < share
    pixel, light = pixel[drawn], light[drawn]
    counts = np.diff(view.first)[pixel]
    ends = np.cumsum(counts)
    inside = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)
    entry = np.repeat(view.first[pixel], counts) + inside
    row = view.entry[entry]
    return (
        counts,
        view.texels[row],
        view.share[entry],
        view.views[row],
        view.lights[row, np.repeat(light, counts)],
        view.values[pixel, light],
        view.at_least[pixel, light],
    )
