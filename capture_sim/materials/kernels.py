"""Compiled BRDFs: many points, each under the same number of lights.

All kernels take directions to the viewer ``views`` (n, 3) and to the lights
``lights`` (n, 3, n_lights) in the points' shading frames, all unit, in one
floating-point type, and fill ``values`` (n, 3, n_lights) of that type with the
BRDF in 1/sr. Lights lie along the last axis so that the loops over them become
vector instructions. Values of lights below the horizon mean nothing; points
that see the viewer below the horizon are left as they are. Parameters are
per point. The formulas are those of `capture_sim.materials.analytic`, which a
test compares with these.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

# Sums may be reassociated and NaN ignored; divisions stay exact.
_LOOSE = {"nnan", "ninf", "nsz", "contract", "reassoc"}
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_LOOSE)
_inlined = numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath=_LOOSE, inline="always"
)


@_compiled
def lambert(albedo: Floats, values: Floats) -> None:
    """Fill values with albedo (n, 3) over pi."""
    one_over_pi = values.dtype.type(1.0 / np.pi)
    for i in range(len(values)):
        for c in range(3):
            values[i, c, :] = albedo[i, c] * one_over_pi


@_inlined
def _fifth_power(x: Any) -> Any:
    squared = x * x
    return squared * squared * x


@_compiled
def add_coupled_diffuse(
    views: Floats, lights: Floats, albedo: Floats, specular: Floats, values: Floats
) -> None:
    """Add the diffuse term that a Schlick coat leaves; see `coupled_diffuse`."""
    number = values.dtype.type
    half, one = number(0.5), number(1.0)
    scale = number(28.0 / (23.0 * np.pi))
    for i in range(len(views)):
        view_part = scale * (one - _fifth_power(one - half * views[i, 2]))
        for c in range(3):
            factor = albedo[i, c] * (one - specular[i, c]) * view_part
            for k in range(lights.shape[2]):
                light_part = one - _fifth_power(one - half * lights[i, 2, k])
                values[i, c, k] += factor * light_part


@_compiled
def ggx(
    views: Floats, lights: Floats, alphas: Floats, correlated: bool, values: Floats
) -> None:
    """Fill channel 0 with density times masking, 1 with the cosine to the half vector.

    The caller turns them into colours: see `schlick_colours`, `metal_colours`.
    """
    number = values.dtype.type
    half, one, two = number(0.5), number(1.0), number(2.0)
    tiny = number(1e-30)
    for i in range(len(views)):
        vx, vy, vz = views[i, 0], views[i, 1], views[i, 2]
        ax, ay = alphas[i, 0], alphas[i, 1]
        if vz <= 0.0:
            continue
        peak = one / (number(np.pi) * ax * ay)
        inverse_x, inverse_y = one / (ax * ax), one / (ay * ay)
        view_stretch = np.sqrt(ax * ax * vx * vx + ay * ay * vy * vy + vz * vz)
        for k in range(lights.shape[2]):
            lx, ly, lz = lights[i, 0, k], lights[i, 1, k], lights[i, 2, k]
            hx, hy, hz = vx + lx, vy + ly, vz + lz
            squared = max(hx * hx + hy * hy + hz * hz, tiny)
            tilt = (hx * hx * inverse_x + hy * hy * inverse_y + hz * hz) / squared
            stretch = np.sqrt(ax * ax * lx * lx + ay * ay * ly * ly + lz * lz)
            if correlated:
                bottom = two * (lz * view_stretch + vz * stretch)
            else:
                bottom = (vz + view_stretch) * (lz + stretch)
            values[i, 0, k] = peak / (tilt * tilt * max(bottom, tiny))
            values[i, 1, k] = min(half * np.sqrt(squared), one)


@_compiled
def schlick_colours(specular: Floats, values: Floats) -> None:
    """Turn lobe and cosine in channels 0 and 1 into colours by Schlick's term."""
    one = values.dtype.type(1.0)
    for i in range(len(values)):
        red, green, blue = specular[i, 0], specular[i, 1], specular[i, 2]
        for k in range(values.shape[2]):
            lobe = values[i, 0, k]
            rest = _fifth_power(one - values[i, 1, k])
            values[i, 0, k] = lobe * (red + (one - red) * rest)
            values[i, 1, k] = lobe * (green + (one - green) * rest)
            values[i, 2, k] = lobe * (blue + (one - blue) * rest)


@_compiled
def metal_colours(specular: Floats, eta: Floats, kappa: Floats, values: Floats) -> None:
    """Turn lobe and cosine in channels 0 and 1 into colours by a metal's Fresnel term.

    The formula is that of `conductor_fresnel`, with the squared cosine for c2.
    """
    number = values.dtype.type
    one, two, half = number(1.0), number(2.0), number(0.5)
    for i in range(len(values)):
        lobe, cosine = values[i, 0].copy(), values[i, 1].copy()
        for c in range(3):
            square = eta[c] * eta[c] - kappa[c] * kappa[c]
            product = two * eta[c] * kappa[c]
            scale = half * specular[i, c]
            for k in range(values.shape[2]):
                c2 = cosine[k] * cosine[k]
                s2 = one - c2
                difference = square - s2
                root = np.sqrt(difference * difference + product * product)
                real = max(two * (root + difference), root - root)
                twice = cosine[k] * np.sqrt(real)
                perpendicular = (root + c2 - twice) / (root + c2 + twice)
                weight = c2 * root + s2 * s2
                bent = twice * s2
                parallel = one + (weight - bent) / (weight + bent)
                values[i, c, k] = lobe[k] * scale * perpendicular * parallel


@_compiled
def phong(
    views: Floats,
    lights: Floats,
    lit: NDArray[np.bool_],
    specular: Floats,
    exponents: Floats,
    values: Floats,
) -> None:
    """Fill values with the Ashikhmin-Shirley lobe where ``lit`` (n, n_lights)."""
    number = values.dtype.type
    half, one, tiny = number(0.5), number(1.0), number(1e-30)
    for i in range(len(views)):
        vx, vy, vz = views[i, 0], views[i, 1], views[i, 2]
        eu, ev = exponents[i, 0], exponents[i, 1]
        peak = np.sqrt((eu + one) * (ev + one)) / number(8.0 * np.pi)
        for k in range(lights.shape[2]):
            if not lit[i, k]:
                continue
            lx, ly, lz = lights[i, 0, k], lights[i, 1, k], lights[i, 2, k]
            hx, hy, hz = vx + lx, vy + ly, vz + lz
            squared = max(hx * hx + hy * hy + hz * hz, tiny)
            x2, y2 = hx * hx / squared, hy * hy / squared
            power = (eu * x2 + ev * y2) * _log_cosine_slope(x2 + y2, hz * hz / squared, half)
            cosine = half * np.sqrt(squared)
            lobe = peak * np.exp(power) / max(cosine * max(vz, lz), tiny)
            rest = _fifth_power(one - min(cosine, one))
            for c in range(3):
                mirror = specular[i, c]
                values[i, c, k] = lobe * (mirror + (one - mirror) * rest)


@_inlined
def _log_cosine_slope(sine2: Any, cosine2: Any, half: Any) -> Any:
    """``log(cos) / sin^2`` without loss at the pole, where it is -1/2."""
    if sine2 < 1e-7:
        return -half * (half * sine2 + half + half)
    if sine2 < half:
        return half * np.log1p(-sine2) / sine2
    return half * np.log(cosine2) / sine2
