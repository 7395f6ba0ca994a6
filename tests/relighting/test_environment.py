"""Environment maps: where their pixels lie, what they send in all, what that lights."""

import numpy as np
import pytest

from reflfield.capture.images import write_exr
from reflfield.capture.lights import Light
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError, InputError, ShapeError
from reflfield.field.synthetic import (
    FramedSurface,
    baked_field,
    lambert,
    sphere_surface,
    square_surface,
)
from reflfield.geometry.mesh import read_ply
from reflfield.relighting.environment import EnvironmentMap, direction_from_uv
from reflfield.relighting.exposure import luminance
from reflfield.relighting.orbit import OrbitOptions, orbit_cameras
from reflfield.relighting.renderer import Renderer, RenderOptions, render
from reflfield.sphere.rotations import frames_from_normals

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
    return EnvironmentMap(radiance, convention)


def irradiance(directions, irradiances, normals):
    return np.maximum(normals @ directions.T, 0) @ irradiances


@pytest.mark.parametrize("convention", AXES)
def test_axes_lie_where_the_formats_say(convention):
    for (u, v), axis in AXES[convention].items():
        assert np.allclose(direction_from_uv(u, v, convention), axis, atol=1e-12)


@pytest.mark.parametrize("convention", AXES)
def test_a_bright_pixel_lights_the_side_it_should(convention):
    for (u, v), axis in AXES[convention].items():
        radiance = np.zeros((32, 64, 3), np.float32)
        radiance[min(int(v * 32), 31), int(u * 64)] = 5.0
        lights = EnvironmentMap(radiance, convention).quantise(4)
        assert len(lights) == 1
        # Half a pixel along each axis: 0.5 * pi / 32 * sqrt(2) = 0.07 rad.
        assert lights.directions[0] @ axis > np.cos(0.0695)
        field = baked_field(sphere_surface(16), lambert(1.0))
        renderer = Renderer(field, RenderOptions(workers=1, samples_per_pixel=1))
        (camera,) = orbit_cameras(field.positions, OrbitOptions(n_frames=1, size=1, up=axis))
        sources = renderer._sources(EnvironmentMap(radiance, convention))
        values = sources[0].radiance(camera, np.arange(field.n_texels, dtype=np.int32))[:, 0]
        brightest = field.local_from_world[np.argmax(values), 2]
        assert brightest @ axis > 0.95


def test_rotation_turns_the_map_into_the_world():
    radiance = np.zeros((16, 32, 3), np.float32)
    radiance[0] = 1.0  # zenith, +Y of the map
    world_z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    sky = EnvironmentMap(radiance, "openexr", world_z_up)
    assert sky.quantise(1).directions[0] @ [0, 0, 1] > 0.9999


def test_solid_angles_fill_the_sphere(rounding):
    sky = EnvironmentMap(np.ones((33, 50, 3), np.float32))
    total = sky.solid_angles.sum() * 50
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
        return np.abs(sent / full - 1).max()

    # Cells shrink like 1/sqrt(n) and the error with their area: measured 0.003 at 512.
    assert error(512) < 0.01
    assert error(512) < error(32)


def test_a_small_sun_gets_a_light_of_its_own(rng):
    sky = random_map(rng, 64)
    sky.radiance[20, 30] = 1e5
    lights = sky.quantise(64)
    strongest = np.argmax(lights.irradiances.sum(axis=1))
    assert lights.directions[strongest] @ sky.directions[20, 30] > np.cos(0.01)


def test_large_maps_are_reduced_first_without_loss(rng):
    sky = random_map(rng, 300)
    lights = sky.quantise(100)
    expected = (sky.radiance * sky.solid_angles[:, None, None]).sum(axis=(0, 1))
    assert np.allclose(lights.irradiances.sum(axis=0), expected, rtol=1e-9)


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
    (camera,) = orbit_cameras(field.positions, OrbitOptions(n_frames=1, size=32))
    rendering = render(field, camera, sky, RenderOptions(workers=2, samples_per_pixel=4))
    inside = rendering.coverage == 1
    share = rendering.image[inside] / (2.0 * albedo)
    # 512 lights; the hat functions of 33 x 33 nodes; in the frame of a flat triangle the
    # horizon of a texel is off by up to 4 degrees, which holds 0.25 % of the cosine.
    assert np.abs(share.mean() - 1) < 5e-3
    assert np.abs(share - 1).max() < 0.03


def test_map_equals_its_lights_one_by_one(rng):
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
    assert np.allclose(by_map, one_by_one, rtol=1e-4, atol=1e-6)
    assert by_map.max() > 0.1


def test_traced_shadows_do_not_depend_on_order(rng):
    field = baked_field(sphere_surface(12), lambert(0.7), visibility="factored", light_side=5)
    sky, options = random_map(rng, 8), RenderOptions(workers=2, environment_directions=30)
    cameras = orbit_cameras(field.positions, OrbitOptions(n_frames=3, size=24))
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
    (camera,) = orbit_cameras(field.positions, OrbitOptions(n_frames=1, size=24))
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
    directions[100:, 1] *= 0.05  # a band around the horizon
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def seen(direction):
        interaction.wi = [float(x) for x in -direction]  # from the sky to us
        return np.array(emitter.eval(interaction)).ravel()[0]

    error = np.abs([seen(d) for d in directions] - (2 + directions @ slopes))
    # Mitsuba 3.9 puts the first and last rows' centres on the poles, half a row off ours
    # (pi / 64 times the slope, 0.065); on the horizon only interpolation is left.
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
        "three quarters": turn.T, "mirrored": np.diag([-1, 1, 1]),
        "+Z up": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    }  # fmt: skip
    renderer = Renderer(field, RenderOptions(samples_per_pixel=1, environment_directions=60))

    def likeness(rotation):
        sky = EnvironmentMap.open(light.file, light.convention, rotation)
        rendering = renderer.render(camera, sky)
        inside = rendering.coverage == 1
        logs = [np.log(x[inside] + 1e-3) for x in (luminance(rendering.image), wanted)]
        return np.corrcoef(*logs)[0, 1]

    scores = {name: likeness(rotation) for name, rotation in rotations.items()}
    assert max(scores, key=scores.get) == "stated", scores


def test_bad_maps_are_refused(tmp_path):
    good = np.ones((4, 8, 3), np.float32)
    with pytest.raises(InputError, match="convention: expected one of"):
        EnvironmentMap(good, "unity")
    with pytest.raises(ShapeError, match="radiance"):
        EnvironmentMap(good[..., 0])
    with pytest.raises(InputError, match="radiance: expected an image of finite"):
        EnvironmentMap(np.full_like(good, np.nan))
    with pytest.raises(InputError, match="world_from_environment"):
        EnvironmentMap(good, "openexr", 2 * np.eye(3))
    with pytest.raises(InputError, match="n_lights"):
        EnvironmentMap(good).quantise(0)
    with pytest.raises(CaptureError, match=r"none\.exr"):
        EnvironmentMap.open(tmp_path / "none.exr")
    with pytest.raises(InputError, match="light 'a': expected an environment"):
        EnvironmentMap.of_light(Light("a", "directional"))
