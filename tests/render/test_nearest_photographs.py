"""The nearest photograph: which one it is, and what of it another camera sees."""

import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.image_writing import write_exr
from reflfield.capture.lights import DirectionalLight, Light
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.errors import InputError
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.nearest_photographs import NearestPhotographs, filled_from_nearest
from reflfield.render.renderer import RenderOptions, render
from tests.synthetic_fields import baked_field, lambert, sphere_surface

ALBEDO = np.array([0.8, 0.5, 0.2])


def around(degrees, elevation=0.0):
    """Direction in a plane that is tilted by the elevation."""
    a, e = np.radians([degrees, elevation])
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def camera(degrees, name="c"):
    return Camera.look_at(4 * around(degrees), width=48, height=48, fov_deg=36, id=name)


@pytest.fixture(scope="module")
def sphere():
    """A matt sphere, which casts no shadow on itself but where it faces away."""
    return baked_field(sphere_surface(32), lambert(ALBEDO), visibility="kept")


@pytest.fixture(scope="module")
def capture(sphere, tmp_path_factory):
    """Cameras at 0, 40 and 180 degrees, each under lights at 0 and 60 degrees."""
    root = tmp_path_factory.mktemp("nearest")
    cameras = tuple(camera(d, f"c{d}") for d in (0, 40, 180))
    lights = tuple(DirectionalLight(around(d, 20), np.pi * k, id=f"l{d}")
                   for d, k in ((0, 1), (60, 2)))  # fmt: skip
    photographs = []
    for i, view in enumerate(cameras):
        for j, light in enumerate(lights):
            name = f"{view.id}_{light.id}"
            image = render(sphere, view, light, RenderOptions(workers=1)).image
            write_exr(root / f"{name}.exr", image)
            exposures = (Exposure(root / f"{name}.exr"),)
            photographs.append(Photograph(name, i, j, exposures))
    return Capture("sphere", root, cameras, lights, tuple(photographs))


@pytest.fixture(scope="module")
def nearest(sphere, capture):
    return NearestPhotographs(FieldSurface(sphere, 1), capture)


@pytest.mark.parametrize(
    ("view", "light", "name", "angles"),
    [
        (10, 50, "c0_l60", (10, 9.39)),
        (25, 0, "c40_l0", (15, 0)),
        # 30 from the light at 0, 30 from that at 60: as near; 170 from the one camera.
        (190, 5, "c180_l0", (10, 4.70)),
    ],
)
def test_the_least_sum_of_squared_angles_decides(nearest, view, light, name, angles):
    carried = nearest.carried(camera(view), DirectionalLight(around(light, 20)))
    assert carried.name == name
    angle_pair = np.degrees([carried.view_angle, carried.light_angle])
    # Lights at 20 degrees of elevation: the arc between them, by the haversine formula.
    assert angle_pair == pytest.approx(angles, abs=0.02)


def test_samples_are_those_of_the_nearest_over_its_light(nearest, sphere):
    """Twice as strong a light makes no difference: the sample is radiance over irradiance."""
    other = DirectionalLight(around(55, 20), 5.0)
    carried = nearest.carried(camera(5), other)
    assert carried.name == "c0_l60"
    normals = nearest.surface.texels.normal.astype(np.float64)
    cosine = np.maximum(normals @ around(60, 20), 0)
    # Texels well inside what the nearest camera sees, and well lit.
    inner = (normals @ around(0) > 0.6) & (cosine > 0.2)
    expected = cosine[inner, None] * ALBEDO / np.pi
    # Texels and pixels are 6 and 3 degrees wide: cosines differ by .07 from one to the next.
    assert carried.samples[inner] == pytest.approx(expected, abs=0.07 * ALBEDO.max() / np.pi)
    # The rim, where texels of the poles crowd: within 1.5 of its 19 pixels none is sampled.
    assert 0 < carried.share_filled < 0.5


def test_what_the_nearest_does_not_see_comes_from_the_next(nearest):
    """From 100 degrees, beyond the horizon of the camera at 40, the one at 180 sees on."""
    carried = nearest.carried(camera(100), DirectionalLight(around(60, 20)))
    assert carried.name == "c40_l60"
    assert carried.n_photographs >= 2
    normals = nearest.surface.texels.normal.astype(np.float64)
    # Beyond 130 degrees the camera at 40 sees nothing, and the light at 60 still shines.
    beyond = (normals @ around(140) > 0.995) & (normals @ around(60, 20) > 0.05)
    assert beyond.any()
    cosine = normals[beyond] @ around(60, 20)
    expected = cosine[:, None] * ALBEDO / np.pi
    # A third of what neighbours differ by: observed .002.
    assert carried.samples[beyond] == pytest.approx(expected, abs=0.006)


def test_a_photograph_is_not_its_own_nearest(nearest, capture):
    own = capture.photographs[0]
    carried = nearest.carried(capture.cameras[0], capture.lights[0], but=own.name)
    assert carried.name != own.name
    assert nearest.carried(capture.cameras[0], capture.lights[0]).name == own.name


def test_an_environment_has_no_nearest(nearest, tmp_path):
    sky = Light("sky", "environment", file=tmp_path / "sky.exr")
    with pytest.raises(InputError, match="light 'sky'"):
        nearest.carried(camera(0), sky)


def test_columns_are_filled_by_themselves(rng):
    positions = np.arange(5.0)[:, None] * [1, 0, 0]
    values = np.array([[1, np.nan], [np.nan, np.nan], [3, 7], [4, np.nan], [np.nan, 8.0]])
    filled = filled_from_nearest(values, positions)
    assert filled[:, 0].tolist()[2:] == [3, 4, 4]
    assert filled[1, 0] in (1, 3)
    assert filled[:, 1].tolist()[:3] == [7, 7, 7]
    assert np.isnan(values[1, 0])  # what was given stays
    with pytest.raises(InputError, match="values"):
        filled_from_nearest(np.full((2, 1), np.nan), positions[:2])
