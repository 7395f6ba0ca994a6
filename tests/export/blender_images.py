"""Blender's Cycles: what it draws of an exported folder, and how far that is from the field.

Blender's Python is not that of this project: ``BLENDER_PYTHON`` names one that has the
package ``bpy``.
"""

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
from scipy.ndimage import minimum_filter

from reflfield.capture.lights import DirectionalLight
from reflfield.render.renderer import render

# From OpenCV's axes of cameras to Blender's.
_BLENDER_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
# Pixels off the edges of the object and of shadows that count.
_EDGE = 2


@dataclass(frozen=True)
class Compared:
    """Images of Blender and of the field, (size, size, 3), and the pixels that count."""

    drawn: np.ndarray
    wanted: np.ndarray
    inside: np.ndarray

    @property
    def relative(self):
        """Root of squared differences over that of squares."""
        a, b = self.drawn[self.inside], self.wanted[self.inside]
        return float(np.linalg.norm(a - b) / np.linalg.norm(b))

    @property
    def ratios(self):
        """Mean of Blender's image over that of the field, by channel."""
        return self.drawn[self.inside].mean(axis=0) / self.wanted[self.inside].mean(axis=0)


def blender_python():
    """Path of a Python with ``bpy``, or None where ``BLENDER_PYTHON`` is not set."""
    return os.environ.get("BLENDER_PYTHON")


def cycles_images(folder, work, camera, fov_deg, towards, *, samples=64):
    """What Cycles draws under a sun of 1 W/m^2, (n, size, size, 4): without and with shadows.

    Parameters
    ----------
    folder : Path
        As ``export --to blender`` writes it.
    work : Path
        An empty folder.
    camera : Camera
        A square one.
    fov_deg : float
    towards : (3,) array_like
        Direction to the sun.
    samples : int
        Of each pixel.
    """
    images = [
        {"file": str(work / f"{name}.exr"), "towards": list(towards), "shadows": name == "lit"}
        for name in ("bare", "lit")
    ]
    pose = np.eye(4)
    pose[:3] = np.column_stack([camera.rotation.T, camera.centre])
    pose = pose @ _BLENDER_AXES
    jobs = {
        "world_from_camera": pose.tolist(), "fov": np.radians(fov_deg), "size": camera.width,
        "samples": samples, "images": images,
    }  # fmt: skip
    (work / "jobs.json").write_text(json.dumps(jobs))
    script = Path(__file__).with_name("cycles_scene.py")
    # Blender's Python shall not find this project's packages.
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    subprocess.run(
        [blender_python(), script, folder, work / "jobs.json"], check=True, env=clean,
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    return np.stack([_pixels(image["file"]) for image in images])


def compared(field, folder, work, camera, fov_deg, towards):
    """Blender's image of a folder beside that of its field."""
    exposure = json.loads((folder / "material.json").read_text())["exposure"]
    bare, lit = cycles_images(folder, work, camera, fov_deg, towards)
    shown = render(field, camera, DirectionalLight(towards, 1.0))
    in_light = lit[..., :3].sum(-1) > 0.5 * bare[..., :3].sum(-1)
    covered = (
        np.minimum(lit[..., 3], shown.coverage) > 1.0 - 1e-3
    )  # rounding of sums of samples
    lighted = bare[..., :3].sum(-1) > 0
    inside = minimum_filter(covered & in_light & lighted, 2 * _EDGE + 1)
    return Compared(lit[..., :3] / exposure, shown.image, inside)


def _pixels(path):
    with OpenEXR.File(path) as file:
        return file.channels()["RGBA"].pixels
