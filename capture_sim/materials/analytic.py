"""Analytic BRDFs: Lambert, Ashikhmin-Shirley, anisotropic GGX.

Every parameter is a `Texture`, so that each may vary over the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.materials import kernels
from capture_sim.materials.base import (
    SMALLEST_DENOMINATOR,
    Array,
    Floats,
    Material,
    coupled_diffuse,
    half_vectors,
    schlick,
)
from capture_sim.materials.textures import Texture

# Half vectors in float32 are off by about 6e-8; a lobe of width alpha magnifies that by
# 4 / alpha: 1e-5 of its value at this roughness.
SHARP_ALPHA = 0.024

Flags = NDArray[np.bool_]


class _Parametric(Material):
    """A material whose fields are textures."""

    @property
    def uses_uv(self) -> bool:
        values = [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]
        return any(isinstance(value, Texture) and value.uses_uv for value in values)


@dataclass(frozen=True)
class Lambert(_Parametric):
    """Ideal diffuse surface, albedo / pi.

    Parameters
    ----------
    albedo : Texture
        Reflectance, linear RGB in [0, 1].

    Examples
    --------
    >>> from capture_sim.materials.textures import Constant
    >>> up = np.array([[0.0, 0.0, 1.0]])
    >>> Lambert(Constant((0.5, 0.5, 0.5))).evaluate(up, up, np.zeros((1, 2))).round(4)
    array([[0.1592, 0.1592, 0.1592]])
    """

    albedo: Texture

    def _reflect(self, views: Array, lights: Array, uv: Array) -> Array:
        return self.albedo.rgb(uv) / np.pi

    def evaluate_lights(self, views: Floats, lights: Floats, lit: Flags, uv: Array) -> Floats:
        """Albedo / pi for every light; see `Material.evaluate_lights`."""
        values = np.zeros_like(lights)
        kernels.lambert(_like(views, self.albedo.rgb(uv)), values)
        return values


@dataclass(frozen=True)
class AshikhminShirley(_Parametric):
    r"""Anisotropic Phong BRDF with an energy-conserving diffuse term.

    :math:`\frac{\sqrt{(n_u+1)(n_v+1)}}{8\pi}\,
    \frac{(n\cdot h)^{n_u\cos^2\phi_h+n_v\sin^2\phi_h}}
    {(h\cdot l)\max(n\cdot l, n\cdot v)}\,F(h\cdot l)` plus `coupled_diffuse`.

    Parameters
    ----------
    specular, diffuse : Texture
        Specular reflectance at normal incidence and diffuse albedo, RGB in [0, 1].
    exponent_u, exponent_v : Texture
        Phong exponents n_u along the tangent, n_v along the binormal, >= 0;
        the larger, the narrower the highlight in that direction.

    References
    ----------
    M. Ashikhmin and P. Shirley, "An anisotropic Phong BRDF model", Journal of
    Graphics Tools 5(2), 2000.

    Examples
    --------
    All directions along the normal, exponents 3: (3 + 1) / (8 pi) x 0.5.

    >>> from capture_sim.materials.textures import Constant
    >>> up = np.array([[0.0, 0.0, 1.0]])
    >>> three, half, zero = Constant((3.0,)), Constant((0.5,)), Constant((0.0,))
    >>> AshikhminShirley(half, zero, three, three).evaluate(up, up, np.zeros((1, 2))).round(4)
    array([[0.0796, 0.0796, 0.0796]])
    """

    specular: Texture
    diffuse: Texture
    exponent_u: Texture
    exponent_v: Texture

    def _reflect(self, views: Array, lights: Array, uv: Array) -> Array:
        specular = self.specular.rgb(uv)
        halves, cosine = half_vectors(views, lights)
        exponents = self.exponent_u.scalar(uv), self.exponent_v.scalar(uv)
        larger = np.maximum(views[:, 2:], lights[:, 2:])
        lobe = phong_density(halves, *exponents)
        lobe /= 4.0 * np.maximum(cosine * larger, SMALLEST_DENOMINATOR)
        shine = lobe * schlick(specular, cosine)
        return shine + coupled_diffuse(self.diffuse.rgb(uv), specular, views, lights)

    def evaluate_lights(self, views: Floats, lights: Floats, lit: Flags, uv: Array) -> Floats:
        """Compiled `evaluate`; see `Material.evaluate_lights`."""
        values = np.zeros_like(lights)
        specular = _like(views, self.specular.rgb(uv))
        exponents = np.hstack([self.exponent_u.scalar(uv), self.exponent_v.scalar(uv)])
        kernels.phong(views, lights, lit, specular, _like(views, exponents), values)
        albedo = _like(views, self.diffuse.rgb(uv))
        kernels.add_coupled_diffuse(views, lights, albedo, specular, values)
        return values

    def lobe(self, uv: Array) -> Array:
        """alpha^2 = 2 / (n + 2), which has the same curvature at the peak."""
        exponents = np.hstack([self.exponent_u.scalar(uv), self.exponent_v.scalar(uv)])
        return np.asarray(np.sqrt(2.0 / (exponents + 2.0)))

    @property
    def precision(self) -> type[np.floating[Any]]:
        """float64: exponents magnify the rounding of half vectors."""
        return np.float64


def _like(views: Floats, parameters: Array) -> Floats:
    """Parameters of points in the floating-point type of the directions."""
    return np.ascontiguousarray(parameters, dtype=views.dtype)


def phong_density(halves: Array, exponent_u: Array, exponent_v: Array) -> Array:
    r"""Anisotropic Phong density of half vectors.

    :math:`\frac{\sqrt{(n_u+1)(n_v+1)}}{2\pi}\,
    h_z^{(n_u h_x^2 + n_v h_y^2) / (1 - h_z^2)}`

    Evaluated through ``log1p`` so that neither the pole (0/0 in the exponent) nor
    huge exponents lose digits.

    Parameters
    ----------
    halves : (n, 3) float64
        Unit half vectors above the horizon.
    exponent_u, exponent_v : (n, 1) float64
        Phong exponents >= 0.

    Returns
    -------
    (n, 1) float64
        1/sr.

    Examples
    --------
    >>> tilted = np.array([[0.6, 0.0, 0.8]])
    >>> phong_density(tilted, np.array([[2.0]]), np.array([[2.0]])).round(4)  # 3/(2 pi) .8^2
    array([[0.3056]])
    """
    x2, y2 = halves[:, :1] ** 2, halves[:, 1:2] ** 2
    sine2 = np.minimum(x2 + y2, 0.5)
    z = np.maximum(halves[:, 2:], SMALLEST_DENOMINATOR)
    log_cosine = np.where(x2 + y2 < 0.5, 0.5 * np.log1p(-sine2), np.log(z))
    # log(cos) / sin^2 tends to -1/2 at the pole.
    at_pole = x2 + y2 < 1e-15
    slope = np.where(at_pole, -0.5, log_cosine / np.where(at_pole, 1.0, x2 + y2))
    peak = np.sqrt((exponent_u + 1.0) * (exponent_v + 1.0)) / (2.0 * np.pi)
    return peak * np.exp((exponent_u * x2 + exponent_v * y2) * slope)


@dataclass(frozen=True)
class GGX(_Parametric):
    r"""Anisotropic GGX microfacets, with Smith masking, over a diffuse base.

    :math:`\frac{D(h)\,G_2(v,l)\,F(h\cdot l)}{4\,(n\cdot v)(n\cdot l)}` plus
    `coupled_diffuse`, single scattering only.

    Parameters
    ----------
    specular, diffuse : Texture
        Reflectance at normal incidence and diffuse albedo, RGB in [0, 1]. With a
        metal, `specular` scales the conductor's Fresnel term instead.
    alpha_x, alpha_y : Texture
        Roughness along tangent and binormal, in [1e-4, 1].
    conductor : tuple of two RGB triples, optional
        Refraction index and extinction coefficient of a metal.
    correlated : bool
        True for height-correlated masking (Heitz), False for the product of the
        two directions' masking, as some renderers have it.

    References
    ----------
    E. Heitz, "Understanding the masking-shadowing function in microfacet-based
    BRDFs", Journal of Computer Graphics Techniques 3(2), 2014.

    Examples
    --------
    All directions along the normal: 1 / (4 pi alpha^2) times F.

    >>> from capture_sim.materials.textures import Constant
    >>> up = np.array([[0.0, 0.0, 1.0]])
    >>> half, zero = Constant((0.5,)), Constant((0.0,))
    >>> GGX(half, zero, half, half).evaluate(up, up, np.zeros((1, 2))).round(4)
    array([[0.1592, 0.1592, 0.1592]])
    """

    specular: Texture
    diffuse: Texture
    alpha_x: Texture
    alpha_y: Texture
    conductor: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    correlated: bool = True

    def _reflect(self, views: Array, lights: Array, uv: Array) -> Array:
        alphas = np.hstack([self.alpha_x.scalar(uv), self.alpha_y.scalar(uv)])
        halves, cosine = half_vectors(views, lights)
        masking = smith_visibility(views, lights, alphas, correlated=self.correlated)
        lobe = ggx_density(halves, alphas) * masking
        shine = lobe * self._fresnel(cosine, uv)
        if self.diffuse.bounds == (0.0, 0.0):
            return shine
        at_normal = self._fresnel(np.ones((1, 1)), uv)
        return shine + coupled_diffuse(self.diffuse.rgb(uv), at_normal, views, lights)

    def evaluate_lights(self, views: Floats, lights: Floats, lit: Flags, uv: Array) -> Floats:
        """Compiled `evaluate`; see `Material.evaluate_lights`."""
        values = np.zeros_like(lights)
        alphas = np.hstack([self.alpha_x.scalar(uv), self.alpha_y.scalar(uv)])
        kernels.ggx(views, lights, _like(views, alphas), self.correlated, values)
        specular = _like(views, self.specular.rgb(uv))
        if self.conductor is None:
            kernels.schlick_colours(specular, values)
        else:
            eta, kappa = (_like(views, np.array(row)) for row in self.conductor)
            kernels.metal_colours(specular, eta, kappa, values)
        if self.diffuse.bounds != (0.0, 0.0):
            at_normal = _like(views, self._fresnel(np.ones((len(uv), 1)), uv))
            albedo = _like(views, self.diffuse.rgb(uv))
            kernels.add_coupled_diffuse(views, lights, albedo, at_normal, values)
        return values

    def lobe(self, uv: Array) -> Array:
        """The roughness itself."""
        return np.hstack([self.alpha_x.scalar(uv), self.alpha_y.scalar(uv)])

    @property
    def precision(self) -> type[np.floating[Any]]:
        """float64 for lobes that are too sharp for float32."""
        sharpest = min(self.alpha_x.bounds[0], self.alpha_y.bounds[0])
        return np.float64 if sharpest < SHARP_ALPHA else np.float32

    def _fresnel(self, cosine: Array, uv: Array) -> Array:
        if self.conductor is None:
            return schlick(self.specular.rgb(uv), cosine)
        eta, kappa = (np.array(values) for values in self.conductor)
        return self.specular.rgb(uv) * conductor_fresnel(cosine, eta, kappa)


def ggx_density(halves: Array, alphas: Array) -> Array:
    r"""GGX density of microfacet normals, :math:`D(h)`.

    :math:`\left[\pi\alpha_x\alpha_y\left((h_x/\alpha_x)^2+(h_y/\alpha_y)^2+h_z^2
    \right)^2\right]^{-1}`

    Parameters
    ----------
    halves : (n, 3) float64
        Unit half vectors.
    alphas : (n, 2) float64
        Roughness along tangent and binormal, > 0.

    Returns
    -------
    (n, 1) float64
        1/sr; its cosine-weighted integral over the hemisphere is 1.

    Examples
    --------
    >>> ggx_density(np.array([[0.0, 0.0, 1.0]]), np.array([[0.5, 0.5]])).round(4)  # 4/pi
    array([[1.2732]])
    """
    stretched = np.sum((halves[:, :2] / alphas) ** 2, axis=1) + halves[:, 2] ** 2
    density = 1.0 / (np.pi * np.prod(alphas, axis=1) * stretched**2)
    return density[:, None]


def smith_visibility(views: Array, lights: Array, alphas: Array, *, correlated: bool) -> Array:
    r"""Smith masking of GGX over the cosines, :math:`G_2 / (4 (n\cdot v)(n\cdot l))`.

    With :math:`s(d) = |(\alpha_x d_x, \alpha_y d_y, d_z)|` the height-correlated
    form is :math:`\tfrac12 / (l_z s(v) + v_z s(l))`, the separable one
    :math:`1 / ((v_z + s(v))(l_z + s(l)))`; both are finite up to the horizon.

    Parameters
    ----------
    views, lights : (n, 3) float64
        Unit directions above the horizon.
    alphas : (n, 2) float64
        Roughness along tangent and binormal.
    correlated : bool
        True for the height-correlated form.

    Returns
    -------
    (n, 1) float64

    Examples
    --------
    Nothing is hidden from above, so that 1/4 is left:

    >>> up, rough = np.array([[0.0, 0.0, 1.0]]), np.array([[0.5, 0.5]])
    >>> smith_visibility(up, up, rough, correlated=True)
    array([[0.25]])
    """
    view_stretch = np.sqrt(np.sum((views[:, :2] * alphas) ** 2, axis=1) + views[:, 2] ** 2)
    light_stretch = np.sqrt(np.sum((lights[:, :2] * alphas) ** 2, axis=1) + lights[:, 2] ** 2)
    if correlated:
        bottom = 2.0 * (lights[:, 2] * view_stretch + views[:, 2] * light_stretch)
    else:
        bottom = (views[:, 2] + view_stretch) * (lights[:, 2] + light_stretch)
    return (1.0 / np.maximum(bottom, SMALLEST_DENOMINATOR))[:, None]


def conductor_fresnel(cosine: Array, eta: Array, kappa: Array) -> Array:
    r"""Unpolarised Fresnel reflectance of a metal in air.

    Parameters
    ----------
    cosine : (n, 1) float64
        Cosine of the angle of incidence.
    eta, kappa : (3,) float64
        Real and imaginary part of the refraction index per channel.

    Returns
    -------
    (n, 3) float64
        Mean of the reflectances of both polarisations.

    References
    ----------
    M. Born and E. Wolf, "Principles of Optics", chapter on metal optics.

    Examples
    --------
    Normal incidence: ((eta - 1)^2 + k^2) / ((eta + 1)^2 + k^2).

    >>> conductor_fresnel(np.ones((1, 1)), np.array([1.0]), np.array([2.0]))
    array([[0.5]])
    """
    c2 = np.minimum(cosine, 1.0) ** 2
    s2 = 1.0 - c2
    difference = eta**2 - kappa**2 - s2
    root = np.sqrt(difference**2 + 4.0 * (eta * kappa) ** 2)
    real = np.sqrt(np.maximum(0.5 * (root + difference), 0.0))
    twice = 2.0 * np.sqrt(c2) * real
    perpendicular = (root + c2 - twice) / (root + c2 + twice)
    weight = c2 * root + s2**2
    parallel = perpendicular * (weight - twice * s2) / (weight + twice * s2)
    return 0.5 * (perpendicular + parallel)
