"""Effects of the rig: what is rendered differs from what is reported, by as much as asked."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture_sim.effects import (
    dropped_photographs,
    falloff_profile,
    light_position_error,
    light_variation,
    misregistration,
    pose_error,
)
from capture_sim.effects.bounds import steepness
from capture_sim.effects.near_lights import apply as illuminate
from capture_sim.effects.rig import real_rig
from capture_sim.errors import SceneError
from capture_sim.materials import make_material
from capture_sim.rays import camera_rays
from capture_sim.scene import parse_scene


def scene(kind="point", n=40, **effects):
    return parse_scene(
        {
            "object": {"preset": "sphere", "radius": 0.05},
            "material": {"preset": "grey_card"},
            "cameras": {"preset": "fibonacci", "n": n, "width": 64, "height": 64},
            "lights": {"preset": "fibonacci", "n": n, "kind": kind},
            "effects": {"simulate": list(effects), **effects},
        }
    )


def test_a_rig_without_effects_is_as_reported():
    plain = scene()
    rig = real_rig(plain)
    assert rig.cameras is plain.cameras
    assert rig.lights is plain.lights
    assert rig.photographed.all()


def test_reported_calibration_stays_where_errors_are_not_calibrated():
    tables = {"pose_error": {}, "misregistration": {}, "light_variation": {}}
    thing = scene(**tables, light_position_error={}, falloff_profile={})
    rig = real_rig(thing)
    assert rig.reported_cameras == thing.cameras
    assert rig.reported_lights == thing.lights
    assert rig.cameras != thing.cameras
    assert {light["type"] for light in rig.lights} == {"spot"}


def test_poses_err_by_the_given_standard_deviations(rounding):
    thing = scene(n=400, pose_error={"rotation_deg": 0.5, "translation": 1e-3})
    rig = real_rig(thing)
    before = np.array([c["camera_from_world"] for c in thing.cameras])
    after = np.array([c["camera_from_world"] for c in rig.cameras])
    error = after @ np.linalg.solve(before, np.broadcast_to(np.eye(4), before.shape))
    turns = np.degrees(Rotation.from_matrix(error[:, :3, :3]).as_rotvec())
    band = 4.0 / np.sqrt(2 * turns.size)  # 4 sigma of a standard deviation
    assert turns.std() == pytest.approx(0.5, rel=band)
    assert error[:, :3, 3].std() == pytest.approx(1e-3, rel=band)
    determinants = np.linalg.det(after[:, :3, :3])
    np.testing.assert_allclose(determinants, 1.0, rounding(np.float64, operations=6))


def test_misregistration_moves_the_principal_point():
    thing = scene(n=400, misregistration={"pixels": 0.7})
    shift = [
        (real["cx"] - said["cx"], real["cy"] - said["cy"])
        for real, said in zip(real_rig(thing).cameras, thing.cameras, strict=True)
    ]
    assert np.std(shift) == pytest.approx(0.7, rel=4 / np.sqrt(2 * 800))
    assert misregistration.needed(thing).bound > 0.0


def test_lens_distortion_bends_rays_as_opencv_projects_points():
    import cv2

    terms = {"k1": -0.2, "k2": 0.05, "k3": 0.01, "p1": 1e-3, "p2": -2e-3}
    thing = scene(n=2, lens_distortion=terms)
    rig = real_rig(thing)
    assert rig.reported_cameras == rig.cameras
    camera = {**rig.cameras[0], "camera_from_world": np.eye(4).tolist()}
    pixels = np.array([[0.5, 0.5], [10.0, 40.0], [63.5, 63.5], [32.0, 32.0]])
    _, directions = camera_rays(camera, pixels)
    matrix = np.array(
        [[camera["fl_x"], 0, camera["cx"]], [0, camera["fl_y"], camera["cy"]], [0, 0, 1]]
    )
    order = np.array([terms[key] for key in ("k1", "k2", "p1", "p2", "k3")])
    again = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), matrix, order)[0]
    # The iteration that undistorts stops at 1e-12 of the focal length.
    np.testing.assert_allclose(again.reshape(-1, 2), pixels, atol=1e-8)


def test_a_lens_taken_for_a_perfect_one_is_not_reported():
    rig = real_rig(scene(n=2, lens_distortion={"k1": -0.1, "calibrated": False}))
    assert "k1" not in rig.reported_cameras[0]
    assert rig.cameras[0]["k1"] == -0.1


def test_lights_vary_by_the_given_standard_deviations():
    thing = scene(n=400, light_variation={"intensity": 0.05, "colour": 0.02})
    ratio = np.log(
        [
            np.array(real["intensity"]) / said["intensity"]
            for real, said in zip(real_rig(thing).lights, thing.lights, strict=True)
        ]
    )
    band = 4 / np.sqrt(2 * 400)
    assert ratio.mean(axis=1).std() == pytest.approx(
        np.hypot(0.05, 0.02 / np.sqrt(3)), rel=band
    )
    within = ratio - ratio.mean(axis=1, keepdims=True)
    assert within.std() == pytest.approx(0.02 * np.sqrt(2 / 3), rel=band)
    bound = light_variation.needed(thing).bound
    assert bound == pytest.approx(np.abs(np.exp(ratio) - 1).max())


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_lights_move_by_the_given_standard_deviations(kind):
    thing = scene(kind, n=400, light_position_error={"position": 2e-3, "angle_deg": 0.3})
    key, size = ("position", 2e-3) if kind == "point" else ("direction", np.radians(0.3))
    moves = np.array(
        [
            np.subtract(real[key], said[key])
            for real, said in zip(real_rig(thing).lights, thing.lights, strict=True)
        ]
    )
    # Turning a vector by a random rotation moves it in the plane across it alone.
    expected = size if kind == "point" else size * np.sqrt(2 / 3)
    assert moves.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * moves.size))
    assert light_position_error.needed(thing).bound > 0.0


def test_fall_off_is_a_power_of_the_cosine_about_the_object(rounding):
    thing = scene(n=3, falloff_profile={"exponent": 2.0, "calibrated": True})
    rig = real_rig(thing)
    assert rig.reported_lights == rig.lights
    point = np.array([[0.03, 0.0, 0.0]])
    spot, plain = illuminate(rig.lights[1:2], point), illuminate(thing.lights[1:2], point)
    position = np.array(thing.lights[1]["position"])
    to_centre, to_point = -position, point[0] - position
    cosine = to_centre @ to_point / np.linalg.norm(to_centre) / np.linalg.norm(to_point)
    np.testing.assert_allclose(
        spot.irradiance[0, 0], plain.irradiance[0, 0] * cosine**2, rounding(np.float64)
    )
    assert falloff_profile.needed(thing).bound == pytest.approx(
        0.05**2, abs=rounding(np.float64)
    )


def test_photographs_are_dropped_with_the_given_probability():
    thing = scene(n=40, dropped_photographs={"fraction": 0.1})
    photographed = real_rig(thing).photographed
    assert photographed.shape == (40, 40)
    assert (~photographed).mean() == pytest.approx(0.1, abs=4 * np.sqrt(0.1 * 0.9 / 1600))
    assert str((~photographed).sum()) in dropped_photographs.needed(thing).reason


def test_losing_every_photograph_is_refused():
    with pytest.raises(SceneError, match=r"dropped_photographs\.fraction: expected some"):
        real_rig(scene(n=2, dropped_photographs={"fraction": 1.0}))


def test_errors_are_the_same_whatever_else_is_on():
    alone = real_rig(scene(n=3, pose_error={})).cameras
    both = real_rig(scene(n=3, light_variation={}, pose_error={})).cameras
    assert alone == both
    assert pose_error.needed(scene(n=3, pose_error={})).bound > 0.0


@pytest.mark.parametrize("alpha", [0.1, 0.2, 0.4])
def test_steepness_of_a_lobe(alpha):
    """GGX at normal incidence: D falls with tan(theta/2)^2/alpha^2, so slope ~ 1/alpha."""
    lobe = make_material({"type": "ggx", "diffuse": 0.0, "metal": "silver", "alpha": alpha})
    # The slope of (1 + t^2)^-2 is largest at t = 1/sqrt(5): .644 / (2 alpha) per radian of the
    # light; grazing incidence is steeper, by less than the inverse of its cosine squared.
    assert 0.644 / (2 * alpha) < steepness(lobe) < 4 * 0.644 / alpha
