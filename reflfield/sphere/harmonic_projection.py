r"""Scattered samples of one or two directions to harmonic coefficients.

Regularised least squares in the L2 norm of the sphere: samples of the upper hemisphere
weigh by the solid angle nearest to them, and the lower hemisphere is zero
(Müller, Sarlette and Klein, "Data-driven local coordinate systems for
image-based rendering", Eurographics 2006, section 4.1), as if it were sampled
densely:

.. math::

    (Y^\top W Y + G_{z<0} + \lambda S)\, a = Y^\top W s .
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError
from reflfield.sphere.coupling import BandLimits
from reflfield.sphere.harmonics import check_band_limit, real_harmonics
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.util.validation import check_shape, unit_directions

# Shrinks the highest degree by this share where samples determine it fully; enough to
# regularise what a sparse dome does not determine, too little to blur what it does.
SMOOTHING = 1e-3
# Of the way to the fit that unobserved samples go in each round of filling.
FILLING_SHARES = (2.0, 1.0)
# Side of the grid whose nodes share out the solid angle among the directions.
AREA_SIDE = 65


def safe_band_limit(n_directions: int) -> int:
    """Highest band limit that so many directions of the upper hemisphere support.

    Half of the ``L**2`` coefficients serve the lower hemisphere, which is
    known to be zero, so ``L**2 <= 2 * n_directions``. One direction supports L = 1:
    it does not vary.

    Examples
    --------
    >>> [safe_band_limit(n) for n in (1, 32, 81, 151)]
    [1, 8, 12, 16]
    """
    if n_directions <= 1:
        return 1
    return min(16, int(np.sqrt(2 * n_directions)))


def lower_gram(band_limit: int) -> NDArray[np.float64]:
    """Scalar products of all harmonics over the hemisphere z < 0, exactly.

    Examples
    --------
    >>> lower_gram(1).round(12)
    array([[0.5]])
    """
    nodes, weights = np.polynomial.legendre.leggauss(band_limit)
    n_azimuths = 2 * band_limit
    z = np.repeat(0.5 * (nodes - 1.0), n_azimuths)
    azimuth = np.tile(2 * np.pi * np.arange(n_azimuths) / n_azimuths, band_limit)
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    values = real_harmonics(directions, band_limit)
    area = np.repeat(0.5 * weights, n_azimuths) * (2 * np.pi / n_azimuths)
    return (values * area[:, None]).T @ values


def solid_angles(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of the upper hemisphere nearest to each direction; zero below the horizon.

    Parameters
    ----------
    directions : (n, 3) float64
        Unit vectors.

    Returns
    -------
    (n,) float64
        Sums to 2 pi if any direction lies above the horizon.

    Examples
    --------
    >>> solid_angles(np.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])).sum().round(12)
    np.float64(6.28318530718)
    """
    above = np.flatnonzero(directions[:, 2] > 0.0)
    shares = np.zeros(len(directions))
    if len(above):
        grid = HemisphereGrid(AREA_SIDE)
        nearest = np.argmax(grid.directions @ directions[above].T, axis=1)
        counts = np.bincount(nearest, weights=grid.solid_angles, minlength=len(above))
        # Directions that no node is nearest to (duplicates) still count a little.
        counts = np.maximum(counts, 1e-3 / len(above))
        shares[above] = counts * (2 * np.pi / counts.sum())
    return shares


@dataclass(frozen=True, eq=False)
class DirectionOperator:
    """Analysis and synthesis of functions of one direction.

    Parameters
    ----------
    analysis : (band_limit**2, n) float64
        Samples to coefficients.
    synthesis : (n, band_limit**2) float64
        Coefficients to samples; zero rows below the horizon.
    """

    analysis: NDArray[np.floating]
    synthesis: NDArray[np.floating]


def direction_operator(
    name: str, directions: ArrayLike, band_limit: int, smoothing: float = SMOOTHING
) -> DirectionOperator:
    """Operator between samples at directions and coefficients.

    Parameters
    ----------
    name : str
        Argument name, quoted in messages.
    directions : (n, 3) array_like
        Unit vectors, z up. Samples below the horizon are not used.
    band_limit : int
        1 to 16; 1 stands for a direction that does not vary: the mean.
    smoothing : float
        Weight of the squared Laplacian, relative to its largest value.

    Returns
    -------
    DirectionOperator

    Raises
    ------
    ShapeError, InputError
        If the directions are malformed, or too few for the band limit.

    Examples
    --------
    >>> grid = HemisphereGrid(9)
    >>> operator = direction_operator("views", grid.directions, 4)
    >>> operator.analysis.shape
    (16, 81)
    """
    vectors = unit_directions(name, directions)
    check_band_limit("band_limit", band_limit)
    if band_limit == 1:
        constant = np.sqrt(4 * np.pi)
        ones = np.ones((1, len(vectors)))
        return DirectionOperator(ones * (constant / len(vectors)), ones.T / constant)
    safe = safe_band_limit(int(np.sum(vectors[:, 2] > 0.0)))
    if band_limit > safe:
        raise InputError(
            f"band_limit: expected at most {safe} for the {len(vectors)} {name} "
            f"({int(np.sum(vectors[:, 2] > 0))} above the horizon), received {band_limit}; "
            f"a band limit of {safe} is safe"
        )
    synthesis = real_harmonics(vectors, band_limit)
    weighted = synthesis * solid_angles(vectors)[:, None]
    degree = np.floor(np.sqrt(np.arange(band_limit**2)))
    roughness = np.diag((degree * (degree + 1) / (band_limit * (band_limit - 1))) ** 2)
    gram = np.asarray(
        weighted.T @ synthesis + lower_gram(band_limit) + smoothing * roughness, np.float64
    )
    analysis = np.linalg.solve(gram, weighted.T)
    above = (vectors[:, 2:] > 0.0).astype(np.float64)
    return DirectionOperator(analysis, synthesis * above)


@dataclass(frozen=True, eq=False)
class Projector:
    """Samples on views x lights to coefficients of both directions, and back.

    Parameters
    ----------
    views, lights : (k, 3) array_like
        Unit vectors of the common directions, z up.
    band_limits : (int, int)
        Of view and light. 1: that direction does not vary.
    smoothing : float
        See `direction_operator`.

    Raises
    ------
    ShapeError, InputError
        As `direction_operator`.

    Notes
    -----
    Complete texels cost two matrix products with operators that are built
    once. Where samples are missing they are first predicted (see `fill`), so the
    same operators serve every pattern of gaps.

    Examples
    --------
    >>> grid = HemisphereGrid(9)
    >>> projector = Projector(grid.directions, grid.directions, (4, 4))
    >>> projector.project(np.ones((2, 81, 81), np.float32)).shape
    (2, 16, 16)
    """

    views: NDArray[np.float64]
    lights: NDArray[np.float64]
    band_limits: BandLimits
    smoothing: float = SMOOTHING

    def __post_init__(self) -> None:
        pairs = (("view", self.views), ("light", self.lights))
        for (side, directions), limit in zip(pairs, self.band_limits, strict=True):
            operator = direction_operator(side + "s", directions, limit, self.smoothing)
            object.__setattr__(self, "_" + side, operator)

    def _operators(
        self, dtype: np.dtype[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        view: DirectionOperator = self._view  # type: ignore[attr-defined]
        light: DirectionOperator = self._light  # type: ignore[attr-defined]
        return view.analysis.astype(dtype), light.analysis.astype(dtype)

    def project(self, samples: NDArray[np.floating]) -> NDArray[np.floating]:
        """Coefficients of complete samples.

        Parameters
        ----------
        samples : (n, n_views, n_lights) float
            Finite.

        Returns
        -------
        (n, L_view**2, L_light**2) float
            In the dtype of the samples.
        """
        check_shape("samples", samples, (None, len(self.views), len(self.lights)))
        view, light = self._operators(samples.dtype)
        n, n_views, n_lights = samples.shape
        half = samples.reshape(n * n_views, n_lights) @ light.T
        return np.matmul(view, half.reshape(n, n_views, -1))

    def synthesize(self, coefficients: NDArray[np.floating]) -> NDArray[np.floating]:
        """Samples of coefficients, (n, n_views, n_lights); zero below the horizon."""
        view: DirectionOperator = self._view  # type: ignore[attr-defined]
        light: DirectionOperator = self._light  # type: ignore[attr-defined]
        left = view.synthesis.astype(coefficients.dtype)
        right = light.synthesis.astype(coefficients.dtype)
        return np.matmul(np.matmul(left, coefficients), right.T)

    def round_trips(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coefficients of the samples of each coefficient: (L**2, L**2) of view and light.

        Not the identity: samples below the horizon count as zero.
        """
        view: DirectionOperator = self._view  # type: ignore[attr-defined]
        light: DirectionOperator = self._light  # type: ignore[attr-defined]
        return view.analysis @ view.synthesis, light.analysis @ light.synthesis

    def fill(
        self,
        samples: NDArray[np.floating],
        prior: NDArray[np.floating],
    ) -> NDArray[np.floating]:
        r"""Samples with the unobserved ones predicted.

        First guess: the prior, scaled to the texel's observed samples. Rounds then move the
        unobserved samples m towards the band-limited fit P of all; one that goes the share
        :math:`\omega` of the way leaves :math:`1 - \omega\lambda` of their error, where
        :math:`\lambda` are the eigenvalues of :math:`1 - P_{mm}`, between 0 and 1. Twice the
        way and then once leaves an eighth at most for :math:`\lambda \ge 1/2`, about what
        half of the samples missing at random give; once each time leaves a quarter.

        Parameters
        ----------
        samples : (n, n_views, n_lights) float
            Not finite where unobserved.
        prior : (n_views, n_lights) float
            Expected samples up to scale, finite.

        Returns
        -------
        (n, n_views, n_lights) float
            Finite; the input itself if nothing is missing.
        """
        check_shape("samples", samples, (None, len(self.views), len(self.lights)))
        incomplete = np.flatnonzero(~np.isfinite(samples).all(axis=(1, 2)))
        if len(incomplete) == 0:
            return samples
        part = samples[incomplete]
        observed = np.isfinite(part)
        part = np.where(observed, part, 0)
        power = (observed * (prior**2)[None]).sum(axis=(1, 2))
        scale = (part * prior).sum(axis=(1, 2)) / np.where(power > 0, power, 1)
        part = np.where(observed, part, scale[:, None, None] * prior).astype(samples.dtype)
        for share in FILLING_SHARES:
            fit = self.synthesize(self.project(part))
            part = np.where(observed, part, part + part.dtype.type(share) * (fit - part))
        filled = samples.copy()
        filled[incomplete] = part
        return filled
