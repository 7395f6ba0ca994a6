"""Fisheye cameras carve and see like others, also far off their axes."""

from dataclasses import replace

import numpy as np
import pytest
import rigs

from reflfield.geometry.visual_hull import HullOptions, visual_hull

RAW = HullOptions(resolution=32, blur=0.0, smoothing=0, n_triangles=0)


def turned(camera, angle):
    """A fisheye camera in the same place, turned away about its vertical axis."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.eye(4)
    turn[:3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
    return replace(
        camera,
        kind="opencv_fisheye",
        distortion=(0.05, -0.01, 0, 0, 0, 0),
        camera_from_world=turn @ camera.camera_from_world,
    )


def test_the_same_ball_is_carved():
    plain = rigs.cameras(10, size=128)
    expected, _ = visual_hull(plain, [rigs.ball_silhouette(c, samples=2) for c in plain], RAW)
    bent = [turned(replace(c, fl_x=64.0, fl_y=64.0), np.radians(40.0)) for c in plain]
    mesh, report = visual_hull(bent, [rigs.ball_silhouette(c, samples=2) for c in bent], RAW)
    # a third of the resolution of the plain cameras: .04 pixel or .001 of the radius
    assert mesh.volume == pytest.approx(expected.volume, rel=0.01)
    # Cones meet in corners, by a fifth of a voxel of .07 at most: observed .008.
    np.testing.assert_allclose(mesh.bounds, expected.bounds, atol=0.014)
    assert report.overlap.min() > 0.97
