"""What every material offers to the renderer and to the truth.

Directions are unit vectors pointing away from the surface, in the shading frame
(x tangent, y binormal, z normal). BRDF values are in 1/sr and leave out the
cosine of the light.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

# Both directions on the horizon make the denominators of the microfacet models
# vanish; below this cosine product the surface is seen edge on and unlit.
SMALLEST_DENOMINATOR = 1e-30


class Material(ABC):
    """A surface that reflects; the base of all materials.

    Subclasses implement `_reflect` for pairs of directions above the horizon.
    """

    def evaluate(self, views: Array, lights: Array, uv: Array) -> Array:
        """BRDF value, without the cosine of the light.

        Parameters
        ----------
        views, lights : (n, 3) float64
            Unit directions to the viewer and to the light, shading frame.
        uv : (n, 2) float64
            Texture coordinates.

        Returns
        -------
        (n, 3) float64
            1/sr, linear RGB; 0 where either direction is not above the horizon.
        """
        above = (views[:, 2] > 0.0) & (lights[:, 2] > 0.0)
        if above.all():
            return self._reflect(views, lights, uv)
        values = np.zeros((len(views), 3))
        values[above] = self._reflect(views[above], lights[above], uv[above])
        return values

    @abstractmethod
    def _reflect(self, views: Array, lights: Array, uv: Array) -> Array:
        """BRDF of directions that are all above the horizon, (n, 3)."""

    def evaluate_lights(
        self, views: Floats, lights: Floats, lit: NDArray[np.bool_], uv: Array
    ) -> Floats:
        """BRDF values of points that each have the same number of lights.

        The same as `evaluate`, in an order and a precision made for speed.

        Parameters
        ----------
        views : (n, 3) float32 or float64
            Unit directions to the viewer, shading frame.
        lights : (n, 3, n_lights) like `views`
            Unit directions to the lights, shading frame.
        lit : (n, n_lights) bool
            Pairs that are wanted, all with both directions above the horizon.
        uv : (n, 2) float64
            Texture coordinates.

        Returns
        -------
        (n, 3, n_lights) like `views`
            1/sr, linear RGB; finite or not, but of no meaning where not `lit`.

        Notes
        -----
        This general form gathers the wanted pairs; materials with a compiled
        kernel override it.
        """
        point, light = np.nonzero(lit)
        values = np.zeros_like(lights)
        # float64 whatever comes in: the measured tables are searched in it.
        pairs = self._reflect(
            views[point].astype(np.float64),
            lights[point, :, light].astype(np.float64),
            uv[point],
        )
        values[point, :, light] = pairs
        return values

    def lobe(self, uv: Array) -> Array:
        """Width of the highlight, to draw directions from.

        Parameters
        ----------
        uv : (n, 2) float64
            Texture coordinates.

        Returns
        -------
        (n, 2) float64
            Roughness along tangent and binormal of the GGX distribution that is most
            like the highlight; 0 where there is none.
        """
        return np.zeros((len(uv), 2))

    @property
    def precision(self) -> type[np.floating[Any]]:
        """Type in which `evaluate_lights` keeps about five digits."""
        return np.float32

    def frame_change(self, uv: Array) -> Array:
        """Rotation into the shading frame, ``shading_from_surface``.

        Parameters
        ----------
        uv : (n, 2) float64
            Texture coordinates.

        Returns
        -------
        (n, 3, 3) float64
            Rows are the shading tangent, binormal and normal in the surface
            frame (tangent along dP/du, smooth normal); the identity unless the
            material turns or bumps its frame.
        """
        return np.broadcast_to(np.eye(3), (len(uv), 3, 3))

    def label(self, uv: Array) -> NDArray[np.int16]:
        """Index of the material at each point, (n,) int16; 0 unless mixed."""
        return np.zeros(len(uv), np.int16)

    @property
    def uses_uv(self) -> bool:
        """True if the value or the frame depends on texture coordinates."""
        return False


def half_vectors(views: Array, lights: Array) -> tuple[Array, Array]:
    """Half vectors and their cosine with either direction.

    Parameters
    ----------
    views, lights : (n, 3) float64
        Unit directions above the horizon.

    Returns
    -------
    halves : (n, 3) float64
        ``(v + l) / |v + l|``.
    cosines : (n, 1) float64
        ``h . v = h . l = |v + l| / 2``, which rounding cannot make negative.

    Examples
    --------
    >>> half_vectors(np.array([[0.6, 0, 0.8]]), np.array([[-0.6, 0, 0.8]]))
    (array([[0., 0., 1.]]), array([[0.8]]))
    """
    total = views + lights
    length = np.linalg.norm(total, axis=1, keepdims=True)
    length = np.maximum(length, SMALLEST_DENOMINATOR)
    return total / length, 0.5 * length


def schlick(reflectance: Array, cosine: Array) -> Array:
    """Schlick's Fresnel term, F = r + (1 - r) (1 - cos)^5.

    Parameters
    ----------
    reflectance : (n, 3) float64
        Reflectance at normal incidence.
    cosine : (n, 1) float64
        Cosine between half vector and direction.

    Returns
    -------
    (n, 3) float64

    References
    ----------
    C. Schlick, "An inexpensive BRDF model for physically-based rendering", 1994.

    Examples
    --------
    >>> schlick(np.array([[0.04]]), np.array([[0.5]])).round(3)
    array([[0.07]])
    """
    return reflectance + (1.0 - reflectance) * _fifth_power(1.0 - np.minimum(cosine, 1.0))


def coupled_diffuse(albedo: Array, specular: Array, views: Array, lights: Array) -> Array:
    r"""Diffuse term that takes what a Schlick coat leaves over.

    :math:`\frac{28\,\rho_d}{23\pi}(1-\rho_s)(1-(1-\frac{n\cdot l}{2})^5)
    (1-(1-\frac{n\cdot v}{2})^5)`

    Parameters
    ----------
    albedo, specular : (n, 3) float64
        Diffuse albedo and specular reflectance at normal incidence.
    views, lights : (n, 3) float64
        Unit directions above the horizon.

    Returns
    -------
    (n, 3) float64
        1/sr.

    References
    ----------
    M. Ashikhmin and P. Shirley, "An anisotropic Phong BRDF model", Journal of
    Graphics Tools 5(2), 2000.

    Examples
    --------
    Both along the normal: 28 / (23 pi) (31/32)^2.

    >>> up = np.array([[0.0, 0.0, 1.0]])
    >>> coupled_diffuse(np.ones((1, 1)), np.zeros((1, 1)), up, up).round(4)
    array([[0.3637]])
    """
    view_part = 1.0 - _fifth_power(1.0 - 0.5 * views[:, 2:])
    light_part = 1.0 - _fifth_power(1.0 - 0.5 * lights[:, 2:])
    return 28.0 / (23.0 * np.pi) * albedo * (1.0 - specular) * view_part * light_part


def _fifth_power(x: Array) -> Array:
    """``x ** 5`` by products, an order of magnitude faster than the general power."""
    squared = x * x
    return squared * squared * x
