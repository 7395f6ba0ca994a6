r"""Whether photographs under neighbouring lights look alike, as they do of any material.

Within a view, the photograph under a light resembles those under the lights beside it more
than others, once each pixel is divided by its mean over the lights. A photograph that does not,
but resembles those around another light, belongs to that one. This needs no surface and no
model of the material; it does not see errors that all lights share, such as a mirrored axis.

For unit vectors :math:`z_l` of the photographs of a view, all comparisons follow from their
Gram matrix :math:`C_{kl} = z_k \cdot z_l`: the weighted mean :math:`\sum_k w_k z_k` of the
neighbours of the place of light m correlates with photograph l by
:math:`\sum_k w_k C_{kl} / \sqrt{w^\top C w}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Lights beside a place whose photographs predict what is seen from there, and how many lights
# a comparison needs.
NEIGHBOURS, FEWEST_LIGHTS = 4, 7
# Pixels of a view that are compared.
MOST_PIXELS = 2000
# Angle that softens the weights of near neighbours, radians.
_SOFTENING = np.radians(5.0)


@dataclass(frozen=True, eq=False)
class LightFit:
    """How well photographs under each light fit to the places of all lights.

    Parameters
    ----------
    fit : (n_lights, n_lights) float64
        Correlation of the photographs of light l (row) with what is predicted at the place of
        light m (column); NaN where nothing is known.
    """

    fit: Array

    @property
    def own(self) -> Array:
        """Fit of each light to its own place."""
        return np.diag(self.fit)

    def best_other(self, light: int) -> tuple[int, float]:
        """The other place that fits best, and how well."""
        others = self.fit[light].copy()
        others[light] = np.nan
        if np.isnan(others).all():
            return light, float("-inf")
        best = int(np.nanargmax(others))
        return best, float(others[best])


def gram_matrix(images: Mapping[int, Float32], n_lights: int) -> Array:
    """Correlations (n_lights, n_lights) of a view's photographs; NaN where there are none.

    Parameters
    ----------
    images : dict of int to (n,) float32
        By light: luminance of the pixels of the object.
    n_lights : int
    """
    gram = np.full((n_lights, n_lights), np.nan)
    lights = sorted(images)
    if len(lights) < FEWEST_LIGHTS:
        return gram
    pixels = np.sqrt(np.maximum(np.array([images[light] for light in lights]), 0))
    pixels = pixels[:, :: -(-pixels.shape[1] // MOST_PIXELS)]
    exposure = pixels.mean(axis=1, keepdims=True)
    typical = np.median(pixels / np.maximum(exposure, 1e-12), axis=0)
    used = typical > 0.1 * np.median(typical)
    if used.sum() < 8:
        return gram
    relative = pixels[:, used] / typical[used]
    relative -= relative.mean(axis=1, keepdims=True)
    length = np.linalg.norm(relative, axis=1)
    # A photograph without any structure says nothing.
    plain = ~(length > 1e-6 * max(float(length.max()), 1e-300))
    unit = relative / np.where(plain, 1, length)[:, None]
    values = unit @ unit.T
    values[plain] = values[:, plain] = np.nan
    gram[np.ix_(lights, lights)] = values
    return gram


def light_fit(
    gram: Array, directions: Array, doubtful: frozenset[int] = frozenset()
) -> LightFit:
    """Fit of the photographs of every light to the places of all.

    Parameters
    ----------
    gram : (n_lights, n_lights) float64
        Of `gram_matrix`, or a mean of several.
    directions : (n_lights, 3) float64
        Unit directions to the lights from the object; NaN where unknown.
    doubtful : frozenset of int
        Lights whose photographs predict nothing.
    """
    n = len(gram)
    fit = np.full((n, n), np.nan)
    known = np.isfinite(np.diag(gram)) & np.isfinite(directions).all(axis=1)
    usable = known & ~np.isin(np.arange(n), list(doubtful))
    angle = np.arccos(np.clip(directions @ directions.T, -1, 1))
    for place in np.flatnonzero(np.isfinite(directions).all(axis=1)):
        near = [int(i) for i in np.argsort(angle[place], kind="stable") if usable[i]]
        near = [i for i in near if i != place][: NEIGHBOURS + 1]
        for light in np.flatnonzero(known):
            some = [i for i in near if i != light][:NEIGHBOURS]
            fit[light, place] = _correlation(gram, int(light), some, angle[place])
    return LightFit(fit)


def _correlation(gram: Array, light: int, some: list[int], angle: Array) -> float:
    weights = 1.0 / (angle[some] + _SOFTENING)
    inner = gram[np.ix_(some, some)]
    known = np.isfinite(gram[light, some]) & np.isfinite(inner).all(axis=1)
    if known.sum() < 2:
        return float("nan")
    weights = np.where(known, weights, 0)
    norm = float(weights @ np.nan_to_num(inner) @ weights)
    return float(weights @ np.nan_to_num(gram[light, some]) / np.sqrt(max(norm, 1e-12)))
