"""Pictures against formulas: a plane and a sphere whose radiance is known."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.lights import Light
from reflfield.errors import InputError
from reflfield.field.build import FittedReflectance, build_field
from reflfield.field.evaluation import evaluate
from reflfield.field.indirect_light import IndirectLight
from reflfield.field.texel_taps import texel_taps
from reflfield.geometry.ray_scene import RayScene
from reflfield.render.camera_rays import pixel_window
from reflfield.render.renderer import Renderer, RenderOptions, render
from tests.synthetic_fields import (
    FramedSurface,
    baked_field,
    blinn_phong,
    lambert,
    sphere_surface,
    square_surface,
)

ONE_THREAD = RenderOptions(workers=1)


def constant(value):
    """Samples that do not vary: every step of the renderer is then exact."""
    return lambda views, lights: np.full((len(views), len(lights), 3), float(value))


def overhead(size=16, pixels_per_metre=20.0, height=5.0, **changes):
    """Orthographic camera that looks down on the plane z = 0."""
    pose = looking_at([0, 0, height], [0, 0, 0], [0, 1, 0])
    centre = size / 2
    camera = Camera(
        "top",
        "orthographic",
        size,
        size,
        pixels_per_metre,
        pixels_per_metre,
        centre,
        centre,
        pose,
    )
    return replace(camera, **changes)


def perspective(position, size=32, focal=40.0, target=(0, 0, 0), up=(0, 0, 1)):
    return Camera(
        "eye", "opencv", size, size, focal, focal, size / 2, size / 2,
        looking_at(position, target, up),
    )  # fmt: skip


def lamp(position=(0.4, -0.3, 2.0), intensity=(8.0, 4.0, 2.0)):
    return Light("lamp", "point", position=position, intensity=intensity)


def sun(direction, irradiance=(1.0, 1.0, 1.0)):
    return Light("sun", "directional", direction=direction, intensity=irradiance)


def varied_field(rng, n_texels=6, **options):
    """A square whose texels all differ, in two clusters."""
    surface = square_surface(n_texels)
    n = n_texels**2
    base = lambert(np.pi)
    from reflfield.sphere.hemisphere import HemisphereGrid

    grid = HemisphereGrid(5)
    mean = base(grid.directions, grid.directions) ** (1 / 3)
    fitted = FittedReflectance(
        local_from_world=surface.base_from_world,
        cluster=rng.integers(0, 2, n),
        coefficients=rng.normal(size=(n, 2)),
        mean=np.stack([mean, 0.5 * mean]),
        basis=0.1 * rng.normal(size=(2, 2, 25, 25, 3)),
    )
    return build_field(surface, fitted, **options)


def test_lambert_plane_has_the_textbook_radiance():
    albedo = np.array([0.2, 0.5, 0.8])
    field = baked_field(square_surface(8), lambert(albedo), light_side=33)
    light = lamp()
    camera = overhead(size=17)
    image = render(field, camera, light, ONE_THREAD).image
    distance = np.linalg.norm([0.4, -0.3, 2.0])
    expected = albedo / np.pi * 2.0 / distance * np.array([8.0, 4.0, 2.0]) / distance**2
    # The irradiance varies within the pixel.
    assert np.allclose(image[8, 8], expected, rtol=3e-3)


def test_constant_reflectance_gives_the_irradiance_times_the_cosine(rounding):
    field = baked_field(square_surface(4), constant(0.25), domain="linear")
    camera, light = (
        overhead(size=9, pixels_per_metre=15.0),
        sun([0.3, 0.1, 0.5], [2.0, 3.0, 4.0]),
    )
    rendering = render(field, camera, light, ONE_THREAD)
    # int16 codes: the largest value has the largest code, so it is exact to rounding.
    tolerance = rounding(np.float32, operations=16)
    expected = 0.25 * 0.5 / np.sqrt(0.35) * np.array([2.0, 3.0, 4.0])
    assert np.abs(rendering.image - expected).max() < 4 * tolerance
    assert np.array_equal(rendering.coverage, np.ones((9, 9)))


def test_coverage_is_the_covered_share_of_a_pixel():
    # The square's edge runs through pixels: a quarter of the border pixels is covered.
    field = baked_field(square_surface(1), constant(1.0), domain="linear")
    rendering = render(
        field, overhead(size=8, pixels_per_metre=4.5), sun([0, 0, 1]), ONE_THREAD
    )
    row = rendering.coverage[4]
    assert np.array_equal(row, [0, 0.25, 1, 1, 1, 1, 0.25, 0])
    assert rendering.coverage[1, 1] == 0.0625
    # Premultiplied by coverage, over black.
    assert np.allclose(rendering.image[..., 0], rendering.coverage, atol=1e-6)


@pytest.mark.reference
def test_pictures_agree_with_a_sum_over_samples(rng):
    """Every sub-pixel sample worked out on the plane by hand, no merging."""
    field = varied_field(rng)
    camera, light = perspective([0.3, -1.2, 1.5], size=24, focal=20.0), lamp()
    image = render(field, camera, light, RenderOptions(workers=1, samples_per_pixel=9)).image
    axis = (np.arange(72) + 0.5) / 3
    x, y = np.meshgrid(axis, axis)
    origins, directions = camera.rays(np.stack([x.ravel(), y.ravel()], 1))
    points = origins - directions * (origins[:, 2] / directions[:, 2])[:, None]
    on_square = (np.abs(points[:, :2]) < 0.5).all(axis=1)
    pixel_width = np.linalg.norm(points - origins, axis=1) / 20.0
    ratio = pixel_width * np.sqrt(field.n_texels)
    transition = np.clip(np.maximum(1 - ratio, ratio / 3), 0, 1)
    texels, weights = texel_taps(field, points[:, :2] + 0.5, transition)
    values = sum(
        weights[:, [j]]
        * evaluate(
            field, texels[:, j], camera.view_directions(points), light.directions(points)
        )
        for j in range(4)
    )
    radiance = values * light.irradiance(points) * on_square[:, None]
    expected = radiance.reshape(24, 3, 24, 3, 3).mean(axis=(1, 3))
    # Merged samples use their mean position. Across a pixel, 0.08 m here, directions turn
    # by 0.05; all of a pixel's samples may fall to one texel, so the second-order error of
    # their mean is up to 3 times its square (functions linear between nodes 0.5 apart bend).
    assert np.abs(image - expected).max() < 8e-3 * expected.max()
    assert expected.max() > 0.1


def checked_square(values):
    """Field of a square whose texels have some values (n, n), row 0 at the top."""
    n = len(values)
    surface = square_surface(n)
    fitted = FittedReflectance(
        surface.base_from_world,
        np.arange(n * n),
        np.zeros((n * n, 0)),
        values.reshape(n * n, 1, 1, 1) * np.ones((n * n, 1, 1, 3)),
        np.zeros((n * n, 0, 1, 1, 3)),
        domain="linear",
    )
    return build_field(surface, fitted)


def test_texels_as_large_as_pixels_are_not_blurred(rng):
    """Seen from where it was photographed, every pixel shows its own texel."""
    values = rng.random((8, 8))
    image = render(checked_square(values), overhead(8, 8.0), sun([0, 0, 1]), ONE_THREAD).image
    # The means are stored in 16 bits.
    assert np.allclose(image[..., 0], values, atol=1e-4)


@pytest.mark.parametrize("pixels_per_metre", [29.0, 17.3, 9.1])
def test_smaller_texels_have_the_weights_of_their_areas(pixels_per_metre, rng):
    """Pixels of 1.1, 1.9 and 3.5 texels, against the areas of texels in each."""
    n, size = 32, 8
    values = rng.random((n, n))
    camera = overhead(size, pixels_per_metre)
    image = render(checked_square(values), camera, sun([0, 0, 1]), ONE_THREAD).image
    edges = n * (0.5 + (np.arange(size + 1) - size / 2) / pixels_per_metre)
    low = np.maximum(edges[:-1, None], np.arange(n))
    high = np.minimum(edges[1:, None], np.arange(1, n + 1))
    shares = np.clip(high - low, 0, None) / np.diff(edges)[:, None]
    # The means are stored in 16 bits.
    assert np.allclose(image[..., 0], shares @ values @ shares.T, atol=1e-4)


def test_texture_stands_upright():
    """A bright corner of the texture appears in the same corner of the picture."""
    surface = square_surface(4)
    cluster = np.zeros(16, int)
    cluster[surface.texel_of_pixel[0, 3]] = 1  # top right
    fitted = FittedReflectance(
        surface.base_from_world,
        cluster,
        np.zeros((16, 0)),
        np.array([0.0, 1.0]).reshape(2, 1, 1, 1) * np.ones((2, 1, 1, 3)),
        np.zeros((2, 0, 1, 1, 3)),
    )
    image = render(
        build_field(surface, fitted), overhead(8, 8.0), sun([0, 0, 1]), ONE_THREAD
    ).image
    assert np.unravel_index(np.argmax(image[..., 0]), (8, 8)) == (0, 7)
    assert not image[4:, :4].any()


def test_linear_in_the_lights(rng, rounding):
    field = varied_field(rng)
    camera, first, second = perspective([1, 1, 2]), lamp(), sun([0.2, 0.5, 1.0])
    renderer = Renderer(field, ONE_THREAD)
    both = renderer.render(camera, [first, second]).image
    alone = [renderer.render(camera, light).image for light in (first, second)]
    assert np.abs(both - sum(alone)).max() < rounding(np.float32, scale=both.max())
    # A frame with several lights names them as one group.
    group = Light("both", "group", members=(first, second))
    assert np.array_equal(renderer.render(camera, group).image, both)
    double = renderer.render(camera, replace(first, intensity=2 * first.intensity)).image
    assert np.abs(double - 2 * alone[0]).max() < rounding(np.float32, scale=double.max())
    assert not renderer.render(camera, []).image.any()


def test_spot_lights_only_inside_their_cone():
    field = baked_field(square_surface(2), constant(1.0), domain="linear")
    spot = Light(
        "spot", "spot", position=[0, 0, 1], direction=[0, 0, -1], intensity=[1, 1, 1],
        cone_angle=0.2, falloff_angle=0.2,
    )  # fmt: skip
    image = render(field, overhead(15, 15.0), spot, ONE_THREAD).image[..., 0]
    # The mean over a pixel of 1/15 m, of 1 / r^3, is .0011 less; shaded by texels .00001.
    assert image[7, 7] == pytest.approx(1.0, rel=1e-3)
    assert not image[0].any()


@pytest.mark.parametrize("visibility", ["kept", "factored"])
def test_blocks_and_threads_do_not_matter(visibility):
    field = baked_field(sphere_surface(12), blinn_phong(0.5, 0.5, 20.0), visibility=visibility)
    camera, lights = perspective([0, -4, 1], size=40), [lamp([3, -3, 3]), sun([1, 0, 0])]
    pictures = [
        render(field, camera, lights, RenderOptions(block_pixels=block, workers=workers)).image
        for block, workers in [(4096, 1), (64, 3), (1, 2)]
    ]
    assert np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[0], pictures[2])


def test_sphere_is_brightest_at_the_half_vector():
    field = baked_field(
        sphere_surface(64), blinn_phong(0.0, 1.0, 200.0), view_side=25, light_side=25
    )
    camera, direction = (
        perspective([0, -6, 0], size=65, focal=180.0),
        np.array([1.0, -1.0, 0.5]),
    )
    image = render(field, camera, sun(direction), ONE_THREAD).image[..., 0]
    half = direction / 1.5 + [0, -1, 0]
    half /= np.linalg.norm(half)
    expected, _ = camera.project(half[None])
    weight = np.where(image > 0.5 * image.max(), image, 0)
    row, column = np.mgrid[:65, :65] + 0.5
    centroid = [(weight * c).sum() / weight.sum() for c in (column, row)]
    # The falling cosine of the light shifts the lobe's centroid by about a pixel.
    assert np.abs(centroid - expected[0]).max() < 2.0


def two_squares(visibility):
    """A floor of size 2 at z = 0 and a roof of size 0.6 at z = 1 above its centre."""
    floor, roof = square_surface(1, 2.0), square_surface(1, 0.6)
    texture = np.zeros((8, 16), int)
    texture[:, 8:] = 1
    surface = FramedSurface(
        positions=np.concatenate([floor.positions, np.add(roof.positions, [0, 0, 1.0])]),
        faces=np.concatenate([floor.faces, roof.faces + 4]),
        uv=np.concatenate([floor.uv * [0.5, 1], roof.uv * [0.5, 1] + [0.5, 0]]),
        texel_of_pixel=texture,
        base_from_world=np.tile(np.eye(3), (2, 1, 1)),
    )
    return baked_field(surface, constant(1.0), domain="linear", visibility=visibility)


def floor_radiance(field, light, point):
    """Radiance of one point of the floor, seen from the side below the roof."""
    camera = perspective(
        [point[0], point[1] - 3.0, 0.8], size=3, focal=3000.0, target=(*point, 0)
    )
    return render(field, camera, light, ONE_THREAD).image[1, 1, 0]


def test_shadows_are_traced_where_they_were_factored_out(rounding):
    above, taps = sun([0, 0, 1]), rounding(np.float32, operations=8)
    assert floor_radiance(two_squares("kept"), above, (0, 0)) == pytest.approx(1, rel=taps)
    factored = two_squares("factored")
    assert floor_radiance(factored, above, (0, 0)) == 0
    assert floor_radiance(factored, above, (0.5, 0.5)) == pytest.approx(1, rel=taps)
    # Slanted light moves the shadow by a metre.
    assert floor_radiance(factored, sun([-0.7, 0, 1]), (0.7, 0)) == 0
    cosine = 1 / np.sqrt(1.49)
    lit = floor_radiance(factored, sun([-0.7, 0, 1]), (0, 0))
    assert lit == pytest.approx(cosine, rel=taps)


def test_a_lamp_below_the_roof_is_not_shadowed_by_it(rounding):
    factored = two_squares("factored")
    assert floor_radiance(factored, lamp([0, 0, 2], [4, 4, 4]), (0, 0)) == 0
    lit = floor_radiance(factored, lamp([0, 0, 0.5], [1, 1, 1]), (0, 0))
    # A pixel is a millimetre wide, which takes 1.5 (.0005 / .5)^2.
    assert lit == pytest.approx(4, rel=1.5e-6 + rounding(np.float32, operations=8))


def test_unknown_lighting_is_shown_as_it_was(rounding):
    field = baked_field(
        square_surface(2), constant(0.3), light_side=1, domain="linear", light_model="unknown",
        visibility="factored",
    )  # fmt: skip
    camera, unknown = overhead(), Light("room", "unknown")
    image = render(field, camera, unknown, ONE_THREAD).image
    np.testing.assert_allclose(image, 0.3, rtol=rounding(np.float32, operations=8))
    # Nothing is known of its answer to other lights, so these do not change it.
    assert np.array_equal(render(field, camera, [lamp(), lamp()], ONE_THREAD).image, image)


def test_unknown_lights_are_refused_where_lights_were_known():
    field = baked_field(square_surface(2), constant(0.3))
    with pytest.raises(InputError, match="light 'room': expected a known light"):
        render(field, overhead(), Light("room", "unknown"))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"samples_per_pixel": 5}, "samples_per_pixel: expected a square number"),
        ({"samples_per_pixel": 0}, "samples_per_pixel: expected 1 to 4096"),
        ({"block_pixels": 0}, "block_pixels"),
        ({"workers": -1}, "workers"),
        ({"ray_offset": float("nan")}, "ray_offset"),
    ],
)
def test_bad_options_are_refused(change, text):
    with pytest.raises(InputError, match=text):
        RenderOptions(**change)


@pytest.mark.stability
@pytest.mark.parametrize("samples", [lambert(0.0), lambert(1e12), lambert(1e-12)])
def test_zero_and_extreme_fields_stay_finite(samples):
    field = baked_field(sphere_surface(8), samples)
    image = render(field, perspective([0, -4, 0]), lamp([0, -3, 1]), ONE_THREAD).image
    assert np.isfinite(image).all()
    assert (image >= 0).all()


@pytest.mark.stability
@pytest.mark.parametrize("height", [1e-9, 1e-3, 0.0, -1.0])
def test_grazing_and_reversed_planes_are_finite(height):
    field = baked_field(square_surface(2), constant(1.0), domain="linear")
    camera = perspective([0.0, -2.0, height])
    rendering = render(field, camera, lamp(), ONE_THREAD)
    assert np.isfinite(rendering.image).all()
    if height < 0:  # the inside of an open surface covers, and is black
        assert rendering.coverage.max() == 1
        assert not rendering.image.any()


@pytest.mark.stability
def test_pixels_without_texels_are_black_but_covered(rounding):
    surface = square_surface(4)
    absent = replace(surface, texel_of_pixel=np.where(surface.texel_of_pixel < 8, -1, 3))
    field = baked_field(absent, constant(1.0), domain="linear")
    rendering = render(field, overhead(8, 8.0), sun([0, 0, 1]), ONE_THREAD)
    assert np.array_equal(rendering.coverage, np.ones((8, 8)))
    # Rows 0 and 1 of the texture are absent; below them the rest is read undimmed.
    assert not rendering.image[:3].any()
    np.testing.assert_allclose(rendering.image[4:], 1, rtol=rounding(np.float32, operations=8))


@pytest.mark.stability
@pytest.mark.parametrize("pose", ["inside", "away"])
def test_cameras_that_see_nothing_useful(pose):
    field = baked_field(sphere_surface(8), lambert(0.5))
    away = perspective([0, -4, 0], target=(0, -8, 0))
    camera = away if pose == "away" else perspective([0, 0, 0], target=(1, 0, 0))
    rendering = render(field, camera, lamp(), ONE_THREAD)
    assert not rendering.image.any()
    assert rendering.coverage.max() == (0 if pose == "away" else 1)


def test_window_holds_all_of_the_mesh():
    field = baked_field(sphere_surface(16), lambert(0.5))
    camera = replace(
        perspective([0, -4, 0], size=64, focal=60.0), distortion=(-0.2, 0, 0, 0, 0, 0)
    )
    renderer = Renderer(field, ONE_THREAD)
    first_row, end_row, first_column, end_column = pixel_window(camera, renderer.surface.mesh)
    assert 0 < first_row < end_row < 64
    centres = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5), axis=-1)
    origins, directions = camera.rays(centres.reshape(-1, 2))
    hit = np.zeros(64 * 64, bool)
    hit[renderer.surface.first_hits(origins, directions).ray] = True
    rows, columns = np.nonzero(hit.reshape(64, 64))
    assert first_row <= rows.min()
    assert rows.max() < end_row
    assert first_column <= columns.min()
    assert columns.max() < end_column


def test_shadows_show_indirect_light(rounding):
    """A square lit from behind: no light reaches what the camera sees."""
    surface = square_surface(4)
    fit = FittedReflectance(
        local_from_world=surface.base_from_world,
        cluster=np.zeros(16, int),
        coefficients=np.zeros((16, 0)),
        mean=np.ones((1, 1, 1, 3)),
        basis=np.zeros((1, 0, 1, 1, 3)),
        # Y_00 = 1 / (2 sqrt(pi)): transformed .5 for red, .2 for blue.
        indirect=IndirectLight(
            np.array([[[1.0, 0.0, 0.4]]], np.float32) * np.float32(np.sqrt(np.pi)),
            np.zeros((16, 0), np.float32),
        ),
    )
    traced, kept = (
        build_field(surface, fit, visibility=visibility) for visibility in ("factored", "kept")
    )
    behind, camera = sun([0.0, 0.6, -0.8], [2.0, 2.0, 2.0]), overhead(size=9)
    expected = np.broadcast_to([2 * 0.5**3, 0.0, 2 * 0.2**3], (9, 9, 3))
    # The function, its coefficient and the light, cubed.
    cubed = rounding(np.float32, operations=3, condition=3)
    np.testing.assert_allclose(
        render(traced, camera, behind, ONE_THREAD).image, expected, rtol=cubed
    )
    # From the front everything is lit, and shadows that are in the data are not lit again.
    front = sun([0.0, 0.6, 0.8])
    pictures = [render(f, camera, front, ONE_THREAD).image for f in (traced, kept)]
    np.testing.assert_array_equal(*pictures)
    np.testing.assert_allclose(pictures[0], 1.0, rtol=rounding(np.float32, operations=8))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"samples_per_pixel": 10**10}, "samples_per_pixel: expected 1 to 4096, received 1000"),
        ({"environment_directions": 10**6}, "environment_directions: expected 1 to 16384"),
        ({"block_pixels": 10**9}, "block_pixels: expected 1 to 1048576"),
        ({"workers": 10**9}, "workers: expected 0 to 1024"),
        ({"ray_offset": 1e300}, "ray_offset: expected 0.0 to 0.1"),
    ],
)
def test_numbers_beyond_any_use_are_refused(change, text):
    with pytest.raises(InputError, match=text):
        RenderOptions(**change)


def test_a_block_traces_with_the_thread_that_it_has(monkeypatch):
    """Threads of blocks times threads of queries would be their square."""
    asked = []

    class Scene(RayScene):
        def __init__(self, mesh, threads=0):
            asked.append(threads)
            super().__init__(mesh, threads)

    monkeypatch.setattr("reflfield.render.camera_rays.RayScene", Scene)
    Renderer(baked_field(square_surface(2), constant(0.3)), RenderOptions(workers=7))
    assert asked == [1]
