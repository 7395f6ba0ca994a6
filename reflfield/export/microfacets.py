r"""Reflectance of the material of glTF 2.0, with its extensions for gloss.

For unit vectors v to the viewer and l to the light, h their half vector, n the normal, t the
direction along which highlights stretch, and b across it:

.. math::
    D = \frac{1}{\pi \alpha_t \alpha_b} \Big(\frac{h_t^2}{\alpha_t^2} +
        \frac{h_b^2}{\alpha_b^2} + h_n^2\Big)^{-2}, \quad
    V = \min\Big(1, \frac{1/2}{l_n \Vert(\alpha_t v_t, \alpha_b v_b, v_n)\Vert +
        v_n \Vert(\alpha_t l_t, \alpha_b l_b, l_n)\Vert}\Big),

with :math:`\alpha_b = \mathrm{roughness}^2` and
:math:`\alpha_t = \alpha_b + (1 - \alpha_b)\,\mathrm{strength}^2`. A dielectric reflects
:math:`(1 - \max_c F_c)\,\mathrm{base} / \pi + F V D` and a metal :math:`F V D`, each with
Schlick's F; their shares are 1 - metallic and metallic.

References
----------
Khronos Group, "glTF 2.0 Specification", appendix B; extensions KHR_materials_anisotropy,
KHR_materials_specular and KHR_materials_ior.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.util.validation import check_shape

Doubles = NDArray[np.float64]

# Share of light that a dielectric of index 1.5, that of glTF where none is stated, reflects.
DIELECTRIC_F0 = 0.04


@dataclass(frozen=True, eq=False)
class MicrofacetMaterial:
    """Material of glTF at n points.

    Parameters
    ----------
    base_colour : (n, 3) float64
        Linear, 0 to 1.
    metallic, roughness, strength : (n,) float64
        0 to 1; the last of the anisotropy.
    dielectric_f0 : (n, 3) float64
        What the dielectric reflects of light from straight above, 0 to 1.
    dielectric_f90 : (n,) float64
        The same of grazing light.
    normals, stretch : (n, 3) float64
        Unit vectors in the world: normal, and the direction along which highlights stretch.
    """

    base_colour: Doubles
    metallic: Doubles
    roughness: Doubles
    strength: Doubles
    dielectric_f0: Doubles
    dielectric_f90: Doubles
    normals: Doubles
    stretch: Doubles

    def __post_init__(self) -> None:
        n = len(self.metallic)
        for name in ("base_colour", "dielectric_f0", "normals", "stretch"):
            check_shape(name, getattr(self, name), (n, 3))
        for name in ("roughness", "strength", "dielectric_f90"):
            check_shape(name, getattr(self, name), (n,))

    def evaluate(self, points: NDArray[np.integer], views: Doubles, lights: Doubles) -> Doubles:
        """Reflectance times the light's cosine, 1/sr, (m, 3), as `field.evaluation` says it.

        Parameters
        ----------
        points : (m,) int
            Numbers of points.
        views, lights : (m, 3) float64
            Unit vectors in the world.

        Examples
        --------
        White chalk: 0.96 / pi of diffuse light and a faint, wide highlight.

        >>> one, up = np.ones(1), np.array([[0.0, 0.0, 1.0]])
        >>> chalk = MicrofacetMaterial(
        ...     np.ones((1, 3)), 0 * one, one, 0 * one, np.full((1, 3), 0.04), one, up,
        ...     np.array([[1.0, 0.0, 0.0]]))
        >>> chalk.evaluate(np.zeros(1, int), up, up).round(4)
        array([[0.3088, 0.3088, 0.3088]])
        """
        out = np.zeros((len(points), 3))
        _evaluate(
            *(self.base_colour, self.metallic, self.roughness, self.strength),
            *(self.dielectric_f0, self.dielectric_f90, self.normals, self.stretch),
            *(points, views, lights, out),
        )
        return out


# Kernel helpers are typed by numba; to mypy their scalars are Any.


@numba.njit(cache=True, nogil=True)
def gloss_term(basis: Any, view: Any, light: Any, along: float, across: float) -> Any:
    """Distribution and visibility of microfacets for one pair of directions.

    Parameters
    ----------
    basis : (3, 3) float64
        Rows t, b and n.
    view, light : (3,) float
    along, across : float
        The two alphas.

    Returns
    -------
    gloss, grazing, cosine : float
        ``D V``, ``(1 - v h)^5``, and the cosine of the light; zeros where the normal faces
        away from view or light.
    """
    vt = basis[0, 0] * view[0] + basis[0, 1] * view[1] + basis[0, 2] * view[2]
    vb = basis[1, 0] * view[0] + basis[1, 1] * view[1] + basis[1, 2] * view[2]
    vn = basis[2, 0] * view[0] + basis[2, 1] * view[1] + basis[2, 2] * view[2]
    lt = basis[0, 0] * light[0] + basis[0, 1] * light[1] + basis[0, 2] * light[2]
    lb = basis[1, 0] * light[0] + basis[1, 1] * light[1] + basis[1, 2] * light[2]
    ln = basis[2, 0] * light[0] + basis[2, 1] * light[1] + basis[2, 2] * light[2]
    if vn <= 0.0 or ln <= 0.0:
        return 0.0, 0.0, 0.0
    ht, hb, hn = vt + lt, vb + lb, vn + ln
    scale = 1.0 / np.sqrt(ht * ht + hb * hb + hn * hn)
    ht, hb, hn = ht * scale, hb * scale, hn * scale
    spread = (ht / along) ** 2 + (hb / across) ** 2 + hn * hn
    shadowing = ln * np.sqrt((along * vt) ** 2 + (across * vb) ** 2 + vn * vn)
    shadowing += vn * np.sqrt((along * lt) ** 2 + (across * lb) ** 2 + ln * ln)
    visibility = min(0.5 / shadowing, 1.0)
    gloss = visibility / (np.pi * along * across * spread * spread)
    return gloss, (1.0 - min(vt * ht + vb * hb + vn * hn, 1.0)) ** 5, ln


@numba.njit(cache=True, nogil=True)
def _fill_basis(normal: Any, stretch: Any, basis: Any) -> None:
    """Rows t, b, n of the normal and a direction, which is made orthogonal to it."""
    along = 0.0
    for d in range(3):
        along += normal[d] * stretch[d]
    size = 0.0
    for d in range(3):
        basis[2, d] = normal[d]
        basis[0, d] = stretch[d] - along * normal[d]
        size += basis[0, d] ** 2
    scale = 1.0 / max(np.sqrt(size), 1e-12)
    for d in range(3):
        basis[0, d] *= scale
    for d in range(3):
        i, j = (d + 1) % 3, (d + 2) % 3
        basis[1, d] = basis[2, i] * basis[0, j] - basis[2, j] * basis[0, i]


@numba.njit(cache=True, nogil=True)
def _evaluate(
    base: Doubles,
    metallic: Doubles,
    roughness: Doubles,
    strength: Doubles,
    f0: Doubles,
    f90: Doubles,
    normals: Doubles,
    stretch: Doubles,
    points: NDArray[np.integer],
    views: Doubles,
    lights: Doubles,
    out: Doubles,
) -> None:
    basis, reflected = np.zeros((3, 3)), np.zeros(3)
    for i in range(len(points)):
        at = points[i]
        _fill_basis(normals[at], stretch[at], basis)
        across = roughness[at] ** 2
        along = across + (1.0 - across) * strength[at] ** 2
        gloss, grazing, cosine = gloss_term(basis, views[i], lights[i], along, across)
        for c in range(3):
            reflected[c] = f0[at, c] + (f90[at] - f0[at, c]) * grazing
        let_in = (1.0 - max(reflected[0], reflected[1], reflected[2])) / np.pi
        for c in range(3):
            dielectric = let_in * base[at, c] + gloss * reflected[c]
            metal = gloss * (base[at, c] + (1.0 - base[at, c]) * grazing)
            out[i, c] = cosine * (dielectric + metallic[at] * (metal - dielectric))
