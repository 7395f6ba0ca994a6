r"""Materials that light enters and leaves somewhere else: the dipole of a dense medium."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from capture_sim.materials.base import Array, Floats, Material

# Albedos that the dipole is solved for; 1 would need a medium that absorbs nothing.
LARGEST_ALBEDO = 0.999


@dataclass(frozen=True)
class Dipole:
    r"""Light that enters a flat dense medium at one point and leaves around it.

    :math:`R(r) = \frac{\alpha'}{4\pi}\left[z_r(1+\sigma d_r)\frac{e^{-\sigma d_r}}{d_r^3}
    + z_v(1+\sigma d_v)\frac{e^{-\sigma d_v}}{d_v^3}\right]`, with the depth :math:`z_r` of
    the light in the medium and the height :math:`z_v` of its negative image,
    :math:`d_{r,v} = \sqrt{r^2 + z_{r,v}^2}` and :math:`\sigma` the reciprocal of `length`.

    Parameters
    ----------
    albedo : float
        Part of the light that enters which leaves again, in [0, 1).
    length : float
        Diffusion length, metres: how far light gets, > 0.
    refraction : float
        Refraction index of the medium, >= 1.

    References
    ----------
    H. W. Jensen, S. R. Marschner, M. Levoy and P. Hanrahan, "A practical model for
    subsurface light transport", SIGGRAPH 2001.

    Examples
    --------
    All that leaves is the albedo:

    >>> round(float(Dipole(0.8, 0.005, 1.3).within(np.array(1.0))), 6)
    0.8
    """

    albedo: float
    length: float
    refraction: float

    @cached_property
    def _ratio(self) -> float:
        """Height of the image over the depth of the light, 1 + 4 A / 3."""
        n = self.refraction
        inside = -1.440 / n**2 + 0.710 / n + 0.668 + 0.0636 * n
        return 1.0 + 4.0 / 3.0 * (1.0 + inside) / (1.0 - inside)

    @cached_property
    def _reduced_albedo(self) -> float:
        """Alpha' of the medium that has this albedo."""

        def leaving(alpha: float) -> float:
            depth = np.sqrt(3.0 * (1.0 - alpha))
            images = np.exp(-depth) + np.exp(-self._ratio * depth)
            return float(0.5 * alpha * images - min(self.albedo, LARGEST_ALBEDO))

        return float(brentq(leaving, 0.0, 1.0, xtol=1e-14))

    @cached_property
    def depths(self) -> tuple[float, float]:
        """Depth of the light and height of its image, metres."""
        depth = self.length * np.sqrt(3.0 * (1.0 - self._reduced_albedo))
        return float(depth), float(self._ratio * depth)

    def profile(self, distance: Array) -> Array:
        """R at distances from where the light enters, 1/m2."""
        total = np.zeros_like(distance)
        for depth in self.depths:
            far = np.sqrt(distance**2 + depth**2)
            total += depth * (1.0 + far / self.length) * np.exp(-far / self.length) / far**3
        return self._reduced_albedo / (4.0 * np.pi) * total

    def within(self, distance: Array) -> Array:
        """Part of the light that leaves within a distance; the integral of `profile`."""
        total = np.zeros_like(distance)
        for depth in self.depths:
            far = np.sqrt(distance**2 + depth**2)
            total += np.exp(-depth / self.length) - depth * np.exp(-far / self.length) / far
        return 0.5 * self._reduced_albedo * total


@dataclass(frozen=True)
class Translucent(Material):
    """A matte translucent body, the same all through, under a coat.

    Parameters
    ----------
    coat : Material
        What the surface reflects before light enters; its albedo and that of the
        body should not exceed 1 together.
    albedo : tuple of float
        Of the body, RGB in [0, 1).
    length : tuple of float
        Diffusion length in the body, RGB, metres.
    refraction : float
        Refraction index of the body, >= 1.

    Notes
    -----
    As a BRDF, without scattering below the surface, the body is Lambertian of the same
    albedo; `capture_sim.effects.subsurface` puts the difference in.
    """

    coat: Material
    albedo: tuple[float, ...]
    length: tuple[float, ...]
    refraction: float = 1.3

    @cached_property
    def dipoles(self) -> tuple[Dipole, ...]:
        """One for each channel."""
        pairs = zip(self.albedo, self.length, strict=True)
        return tuple(Dipole(albedo, length, self.refraction) for albedo, length in pairs)

    def _reflect(self, views: Array, lights: Array, uv: Array) -> Array:
        return self.coat.evaluate(views, lights, uv) + np.array(self.albedo) / np.pi

    def evaluate_lights(
        self, views: Floats, lights: Floats, lit: NDArray[np.bool_], uv: Array
    ) -> Floats:
        """Coat and body; see `Material.evaluate_lights`."""
        values = self.coat.evaluate_lights(views, lights, lit, uv)
        values += (np.array(self.albedo)[:, None] / np.pi).astype(values.dtype)
        return values

    def lobe(self, uv: Array) -> Array:
        """That of the coat."""
        return self.coat.lobe(uv)

    @property
    def precision(self) -> type[np.floating[Any]]:
        """That of the coat."""
        return self.coat.precision

    @property
    def uses_uv(self) -> bool:
        """True if the coat varies over the surface."""
        return self.coat.uses_uv
