"""Errors of poses planted in a small simulated dome, and what is left of them.

``python -m tests.calibration.planted_poses FOLDER`` simulates the dome in a new folder, and
prints for errors of several sizes what the correction by silhouettes leaves of them.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.calibration.camera_correction import correct_cameras
from reflfield.capture.readers import open_capture
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.visual_hull import HullOptions, visual_hull

MIDDLE = np.array([0.0, 0.0, 0.1])
SCENE = {
    "name": "amphora",
    "effects": ["antialiasing"],
    "object": {"preset": "amphora", "height": 0.2},
    "material": {"preset": "matte_clay"},
    "cameras": {
        "preset": "rings",
        "elevations_deg": [5, 32, 60],
        "counts": [6, 4, 2],
        "offsets_deg": [20, 0, 15],
        "target": MIDDLE.tolist(),
        "distance": 0.8,
        "extent": 0.25,
        "width": 128,
        "height": 128,
    },
    "lights": {
        "preset": "rings",
        "elevations_deg": [40],
        "counts": [1],
        "offsets_deg": [0],
        "target": MIDDLE.tolist(),
        "distance": 0.6,
    },
    "image": {"samples_per_side": 1, "edge_samples_per_side": 8},
    "heldout": {"photographs": 0},
    "truth": {"per_view": False, "points": 1},
}
# Degrees and millimetres.
PLANTED = [(0.0, 0.0), (0.1, 1.0), (0.3, 2.0), (0.5, 3.0), (1.0, 1.0), (1.0, 5.0), (0.1, 5.0)]


def simulate(folder):
    write_capture(parse_scene(SCENE), folder)


def with_pose_errors(capture, degrees, millimetres, rng):
    """The capture, each camera turned and shifted by so much in a random direction."""
    return replace(
        capture, cameras=tuple(_moved(c, degrees, millimetres, rng) for c in capture.cameras)
    )


def _moved(camera, degrees, millimetres, rng):
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    error[:3, 3] = 1e-3 * millimetres * way
    return replace(camera, camera_from_world=error @ camera.camera_from_world)


@dataclass(frozen=True)
class PoseErrors:
    """Root mean squares over all cameras, but for a similarity of all of them together.

    Of rotations, of positions, and of where points of the object are imaged.
    """

    degrees: float
    millimetres: float
    pixels: float


class PoseErrorMeter:
    """The similarity that brings cameras nearest to the true ones."""

    def __init__(self, cameras, truth):
        self.cameras, self.truth = cameras, truth
        # Half a degree counts as much as three millimetres.
        scaled = [0.5, 3.0]
        self.parameters = least_squares(
            lambda p: np.concatenate(
                [d.ravel() / s for d, s in zip(self.differences(p), scaled, strict=True)]
            ),
            np.zeros(7),
        ).x

    def differences(self, parameters):
        """Rotation vectors in degrees, and differences of positions in millimetres."""
        turn, scale = Rotation.from_rotvec(parameters[:3]).as_matrix(), np.exp(parameters[3])
        angles = [
            Rotation.from_matrix(one.rotation @ turn.T @ other.rotation.T).as_rotvec()
            for one, other in zip(self.cameras, self.truth, strict=True)
        ]
        centres = np.array([camera.centre for camera in self.cameras])
        placed = MIDDLE + parameters[4:] + scale * (centres - MIDDLE) @ turn.T
        true = np.array([camera.centre for camera in self.truth])
        return np.degrees(angles), 1e3 * (placed - true)

    def from_true(self, points):
        """Points of the true world in that of the cameras."""
        turn, scale = Rotation.from_rotvec(self.parameters[:3]).as_matrix(), np.exp(
            self.parameters[3]
        )  # fmt: skip
        return MIDDLE + (points - MIDDLE - self.parameters[4:]) @ turn / scale

    def errors(self):
        points = MIDDLE + np.random.default_rng(0).uniform(-0.08, 0.08, (200, 3))
        here = self.from_true(points)
        pixels = [
            np.linalg.norm(one.project(here)[0] - other.project(points)[0], axis=1)
            for one, other in zip(self.cameras, self.truth, strict=True)
        ]
        degrees, millimetres = (
            np.sqrt(np.square(d).sum(axis=1).mean()) for d in self.differences(self.parameters)
        )
        return PoseErrors(degrees, millimetres, np.sqrt(np.square(pixels).mean()))

    def hull_iou(self, silhouettes):
        """Intersection over union of the cameras' hull with that of the true ones."""
        points = MIDDLE + np.random.default_rng(1).uniform(-0.11, 0.11, (40_000, 3))
        true = _hull(self.truth, silhouettes).inside(points)
        here = _hull(self.cameras, silhouettes).inside(self.from_true(points))
        return (true & here).sum() / (true | here).sum()


def _hull(cameras, silhouettes):
    return RayScene(visual_hull(cameras, silhouettes, HullOptions(96, tolerance=0))[0], 1)


def main(folder):
    simulate(folder)
    capture = open_capture(folder)
    silhouettes = [capture.read_silhouette(view) for view in range(capture.n_views)]
    print("| planted | | rotation | position | image | hull IoU |\n|---|---|---|---|---|---|")
    for degrees, millimetres in PLANTED:
        wrong = with_pose_errors(capture, degrees, millimetres, np.random.default_rng(1))
        corrected = correct_cameras(wrong).cameras
        for what, cameras in (("before", wrong.cameras), ("after", corrected)):
            meter = PoseErrorMeter(cameras, capture.cameras)
            e = meter.errors()
            print(
                f"| {degrees} deg, {millimetres} mm | {what} | {e.degrees:.3f} deg "
                f"| {e.millimetres:.2f} mm | {e.pixels:.2f} px "
                f"| {meter.hull_iou(silhouettes):.4f} |",
                flush=True,
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
