"""Exported folders in Blender: its Cycles beside the formula of the maps, and the field."""

import json
from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.export import blender
from reflfield.export.formats import export_field
from reflfield.export.material_maps import MaterialMaps
from reflfield.export.microfacets import MicrofacetMaterial
from reflfield.geometry.mesh import unit_or_zero
from tests.export.blender_images import blender_python, compared, cycles_images
from tests.synthetic_fields import baked_field, lambert, square_surface
from tests.viewer.shown_fields import half_vector_field

pytestmark = pytest.mark.skipif(
    blender_python() is None, reason="needs Blender (set BLENDER_PYTHON to a Python with bpy)"
)
ROUGHNESS, STRENGTH, ANGLE = 0.3, 0.45, 35.0  # of a brushed metal; degrees from the tangent


def brushed_maps(shape, direction, *, mirrored):
    """Maps of a metal whose highlights stretch along a direction of the tangent space."""

    def image(*values):
        texel = np.rint(255 * np.array(values)).astype(np.uint8)
        return np.broadcast_to(texel, (*shape, len(values)))

    anisotropy = image(*(0.5 + 0.5 * direction), STRENGTH)
    maps = (image(1.0, 1.0, 1.0), image(1.0, ROUGHNESS, 1.0), image(0.5, 0.5, 1.0))
    errors = dict.fromkeys(("relative", "median_of_texels", "relative_near_highlights"), 0.0)
    white = image(1.0, 1.0, 1.0, 1.0)
    sides = np.full(shape, mirrored)
    return MaterialMaps(*maps, anisotropy, white, sides, 1.0, 1.0, 1.0, errors)


@pytest.mark.reference
@pytest.mark.parametrize("mirrored", [False, True])
def test_highlights_of_brushed_metal_stretch_as_they_should(tmp_path, monkeypatch, mirrored):
    """Also in charts that the texture shows mirrored, u along -x."""
    surface = square_surface(8)
    if mirrored:
        surface = replace(surface, uv=surface.uv * [-1, 1] + [1, 0])
    field = baked_field(surface, lambert(0.5), domain="linear")
    direction = np.array([np.cos(np.radians(ANGLE)), np.sin(np.radians(ANGLE))])
    maps = brushed_maps((8, 8), direction * [-1 if mirrored else 1, 1], mirrored=mirrored)
    monkeypatch.setattr(blender, "material_maps", lambda *_: maps)
    export_field(field, tmp_path / "out", "blender")
    camera = Camera.look_at([0.3, -0.2, 1.5], up=[0, 1, 0], width=64, height=64, fov_deg=30)
    towards = np.array([-0.1, 0.3, 1.0]) / np.linalg.norm([-0.1, 0.3, 1.0])
    _, lit = cycles_images(tmp_path / "out", tmp_path, camera, 30, towards)
    one, side = np.ones(1), -1 if mirrored else 1
    tilt = 128 / 127.5 - 1  # what 8 bits make of an upright normal
    metal = MicrofacetMaterial(
        np.ones((1, 3)), one, ROUGHNESS * one, STRENGTH * one, np.full((1, 3), 0.04), one,
        unit_or_zero(np.array([[side * tilt, tilt, 1.0]])), np.array([[*direction, 0.0]]),
    )  # fmt: skip
    rows, columns = np.mgrid[:64, :64]
    _, rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]) + 0.5)
    lights = np.broadcast_to(towards, rays.shape)
    wanted = metal.evaluate(np.zeros(len(rays), int), -rays, lights).reshape(64, 64, 3)
    inside = lit[..., 3] > 0.999
    off = np.linalg.norm((lit[..., :3] - wanted)[inside]) / np.linalg.norm(wanted[inside])
    # Directions are stored in steps of 1.4 degrees, a quarter of the highlight's width.
    assert off < 0.03


@pytest.mark.reference
def test_blender_shows_the_field_as_well_as_the_maps_can(tmp_path):
    """Relative difference and brightness, off the edges of object and shadows."""
    field = half_vector_field()
    export_field(field, tmp_path / "out", "blender")
    camera = Camera.look_at([4.0, -2.0, 2.0], width=128, height=128, fov_deg=30)
    shown = compared(field, tmp_path / "out", tmp_path, camera, 30, [0.5, -0.6, 0.6])
    stated = json.loads((tmp_path / "out" / "material.json").read_text())["error"]
    assert shown.relative < stated["relative_near_highlights"]
    # One view and light, not all: the maps' own error leaves this in the mean of a channel.
    np.testing.assert_allclose(shown.ratios, 1.0, rtol=0, atol=stated["relative"] / 2)
