r"""Indirect light: what a texel shows where no light reaches it directly.

Traced shadows are black, those of photographs are not: other parts of the object shine into
them. For texel t and light l in whose shadow it lies, a field shows, in the transformed domain,

.. math:: u_{tl} = Y(l)^\top \Big( m + \sum_k c_{tk} B_k \Big),

Y the real spherical harmonics of the light's direction in the world, m and B coefficients of
each channel. `field.indirect_fit` finds them.

Part of that light is known without a fit: what lit parts of the surface send to the texel,
traced through the field itself (`render.bounced_light`). Where the capture shows it, harmonics
hold what it leaves, and

.. math:: u_{tl} = g\, T(b_{tl}) + Y(l)^\top \Big( m + \sum_k c_{tk} B_k \Big),

b the bounced light of texel t under light l as a sample, T the transform of the domain and g a
gain of each channel, 0 where the capture shows no such light.

Nothing is extrapolated: towards lights from where none of the capture's came, a texel shows
what it would under the nearest of those (`field.observed_sphere`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import isqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.observed_sphere import bounded_table, interpolate
from reflfield.sphere.harmonics import real_harmonics
from reflfield.util.validation import check_shape

Array = NDArray[np.float64]
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class IndirectLight:
    """Indirect light of all texels, in the transformed domain.

    Parameters
    ----------
    functions : (K + 1, n_harmonics, 3) float32
        Mean, then basis, as coefficients of `sphere.harmonics.real_harmonics` of the
        light's direction in the world. Root mean square of a basis function over the sphere
        and the channels: 1.
    coefficients : (n_texels, K) float32
    observed : (n, 3) float64, optional
        Directions of the lights that the functions are known for; beyond them the nearest
        ones count. By default the functions are taken as they are everywhere.
    gain : (3,) float32, optional
        Of bounced light, in the transformed domain. By default none is traced.
    """

    functions: Floats
    coefficients: Floats
    observed: Array | None = None
    gain: Floats = field(default_factory=lambda: np.zeros(3, np.float32))

    def __post_init__(self) -> None:
        check_shape("functions", self.functions, (None, None, 3))
        check_shape("coefficients", self.coefficients, (None, len(self.functions) - 1))
        check_shape("gain", self.gain, (3,))
        if self.observed is not None:
            check_shape("observed", self.observed, (None, 3))

    @property
    def is_black(self) -> bool:
        """Whether there is none anywhere."""
        return not (np.any(self.functions) or self.is_traced)

    @property
    def is_traced(self) -> bool:
        """Whether bounced light is a part of it."""
        return bool(np.any(self.gain))

    @property
    def band_limit(self) -> int:
        """Of the harmonics."""
        return isqrt(self.functions.shape[1])

    def _weights(self, texels: NDArray[np.integer]) -> Floats:
        """(n, K + 1): 1, then the coefficients."""
        ones = np.ones((len(texels), 1), np.float32)
        return np.concatenate([ones, self.coefficients[texels]], axis=1)

    def _harmonic_sums(self, directions: NDArray[Any]) -> Floats:
        """Functions as they were fitted, (n, (K + 1) * 3)."""
        harmonics = real_harmonics(directions, self.band_limit).astype(np.float32)
        # (n_harmonics, K + 1, 3): one product for all functions and channels.
        by_harmonic = np.moveaxis(self.functions, 1, 0).reshape(self.functions.shape[1], -1)
        return np.asarray(harmonics @ by_harmonic)

    @cached_property
    def _table(self) -> Floats:
        """Functions over the sphere, bounded by the observed directions."""
        observed = np.zeros((0, 3)) if self.observed is None else self.observed
        return bounded_table(self._harmonic_sums, observed)

    def at(self, directions: NDArray[Any]) -> Floats:
        """Functions under lights from some directions, (n, K + 1, 3) float32.

        Parameters
        ----------
        directions : (n, 3) float
            Unit vectors to the light, world frame.
        """
        if self.observed is None or not len(self.observed):
            values = self._harmonic_sums(directions)
        else:
            values = interpolate(self._table, directions)
        return values.reshape(len(directions), len(self.functions), 3)

    def towards(
        self,
        texels: NDArray[np.integer],
        directions: NDArray[Any],
        power: int,
        bounced: Floats | None = None,
    ) -> Floats:
        """Indirect light of texels, each under a light of its own.

        Parameters
        ----------
        texels : (n,) int
        directions : (n, 3) float
            Unit vectors to the light, world frame.
        power : int
            Of the inverse transform, from the domain to samples.
        bounced : (n, 3) float32, optional
            Bounced light as samples, not negative; none by default.

        Returns
        -------
        (n, 3) float32
            1/sr, never negative.
        """
        values = np.einsum("nk,nkc->nc", self._weights(texels), self.at(directions))
        return self._samples(values, power, bounced)

    def under(
        self,
        texels: NDArray[np.integer],
        directions: NDArray[Any],
        power: int,
        bounced: Floats | None = None,
    ) -> Floats:
        """Indirect light of texels under lights that all share, (n, m, 3); see `towards`."""
        at_lights = np.moveaxis(self.at(directions), 1, 0).reshape(len(self.functions), -1)
        values = self._weights(texels) @ at_lights
        return self._samples(values.reshape(len(texels), len(directions), 3), power, bounced)

    def _samples(self, values: Floats, power: int, bounced: Floats | None) -> Floats:
        """Samples from what harmonics show and bounced light."""
        if bounced is not None:
            values = values + self.gain * bounced ** np.float32(1 / power)
        return np.asarray(np.maximum(values, 0) ** power)


def no_indirect_light(n_texels: int) -> IndirectLight:
    """Black shadows.

    Examples
    --------
    >>> no_indirect_light(5).is_black
    True
    """
    return IndirectLight(np.zeros((1, 1, 3), np.float32), np.zeros((n_texels, 0), np.float32))
