r"""Positions of lights, fitted to what points of a surface look like under each of them.

The model is matt: a point :math:`x_i` with the normal times albedo :math:`b_i` has under light
:math:`l` at :math:`p_l` the luminance

.. math:: Y_{li} = g_l I_l \frac{\max(b_i \cdot (p_l - x_i), 0)}{\|p_l - x_i\|^3}.

Normals with albedo, from all lights, and positions with gains :math:`g_l`, light by light, are
fitted in turn; samples off the model (highlights, shadows) weigh less. This is near-light
photometric stereo with its lights refined. [1]_ Two things luminance does not tell, and stay as
described: distances, which gains make up for, and what one linear map of the positions of all
lights does, the inverse of which normals with albedo make up for.

References
----------
.. [1] T. Papadhimitri and P. Favaro, "Uncalibrated near-light photometric stereo", BMVC 2014.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from reflfield.checking.shading_fit import nanmedian

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Rounds of fits in turn, and times that samples are weighed in each.
ROUNDS, WEIGHINGS = 15, 2
# Standard deviations of samples about the model, as shares of the expected luminance and of a
# point's mean, that are assumed at least and at most; and what a normal's own direction counts
# for, in samples.
LEAST_SPREAD, LARGEST_SPREAD, PRIOR_SAMPLES = 0.003, 0.1, 0.003
# Expected errors: of positions, across, as a share of the distance; of logarithms of gains.
EXPECTED_SHIFT, EXPECTED_GAIN = 0.006, 0.1
FEWEST_SAMPLES = 60


@dataclass(frozen=True, eq=False)
class LitPoints:
    """Points of a surface, and what they look like under each light.

    Parameters
    ----------
    points, normals : (n, 3) float64
    luminance : (n_lights, n) float64
        NaN where a point is not lit well, not seen, or saturated.
    strength : (n_lights,) float64
        Luminance of the radiant intensities.
    """

    points: Array
    normals: Array
    luminance: Array
    strength: Array

    def some(self, chosen: Bools, lights: Sequence[int] | None = None) -> LitPoints:
        """Some of the points, under all or some lights."""
        rows = list(range(len(self.luminance)) if lights is None else lights)
        return LitPoints(
            self.points[chosen],
            self.normals[chosen],
            self.luminance[rows][:, chosen],
            self.strength[rows],
        )

    def factors(self, positions: Array) -> Array:
        """Vectors (n_lights, n, 3) whose product with normal times albedo is the luminance."""
        towards = positions[:, None] - self.points
        cubed = np.linalg.norm(towards, axis=2, keepdims=True) ** 3
        return self.strength[:, None, None] * towards / cubed

    def surfaces(self, positions: Array) -> Array:
        """Normals times albedo (n, 3) that fit best with lights at some positions."""
        factors, known = self.factors(positions), np.isfinite(self.luminance)
        values = np.where(known, self.luminance, 0.0)
        weights = known.astype(np.float64)
        shaded = np.maximum(np.einsum("lnc,nc->ln", factors, self.normals), 1e-300)
        albedo = _weighted_mean(values / shaded, weights * shaded * shaded)
        surfaces: Array = albedo[:, None] * self.normals
        for _ in range(WEIGHINGS):
            square = np.einsum("ln,lnc,lnd->ncd", weights, factors, factors)
            ridge = PRIOR_SAMPLES / 3 * np.einsum("ncc->n", square) / np.maximum(
                weights.sum(axis=0), 1e-9
            )  # fmt: skip
            square += (ridge + 1e-300)[:, None, None] * np.eye(3)
            right = np.einsum("ln,lnc,ln->nc", weights, factors, values)
            right += ridge[:, None] * albedo[:, None] * self.normals
            surfaces = np.linalg.solve(square, right[..., None])[..., 0]
            weights = known * _weights(self.relative(factors, surfaces), known)
        return surfaces

    def relative(self, factors: Array, surfaces: Array) -> Array:
        """Differences (n_lights, n) from the model, in shares of what is expected."""
        expected = np.maximum(np.einsum("lnc,nc->ln", factors, surfaces), 0.0)
        known = np.isfinite(self.luminance)
        usual = _weighted_mean(expected, known.astype(np.float64))
        scale = np.maximum(0.5 * (expected + usual), 1e-300)
        return np.where(known, (np.nan_to_num(self.luminance) - expected) / scale, 0.0)

    def brightened(self, gains: Array) -> LitPoints:
        """The same under lights that are brighter than described."""
        return replace(self, strength=self.strength * gains)

    def misfit(self, positions: Array) -> float:
        """Median difference of the samples from the model, in shares of the luminance.

        With the gains of the lights that fit best.
        """
        gains = np.ones(len(positions))
        for _ in range(ROUNDS):
            lit = self.brightened(gains)
            factors, surfaces = lit.factors(positions), lit.surfaces(positions)
            relative = lit.relative(factors, surfaces)
            expected = np.maximum(np.einsum("lnc,nc->ln", factors, surfaces), 1e-300)
            ratios = nanmedian(self.luminance / expected, axis=1)
            gains *= np.where(np.isfinite(ratios), ratios, 1.0)
            gains /= np.median(gains)
        return float(np.median(np.abs(relative[np.isfinite(self.luminance)])))


def _spread(relative: Array) -> float:
    """Robust standard deviation of the samples about the model."""
    return float(np.clip(1.4826 * np.median(np.abs(relative)), LEAST_SPREAD, LARGEST_SPREAD))


def _weights(relative: Array, known: Bools) -> Array:
    weights: Array = 1.0 / (1.0 + np.square(relative / (2 * _spread(relative[known]))))
    return weights


def _weighted_mean(values: Array, weights: Array) -> Array:
    mean: Array = (weights * values).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-300)
    return mean


def adjust_lights(lit: LitPoints, positions: Array) -> tuple[Array, Array]:
    """Fit the positions of lights.

    Parameters
    ----------
    lit : LitPoints
    positions : (n_lights, 3) float64
        As described. A light of which too few samples are known stays there.

    Returns
    -------
    positions : (n_lights, 3) float64
    gains : (n_lights,) float64
        By which lights are brighter than described; their median is 1.
    """
    across, gains = np.zeros((len(positions), 2)), np.ones(len(positions))
    towards = positions - lit.points.mean(axis=0)
    axes = _axes_across(towards)
    told = _without_linear_maps(towards, axes)
    for _ in range(ROUNDS):
        moved = positions + np.einsum("la,lac->lc", across, axes)
        brightened = lit.brightened(gains)
        surfaces = brightened.surfaces(moved)
        relative = brightened.relative(brightened.factors(moved), surfaces)
        spread = _spread(relative[np.isfinite(lit.luminance)])
        for light, luminance in enumerate(lit.luminance):
            known = np.isfinite(luminance)
            if known.sum() >= FEWEST_SAMPLES:
                start = np.append(across[light], np.log(gains[light]) / EXPECTED_GAIN)
                fitted = _fit(
                    lit.some(known, [light]), surfaces[known], positions[light],
                    axes[light], spread, start,
                )  # fmt: skip
                across[light], gains[light] = fitted[:2], np.exp(EXPECTED_GAIN * fitted[2])
        gains /= np.median(gains)
        across = (told @ across.ravel()).reshape(-1, 2)
    return positions + np.einsum("la,lac->lc", across, axes), gains


def _axes_across(towards: Array) -> Array:
    """Two vectors (n, 2, 3) across each of some vectors, as long as expected shifts."""
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    least = np.eye(3)[np.abs(towards).argmin(axis=1)]
    first = np.cross(towards / length, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(towards / length, first)
    return EXPECTED_SHIFT * length[:, None] * np.stack([first, second], axis=1)


def _without_linear_maps(towards: Array, axes: Array) -> Array:
    """Projection (2 n, 2 n) of shifts that removes what one linear map of all lights does.

    Of such a map, and its inverse of normals with albedo, luminance tells nothing.
    """
    unit = axes / np.linalg.norm(axes, axis=2, keepdims=True) ** 2
    maps = np.einsum("lac,ld->lacd", unit, towards).reshape(2 * len(towards), 9)
    left, size, _ = np.linalg.svd(maps, full_matrices=False)
    left = left[:, size > 1e-6 * size[0]]
    removed: Array = np.eye(len(left)) - left @ left.T
    return removed


def _fit(
    of_light: LitPoints,
    surfaces: Array,
    position: Array,
    axes: Array,
    spread: float,
    start: Array,
) -> Array:
    """Shifts and gain of one light, in expected errors, (3,)."""
    values = of_light.luminance[0]
    here = np.maximum((of_light.factors(position[None])[0] * surfaces).sum(axis=1), 0.0)
    scale = np.maximum(0.5 * (here + here.mean()), 1e-300) * spread

    def residuals(parameters: Array) -> Array:
        moved = position + parameters[:2] @ axes
        shaded = (of_light.factors(moved[None])[0] * surfaces).sum(axis=1)
        expected = np.exp(EXPECTED_GAIN * parameters[2]) * np.maximum(shaded, 0.0)
        return np.concatenate([(values - expected) / scale, parameters])

    solution: Array = least_squares(residuals, start, loss="cauchy", f_scale=2.0).x
    return solution
