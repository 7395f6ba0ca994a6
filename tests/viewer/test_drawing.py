"""What the page draws against what the library renders: the same cameras, lights, pixels."""

import base64
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import reflfield as rf
from reflfield.capture.cameras import Camera
from reflfield.render.camera_rays import subpixel_offsets
from reflfield.render.renderer import RenderOptions, render
from reflfield.viewer.object_page import camera_values, light_values, object_page
from tests.viewer.shown_fields import (
    clustered_field,
    half_vector_field,
    hourglass,
    plain,
    planar_field,
    two_spheres,
)

SIZE = 48
# Of both: rays through the same places of a pixel.
RAYS = subpixel_offsets(4).tolist()
OPTIONS = RenderOptions(samples_per_pixel=4)
# Of the relative L2 difference. Tables are read through textures of half floats (2^-11 of a
# value) whose interpolation has 8 bits of a step between nodes; a cube trebles both.
TOLERANCE = 0.01
# Pixels around the edges of shadows and of the object: a shadow map has another resolution.
EDGE_PX = 2
LIGHTS = {
    "point": [rf.PointLight([4.0, -1.5, 2.5], [20.0, 18.0, 15.0])],
    "two": [rf.PointLight([3.0, -3.0, 4.0], 20.0), rf.DirectionalLight([0.2, 0.5, 1.0], 0.8)],
    "below": [rf.DirectionalLight([0.6, -0.5, -0.6], 1.0)],
}
FIELDS = {
    "half vector, traced": half_vector_field,
    "half vector, kept": lambda: half_vector_field("kept"),
    "clustered, traced": clustered_field,
    "clustered, kept": lambda: clustered_field("kept"),
    "clustered, linear": lambda: clustered_field(domain="linear"),
}


def view(position, **options):
    return rf.Camera.look_at(
        position, [0.4, 0.0, 0.2], width=SIZE, height=SIZE, fov_deg=33, **options
    )


def drawn(page, camera, lights):
    """What the page shows, (height, width, 4)."""
    text = page.evaluate(
        "(given) => reflfield.renderTest(...given)",
        [camera_values(camera), [light_values(light) for light in lights], RAYS],
    )
    return np.frombuffer(base64.b64decode(text), np.float32).reshape(
        camera.height, camera.width, 4
    )


def away_from_edges(camera, lights):
    """Pixels that no edge of the object or of a shadow is near to."""
    white = plain(two_spheres())
    inside = np.ones((camera.height, camera.width), bool)
    for light in lights:
        seen = render(white, camera, light)
        inside &= ndimage.binary_erosion(seen.coverage == 1, iterations=EDGE_PX)
        dark = seen.image[..., 1] == 0
        near = [ndimage.binary_dilation(part, iterations=EDGE_PX) for part in (dark, ~dark)]
        inside &= ~(near[0] & near[1])
    return inside


def relative(difference, wanted):
    return float(np.linalg.norm(difference) / np.linalg.norm(wanted))


@pytest.mark.parametrize("name", FIELDS)
def test_is_what_the_library_renders(open_page, name):
    field = FIELDS[name]()
    page = open_page(object_page(field))
    camera = view([4.0, -2.5, 1.5])
    for lights in LIGHTS.values():
        shown, wanted = drawn(page, camera, lights), render(field, camera, lights, OPTIONS)
        counted = away_from_edges(camera, lights) if field.visibility == "factored" else (
            ndimage.binary_erosion(wanted.coverage == 1, iterations=EDGE_PX))  # fmt: skip
        # Enough to mean something: the spheres cover a third of the picture.
        assert counted.mean() > 0.15
        difference = (shown[..., :3] - wanted.image)[counted]
        assert relative(difference, wanted.image[counted]) < TOLERANCE
        # Of the four rays of a pixel, hardly one is on the other side of an edge.
        assert np.abs(shown[..., 3] - wanted.coverage).mean() < 1e-3
        # At the edges of shadows, too, few and unbiased.
        assert relative(shown[..., :3] - wanted.image, wanted.image) < 10 * TOLERANCE


def test_no_light_leaks_into_the_shadow_of_a_waist(open_page):
    """Where the light that entered above leaves the object and grazes it again."""
    field = plain(hourglass())
    page = open_page(object_page(field))
    light = rf.DirectionalLight([0.3, 0.0, 1.0], 1.0)
    for position in ([4.0, -2.5, 0.2], [-4.0, 1.0, 0.2]):
        camera = view(position)
        shown, wanted = drawn(page, camera, [light]), render(field, camera, [light], OPTIONS)
        inside = ndimage.binary_erosion(wanted.coverage == 1, iterations=EDGE_PX)
        dark = (
            ndimage.binary_erosion(wanted.image.max(axis=2) == 0, iterations=EDGE_PX) & inside
        )
        assert dark.sum() > 50
        assert shown[..., :3][dark].max() < TOLERANCE * wanted.image.max()


def test_an_object_far_away_in_another_unit_is_the_same(open_page, rounding):
    """Positions of a survey in millimetres; samples a millionth."""
    field = half_vector_field("kept")
    far = np.array([4.4e8, 5.5e9, 1e5])
    box = field.arrays["position_box"]
    moved = replace(
        field,
        arrays={
            **field.arrays,
            "position_box": np.append(box[:3] * 1e3 + far, box[3] * 1e3),
            "diffuse_scale": field.arrays["diffuse_scale"] * np.float32(1e-2),
            "lobe_weight_scale": field.arrays["lobe_weight_scale"] * np.float32(1e-2),
        },
    )  # fmt: skip
    camera, lights = view([4.0, -2.5, 1.5]), [rf.DirectionalLight([1.0, -0.5, 0.7])]
    pose = camera.camera_from_world.copy()
    pose[:3, 3] = pose[:3, 3] * 1e3 - pose[:3, :3] @ far
    there = replace(camera, camera_from_world=pose)
    near = drawn(open_page(object_page(field)), camera, lights)
    shown = drawn(open_page(object_page(moved)), there, lights)
    lit = (near[..., :3] > 0.05) & away_from_edges(camera, lights)[..., None]
    # Single precision of the shaders.
    tolerance = rounding(np.float32, operations=100)
    np.testing.assert_allclose(shown[..., :3][lit] * 1e6, near[..., :3][lit], tolerance)


def parallel_camera():
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    return Camera("v", "orthographic", 40, 30, 36.0, 36.0, 20.0, 15.0, pose)


@pytest.mark.parametrize("light_model", ["known", "unknown"])
@pytest.mark.parametrize("is_parallel", [True, False], ids=["parallel", "perspective"])
def test_a_plane_under_one_camera(open_page, light_model, is_parallel):
    field = planar_field(light_model)
    camera = parallel_camera() if is_parallel else rf.Camera.look_at(
        [0.2, -0.6, 1.8], width=40, height=30, fov_deg=40)  # fmt: skip
    lights = [rf.DirectionalLight([0.5, 0.3, 1.0], 2.0)]
    wanted = rf.Field(field).render(camera, lights, options=OPTIONS)
    shown = drawn(open_page(object_page(field)), camera, lights)
    inside = ndimage.binary_erosion(wanted.any(axis=2), iterations=EDGE_PX)
    assert inside.mean() > 0.2
    difference = (shown[..., :3] - wanted)[inside]
    assert relative(difference, wanted[inside]) < TOLERANCE


def test_no_seam_where_the_texture_ends(open_page):
    """The seam of the spheres' texture runs through the middle of this view."""
    field = half_vector_field("kept")
    camera, lights = view([5.0, 0.1, 0.3]), [rf.DirectionalLight([1.0, 0.2, 0.4])]
    shown = drawn(open_page(object_page(field)), camera, lights)[..., :3]
    wanted = render(field, camera, lights, OPTIONS).image
    row, columns = SIZE // 2, slice(SIZE // 4, SIZE // 2)
    assert wanted[row, columns].min() > 0
    step = TOLERANCE * wanted[row, columns].max()
    np.testing.assert_allclose(shown[row, columns], wanted[row, columns], rtol=0, atol=step)
