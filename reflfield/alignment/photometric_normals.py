r"""Normals of texels that one view shows under many lights, by photometric stereo.

The luminance of a texel under light j is taken for

.. math:: y_j = (n \cdot l_j)_+ \Big( a + \tfrac14 V \sum_k w_k D_k(n \cdot h_j) \Big),

a matt part and lobes about the half vector h of light and view: D is the distribution of GGX
of a few roughnesses, V = 1 / (l + v - l v) with the cosines l and v of light and view, as in
`field.half_vector`, and a and w are not negative. Lobes stand upright on the normal. Seen from
one side, lobes that any function of the half vector could be would leave a common lean of all
normals undetermined.

Of each texel the normal and the weights are found by Gauss-Newton steps with weights that
bound shadows and interreflections, from several beginnings, the best of which goes on.

References
----------
R. J. Woodham, "Photometric method for determining surface orientation from multiple images",
Optical Engineering 19(1), 1980.
B. Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.sphere.rotations import frames_from_normals
from reflfield.util.cholesky import cholesky_factor, solve_vector
from reflfield.util.validation import check_shape

Floats = NDArray[np.float32]

# What the compiler may do to sums; NaN, which marks values not measured, stays NaN.
FAST = {"reassoc", "contract", "arcp", "nsz"}

# Roughnesses of the lobes.
ROUGHNESSES = (0.08, 0.2, 0.45)
N_WEIGHTS = 1 + len(ROUGHNESSES)
# Most steps from the best beginning.
MOST_STEPS = 7
# A smaller step is the last one, radians.
SMALL_STEP = 1e-3
# Residuals of square roots, over the root of the brightest value, that count by half.
USUAL_RESIDUAL = np.float32(0.08)
# Of fewer lights lobes must earn their place: they would explain what is wrong with the lights.
FEW_LIGHTS = 40
# Largest tilt of one step, radians, and the least cosine of normal and view.
LARGEST_STEP, LEAST_COSINE = np.float32(0.25), np.float32(0.05)
# Share of the brightest value at which a light counts for the matt beginning.
MATT_SHARE = np.float32(0.15)
# Share of the brightest value above which lights tell where a highlight is.
HIGHLIGHT_SHARE = np.float32(0.5)
# Tie of weights to zero and of tilts to what they are, over the diagonal.
RIDGE = 1e-4

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)
_ALPHA2 = np.array(ROUGHNESSES, np.float32) ** 2


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _facing(normal: Any, view: Any) -> Any:
    return normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _take_samples(values: Any, lights: Any, view: Any, samples: Any) -> None:
    """One texel's values, which of them count, its lights and half vectors, as rows.

    All loops over lights run along rows, so that the compiler takes several lights at a time.
    """
    own, counted, towards, halves = samples
    for j in range(len(values)):
        measured = not np.isnan(values[j])
        own[j] = values[j] if measured else _ZERO
        counted[j] = _ONE if measured else _ZERO
    for j in range(len(values)):
        x, y, z = lights[j, 0], lights[j, 1], lights[j, 2]
        hx, hy, hz = x + view[0], y + view[1], z + view[2]
        scale = _ONE / np.sqrt(hx * hx + hy * hy + hz * hz + np.float32(1e-12))
        towards[0, j], towards[1, j], towards[2, j] = x, y, z
        halves[0, j], halves[1, j], halves[2, j] = hx * scale, hy * scale, hz * scale


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _terms(normal: Any, view: Any, samples: Any, parts: Any, slopes: Any) -> None:
    """What each weight adds under each light, into `parts`; slopes by n.l and n.h apart."""
    _, _, towards, halves = samples
    facing = max(_facing(normal, view), LEAST_COSINE)
    for j in range(towards.shape[1]):
        cosine = (
            normal[0] * towards[0, j] + normal[1] * towards[1, j] + normal[2] * towards[2, j]
        )
        half = normal[0] * halves[0, j] + normal[1] * halves[1, j] + normal[2] * halves[2, j]
        lit = _ONE if cosine > _ZERO else _ZERO
        cosine = max(cosine, _ZERO)
        parts[0, j], slopes[0, 0, j], slopes[0, 1, j] = cosine, lit, _ZERO
        spread = lit * np.float32(0.25) / (cosine + facing - cosine * facing + np.float32(1e-3))
        for k in range(len(_ALPHA2)):
            alpha2 = _ALPHA2[k]
            over = _ONE / (half * half * (alpha2 - _ONE) + _ONE)
            lobe = spread * alpha2 * over * over
            steepness = np.float32(4.0) * half * (_ONE - alpha2) * over
            parts[1 + k, j] = cosine * lobe
            slopes[1 + k, 0, j] = lobe
            slopes[1 + k, 1, j] = cosine * lobe * steepness


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _solve_weights(matrix: Any, right: Any, weights: Any) -> None:
    """Non-negative minimum of a quadratic, by a few sweeps over its coordinates."""
    n = len(weights)
    for _ in range(12):
        for k in range(n):
            rest = right[k]
            for m in range(n):
                if m != k:
                    rest -= matrix[k, m] * weights[m]
            weights[k] = max(rest / max(matrix[k, k], np.float32(1e-20)), _ZERO)


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _trust(value: Any, shown: Any, unit: Any) -> Any:
    """Weight of a squared residual: by the slope of the root, and bounded for outliers."""
    value, shown = max(value, _ZERO), max(shown, _ZERO)
    away = (np.sqrt(value) - np.sqrt(shown)) / (np.sqrt(unit) * USUAL_RESIDUAL)
    return _ONE / ((_ONE + away * away) * (value + shown + np.float32(0.02) * unit))


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _lines(samples: Any, weights: Any, axes: Any, buffers: Any) -> None:
    """Values shown, and their derivatives by the two tilts, into the last rows of `parts`."""
    _, _, towards, halves = samples
    parts, slopes, shown = buffers[0], buffers[1], buffers[4]
    tangent, binormal = axes
    n = len(weights)
    for j in range(len(shown)):
        value, by_light, by_half = _ZERO, _ZERO, _ZERO
        for k in range(N_WEIGHTS):
            value += weights[k] * parts[k, j]
            by_light += weights[k] * slopes[k, 0, j]
            by_half += weights[k] * slopes[k, 1, j]
        x = by_light * towards[0, j] + by_half * halves[0, j]
        y = by_light * towards[1, j] + by_half * halves[1, j]
        z = by_light * towards[2, j] + by_half * halves[2, j]
        shown[j] = value
        parts[n, j] = x * tangent[0] + y * tangent[1] + z * tangent[2]
        parts[n + 1, j] = x * binormal[0] + y * binormal[1] + z * binormal[2]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _normal_equations(own: Any, trusts: Any, shown: Any, parts: Any, sums: Any) -> Any:
    """Lower triangle and right side of the rows of `parts`; the weighted sum of squares."""
    matrix, right = sums
    error = _ZERO
    for j in range(len(own)):
        rest = own[j] - shown[j]
        error += trusts[j] * rest * rest
        shown[j] = trusts[j] * rest
    for k in range(len(right)):
        total = _ZERO
        for j in range(len(own)):
            total += parts[k, j] * shown[j]
        right[k] = total
        for m in range(k + 1):
            total = _ZERO
            for j in range(len(own)):
                total += trusts[j] * parts[k, j] * parts[m, j]
            matrix[k, m] = total
    return error


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _step(samples: Any, view: Any, unit: Any, state: Any, buffers: Any, n_free: int) -> Any:
    """Improve normal and weights once; sum of squares before, and the angle moved."""
    normal, weights = state
    own, counted, _, _ = samples
    parts, slopes, matrix, right, shown, trusts = buffers
    tangent, binormal = _tangents(normal)
    _terms(normal, view, samples, parts, slopes)
    _lines(samples, weights, (tangent, binormal), buffers)
    for j in range(len(own)):
        trusts[j] = counted[j] * _trust(own[j], shown[j], unit)
    error = _normal_equations(own, trusts, shown, parts, (matrix, right))
    return error, _move(state, tangent, binormal, matrix, right, n_free)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _complete(weights: Any, matrix: Any, right: Any, n_free: int) -> None:
    """Fill the upper triangle, add the tie, and hold weights at zero that would fall.

    So are all but the first `n_free`.
    """
    n = len(right)
    for k in range(n):
        matrix[k, k] += RIDGE * matrix[k, k] + 1e-12
        for m in range(k):
            matrix[m, k] = matrix[k, m]
    for k in range(len(weights)):
        if k >= n_free or (weights[k] <= _ZERO and right[k] <= 0.0):
            matrix[k, :] = 0.0
            matrix[:, k] = 0.0
            matrix[k, k], right[k] = 1.0, 0.0


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _move(state: Any, tangent: Any, binormal: Any, matrix: Any, right: Any, n_free: int) -> Any:
    """Take a bounded Gauss-Newton step; weights stay non-negative. Its angle, radians."""
    normal, weights = state
    n = len(weights)
    _complete(weights, matrix, right, n_free)
    if not cholesky_factor(matrix, n + 2):
        return 0.0
    solve_vector(matrix, right)
    size = np.sqrt(right[n] ** 2 + right[n + 1] ** 2)
    factor = min(1.0, LARGEST_STEP / max(size, 1e-12))
    for k in range(n):
        weights[k] = max(weights[k] + right[k], _ZERO)
    for d in range(3):
        normal[d] += factor * (right[n] * tangent[d] + right[n + 1] * binormal[d])
    _normalise(normal)
    return size


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _normalise(vector: Any) -> None:
    scale = _ONE / np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2 + np.float32(1e-20))
    for d in range(3):
        vector[d] *= scale


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _tangents(normal: Any) -> Any:
    """Two unit vectors perpendicular to a normal and to each other."""
    sign = _ONE if normal[2] >= _ZERO else -_ONE
    a = -_ONE / (sign + normal[2])
    b = normal[0] * normal[1] * a
    tangent = (_ONE + sign * normal[0] * normal[0] * a, sign * b, -sign * normal[0])
    return tangent, (b, sign + normal[1] * normal[1] * a, -normal[1])


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _matt_normal(values: Any, lights: Any, least: Any, normal: Any) -> None:
    """Normal of a matt surface from the values above a bound."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for j in range(len(values)):
        if values[j] >= least:
            for d in range(3):
                right[d] += lights[j, d] * values[j]
                for e in range(3):
                    matrix[d, e] += lights[j, d] * lights[j, e]
    for d in range(3):
        matrix[d, d] += 1e-4 * (matrix[0, 0] + matrix[1, 1] + matrix[2, 2]) + 1e-12
    if cholesky_factor(matrix, 3):
        solve_vector(matrix, right)
        for d in range(3):
            normal[d] = right[d]
    _normalise(normal)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _mirror_normal(values: Any, lights: Any, view: Any, least: Any, normal: Any) -> None:
    """Mean half vector of the lights whose values are above a bound."""
    normal[:] = _ZERO
    for j in range(len(values)):
        if values[j] >= least:
            hx, hy, hz = lights[j, 0] + view[0], lights[j, 1] + view[1], lights[j, 2] + view[2]
            scale = values[j] / np.sqrt(hx * hx + hy * hy + hz * hz + np.float32(1e-12))
            normal[0] += scale * hx
            normal[1] += scale * hy
            normal[2] += scale * hz
    _normalise(normal)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _start_weights(samples: Any, view: Any, unit: Any, state: Any, buffers: Any) -> Any:
    """Set the weights that fit best at a normal; the sum of squares that they leave."""
    normal, weights = state
    own, counted, _, _ = samples
    parts, slopes, matrix, right, shown, trusts = buffers
    n = len(weights)
    _terms(normal, view, samples, parts, slopes)
    for j in range(len(own)):
        shown[j] = _ZERO
        spread = np.float32(2.0) * max(own[j], _ZERO) + np.float32(0.02) * unit
        trusts[j] = counted[j] / spread
    sums = matrix[:n, :n], right[:n]
    error = _normal_equations(own, trusts, shown, parts, sums)
    for k in range(n):
        for m in range(k):
            matrix[m, k] = matrix[k, m]
    weights[:] = _ZERO
    _solve_weights(*sums, weights)
    for k in range(n):
        error -= weights[k] * right[k]
    return error


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _brightest(values: Any) -> Any:
    """Largest value, NaN left out; 0 if there is none."""
    largest = _ZERO
    for value in values:
        if value > largest:
            largest = value
    return largest


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _best_start(samples: Any, view: Any, unit: Any, states: Any, buffers: Any) -> int:
    """Beginning with the least error; -1 if none faces the camera."""
    starts, weights = states
    best, least = -1, np.inf
    for s in range(len(starts)):
        if _facing(starts[s], view) < LEAST_COSINE:
            continue
        error = _start_weights(samples, view, unit, (starts[s], weights[s]), buffers)
        if error < least:
            best, least = s, error
    return best


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _converge(samples: Any, view: Any, unit: Any, state: Any, buffers: Any, n_free: int) -> Any:
    """Take steps until they are small; the sum of squares before the last."""
    moved, step, error = np.inf, 0, _ZERO
    while moved >= SMALL_STEP and step < MOST_STEPS:
        error, moved = _step(samples, view, unit, state, buffers, n_free)
        step += 1
    return error


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _matt_fit(samples: Any, view: Any, unit: Any, state: Any, buffers: Any) -> Any:
    """Fit of the matt part alone from the normal of a matt surface; its sum of squares."""
    normal, weights = state
    if _facing(normal, view) < LEAST_COSINE:
        return np.float32(np.inf)
    _start_weights(samples, view, unit, state, buffers)
    weights[1:] = _ZERO
    return _converge(samples, view, unit, state, buffers, 1)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _suffices(matt: Any, glossy: Any, values: Any) -> Any:
    """Whether a matt part explains values as well as lobes do, by Schwarz's criterion."""
    n = 0
    for value in values:
        n += not np.isnan(value)
    return n * np.log(max(matt, 1e-30)) < n * np.log(max(glossy, 1e-30)) + (
        N_WEIGHTS - 1
    ) * np.log(max(n, 1))


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _fit_texels(values: Any, lights: Any, views: Any, normals: Any, residuals: Any) -> None:
    n, n_lights = N_WEIGHTS, values.shape[1]
    samples = (
        np.zeros(n_lights, np.float32),
        np.zeros(n_lights, np.float32),
        np.zeros((3, n_lights), np.float32),
        np.zeros((3, n_lights), np.float32),
    )
    buffers = (
        np.zeros((n + 2, n_lights), np.float32),
        np.zeros((n, 2, n_lights), np.float32),
        np.zeros((n + 2, n + 2)),
        np.zeros(n + 2),
        np.zeros(n_lights, np.float32),
        np.zeros(n_lights, np.float32),
    )
    starts, weights = np.zeros((3, 3), np.float32), np.zeros((3, n), np.float32)
    for t in range(len(values)):
        unit, view = _brightest(values[t]), views[t]
        if unit <= _ZERO:
            continue
        _take_samples(values[t], lights[t], view, samples)
        starts[:] = normals[t]
        _matt_normal(values[t], lights[t], MATT_SHARE * unit, starts[0])
        _mirror_normal(values[t], lights[t], view, HIGHLIGHT_SHARE * unit, starts[1])
        best = _best_start(samples, view, unit, (starts, weights), buffers)
        if best < 0:
            continue
        state = starts[best], weights[best]
        residuals[t] = _converge(samples, view, unit, state, buffers, n)
        if values.shape[1] < FEW_LIGHTS:
            other = (best + 1) % len(starts)
            matt = starts[other], weights[other]
            _matt_normal(values[t], lights[t], MATT_SHARE * unit, matt[0])
            error = _matt_fit(samples, view, unit, matt, buffers)
            if _suffices(error, residuals[t], values[t]):
                best, residuals[t] = other, error
        if _facing(starts[best], view) >= LEAST_COSINE:
            normals[t] = starts[best]


def photometric_normals(
    values: Floats, lights: Floats, views: Floats, start: Floats
) -> tuple[Floats, Floats]:
    """Normals of texels from their luminance under many lights.

    Parameters
    ----------
    values : (n, n_lights) float32
        Luminance of radiance over facing irradiance, 1/sr; NaN where not measured.
    lights : (n, n_lights, 3) float32
        Unit directions from each texel, world frame.
    views : (n, 3) float32
        Unit directions to the camera.
    start : (n, 3) float32
        Unit normals that are tried besides those of a matt and of a mirroring surface, and
        that texels without light keep.

    Returns
    -------
    normals : (n, 3) float32
        Unit length.
    residuals : (n,) float32
        Weighted squared residuals.

    Raises
    ------
    ShapeError
        If shapes disagree.
    """
    check_shape("values", values, (len(start), None))
    check_shape("lights", lights, (*values.shape, 3))
    check_shape("views", views, (len(start), 3))
    normals = np.array(start, np.float32)
    residuals = np.zeros(len(start), np.float32)
    arrays = (np.ascontiguousarray(array, np.float32) for array in (values, lights, views))
    _fit_texels(*arrays, normals, residuals)
    return normals, residuals


def frames_towards(normals: Floats, directions: Floats) -> Floats:
    """Right-handed frames (n, 3, 3) of normals, whose x axis leans towards directions.

    Of directions along the normals the x axis is any that is perpendicular to the normal.

    Examples
    --------
    >>> frames_towards(np.float32([[0, 0, 1]]), np.float32([[0, 0.6, 0.8]]))[0].tolist()
    [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    # In double precision, normals of length 1 to all its digits: of a direction that is nearly
    # the normal, little is left once its part along the normal is taken away.
    exact = normals.astype(np.float64)
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    return frames_from_normals(exact, directions).astype(np.float32)
