"""Fields with known answers: analytic reflectance on a square or a sphere.

Tests start from these, so that a rendered pixel can be compared with a formula.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.build import BaseSurface, FittedReflectance, build_field
from reflfield.field.indirect_light import IndirectLight
from reflfield.field.reflectance_field import INVERSE_POWER, Domain, ReflectanceField
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.sphere.rotations import frames_from_normals


@dataclass(frozen=True, eq=False)
class FramedSurface(BaseSurface):
    """A surface with the frame of each texel.

    Parameters
    ----------
    base_from_world : (n_texels, 3, 3) float64
        Rows tangent, binormal, normal.
    """

    base_from_world: NDArray[np.float64]


# Reflectance (n_views, n_lights, 3) in 1/sr, without the light's cosine, of local views
# (n_views, 3) and local lights (n_lights, 3).
Samples = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def square_surface(n_texels: int = 8, size: float = 1.0) -> FramedSurface:
    """Square in the plane z = 0, centred at the origin, facing +z.

    Parameters
    ----------
    n_texels : int
        Texels along a side.
    size : float
        Length of a side, metres.

    Returns
    -------
    FramedSurface
        Texture u runs along +x, v along +y.

    Examples
    --------
    >>> square_surface(4).texel_of_pixel.shape
    (4, 4)
    """
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    positions = np.concatenate([(uv - 0.5) * size, np.zeros((4, 1))], axis=1)
    return FramedSurface(
        positions=positions,
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        uv=uv,
        texel_of_pixel=np.arange(n_texels**2).reshape(n_texels, n_texels),
        base_from_world=np.tile(np.eye(3), (n_texels**2, 1, 1)),
    )


def sphere_surface(height: int = 32, radius: float = 1.0) -> FramedSurface:
    """Sphere at the origin with a latitude-longitude texture.

    Parameters
    ----------
    height : int
        Texels from pole to pole; twice as many around.
    radius : float
        Metres.

    Returns
    -------
    FramedSurface
        Row 0 at the +z pole; column 0 starts at azimuth 0 and columns follow it.
        The mesh has a vertex at every texel corner.

    Examples
    --------
    A texel of the top row, a good quarter of the way around, looks up and along +y:

    >>> surface = sphere_surface(4)
    >>> surface.base_from_world[surface.texel_of_pixel[0, 2], 2].round(3)
    array([-0.146,  0.354,  0.924])
    """
    width = 2 * height
    v, u = np.meshgrid(
        np.linspace(1, 0, height + 1), np.linspace(0, 1, width + 1), indexing="ij"
    )
    corner = np.arange((height + 1) * (width + 1)).reshape(height + 1, width + 1)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    # The triangles at the poles that would have no area are left out.
    faces = [np.stack([a, b, c], -1)[:-1], np.stack([a, c, d], -1)[1:]]
    centres = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    row, column = (index.ravel() + 0.5 for index in centres)
    normals = _on_sphere(column / width, 1 - row / height)
    azimuth = 2 * np.pi * column / width
    tangents = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=1)
    return FramedSurface(
        positions=radius * _on_sphere(u.ravel(), v.ravel()),
        faces=np.concatenate([f.reshape(-1, 3) for f in faces]),
        uv=np.stack([u.ravel(), v.ravel()], axis=1),
        texel_of_pixel=np.arange(height * width).reshape(height, width),
        base_from_world=frames_from_normals(normals, tangents),
    )


def lambert(albedo: Any) -> Samples:
    """Reflectance ``albedo / pi`` of a diffuse surface.

    Examples
    --------
    >>> up = np.array([[0.0, 0.0, 1.0]])
    >>> lambert([np.pi, 0.0, 0.0])(up, up)
    array([[[1., 0., 0.]]])
    """

    def samples(views: NDArray[np.float64], lights: NDArray[np.float64]) -> NDArray[np.float64]:
        reflectance = np.asarray(albedo, float) / np.pi
        return np.broadcast_to(reflectance, (len(views), len(lights), 3))

    return samples


def blinn_phong(albedo: Any, specular: Any, exponent: float) -> Samples:
    """Diffuse reflectance plus a lobe ``specular * (n . h) ** exponent``.

    Examples
    --------
    >>> up = np.array([[0.0, 0.0, 1.0]])
    >>> float(blinn_phong(0.0, 2.0, 50.0)(up, up)[0, 0, 0])
    2.0
    """

    def samples(views: NDArray[np.float64], lights: NDArray[np.float64]) -> NDArray[np.float64]:
        half = views[:, None] + lights[None]
        half /= np.maximum(np.linalg.norm(half, axis=2, keepdims=True), 1e-12)
        lobe = np.maximum(half[..., 2:], 0.0) ** exponent * np.asarray(specular, float)
        return lambert(albedo)(views, lights) + lobe

    return samples


def baked_field(
    surface: FramedSurface,
    samples: Samples,
    *,
    view_side: int = 9,
    light_side: int = 9,
    domain: Domain = "cube_root",
    indirect: IndirectLight | None = None,
    **options: Any,
) -> ReflectanceField:
    """One reflectance on all of a surface, in the base frames.

    Parameters
    ----------
    surface : FramedSurface
        Where it goes.
    samples : callable
        Reflectance for local views and lights, as `lambert` makes.
    view_side, light_side : int
        Sides of the grids.
    domain : {"cube_root", "square_root", "linear"}
        Domain of the field.
    indirect : IndirectLight, optional
    **options
        Further arguments of `build_field`.

    Returns
    -------
    ReflectanceField
        One cluster, no basis functions.

    Examples
    --------
    >>> field = baked_field(square_surface(4), lambert(0.5))
    >>> field.n_texels, field.n_components
    (16, 0)
    """
    views, lights = HemisphereGrid(view_side).directions, HemisphereGrid(light_side).directions
    mean = samples(views, lights) ** (1.0 / INVERSE_POWER[domain])
    n_texels = len(surface.base_from_world)
    reflectance = FittedReflectance(
        local_from_world=surface.base_from_world,
        cluster=np.zeros(n_texels, int),
        coefficients=np.zeros((n_texels, 0)),
        mean=mean[None],
        basis=np.zeros((1, 0, *mean.shape)),
        domain=domain,
        indirect=indirect,
    )
    return build_field(surface, reflectance, **options)


def _on_sphere(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    azimuth, polar = 2 * np.pi * u, np.pi * (1 - v)
    ring = np.sin(polar)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.cos(polar)], axis=1)
