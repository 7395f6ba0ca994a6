"""Rigs, cameras and lights."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture_sim.dome import (
    bonn151,
    fibonacci,
    look_at,
    make_cameras,
    make_lights,
    rig_presets,
    rings,
    ubo81,
)
from capture_sim.errors import SceneError


@pytest.mark.reference
def test_bonn_directions_are_those_of_the_dome(shared_data):
    folder = shared_data("ubo2014_felt05")
    vectors = np.fromfile(folder / "xyz_loc.bin").reshape(4, 151)[:3].T
    # The file's angles were stored in single precision.
    np.testing.assert_allclose(bonn151(), vectors, atol=1e-6)
    azimuth, elevation = np.fromfile(folder / "bonn_angles.bin").reshape(3, 151)[:2]
    ours = bonn151()
    # 3e-5 degrees: the same.
    np.testing.assert_allclose(np.arcsin(ours[:, 2]), elevation, atol=1e-6)
    turned = np.arctan2(ours[1:, 1], ours[1:, 0]) - azimuth[1:]
    # Observed 1.3e-6, 11 degrees from the pole.
    np.testing.assert_allclose(np.sin(turned), 0.0, atol=2e-6)


def test_bonn_rings_start_where_they_should(rounding):
    directions = bonn151()
    starts = np.cumsum([1, 6, 12, 12, 12, 18, 18, 24, 24])
    azimuth = np.degrees(np.arctan2(directions[starts, 1], directions[starts, 0]))
    inclination = np.degrees(np.arccos(directions[starts, 2]))
    tolerance = rounding(np.float64, scale=15)
    np.testing.assert_allclose(azimuth, [15, 0, 15, 0, 0, 7.5, 0, 7.5, 0], 0, tolerance)
    expected = [11, 23.5, 30, 37.5, 45, 52.5, 60, 67.5, 75]
    np.testing.assert_allclose(inclination, expected)


def test_ubo_directions():
    directions = ubo81()
    inclination = np.degrees(np.arccos(directions[:, 2])).round(6)
    values, counts = np.unique(inclination, return_counts=True)
    assert values.tolist() == [0, 15, 30, 45, 60, 75]
    assert counts.tolist() == [1, 6, 12, 18, 20, 24]


def test_rings_and_offsets(rounding):
    ring = rings([0.0], [4], [np.pi / 4])
    np.testing.assert_allclose(
        ring[0], [np.sqrt(0.5), np.sqrt(0.5), 0.0], 0, rounding(np.float64)
    )
    np.testing.assert_allclose(ring.sum(axis=0), 0.0, atol=rounding(np.float64))


def test_fibonacci_is_even():
    directions = fibonacci(500, np.pi)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    # An even spread has no mean direction and equal second moments: observed 3e-5 and 7e-5.
    evenness = 2e-4
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=evenness)
    np.testing.assert_allclose(directions.T @ directions / 500, np.eye(3) / 3, 0, evenness)
    cosine = directions @ directions.T - 3 * np.eye(500)
    spacing = np.arccos(cosine.max(axis=1))
    assert spacing.min() > 0.7 * np.sqrt(4 * np.pi / 500)
    assert fibonacci(50, np.radians(60))[:, 2].min() > 0.5


# -------------------------------------------------------------------------- cameras


@pytest.mark.parametrize("target", [(0.0, 0.0, 0.0), (0.3, -0.1, 0.2)])
def test_poses_look_at_the_target_with_z_up(target, rng, rounding):
    target = np.array(target)
    directions = np.vstack([rng.normal(size=(50, 3)), [[0, 0, 1.0], [0, 0, -1.0]]])
    positions = target + directions
    poses = look_at(positions, target)
    rotations = poses[:, :3, :3]
    products = np.einsum("nij,nkj->nik", rotations, rotations)
    np.testing.assert_allclose(products - np.eye(3), 0.0, atol=rounding(np.float64))
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    here = np.einsum("nij,nj->ni", rotations, positions) + poses[:, :3, 3]
    tolerance = rounding(np.float64, scale=np.abs(positions).max())
    np.testing.assert_allclose(here, 0.0, atol=tolerance)
    seen = rotations @ target + poses[:, :3, 3]
    np.testing.assert_allclose(seen[:, :2], 0.0, atol=tolerance)
    np.testing.assert_allclose(seen[:, 2], np.linalg.norm(directions, axis=1))
    up = rotations @ [0.0, 0.0, 1.0]  # OpenCV: image up is -y
    np.testing.assert_allclose(up[:50, 0], 0.0, atol=rounding(np.float64))
    assert (up[:50, 1] < 0.0).all()


def test_view_from_above_has_x_right_and_y_up():
    camera = make_cameras({"preset": "rti", "distance": 2.0})[0]
    pose = np.array(camera["camera_from_world"])
    np.testing.assert_allclose(pose[:3, :3] @ [1.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(pose[:3, :3] @ [0.0, 1.0, 0.0], [0.0, -1.0, 0.0])


def test_extent_and_field_of_view_agree():
    extent = 2.0 * 1.5 * np.tan(np.radians(10.0))
    common = {"preset": "ubo81", "distance": 1.5, "width": 320, "height": 200}
    by_extent = make_cameras({**common, "extent": extent})
    by_angle = make_cameras({**common, "field_of_view_deg": 20.0})
    assert by_extent[7]["fl_x"] == pytest.approx(by_angle[7]["fl_x"])
    assert len(by_angle) == 81
    assert by_angle[80]["id"] == "v080"
    assert (by_angle[0]["cx"], by_angle[0]["cy"]) == (160.0, 100.0)
    # A point at the border of the extent falls on the border of the image.
    pose, right = np.array(by_extent[9]["camera_from_world"]), np.zeros(3)
    right = pose[:3, :3].T @ [extent / 2, 0.0, 0.0]
    x, _, z = pose[:3, :3] @ right + pose[:3, 3]
    assert by_extent[9]["fl_x"] * x / z + 160.0 == pytest.approx(320.0)


def test_orthographic_cameras_and_distortion():
    camera = make_cameras({"preset": "rti", "model": "orthographic", "extent": 0.5})[0]
    assert (camera["model"], camera["fl_x"]) == ("orthographic", 512.0)
    bent = make_cameras({"preset": "rti", "k1": -0.1})[0]
    assert bent["k1"] == -0.1
    assert "k2" not in bent


# --------------------------------------------------------------------------- lights


def test_point_lights_give_the_irradiance_asked_for(rounding):
    target = np.array([0.0, 0.0, 0.1])
    lights = make_lights(
        {
            "preset": "bonn151",
            "distance": 0.8,
            "target": target.tolist(),
            "irradiance": [3.0, 2.0, 1.0],
        }
    )
    assert len(lights) == 151
    for light, direction in zip(lights, bonn151(), strict=True):
        offset = np.array(light["position"]) - target
        np.testing.assert_allclose(offset, 0.8 * direction, 0, rounding(np.float64))
        np.testing.assert_allclose(np.array(light["intensity"]) / (offset @ offset), [3, 2, 1])


def test_intensity_and_directional_lights():
    point = make_lights({"preset": "rti", "n": 5, "distance": 0.5, "intensity": 8.0})
    assert len(point) == 5
    assert point[0]["intensity"] == [8.0, 8.0, 8.0]
    far = make_lights({"preset": "list", "directions": [[0, 3, 4]], "kind": "directional"})[0]
    assert far["type"] == "directional"
    np.testing.assert_allclose(far["direction"], [0.0, 0.6, 0.8])
    np.testing.assert_allclose(far["irradiance"], np.pi)


def test_every_rig_serves_cameras_and_lights():
    extra = {"list": {"directions": [[0.0, 0.0, 1.0]]}}
    for name in rig_presets():
        table = {"preset": name, **extra.get(name, {})}
        for things in (make_cameras(table), make_lights(table)):
            assert len({thing["id"] for thing in things}) == len(things)


def test_rings_from_a_table(rounding):
    table = {"preset": "rings", "elevations_deg": [-30, 90], "counts": [3, 1]}
    positions = np.array([light["position"] for light in make_lights(table)])
    np.testing.assert_allclose(positions[:, 2], [-0.5, -0.5, -0.5, 1.0])
    turn = Rotation.from_euler("z", 120, degrees=True)
    np.testing.assert_allclose(turn.apply(positions[0]), positions[1], 0, rounding(np.float64))


@pytest.mark.parametrize(
    ("make", "table", "message"),
    [
        (make_cameras, {}, "preset"),
        (make_cameras, {"preset": "geodesic"}, "preset: expected one of bonn151"),
        (make_cameras, {"preset": "bonn151", "n": 3}, "'n'"),
        (make_cameras, {"preset": "rti", "distance": 0}, "distance"),
        (make_cameras, {"preset": "rti", "width": 0}, "width"),
        (make_cameras, {"preset": "rti", "field_of_view_deg": 180}, "field_of_view_deg"),
        (
            make_cameras,
            {"preset": "rti", "model": "orthographic", "field_of_view_deg": 20},
            "give extent",
        ),
        (make_cameras, {"preset": "list", "directions": [[0, 0, 0]]}, "not zero"),
        (make_cameras, {"preset": "list"}, "directions"),
        (make_cameras, {"preset": "rings", "counts": [1.5, 1, 1]}, "whole counts"),
        (make_cameras, {"preset": "rings", "counts": [1]}, "as many"),
        (make_lights, {"preset": "rti", "kind": "laser"}, "kind"),
        (make_lights, {"preset": "rti", "irradiance": 0.0}, "shines"),
        (make_lights, {"preset": "rti", "irradiance": [1, 1, -1]}, "shines"),
        (make_lights, {"preset": "rti", "kind": "directional", "intensity": 1}, "intensity"),
    ],
)
def test_bad_tables_say_what_is_wrong(make, table, message):
    with pytest.raises(SceneError, match=message):
        make(table)
