r"""Fit of the indirect light to the samples in traced shadows.

For each texel t and light l in whose shadow it lies, the samples of all views are averaged in
the transformed domain and modelled as

.. math:: u_{tl} = Y(l)^\top \Big( m + \sum_k c_{tk} B_k \Big) + \text{noise}

(see `field.indirect_light`). Samples of a texel are scattered: it lies in the shadow of some
lights only. Texels are therefore taken as draws of one Gaussian over coefficients, whose mean
and covariance follow by expectation maximisation from what each has [1]_; B are the leading
axes of the covariance, c the posterior means along them. No texel is made brighter than it
was seen under any light in whose shadow it lay.

References
----------
.. [1] A. Dempster, N. Laird, D. Rubin, "Maximum likelihood from incomplete data via the EM
   algorithm", Journal of the Royal Statistical Society B 39, 1977.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import isqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.observations.shade import Shade
from reflfield.sphere.harmonics import n_coefficients, real_harmonics
from reflfield.util.blas_threads import thread_pool

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Degrees 0 to 3 of the light's direction, fewer where there are fewer lights than twice their
# coefficients: indirect light is smooth.
BAND_LIMIT = 4
ROUNDS = 12
# Where expectation maximisation begins: variances of texels and of samples over the mean square
# of all samples.
FIRST_SPREAD, FIRST_NOISE = 0.25, 0.001
# Weight of l (l + 1) against the samples in the first mean.
SMOOTHNESS = 0.1
# Less than this share of that is nothing; keeps covariances regular.
LEAST_SHARE = 1e-9
TEXELS_AT_ONCE = 1024
# Times that what a texel shows is brought back to its brightest sample, and the standard
# deviation that this limit counts with, over the sample.
LIMIT_ROUNDS, LIMIT_SHARE = 2, 0.1


@dataclass(frozen=True, eq=False)
class IndirectModel:
    """Distribution of the texels' coefficients, over (harmonic, channel).

    Parameters
    ----------
    mean : (n_harmonics * 3,) float64
    axes : (n_harmonics * 3, K) float64
        Orthonormal.
    variances : (K,) float64
        Along the axes, descending.
    noise : float
        Variance of one view's sample.
    """

    mean: Array
    axes: Array
    variances: Array
    noise: float

    @property
    def band_limit(self) -> int:
        """Of the harmonics."""
        return isqrt(len(self.mean) // 3)

    @property
    def unit(self) -> float:
        """Coefficient along an axis whose root mean square over sphere and channels is 1."""
        return float(np.sqrt(3 * 4 * np.pi))

    def functions(self) -> Floats:
        """Mean and basis functions, (K + 1, n_harmonics, 3)."""
        rows = np.concatenate([self.mean[None], self.axes.T * self.unit])
        return rows.reshape(len(rows), -1, 3).astype(np.float32)

    def coefficients(self, shade: Shade) -> Floats:
        """Posterior means of some texels, (n, K); 0 without shade.

        A texel that would show more, under one of the lights without a sample, than in any
        of its samples is solved again with that light's sample at its brightest, which counts
        as known to `LIMIT_SHARE`: little where the samples determine the coefficients.
        """
        if not len(self.variances):
            return np.zeros((len(shade.values), 0), np.float32)
        seen = shade.weights > 0
        brightest = np.where(seen, shade.values, -np.inf).max(axis=1, keepdims=True)
        # The brightest sample has noise itself.
        limit = np.where(np.isfinite(brightest), brightest + self.noise**0.5, np.inf)
        largest = np.where(np.isfinite(limit), limit, 0.0).max(axis=2, keepdims=True)
        known_to = np.maximum((LIMIT_SHARE * largest) ** 2, self.noise)
        harmonics = real_harmonics(shade.lights.reshape(-1, 3), self.band_limit)
        harmonics = harmonics.reshape(*seen.shape[:2], n_coefficients(self.band_limit))
        means = self._posterior(Systems.of(shade, self.band_limit))
        for _ in range(LIMIT_ROUNDS):
            coefficients = self.mean + means @ self.axes.T
            shown = harmonics @ coefficients.reshape(len(means), -1, 3)
            beyond = ((shown > limit) & ~seen).any(axis=2, keepdims=True) & ~seen
            if not beyond.any():
                break
            values = np.where(seen, shade.values, np.minimum(shown, limit))
            weights = shade.weights + beyond * (self.noise / known_to)
            limited = Shade(values.astype(np.float32), weights, shade.lights)
            means = self._posterior(Systems.of(limited, self.band_limit))
        return (means / self.unit).astype(np.float32)

    def _posterior(self, system: Systems) -> Array:
        """Means along the axes, (n, K)."""
        precision = np.diag(1.0 / self.variances)
        gram = np.einsum("ak,nab,bl->nkl", self.axes, system.gram, self.axes, optimize=True)
        moments = (system.moments - system.gram @ self.mean) @ self.axes
        solved = np.linalg.solve(gram / self.noise + precision, moments[..., None] / self.noise)
        return np.asarray(solved[..., 0])


@dataclass(frozen=True, eq=False)
class Systems:
    """Normal equations of some texels' coefficients.

    Parameters
    ----------
    gram : (n, d, d) float64
        Sum over samples of weight times outer product.
    moments : (n, d) float64
    energy, count : (n,) float64
        Weighted sum of squares, and number, of the samples.
    """

    gram: Array
    moments: Array
    energy: Array
    count: Array

    @classmethod
    def of(cls, shade: Shade, band_limit: int) -> Systems:
        """Sums over the shade of each texel."""
        n, n_lights, _ = shade.weights.shape
        harmonics = real_harmonics(shade.lights.reshape(-1, 3), band_limit)
        # Not -1: where no texel is in shadow there is nothing to infer it from.
        harmonics = harmonics.reshape(n, n_lights, n_coefficients(band_limit))
        size = harmonics.shape[2]
        values = shade.values.astype(np.float64)
        gram, moments = np.zeros((n, size, 3, size, 3)), np.zeros((n, size, 3))
        for c in range(3):
            weighted = np.swapaxes(harmonics * shade.weights[..., c, None], 1, 2)
            gram[:, :, c, :, c] = weighted @ harmonics
            moments[..., c] = (weighted @ values[..., c, None])[..., 0]
        return cls(
            gram.reshape(n, 3 * size, 3 * size),
            moments.reshape(n, 3 * size),
            np.einsum("nlc,nlc->n", shade.weights, values**2),
            (shade.weights > 0).sum(axis=(1, 2)).astype(np.float64),
        )

    def divided_by(self, size: float) -> Systems:
        """The same for samples divided by `size`."""
        return Systems(self.gram, self.moments / size, self.energy / size**2, self.count)


def band_limit_for(n_lights: int) -> int:
    """Band limit of the indirect light of so many lights.

    Examples
    --------
    >>> [band_limit_for(n) for n in (1, 8, 30, 151)]
    [1, 2, 3, 4]
    """
    return int(np.clip(int((n_lights / 2) ** 0.5), 1, BAND_LIMIT))


def fit_to_shade(
    read: Callable[[Indices], Shade],
    texels: Indices,
    n_lights: int,
    n_components: int,
    *,
    most: int,
    seed: int = 0,
    workers: int = 1,
) -> tuple[IndirectModel, Floats]:
    """Distribution of indirect light over texels, and the coefficients of each.

    Parameters
    ----------
    read : callable
        Shade of some texels.
    texels : (n,) int
        Those that have any.
    n_lights, n_components : int
        As of `fit_indirect`.
    most : int
        Texels, drawn at random, that shape the distribution.
    seed : int
    workers : int
        Threads; the result does not depend on their number.

    Returns
    -------
    model : IndirectModel
    coefficients : (n, K) float32
    """
    rng = np.random.default_rng(seed)
    training = np.sort(rng.choice(texels, min(len(texels), most), replace=False))
    blocks = np.array_split(texels, max(1, len(texels) // TEXELS_AT_ONCE))
    with thread_pool(workers) as pool:
        model = fit_indirect(read, training, n_lights, n_components, pool)
        coefficients = list(pool.map(lambda block: model.coefficients(read(block)), blocks))
    return model, np.concatenate(coefficients)


def fit_indirect(
    read: Callable[[Indices], Shade],
    texels: Indices,
    n_lights: int,
    n_components: int,
    pool: ThreadPoolExecutor,
) -> IndirectModel:
    """Distribution of indirect light over texels.

    Parameters
    ----------
    read : callable
        Shade of some texels.
    texels : (n,) int
        Those that shape the model.
    n_lights : int
    n_components : int
        Basis functions at most.
    pool : ThreadPoolExecutor
        Threads; the model does not depend on their number.

    Returns
    -------
    IndirectModel

    Raises
    ------
    InputError
        If a number of components is negative.
    """
    if n_components < 0:
        raise InputError(f"n_components: expected >= 0, received {n_components}")
    band_limit = band_limit_for(n_lights)
    blocks = np.array_split(texels, max(1, -(-len(texels) // TEXELS_AT_ONCE)))
    systems = list(pool.map(lambda block: Systems.of(read(block), band_limit), blocks))
    size = _root_mean_square(systems, band_limit)
    if not size > 0:
        nothing = np.zeros(3 * n_coefficients(band_limit))
        return IndirectModel(nothing, np.zeros((len(nothing), 0)), np.zeros(0), 1.0)
    # In units of their own size, so that all constants are shares.
    systems = [system.divided_by(size) for system in systems]
    model = _initial(systems, band_limit)
    for _ in range(ROUNDS):
        model = _maximised(systems, model, pool)
    values, vectors = np.linalg.eigh(model.covariance)
    order = np.argsort(-values, kind="stable")[:n_components]
    kept = order[values[order] > LEAST_SHARE]
    squared = size**2
    return IndirectModel(
        model.mean * size, vectors[:, kept], values[kept] * squared, model.noise * squared
    )


def _root_mean_square(systems: list[Systems], band_limit: int) -> float:
    """Of all samples."""
    # The squares of the harmonics of a band limit sum to a constant everywhere.
    of_one = n_coefficients(band_limit) / (4 * np.pi)
    weight = sum(float(np.trace(s.gram.sum(axis=0))) for s in systems) / of_one
    energy = sum(float(s.energy.sum()) for s in systems)
    return float(np.sqrt(energy / weight)) if weight > 0 else 0.0


@dataclass(frozen=True, eq=False)
class _Gaussian:
    """What the texels' coefficients are drawn from, and the variance of a sample."""

    mean: Array
    covariance: Array
    noise: float


def _initial(systems: list[Systems], band_limit: int) -> _Gaussian:
    """Mean by regularised least squares over all texels, and a covariance of smooth light."""
    degree = np.repeat(np.floor(np.sqrt(np.arange(n_coefficients(band_limit)))), 3)
    smooth = degree * (degree + 1.0)
    gram = np.sum([s.gram.sum(axis=0) for s in systems], axis=0)
    moments = np.sum([s.moments.sum(axis=0) for s in systems], axis=0)
    total = np.trace(gram) / len(smooth)
    mean = np.linalg.solve(gram + SMOOTHNESS * total * np.diag(smooth + LEAST_SHARE), moments)
    return _Gaussian(mean, np.diag(FIRST_SPREAD * 4 * np.pi / (1.0 + smooth)), FIRST_NOISE)


def _maximised(
    systems: list[Systems], before: _Gaussian, pool: ThreadPoolExecutor
) -> _Gaussian:
    """One round of expectation maximisation."""
    parts = pool.map(lambda system: _expected(system, before), systems)
    total, outer, residual, count, n = (sum(sums) for sums in zip(*parts, strict=True))
    mean = np.asarray(total / n)
    covariance = outer / n - np.outer(mean, mean)
    covariance = 0.5 * (covariance + covariance.T) + LEAST_SHARE * np.eye(len(mean))
    return _Gaussian(mean, covariance, max(float(residual / count), LEAST_SHARE))


def _expected(system: Systems, before: _Gaussian) -> tuple[Any, ...]:
    """Sums over texels: coefficients, their products, squared residuals, samples, texels."""
    # Texels without samples are excluded.
    seen = system.count > 0
    gram, moments = system.gram[seen], system.moments[seen]
    # Without inverting the covariance, which may be nearly singular.
    ratio = np.eye(len(before.mean)) + before.covariance @ gram / before.noise
    spread = np.linalg.solve(ratio, np.broadcast_to(before.covariance, ratio.shape))
    left = (moments - gram @ before.mean) / before.noise
    posterior = before.mean + (spread @ left[..., None])[..., 0]
    # Expected squared residual: of the posterior mean, and of its uncertainty.
    fitted = ((gram @ posterior[..., None])[..., 0] - 2.0 * moments) * posterior
    return (
        posterior.sum(axis=0),
        posterior.T @ posterior + spread.sum(axis=0),
        float(system.energy[seen].sum() + fitted.sum() + np.sum(spread * gram)),
        float(system.count[seen].sum()),
        int(seen.sum()),
    )
