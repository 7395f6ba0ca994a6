"""Cameras corrected by silhouettes: planted errors of poses, and what is left of them."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from reflfield.api.capture_calibration import calibrate
from reflfield.calibration import camera_correction
from reflfield.calibration.camera_correction import correct_cameras
from reflfield.calibration.pose_adjustment import adjust_poses
from reflfield.calibration.tangent_planes import TangentPlanes, convex_outlines
from reflfield.capture.conversion import convert_capture
from reflfield.capture.image_writing import write_png
from reflfield.capture.readers import open_capture
from reflfield.cli import app
from reflfield.errors import InputError
from reflfield.geometry.cones import measured_views
from tests.calibration.planted_poses import PoseErrorMeter, simulate, with_pose_errors

# The outlines of these images are drawn to .05 pixel. Two touching planes of each of 66 pairs
# tell 72 numbers: errors of images after the correction stay below a pixel.
IMAGED_PX = 1.0


@pytest.fixture(scope="session")
def dome(made_once):
    """The capture of an amphora by twelve cameras."""
    return open_capture(made_once("pose-dome", simulate)[0])


def silhouettes_of(capture):
    return [capture.read_silhouette(view) for view in range(capture.n_views)]


@pytest.mark.parametrize(("degrees", "millimetres"), [(0.1, 1.0), (1.0, 5.0)])
def test_planted_errors_are_removed(dome, degrees, millimetres):
    wrong = with_pose_errors(dome, degrees, millimetres, np.random.default_rng(1))
    correction = correct_cameras(wrong)
    before, after = (
        PoseErrorMeter(wrong.cameras, dome.cameras),
        PoseErrorMeter(correction.cameras, dome.cameras),
    )
    assert after.errors().pixels < min(IMAGED_PX, 0.3 * before.errors().pixels)
    silhouettes = silhouettes_of(dome)
    assert before.hull_iou(silhouettes) < 0.96 < after.hull_iou(silhouettes)
    assert correction.is_kept
    assert correction.before.hull_overlap < correction.after.hull_overlap
    # A turn and a shift across the view look alike: a turn is told where it is large.
    if degrees == 1.0:
        assert after.errors().degrees < 0.4 * before.errors().degrees


def test_right_poses_are_kept(dome):
    correction = correct_cameras(dome)
    assert correction.cameras is dome.cameras
    assert not correction.is_kept
    assert correction.before.gap_px < 0.1
    assert "gain nothing" in correction.lines()[0]


def test_photographs_outweigh_masks_that_are_drawn_badly(dome, monkeypatch):
    wrong = with_pose_errors(dome, 0.5, 2.0, np.random.default_rng(5))
    correction = correct_cameras(wrong)
    assert correction.is_kept
    # What the surface shows says the same as the silhouettes, which it does not know.
    assert correction.after.photographs_differ < 0.5 * correction.before.photographs_differ
    monkeypatch.setattr(camera_correction, "MOST_LOST", 0.01)
    refused = correct_cameras(wrong)
    assert refused.cameras is wrong.cameras
    assert "photographs worse" in refused.lines()[0]


def test_planes_of_right_poses_meet(dome):
    views = measured_views(dome.cameras, silhouettes_of(dome))
    poses = np.array([camera.camera_from_world for camera in dome.cameras])
    planes = TangentPlanes.of(convex_outlines(views), poses)
    assert len(planes.first) == 12 * 11 / 2
    gaps = planes.gaps(poses[planes.first], poses[planes.second])
    assert np.abs(gaps).max() < 0.2
    # One camera that is shifted sideways by a pixel: no pair sees more, some see most of it.
    shifted = poses.copy()
    shifted[3, 0, 3] += 0.8 / dome.cameras[3].fl_x
    gaps = np.abs(planes.gaps(shifted[planes.first], shifted[planes.second]))
    of_camera = (planes.first == 3) | (planes.second == 3)
    assert gaps[~of_camera].max() < 0.2
    assert 0.6 < gaps[of_camera].max() < 1.2


def test_motion_of_all_cameras_shows_nowhere(dome):
    views = measured_views(dome.cameras, silhouettes_of(dome))
    poses = np.array([camera.camera_from_world for camera in dome.cameras])
    planes = TangentPlanes.of(convex_outlines(views), poses)
    wrong = with_pose_errors(dome, 0.3, 1.0, np.random.default_rng(2))
    poses = np.array([camera.camera_from_world for camera in wrong.cameras])
    moved = adjust_poses(planes, poses, np.full(12, 0.8))
    # A shift of all cameras changes no gap, so that the least sum has none of it.
    in_world = np.einsum("vji,vj->vi", moved.camera_from_world[:, :3, :3], moved.shifts)
    size = np.linalg.norm(in_world, axis=1).mean()
    assert np.linalg.norm(in_world.mean(axis=0)) < 0.02 * size


def test_one_wrong_mask_does_little_harm(dome, tmp_path):
    wrong = with_pose_errors(dome, 0.5, 2.0, np.random.default_rng(3))
    mask = dome.read_silhouette(0)
    swollen = cv2.dilate(mask, np.ones((5, 5), np.uint8))
    write_png(tmp_path / "mask.png", np.rint(255 * swollen).astype(np.uint8))
    wrong = replace(wrong, silhouettes=(tmp_path / "mask.png", *wrong.silhouettes[1:]))
    correction = correct_cameras(wrong)
    assert correction.is_kept
    before, after = (
        PoseErrorMeter(cameras[1:], dome.cameras[1:]).errors().pixels
        for cameras in (wrong.cameras, correction.cameras)
    )
    assert after < 0.5 * before


def test_command(dome, tmp_path):
    wrong = with_pose_errors(dome, 0.5, 2.0, np.random.default_rng(4))
    convert_capture(wrong, tmp_path / "wrong")
    arguments = ["calibrate", str(tmp_path / "wrong"), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*arguments, "--cameras"])
    assert done.exit_code == 0, done.output
    assert "cameras: 12 moved" in done.output
    entry = json.loads((tmp_path / "out/calibration.json").read_text())["cameras"]
    assert entry["kept"]
    assert len(entry["moved"]) == 12
    assert entry["before"]["gap_px"] > 5 * entry["after"]["gap_px"]
    written = open_capture(tmp_path / "out")
    errors = PoseErrorMeter(written.cameras, dome.cameras).errors()
    assert errors.pixels < 0.3 * PoseErrorMeter(wrong.cameras, dome.cameras).errors().pixels


def test_refusals(dome, tmp_path):
    with pytest.raises(InputError, match="expected what to correct"):
        calibrate(dome, tmp_path / "out")
    with pytest.raises(InputError, match="at least 5 views"):
        calibrate(dome.subset(views=[0, 1, 2]), tmp_path / "out", cameras=True)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="new or empty folder"):
        calibrate(dome, dome.root, cameras=True)
