"""Clean simulated captures of several kinds, tiny, and the planted faults."""

import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.capture.readers import open_capture
from reflfield.checking.capture_check import check_capture

# An amphora, whose handles tell its sides apart, in a dome of 20 cameras and 13 lights.
SCENE = {
    "name": "amphora",
    "effects": ["antialiasing", "near_lights", "shadows"],
    "object": {"preset": "amphora", "height": 0.2},
    "material": {"preset": "matte_clay"},
    "cameras": {
        "preset": "rings",
        "elevations_deg": [-30, 5, 32, 60, 90],
        "counts": [4, 6, 5, 4, 1],
        "offsets_deg": [10, 20, 0, 15, 0],
        "target": [0.0, 0.0, 0.1],
        "distance": 0.8,
        "extent": 0.25,
        "width": 64,
        "height": 64,
    },
    "lights": {
        "preset": "rings",
        "elevations_deg": [5, 40, 60, 80],
        "counts": [5, 4, 3, 1],
        "offsets_deg": [13, 31, 7, 40],
        "target": [0.0, 0.0, 0.1],
        "distance": 0.6,
    },
    "image": {"samples_per_side": 1, "edge_samples_per_side": 4},
    "heldout": {"photographs": 0},
    "truth": {"per_view": False, "points": 1},
}


@pytest.fixture(scope="session")
def clean_dome(made_once):
    """Folder of the clean dome. Read only."""

    def fill(folder):
        write_capture(parse_scene(SCENE), folder)

    return made_once("check-dome", fill)[0]


@pytest.fixture
def subset_of():
    """Function that keeps some photographs of a capture: those of pairs (view, light)."""

    def keep(planted, pairs):
        def change(document):
            cameras = [camera["id"] for camera in document["cameras"]]
            lights = [light["id"] for light in document["lights"]]
            document["photographs"] = [
                {
                    "camera": cameras[v],
                    "light": lights[light],
                    "file": f"photographs/{cameras[v]}_{lights[light]}.exr",
                }
                for v, light in pairs
            ]

        planted.describe(change)
        return planted

    return keep


@pytest.fixture(scope="session")
def check_folder():
    """Function that checks the capture in a folder."""

    def check(folder):
        return check_capture(open_capture(folder, require_photographs=False))

    return check
