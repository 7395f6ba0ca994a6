"""Errors of positions of lights planted in a small simulated dome, and what is left of them.

``python -m tests.calibration.planted_lights FOLDER`` simulates the dome in a new folder, and
prints for errors of several sizes what the correction by the photographs leaves of them.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.calibration.light_correction import correct_lights
from reflfield.capture.readers import open_capture
from tests.calibration import planted_poses

SCENE = planted_poses.SCENE | {
    "effects": ["antialiasing", "near_lights", "shadows"],
    "lights": {
        "preset": "rings",
        "elevations_deg": [5, 40, 60, 80],
        "counts": [9, 8, 6, 1],
        "offsets_deg": [13, 31, 7, 40],
        "target": planted_poses.MIDDLE.tolist(),
        "distance": 0.6,
    },
    "image": {"samples_per_side": 1, "edge_samples_per_side": 4},
}
# Millimetres.
PLANTED = [0.0, 1.0, 3.0, 5.0]


def simulate(folder):
    write_capture(parse_scene(SCENE), folder)


def with_light_errors(capture, millimetres, rng):
    """The capture, each light shifted by so much in a random direction."""
    ways = rng.normal(size=(capture.n_lights, 3))
    shifts = 1e-3 * millimetres * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    lights = zip(capture.lights, shifts, strict=True)
    return replace(
        capture, lights=tuple(replace(a, position=a.position + shift) for a, shift in lights)
    )


@dataclass(frozen=True)
class LightErrors:
    """Root mean squares over all lights.

    Of positions, of directions from the object, and of these but for one linear map of the
    positions of all lights, of which a matt surface tells nothing.
    """

    millimetres: float
    degrees: float
    degrees_told: float


def light_errors(lights, truth):
    true = np.array([light.position for light in truth]) - planted_poses.MIDDLE
    here = np.array([light.position for light in lights]) - planted_poses.MIDDLE
    across = np.array([np.eye(3) - np.outer(w, w) / (w @ w) for w in true])
    shifts = (across @ (here - true)[..., None]).ravel()
    maps = np.einsum("lac,ld->lacd", across, true).reshape(len(shifts), 9)
    left = shifts - maps @ np.linalg.lstsq(maps, shifts, rcond=1e-9)[0]
    distance = np.linalg.norm(true, axis=1).mean()
    degrees, degrees_told = (
        np.degrees(np.sqrt(np.square(s).sum() / len(true)) / distance) for s in (shifts, left)
    )
    millimetres = 1e3 * np.sqrt(np.square(here - true).sum(axis=1).mean())
    return LightErrors(millimetres, degrees, degrees_told)


def main(folder):
    simulate(folder)
    capture = open_capture(folder)
    print("| planted | | position | direction | but for one map | misfit |")
    print("|---|---|---|---|---|---|")
    for millimetres in PLANTED:
        wrong = with_light_errors(capture, millimetres, np.random.default_rng(1))
        correction = correct_lights(wrong)
        for what, lights, misfit in (
            ("before", wrong.lights, correction.misfit_before),
            ("after", correction.lights, correction.misfit_after),
        ):
            e = light_errors(lights, capture.lights)
            print(
                f"| {millimetres} mm | {what} | {e.millimetres:.2f} mm | {e.degrees:.3f} deg "
                f"| {e.degrees_told:.3f} deg | {100 * misfit:.2f} % |",
                flush=True,
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
