"""Texels of any field fitted by the microfacets of glTF's material.

For each texel, its samples for pairs of directions in its own frame are approximated by a
diffuse colour and one anisotropic highlight: eleven numbers, two of which tilt the normal. The
pairs are the same for all texels: one half of them has view and light spread by their cosines,
in the other half vectors lie close to the normal, where highlights are. A residual is weighted
by the power -2/3 of its sample, as if cube roots were compared (dark samples no more than the
third of the mean), and by Cauchy's function, so that a shadow or a defect that no highlight
explains counts little. Levenberg-Marquardt steps
start at the best of several widths of a round highlight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from reflfield.export.microfacets import DIELECTRIC_F0, gloss_term
from reflfield.field.evaluation import evaluate
from reflfield.field.reflectance_field import ClusteredField, ReflectanceField
from reflfield.options import available_cores
from reflfield.util.blas_threads import thread_pool
from reflfield.util.cholesky import cholesky_factor
from reflfield.util.progress import track

Doubles = NDArray[np.float64]

N_PAIRS = 256
# Directions of the fit are at least so high above the texel, by their cosine: the field rounds
# its cosine below.
LEAST_COSINE = 0.15
# Width of the innermost half vectors, and largest angle of the others, radians.
INNER_ANGLE, OUTER_ANGLE = np.radians(3.0), np.radians(75.0)
_TEXELS_AT_ONCE = 512
# Widths of highlights, and the largest tilt of a normal against the texel's frame.
LEAST_ALPHA, MOST_TILT = 0.01, 1.0
_FIRST_ALPHAS = np.geomspace(0.02, 0.8, 8)
_N_SHAPE, _N_ALL = 5, 11  # unknowns of the highlight's place and shape, and all of them
_N_ROUNDS, _MOST_STEPS = 3, 12  # rounds of weights, and steps of each
# Weight, relative to the samples, that draws what they do not determine to a plain highlight.
_PRIOR = np.array([1e-4, 1e-4, 1e-5, 1e-4, 1e-4])


@dataclass(frozen=True, eq=False)
class MicrofacetFit:
    """Diffuse colour and highlight of each texel.

    Parameters
    ----------
    diffuse, f0 : (n, 3) float64
        Albedo; reflectance for light from straight above, where it arrives at the facets.
    alphas : (n, 2) float64
        Along and across the direction in which highlights stretch; the first is not less.
    normals, stretch : (n, 3) float64
        Unit vectors in the world.
    """

    diffuse: Doubles
    f0: Doubles
    alphas: Doubles
    normals: Doubles
    stretch: Doubles


def direction_pairs(n: int, near_normal: bool, seed: int = 0) -> tuple[Doubles, Doubles]:
    """Views and lights in a texel's frame, (n, 3) each.

    Parameters
    ----------
    n : int
    near_normal : bool
        Whether half vectors are dense near the normal; else both directions are spread over
        the hemisphere by their cosines, evenly.
    seed : int
        Other pairs for another seed.

    Examples
    --------
    >>> views, lights = direction_pairs(1000, near_normal=False)
    >>> bool(abs((views[:, 2] ** 2).mean() - 0.51) < 0.01)  # (1 + 0.15 ** 2) / 2
    True
    """
    chosen: list[tuple[Doubles, Doubles]] = []
    sequence = qmc.Sobol(4, rng=np.random.default_rng(seed))
    while sum(len(views) for views, _ in chosen) < n:
        numbers = sequence.random(1 << int(np.ceil(np.log2(2 * n))))
        views = _cosine_weighted(numbers[:, :2])
        if near_normal:
            half = _near_normal(numbers[:, 2:])
            lights = 2.0 * (views * half).sum(axis=1, keepdims=True) * half - views
        else:
            lights = _cosine_weighted(numbers[:, 2:])
        usable = lights[:, 2] >= LEAST_COSINE
        chosen.append((views[usable], lights[usable]))
    all_views, all_lights = (np.concatenate(part)[:n] for part in zip(*chosen, strict=True))
    return all_views, all_lights


def _cosine_weighted(numbers: Doubles) -> Doubles:
    """Directions whose density is the cosine, above the least one."""
    ring = np.sqrt((1.0 - LEAST_COSINE**2) * numbers[:, 0])
    return _on_ring(ring, numbers[:, 1])


def _near_normal(numbers: Doubles) -> Doubles:
    """Directions whose angle is spread by its inverse hyperbolic sine."""
    reach = np.arcsinh(OUTER_ANGLE / INNER_ANGLE)
    return _on_ring(np.sin(INNER_ANGLE * np.sinh(reach * numbers[:, 0])), numbers[:, 1])


def _on_ring(ring: Doubles, share: Doubles) -> Doubles:
    azimuth = 2.0 * np.pi * share
    height = np.sqrt(1.0 - ring**2)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=1)


def texel_samples(
    field: ReflectanceField,
    texels: NDArray[np.integer],
    pairs: tuple[Doubles, Doubles],
    outward: Doubles,
) -> tuple[Doubles, Doubles, Doubles]:
    """World views and lights of pairs in texels' frames, and the field's samples for them.

    Parameters
    ----------
    field : ReflectanceField
    texels : (n,) int
    pairs : pair of (s, 3) float64
        As of `direction_pairs`.
    outward : (n_texels, 3) float64
        Normals of the base surface: from there a field that was photographed from one side
        is seen.

    Returns
    -------
    views, lights, samples : (n, s, 3) float64
    """
    world_from_local = np.swapaxes(field.local_from_world[texels].astype(np.float64), 1, 2)
    views, lights = (pair @ np.swapaxes(world_from_local, 1, 2) for pair in pairs)
    if isinstance(field, ClusteredField) and field.view_side == 1:
        views = np.broadcast_to(outward[texels, None], lights.shape)
    views, lights = (np.ascontiguousarray(one).reshape(-1, 3) for one in (views, lights))
    repeated = np.repeat(texels, len(pairs[0]))
    samples = evaluate(field, repeated, views.astype(np.float32), lights.astype(np.float32))
    shape = (len(texels), len(pairs[0]), 3)
    return views.reshape(shape), lights.reshape(shape), samples.astype(float).reshape(shape)


def fit_microfacets(
    field: ReflectanceField, outward: Doubles, exposure: float = 1.0
) -> MicrofacetFit:
    """Fit the material of glTF to every texel of a field.

    Parameters
    ----------
    field : ReflectanceField
        Of a known light.
    outward : (n_texels, 3) float64
        Normals of the base surface.
    exposure : float
        Factor of the samples: no surface reflects more light than arrives, but the unit of a
        capture's lamps may say so.

    Returns
    -------
    MicrofacetFit

    Notes
    -----
    About a millisecond a texel and core.
    """
    half = N_PAIRS // 2
    kinds = [direction_pairs(half, near_normal) for near_normal in (False, True)]
    pairs = tuple(np.concatenate(part) for part in zip(*kinds, strict=True))
    texels = np.arange(field.n_texels)
    blocks = [texels[i : i + _TEXELS_AT_ONCE] for i in range(0, len(texels), _TEXELS_AT_ONCE)]
    field.decode()

    def one(block: NDArray[np.integer]) -> Doubles:
        views, lights, samples = texel_samples(field, block, (pairs[0], pairs[1]), outward)
        to_local = np.swapaxes(field.local_from_world[block].astype(np.float64), 1, 2)
        unknowns = np.zeros((len(block), _N_ALL))
        _fit_texels(views @ to_local, lights @ to_local, exposure * samples, unknowns)
        return unknowns

    with thread_pool(available_cores()) as pool:
        done = track(pool.map(one, blocks), len(blocks), "fit of the maps")
        unknowns = np.concatenate(list(done))
    return _in_world(unknowns, field.local_from_world.astype(np.float64))


def _in_world(unknowns: Doubles, local_from_world: Doubles) -> MicrofacetFit:
    """What the unknowns stand for."""
    bases, alphas = np.zeros((len(unknowns), 3, 3)), np.zeros((len(unknowns), 2))
    for i, shape in enumerate(unknowns):
        alphas[i] = lobe_basis(shape, bases[i])
    bases = bases @ local_from_world
    return MicrofacetFit(unknowns[:, 5:8], unknowns[:, 8:11], alphas, bases[:, 2], bases[:, 0])


@numba.njit(cache=True, nogil=True)
def lobe_basis(shape: Any, basis: Any) -> Any:
    """Directions and widths of a highlight.

    Parameters
    ----------
    shape : (5, ...) float64
        Slopes of the normal along x and y; mean logarithm of the widths, and the two numbers
        of a traceless symmetric matrix that stretches the highlight.
    basis : (3, 3) float64
        Filled with t, b and n in the texel's frame.

    Returns
    -------
    along, across : float
        Widths along t, not less, and along b.
    """
    scale = 1.0 / np.sqrt(1.0 + shape[0] ** 2 + shape[1] ** 2)
    nx, ny, nz = shape[0] * scale, shape[1] * scale, scale
    # The texel's x axis, turned upon the plane across the normal.
    ux, uz = nz, -nx
    scale = 1.0 / np.sqrt(ux * ux + uz * uz)
    ux, uz = ux * scale, uz * scale
    wx, wy, wz = ny * uz, nz * ux - nx * uz, -ny * ux
    angle = 0.5 * np.arctan2(shape[4], shape[3])
    c, s = np.cos(angle), np.sin(angle)
    basis[0, 0], basis[0, 1], basis[0, 2] = c * ux + s * wx, s * wy, c * uz + s * wz
    basis[1, 0], basis[1, 1], basis[1, 2] = c * wx - s * ux, c * wy, c * wz - s * uz
    basis[2, 0], basis[2, 1], basis[2, 2] = nx, ny, nz
    stretch = np.hypot(shape[3], shape[4])
    along, across = np.exp(shape[2] + stretch), np.exp(shape[2] - stretch)
    return min(max(along, LEAST_ALPHA), 1.0), min(max(across, LEAST_ALPHA), 1.0)


@numba.njit(cache=True, nogil=True)
def _terms(shape: Any, views: Doubles, lights: Doubles, basis: Doubles, out: Doubles) -> None:
    """Gloss times cosine, grazing and cosine of each pair, (s, 3)."""
    along, across = lobe_basis(shape, basis)
    for i in range(len(views)):
        gloss, grazing, cosine = gloss_term(basis, views[i], lights[i], along, across)
        out[i, 0], out[i, 1], out[i, 2] = gloss * cosine, grazing, cosine


@numba.njit(cache=True, nogil=True)
def _grazing_f90(unknowns: Any) -> float:
    """Reflectance of grazing light: 1, less where less than a dielectric is reflected."""
    return min(max(unknowns[8], unknowns[9], unknowns[10]) / DIELECTRIC_F0, 1.0)


@numba.njit(cache=True, nogil=True)
def _let_in(unknowns: Any, grazing: float, f90: float) -> float:
    """Share of the light that is not reflected at the facets, over pi."""
    most = max(unknowns[8], unknowns[9], unknowns[10])
    return max(1.0 - most - (f90 - most) * grazing, 0.0) / np.pi


@numba.njit(cache=True, nogil=True)
def _cost(unknowns: Any, terms: Doubles, samples: Doubles, weights: Doubles) -> float:
    f90, total = _grazing_f90(unknowns), 0.0
    for i in range(len(terms)):
        gloss, grazing, cosine = terms[i]
        base = cosine * _let_in(unknowns, grazing, f90)
        for c in range(3):
            reflected = unknowns[8 + c] * (1.0 - grazing) + f90 * grazing
            off = base * unknowns[5 + c] + gloss * reflected - samples[i, c]
            total += weights[i, c] * off * off
    for k in range(_N_SHAPE):
        total += _PRIOR[k] * len(terms) * (unknowns[k] - _prior_mean(k)) ** 2
    return total


@numba.njit(cache=True, nogil=True)
def _prior_mean(k: int) -> float:
    return -1.0 if k == 2 else 0.0


@numba.njit(cache=True, nogil=True)
def _normal_equations(
    unknowns: Any,
    terms: Doubles,
    moved: Doubles,
    steps: Doubles,
    samples: Doubles,
    weights: Doubles,
    matrix: Doubles,
    right: Doubles,
) -> None:
    """Gauss-Newton system; `moved` holds the terms with each shape number moved by its step."""
    matrix[:], right[:] = 0.0, 0.0
    f90, row = _grazing_f90(unknowns), np.zeros(_N_SHAPE + 2)
    place = np.arange(_N_SHAPE + 2)
    for i in range(len(terms)):
        gloss, grazing, cosine = terms[i]
        let_in = _let_in(unknowns, grazing, f90)
        for c in range(3):
            diffuse = let_in * unknowns[5 + c]
            reflected = unknowns[8 + c] * (1.0 - grazing) + f90 * grazing
            for k in range(_N_SHAPE):
                change = reflected * (moved[k, i, 0] - gloss)
                row[k] = (change + diffuse * (moved[k, i, 2] - cosine)) / steps[k]
            row[5], row[6] = cosine * let_in, gloss * (1.0 - grazing)
            place[5], place[6] = 5 + c, 8 + c
            off = samples[i, c] - cosine * diffuse - gloss * reflected
            for a in range(_N_SHAPE + 2):
                weighted = weights[i, c] * row[a]
                right[place[a]] += weighted * off
                for b in range(a + 1):
                    matrix[place[a], place[b]] += weighted * row[b]
    for k in range(_N_SHAPE):
        matrix[k, k] += _PRIOR[k] * len(terms)
        right[k] += _PRIOR[k] * len(terms) * (_prior_mean(k) - unknowns[k])


@numba.njit(cache=True, nogil=True)
def _solved(matrix: Doubles, right: Doubles, damping: float, work: Doubles) -> bool:
    """Damped solution, into the last row of `work`; False where there is none."""
    n = len(right)
    work[:n, :n], work[n, :n] = matrix, right
    for k in range(n):
        work[k, k] += damping * matrix[k, k] + 1e-12
    if not cholesky_factor(work[:, :n], n):
        return False
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            work[n, k] -= work[j, k] * work[n, j]
        work[n, k] /= work[k, k]
    return True


@numba.njit(cache=True, nogil=True)
def _clip(unknowns: Any) -> None:
    tilt = np.hypot(unknowns[0], unknowns[1])
    if tilt > MOST_TILT:
        unknowns[0] *= MOST_TILT / tilt
        unknowns[1] *= MOST_TILT / tilt
    unknowns[2] = min(max(unknowns[2], np.log(LEAST_ALPHA)), 0.0)
    stretch = np.hypot(unknowns[3], unknowns[4])
    most = min(unknowns[2] - np.log(LEAST_ALPHA), -unknowns[2])
    if stretch > most:
        unknowns[3] *= most / stretch
        unknowns[4] *= most / stretch
    for k in range(_N_SHAPE, _N_ALL):
        unknowns[k] = max(unknowns[k], 0.0)


@numba.njit(cache=True, nogil=True)
def _round_start(
    views: Doubles, lights: Doubles, samples: Doubles, weights: Doubles, unknowns: Any
) -> None:
    """Best of several widths of a round highlight, colours by two linear equations each."""
    terms, basis, trial = np.zeros((len(views), 3)), np.zeros((3, 3)), np.zeros(_N_ALL)
    best = np.inf
    for alpha in _FIRST_ALPHAS:
        trial[2] = np.log(alpha)
        _terms(trial, views, lights, basis, terms)
        for c in range(3):
            aa, ab, bb, ar, br = 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(len(views)):
                a, b = terms[i, 2] / np.pi, terms[i, 0]
                w, sample = weights[i, c], samples[i, c]
                aa, ab, bb = aa + w * a * a, ab + w * a * b, bb + w * b * b
                ar, br = ar + w * a * sample, br + w * b * sample
            determinant = max(aa * bb - ab * ab, 1e-9 * aa * bb + 1e-300)
            gloss = max((aa * br - ab * ar) / determinant, 0.0)
            trial[8 + c] = gloss
            trial[5 + c] = max((ar - ab * gloss) / max(aa, 1e-300), 0.0)
        cost = _cost(trial, terms, samples, weights)
        if cost < best:
            best = cost
            unknowns[:] = trial


@numba.njit(cache=True, nogil=True)
def _descend(
    views: Doubles, lights: Doubles, samples: Doubles, weights: Doubles, unknowns: Any
) -> None:
    """Levenberg-Marquardt steps."""
    terms, moved = np.zeros((len(views), 3)), np.zeros((_N_SHAPE, len(views), 3))
    basis, trial, steps = np.zeros((3, 3)), np.zeros(_N_ALL), np.full(_N_SHAPE, 1e-3)
    matrix, right = np.zeros((_N_ALL, _N_ALL)), np.zeros(_N_ALL)
    work, damping = np.zeros((_N_ALL + 1, _N_ALL)), 1e-3
    _terms(unknowns, views, lights, basis, terms)
    cost = _cost(unknowns, terms, samples, weights)
    for _ in range(_MOST_STEPS):
        for k in range(_N_SHAPE):
            trial[:] = unknowns
            trial[k] += steps[k]
            _terms(trial, views, lights, basis, moved[k])
        _normal_equations(unknowns, terms, moved, steps, samples, weights, matrix, right)
        before = cost
        for _ in range(4):
            if _solved(matrix, right, damping, work):
                trial[:] = unknowns + work[_N_ALL]
                _clip(trial)
                _terms(trial, views, lights, basis, terms)
                cost = _cost(trial, terms, samples, weights)
                if cost < before:
                    break
            damping *= 10.0
        if not cost < before:
            return
        unknowns[:] = trial
        damping *= 0.2
        if cost > 0.999 * before:
            return


@numba.njit(cache=True, nogil=True)
def _fit_texels(views: Doubles, lights: Doubles, samples: Doubles, unknowns: Doubles) -> None:
    for t in range(len(samples)):
        level = samples[t].mean()
        if not level > 0.0:
            unknowns[t, 2] = _prior_mean(2)
            continue
        # Relative to the mean, so that the priors weigh the same for bright and dark texels.
        weights = (samples[t] / level + 0.3) ** (-4.0 / 3.0) / level**2
        _round_start(views[t], lights[t], samples[t], weights, unknowns[t])
        _descend(views[t], lights[t], samples[t], weights, unknowns[t])
        for _ in range(_N_ROUNDS - 1):
            _reweigh(views[t], lights[t], samples[t], weights, unknowns[t])
            _descend(views[t], lights[t], samples[t], weights, unknowns[t])


@numba.njit(cache=True, nogil=True)
def _reweigh(
    views: Doubles, lights: Doubles, samples: Doubles, weights: Doubles, unknowns: Any
) -> None:
    """Cauchy's weights for the residuals that are left, of three times their spread."""
    terms, f90 = np.zeros((len(views), 3)), _grazing_f90(unknowns)
    _terms(unknowns, views, lights, np.zeros((3, 3)), terms)
    square, total = np.zeros((len(views), 3)), 0.0
    for i in range(len(views)):
        gloss, grazing, cosine = terms[i]
        base = cosine * _let_in(unknowns, grazing, f90)
        for c in range(3):
            reflected = unknowns[8 + c] * (1.0 - grazing) + f90 * grazing
            off = base * unknowns[5 + c] + gloss * reflected - samples[i, c]
            square[i, c] = weights[i, c] * off * off
            total += np.sqrt(np.sqrt(square[i, c]))
    # Of roots, so that few large residuals do not make themselves usual.
    spread = (total / square.size) ** 4 + 1e-12
    for i in range(len(terms)):
        for c in range(3):
            weights[i, c] /= 1.0 + square[i, c] / (9.0 * spread)
