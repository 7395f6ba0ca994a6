"""Fields of each model on two spheres, one of which throws a shadow on the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reflfield.field.build import BaseSurface, FittedReflectance, build_field
from reflfield.field.half_vector import (
    DIFFUSE_NODES,
    N_DIFFERENCE,
    SKEW_NODES,
    HalfVectorModel,
    half_angles,
)
from reflfield.field.half_vector_build import build_half_vector_field
from reflfield.field.indirect_light import IndirectLight
from reflfield.sphere.hemisphere import HemisphereGrid
from tests.synthetic_fields import FramedSurface, blinn_phong, sphere_surface, square_surface

# Where lights of the pretended capture stood: all around, but not below.
OBSERVED = [[np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]
            for e in (0.1, 0.8, 1.4) for a in np.arange(0, 6.2, 0.7)]  # fmt: skip

BEFORE = np.array([1.4, -0.4, 0.9])


def two_spheres(height: int = 24) -> FramedSurface:
    """A sphere with a small one before it, left and right in one texture."""
    large, small = sphere_surface(height), sphere_surface(height, radius=0.35)
    n_vertices, n_texels = len(large.positions), large.texel_of_pixel.size
    half = np.array([0.5, 1.0])
    return FramedSurface(
        positions=np.concatenate([large.positions, small.positions + BEFORE]),
        faces=np.concatenate([large.faces, small.faces + n_vertices]),
        uv=np.concatenate([large.uv * half, small.uv * half + (1.0 - half)]),
        texel_of_pixel=np.concatenate(
            [large.texel_of_pixel, small.texel_of_pixel + n_texels], axis=1
        ),
        base_from_world=np.concatenate([large.base_from_world, small.base_from_world]),
    )


def hourglass(height: int = 48) -> FramedSurface:
    """A closed surface with a waist, whose upper half shades the slope of the lower one."""
    ball = sphere_surface(height)
    across = 0.3 + 0.9 * ball.positions[:, 2:] ** 2
    return replace(
        ball, positions=ball.positions * np.concatenate([across, across, 0 * across + 1.3], 1)
    )


def varying(surface: FramedSurface, n: int) -> np.ndarray:
    """Numbers from 0 to 1 that vary over the texels, (n_texels, n)."""
    normal = surface.base_from_world[:, 2]
    waves = np.arange(1, n + 1)[:, None] * [[2.0, 1.0, -1.5]] + np.arange(n)[:, None]
    return 0.5 + 0.5 * np.sin(normal @ waves.T + np.arange(n))


def indirect_light(surface: FramedSurface, rng: np.random.Generator) -> IndirectLight:
    """Cube roots of a few hundredths, from seven functions of nine harmonics."""
    functions = rng.normal(size=(7, 9, 3)).astype(np.float32) * 0.4
    functions[0] *= 0.05
    functions[0, 0] += 1.2
    coefficients = 0.05 * varying(surface, 6).astype(np.float32)
    return IndirectLight(functions, coefficients)


def half_vector_field(visibility: str = "factored", name: str = "spheres"):
    """Two lobes, a narrow and a wide one, over a diffuse colour."""
    surface, rng = two_spheres(), np.random.default_rng(3)
    angle = half_angles()
    rise = 1.0 + 0.3 * np.arange(N_DIFFERENCE)[:, None, None]
    lobes = [rise * np.exp(-((angle / np.radians(width)) ** 2)) for width in (6.0, 25.0)]
    colours = np.array([[1.0, 0.9, 0.7], [0.5, 0.6, 0.7]])
    lobes = np.stack(lobes).reshape(2, -1, 1) * colours[:, None]
    model = HalfVectorModel(
        frames=surface.base_from_world.astype(np.float32),
        diffuse=(0.3 * varying(surface, 3)).astype(np.float32),
        weights=varying(surface, 2).astype(np.float32),
        lobes=lobes.astype(np.float32),
        skews=rng.uniform(-0.9, 0.9, (2, SKEW_NODES, 3)).astype(np.float32),
        diffuse_table=rng.uniform(0.8, 1.2, DIFFUSE_NODES).astype(np.float32),
    )
    return build_half_vector_field(
        surface, model, indirect_light(surface, rng), visibility=visibility,
        metadata={"observed_lights": OBSERVED, "capture": name},
    )  # fmt: skip


def clustered_field(visibility: str = "factored", domain: str = "cube_root"):
    """Three clusters of a mean and two functions, of different gloss."""
    surface, rng = two_spheres(), np.random.default_rng(4)
    nodes = HemisphereGrid(9).directions
    power = {"cube_root": 3, "square_root": 2, "linear": 1}[domain]
    means = np.stack(
        [blinn_phong([0.9, 0.5, 0.3], 0.3 * e, e)(nodes, nodes) for e in (3.0, 8.0, 20.0)]
    ) ** (1 / power)
    basis = 0.1 * rng.normal(size=(3, 2, *means.shape[1:]))
    reflectance = FittedReflectance(
        local_from_world=surface.base_from_world,
        cluster=np.arange(len(surface.base_from_world)) // 200 % 3,
        coefficients=varying(surface, 2) - 0.5,
        mean=means,
        basis=basis,
        domain=domain,
        indirect=indirect_light(surface, rng) if visibility == "factored" else None,
    )
    return build_field(
        surface, reflectance, visibility=visibility, metadata={"observed_lights": OBSERVED}
    )


def planar_field(light_model: str = "known"):
    """A square whose samples do not vary with the view, as of one fixed camera."""
    surface = square_surface(24)
    lights = HemisphereGrid(9 if light_model == "known" else 1).directions
    mean = blinn_phong([0.8, 0.6, 0.4], 0.5, 9.0)(np.array([[0.0, 0.0, 1.0]]), lights)
    n = len(surface.base_from_world)
    place = np.arange(n) / n
    reflectance = FittedReflectance(
        local_from_world=surface.base_from_world,
        cluster=np.zeros(n, int),
        coefficients=np.stack([np.sin(40 * place), np.cos(90 * place)], axis=1),
        mean=np.cbrt(mean)[None],
        basis=0.1 * np.cbrt(mean)[None, None] * [[[[[1.0, 0, 0]]], [[[0, 1.0, 0.5]]]]],
    )
    return build_field(surface, reflectance, light_model=light_model)


def plain(surface: BaseSurface):
    """A white field on a surface, black in its shadows: shows where these are."""
    nodes = HemisphereGrid(9).directions
    n = len(surface.base_from_world)
    return build_field(
        surface,
        FittedReflectance(
            local_from_world=surface.base_from_world,
            cluster=np.zeros(n, int),
            coefficients=np.zeros((n, 0)),
            mean=np.ones((1, len(nodes), len(nodes), 3)),
            basis=np.zeros((1, 0, len(nodes), len(nodes), 3)),
        ),
        visibility="factored",
    )
