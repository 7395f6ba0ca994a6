"""Environment maps: where their pixels lie, what they send in all, what that lights."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.capture.color_spaces import luminance
from reflfield.capture.image_writing import write_exr
from reflfield.capture.lights import Light
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError, InputError, ShapeError
from reflfield.geometry.mesh import read_ply
from reflfield.render.environment_map import EnvironmentMap, direction_from_uv
from reflfield.render.renderer import Renderer, RenderOptions, render
from reflfield.render.turntable import OrbitOptions, orbit_cameras
from reflfield.sphere.rotations import frames_from_normals
from tests.synthetic_fields import (
    FramedSurface,
    baked_field,
    lambert,
    sphere_surface,
    square_surface,
)

# Image coordinates (u, v down) and the axis they show, by the formulas of the formats.
AXES = {
    "openexr": {
        (0.25, 0.5): (1, 0, 0), (0.5, 0.5): (0, 0, 1), (0.75, 0.5): (-1, 0, 0),
        (0.0, 0.5): (0, 0, -1), (0.3, 0.0): (0, 1, 0), (0.3, 1.0): (0, -1, 0),
    },
    "blender": {
        (0.5, 0.5): (1, 0, 0), (0.25, 0.5): (0, 1, 0), (0.75, 0.5): (0, -1, 0),
        (0.0, 0.5): (-1, 0, 0), (0.3, 0.0): (0, 0, 1), (0.3, 1.0): (0, 0, -1),
    },
}  # fmt: skip
AXES["mitsuba"] = AXES["openexr"]


def random_map(rng, height=16, convention="openexr"):
    radiance = rng.gamma(0.3, size=(height, 2 * height, 3)).astype(np.float32)
    return EnvironmentMap(radiance, convention, np.eye(3))


def irradiance(directions, irradiances, normals):
    return np.maximum(normals @ directions.T, 0) @ irradiances


@pytest.mark.parametrize("convention", AXES)
def test_axes_lie_where_the_formats_say(convention, rounding):
    for (u, v), axis in AXES[convention].items():
        direction = direction_from_uv(u, v, convention)
        np.testing.assert_allclose(direction, axis, rtol=0, atol=rounding(float))


@pytest.mark.parametrize("convention", AXES)
def test_a_bright_pixel_lights_the_side_it_should(convention):
    for (u, v), axis in AXES[convention].items():
        radiance = np.zeros((32, 64, 3), np.float32)
        radiance[min(int(v * 32), 31), int(u * 64)] = 5.0
        sky = EnvironmentMap(radiance, convention, np.eye(3))
        lights = sky.quantise(4)
        assert len(lights) == 1
        # Half a pixel along each axis: 0.5 * pi / 32 * sqrt(2) = 0.07 rad.
        assert lights.directions[0] @ axis > np.cos(0.0695)
        field = baked_field(sphere_surface(16), lambert(1.0))
        renderer = Renderer(field, RenderOptions(workers=1, samples_per_pixel=1))
        (camera,) = orbit_cameras(field.positions, OrbitOptions(n_images=1, size=1, up=axis))
        sources = renderer._sources(sky)
        values = sources[0].radiance(camera, np.arange(field.n_texels, dtype=np.int32))[:, 0]
        brightest = field.local_from_world[np.argmax(values), 2]
        assert brightest @ axis > 0.95


def test_rotation_turns_the_map_into_the_world():
    radiance = np.zeros((16, 32, 3), np.float32)
    radiance[0] = 1.0  # zenith, +Y of the map
    world_z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    sky = EnvironmentMap(radiance, "openexr", world_z_up)
    assert sky.quantise(1).directions[0] @ [0, 0, 1] > 0.9999


# World's up to where the centre of the image and what is a quarter of the image to its left
# are seen, by hand: the zenith goes to `up` by the shortest way, half a turn about X if that
# is down.
UPRIGHT = {
    ("openexr", (0, 1, 0)): ((0, 0, 1), (1, 0, 0)),
    ("openexr", (0, 0, 1)): ((0, -1, 0), (1, 0, 0)),
    ("openexr", (1, 0, 0)): ((0, 0, 1), (0, -1, 0)),
    ("openexr", (0, -1, 0)): ((0, 0, -1), (1, 0, 0)),
    ("openexr", (0, 0, -1)): ((0, 1, 0), (1, 0, 0)),
    ("blender", (0, 0, 1)): ((1, 0, 0), (0, 1, 0)),
    ("blender", (0, 1, 0)): ((1, 0, 0), (0, 0, -1)),
    ("blender", (0, 0, -1)): ((1, 0, 0), (0, -1, 0)),
}
UPRIGHT |= {("mitsuba", up): seen for (name, up), seen in UPRIGHT.items() if name == "openexr"}


def one_pixel(u, v, convention, height=32):
    """A map with one bright pixel: its centre is half a pixel beside (u, v)."""
    radiance = np.zeros((height, 2 * height, 3), np.float32)
    radiance[min(int(v * height), height - 1), int(u * 2 * height)] = 5.0
    return EnvironmentMap(radiance, convention)


@pytest.mark.parametrize(("convention", "up"), UPRIGHT)
def test_a_map_stands_upright_in_the_world_of_the_field(convention, up):
    """Through the renderer: the light of one bright pixel arrives where it should."""
    field = baked_field(sphere_surface(4), lambert(1.0))
    field.metadata["up"] = up
    renderer = Renderer(field, RenderOptions(workers=1))
    centre, left = UPRIGHT[convention, up]
    for (u, v), axis in (((0.5, 0.5), centre), ((0.25, 0.5), left), ((0.5, 0.0), up)):
        source = renderer._sources(one_pixel(u, v, convention))[0]
        # Half a pixel along each axis: 0.5 * pi / 32 * sqrt(2) = 0.07 rad.
        assert source._lights.directions[0] @ np.array(axis) > np.cos(0.0695)


def test_rotation_turns_the_map_to_the_left_seen_from_above(rounding):
    """Independent of the map's code: SciPy's rotation about the up axis, of an oblique one."""
    up = np.array([1.0, 2.0, -2.0])
    sky = one_pixel(0.4, 0.3, "openexr")
    at_rest = sky.turned_to(up).quantise(1).directions[0]
    turned = sky.turned_to(up, 30.0).quantise(1).directions[0]
    expected = Rotation.from_rotvec(np.radians(30) * up / 3).apply(at_rest)
    tolerance = rounding(float, operations=9)
    np.testing.assert_allclose(turned, expected, rtol=0, atol=tolerance)
    # Elevation: row 9 of 32 is 9.5 / 32 * 180 = 53.4 degrees from the zenith.
    assert turned @ up / 3 == pytest.approx(np.cos(np.pi * 9.5 / 32), abs=tolerance)


def test_an_environment_of_a_capture_stays_as_described(tmp_path):
    """Of a capture the frame is stated: the map's +Y is the world's whatever is up."""
    write_exr(tmp_path / "sky.exr", one_pixel(0.3, 0.0, "openexr").radiance)
    field = baked_field(sphere_surface(4), lambert(1.0))
    light = Light("sky", "environment", file=tmp_path / "sky.exr")
    source = Renderer(field, RenderOptions(workers=1))._sources(light)[0]
    assert source._lights.directions[0] @ [0, 1, 0] > np.cos(0.0695)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([1.0, -1.0, 1.0]), r"mirror image \(determinant -1\)"),
        (2 * np.eye(3), "scale or shear"),
        (np.array([[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "scale or shear"),
        (np.full((3, 3), np.nan), "not finite"),
        (np.eye(4), r"shape \(4, 4\)"),
    ],
)
def test_matrices_that_do_not_turn_are_refused(matrix, words):
    black = np.zeros((4, 8, 3), np.float32)
    with pytest.raises(InputError, match=f"world_from_environment: .*{words}"):
        EnvironmentMap(black, "openexr", matrix)
    with pytest.raises(CaptureError, match=f"light 'a': world_from_environment: .*{words}"):
        Light("a", "environment", file=Path("a.exr"), world_from_environment=matrix)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((64, 64), "a square: an angular map .light probe., a mirror ball"),
        ((64, 48), "a vertical cross of a cube map"),
        ((48, 64), "a horizontal cross of a cube map"),
        ((8, 48), "a horizontal strip of the six faces"),
        ((48, 8), "a vertical strip of the six faces"),
        ((16, 64), "one hemisphere"),
        ((32, 56), "56 x 32 pixels; convert it"),
    ],
)
def test_other_layouts_are_refused_by_name(tmp_path, shape, words):
    path = tmp_path / "sky.exr"
    write_exr(path, np.ones((*shape, 3), np.float32))
    with pytest.raises(InputError, match=rf"sky\.exr: expected a latitude-longitude.*{words}"):
        EnvironmentMap.open(path)


def test_maps_a_pixel_off_twice_their_height_are_read(tmp_path):
    write_exr(tmp_path / "sky.exr", np.ones((32, 63, 3), np.float32))
    total = EnvironmentMap.open(tmp_path / "sky.exr").quantise(9).irradiances.sum(axis=0)
    assert np.allclose(total, 4 * np.pi)


def test_negative_values_and_black_maps_are_said(tmp_path, caplog):
    radiance = np.zeros((4, 8, 3), np.float32)
    write_exr(tmp_path / "black.exr", radiance)
    EnvironmentMap.open(tmp_path / "black.exr")
    assert "black.exr: the map is black" in caplog.text
    radiance[1, 2] = (1.0, -0.25, 1.0)
    write_exr(tmp_path / "odd.exr", radiance)
    lights = EnvironmentMap.open(tmp_path / "odd.exr").quantise(4)
    assert "odd.exr: 1 pixels of the map are negative (down to -0.25)" in caplog.text
    assert lights.irradiances[0, 1] == 0
    assert lights.irradiances[0, 0] > 0


def test_transparent_pixels_are_said(tmp_path, caplog):
    """As of the sky in a picture that was rendered without it."""
    radiance = np.ones((4, 8, 4), np.float32)
    write_exr(tmp_path / "sky.exr", radiance, list("RGBA"))
    EnvironmentMap.open(tmp_path / "sky.exr")
    assert caplog.text == ""
    radiance[:2, :, 3] = 0
    radiance[2, 0, 3] = 0.5
    write_exr(tmp_path / "half.exr", radiance, list("RGBA"))
    EnvironmentMap.open(tmp_path / "half.exr")
    assert "half.exr: 17 pixels of the map are not opaque, 16 of them" in caplog.text


@pytest.mark.parametrize("height", [1, 2, 3, 8])
def test_pixels_of_coarse_maps_light_from_all_of_their_area(height):
    """One row would light from the horizon alone."""
    lights = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32)).quantise(256)
    for normal in np.vstack([np.eye(3), -np.eye(3)]):
        sent = irradiance(lights.directions, lights.irradiances, normal[None])
        # Rows of 11 degrees are off by 0.8 %.
        np.testing.assert_allclose(sent, np.pi, rtol=0.01)


def test_solid_angles_fill_the_sphere(rounding):
    sky = EnvironmentMap(np.ones((33, 66, 3), np.float32))
    total = sky.solid_angles.sum() * 66
    assert abs(total - 4 * np.pi) < rounding(np.float64, operations=33, scale=4 * np.pi)


@pytest.mark.parametrize("height", [1, 5, 16, 150])
@pytest.mark.parametrize("n_lights", [1, 7, 200])
def test_energy_is_kept_in_every_channel(height, n_lights, rng, rounding):
    sky = random_map(rng, height)
    expected = (sky.radiance * sky.solid_angles[:, None, None]).sum(axis=(0, 1))
    lights = sky.quantise(n_lights)
    assert len(lights) <= n_lights
    tolerance = rounding(np.float64, operations=1000, scale=expected.max())
    assert np.abs(lights.irradiances.sum(axis=0) - expected).max() < tolerance
    assert np.allclose(np.linalg.norm(lights.directions, axis=1), 1)


def test_irradiance_converges_to_the_full_sum(rng):
    sky = random_map(rng, 32)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = (sky.radiance * sky.solid_angles[:, None, None]).reshape(-1, 3)
    full = irradiance(sky.directions.reshape(-1, 3), weights, normals)

    def error(n_lights):
        lights = sky.quantise(n_lights)
        sent = irradiance(lights.directions, lights.irradiances, normals)
        return np.sqrt(np.mean((sent / full - 1) ** 2))

    # A cosine is lower in the mean over a cell, a disc of 4 pi / n, by its curvature: 1 / n. In
    # cells that the horizon cuts it is higher, in the mean over all by 2 / n.
    for n_lights in (32, 128, 512):
        assert error(n_lights) < 3 / n_lights


def test_a_small_sun_gets_a_light_of_its_own(rng):
    sky = random_map(rng, 64)
    sky.radiance[20, 30] = 1e5
    lights = sky.quantise(64)
    strongest = np.argmax(lights.irradiances.sum(axis=1))
    assert lights.directions[strongest] @ sky.directions[20, 30] > np.cos(0.01)


def test_large_maps_are_reduced_first_without_loss(rng, rounding):
    sky = random_map(rng, 300)
    lights = sky.quantise(100)
    expected = (sky.radiance * sky.solid_angles[:, None, None]).sum(axis=(0, 1))
    # Roundings of 300 x 600 additions wander as the root of their number.
    sums = rounding(float, operations=np.sqrt(300 * 600))
    np.testing.assert_allclose(lights.irradiances.sum(axis=0), expected, rtol=sums)


def test_black_maps_send_nothing():
    lights = EnvironmentMap(np.zeros((4, 8, 3), np.float32)).quantise(10)
    assert not lights.irradiances.any()
    assert np.isfinite(lights.directions).all()


@pytest.mark.parametrize("visibility", ["kept", "factored"])
def test_white_furnace(visibility):
    albedo = np.array([0.3, 0.6, 1.0])
    field = baked_field(
        sphere_surface(24), lambert(albedo), view_side=2, light_side=33, domain="linear",
        visibility=visibility,
    )  # fmt: skip
    sky = EnvironmentMap(np.full((32, 64, 3), 2.0, np.float32))
    (camera,) = orbit_cameras(field.positions, OrbitOptions(n_images=1, size=32))
    rendering = render(field, camera, sky, RenderOptions(workers=2, samples_per_pixel=4))
    inside = rendering.coverage == 1
    share = rendering.image[inside] / (2.0 * albedo)
    # 512 lights; the hat functions of 33 x 33 nodes; in the frame of a flat triangle the
    # horizon of a texel is off by up to 4 degrees, which holds 0.25 % of the cosine.
    assert np.abs(share.mean() - 1) < 5e-3
    assert np.abs(share - 1).max() < 0.03


def test_map_equals_its_lights_one_by_one(rng, rounding):
    """A parallel view of a plane: texel by texel and pixel by pixel are the same then."""
    from reflfield.capture.cameras import Camera, looking_at

    field = baked_field(square_surface(4), lambert(0.7), light_side=5)
    pose = looking_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    camera = Camera("top", "orthographic", 8, 8, 7.0, 7.0, 4.0, 4.0, pose)
    sky = random_map(rng, 8)
    options = RenderOptions(workers=1, environment_directions=20)
    lights = sky.quantise(20)
    suns = [
        Light(f"sun{i}", "directional", direction=d, intensity=e)
        for i, (d, e) in enumerate(zip(lights.directions, lights.irradiances, strict=True))
    ]
    by_map = render(field, camera, sky, options).image
    one_by_one = render(field, camera, suns, options).image
    # Twenty lights, each with 16 taps.
    sums = rounding(np.float32, operations=20 + 16, scale=one_by_one.max())
    np.testing.assert_allclose(by_map, one_by_one, rtol=0, atol=sums)
    assert by_map.max() > 0.1


def test_traced_shadows_do_not_depend_on_order(rng):
    field = baked_field(sphere_surface(12), lambert(0.7), visibility="factored", light_side=5)
    sky, options = random_map(rng, 8), RenderOptions(workers=2, environment_directions=30)
    cameras = orbit_cameras(field.positions, OrbitOptions(n_images=3, size=24))
    forward, backward = Renderer(field, options), Renderer(field, options)
    pictures = [forward.render(camera, sky).image for camera in cameras]
    again = [backward.render(camera, sky).image for camera in reversed(cameras)]
    for first, second in zip(pictures, reversed(again), strict=True):
        assert np.array_equal(first, second)


def test_light_of_a_capture_names_its_map(tmp_path):
    radiance = np.zeros((16, 32, 3), np.float32)
    radiance[0] = 1.0
    write_exr(tmp_path / "sky.exr", radiance)
    light = Light("sky", "environment", file=tmp_path / "sky.exr", convention="blender")
    field = baked_field(sphere_surface(8), lambert(1.0))
    (camera,) = orbit_cameras(field.positions, OrbitOptions(n_images=1, size=24))
    image = render(field, camera, light, RenderOptions(workers=1)).image
    assert image[:10].sum() > 3 * image[14:].sum()


@pytest.mark.reference
def test_mitsuba_reads_the_map_the_same_way(rng):
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    slopes = np.array([1.0, 0.5, -0.7])
    blank = EnvironmentMap(np.zeros((32, 64, 3), np.float32), "mitsuba")
    smooth = np.repeat((2 + blank.directions @ slopes)[..., None], 3, axis=2)
    bitmap = mitsuba.Bitmap(smooth.astype(np.float32))
    emitter = mitsuba.load_dict({"type": "envmap", "bitmap": bitmap})
    interaction = mitsuba.SurfaceInteraction3f()
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # A band of three degrees to both sides of the horizon, however high they were.
    level = np.linalg.norm(directions[100:, ::2], axis=1)
    directions[100:, 1] *= 0.05 * level
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def seen(direction):
        interaction.wi = [float(x) for x in -direction]  # from the sky to us
        return np.array(emitter.eval(interaction)).ravel()[0]

    error = np.abs([seen(d) for d in directions] - (2 + directions @ slopes))
    # Mitsuba 3.9 puts the first and last rows' centres on the poles, half a row off ours
    # (pi / 64 times the slope, 0.065); of that a thirtieth is left three degrees from the
    # horizon, .002, and as much of the interpolation over pi / 32.
    assert error[:100].max() < 0.065
    assert error[100:].max() < 0.006


def face_surface(mesh):
    """One texel for each face: a speck of UV around the centre of its own pixel."""
    n = len(mesh.faces)
    width = int(np.ceil(np.sqrt(n)))
    row, column = np.divmod(np.arange(n), width)
    centre = np.stack([(column + 0.5) / width, 1 - (row + 0.5) / width], axis=1)
    speck = np.array([[-1, -1], [1, -1], [0, 1]]) * 0.01 / width
    texel_of_pixel = np.full(width**2, -1)
    texel_of_pixel[:n] = np.arange(n)
    return FramedSurface(
        positions=mesh.corners.reshape(-1, 3),
        faces=np.arange(3 * n).reshape(n, 3),
        uv=(centre[:, None] + speck).reshape(-1, 2),
        texel_of_pixel=texel_of_pixel.reshape(width, width),
        base_from_world=frames_from_normals(mesh.face_normals, mesh.face_normals),
    )


@pytest.mark.reference
def test_maps_light_an_independent_picture_from_the_same_side(shared_data):
    """Mitsuba's picture of a textured cow: of all orientations, the stated one fits best."""
    truth = shared_data("mitsuba_spot") / "truth"
    frames = open_capture(truth / "relit.json")
    photograph = frames.photographs[0]
    camera, light = frames.cameras[photograph.camera], frames.lights[photograph.light]
    wanted = luminance(frames.read_photograph(0))
    surface = face_surface(read_ply(truth / "mesh.ply"))
    field = baked_field(
        surface,
        lambert(0.5),
        view_side=2,
        light_side=11,
        domain="linear",
        visibility="factored",
    )
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    rotations = {
        "stated": np.eye(3), "quarter turn": turn, "half turn": turn @ turn,
        "three quarters": turn.T,
        "+Z up": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    }  # fmt: skip
    renderer = Renderer(field, RenderOptions(samples_per_pixel=1, environment_directions=60))

    stated = EnvironmentMap.open(light.file, light.convention, np.eye(3))

    def likeness(sky):
        rendering = renderer.render(camera, sky)
        inside = rendering.coverage == 1
        logs = [np.log(x[inside] + 1e-3) for x in (luminance(rendering.image), wanted)]
        return np.corrcoef(*logs)[0, 1]

    skies = {n: replace(stated, world_from_environment=r) for n, r in rotations.items()}
    skies["mirrored"] = replace(stated, radiance=stated.radiance[:, ::-1])
    scores = {name: likeness(sky) for name, sky in skies.items()}
    assert max(scores, key=scores.get) == "stated", scores


def test_bad_maps_are_refused(tmp_path):
    good = np.ones((4, 8, 3), np.float32)
    with pytest.raises(InputError, match="convention: expected one of"):
        EnvironmentMap(good, "unity")
    with pytest.raises(ShapeError, match="radiance"):
        EnvironmentMap(good[..., 0])
    with pytest.raises(InputError, match=r"radiance: .* finite radiance, received 32 pixels"):
        EnvironmentMap(np.full_like(good, np.nan))
    with pytest.raises(InputError, match="n_lights"):
        EnvironmentMap(good).quantise(0)
    with pytest.raises(CaptureError, match=r"none\.exr"):
        EnvironmentMap.open(tmp_path / "none.exr")
    with pytest.raises(InputError, match="light 'a': expected an environment"):
        EnvironmentMap.of_light(Light("a", "directional"))


def test_radiance_hdr_maps_are_read(tmp_path):
    """Flat RGBE pixels, by the format: value (m + 1/2 or m) / 256 * 2 ** (e - 128)."""
    pixels = np.zeros((4, 8, 4), np.uint8)
    pixels[...] = (64, 128, 32, 130)  # mantissas over 256, times 4
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n"
    (tmp_path / "sky.hdr").write_bytes(head + pixels.tobytes())
    total = EnvironmentMap.open(tmp_path / "sky.hdr").quantise(4).irradiances.sum(axis=0)
    # Half a step of the smallest mantissa.
    assert np.allclose(total, 4 * np.pi * np.array([1.0, 2.0, 0.5]), rtol=0.5 / 32 + 1e-6)


def test_infinity_is_spoken_of_as_a_maps(tmp_path):
    radiance = np.ones((4, 8, 3), np.float32)
    radiance[1, 2] = np.inf
    write_exr(tmp_path / "sky.exr", radiance)
    with pytest.raises(CaptureError, match=r"sky\.exr: .*1 pixels.*repair or drop this env"):
        EnvironmentMap.open(tmp_path / "sky.exr")
