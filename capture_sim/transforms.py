"""A capture once more as radiance-field software reads it: ``transforms/`` in its folder.

``transforms_train.json`` and ``transforms_test.json`` list OpenEXR images of radiance over
black with the coverage as alpha, one light each (``pl_pos``, ``pl_intensity``), as NRHints and
GS3 take them. The test split is that of the held-out photographs; where the scene has none, it
is every eighth photograph.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR
from numpy.typing import NDArray
from PIL import Image

from capture_sim.effects import exposure_brackets, simulated
from capture_sim.errors import scene_error
from capture_sim.files import write_json, write_rgba_exr, write_whole
from capture_sim.heldout import heldout_pairs, point_light, transforms_frame
from capture_sim.model import Scene
from capture_sim.photograph import Setup

Table = Mapping[str, Any]

FOLDER = "transforms"
TEST_STEP = 8  # one photograph of so many is a test where none is held out


class SplitImage(NamedTuple):
    """An image of a split, and the files of the capture that it is made of."""

    camera: Table
    light: Table
    photograph: str
    silhouette: str


def check_transforms(scene: Scene) -> None:
    """Refuse scenes that ``transforms.json`` cannot hold.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    SceneError
        If a camera is not a perspective one, a light is a spot, or photographs are bracketed.
    """
    for camera in scene.cameras:
        if camera["model"] != "opencv":
            raise scene_error(
                "cameras.model", "opencv", camera["model"],
                "transforms.json holds perspective cameras; leave out --as transforms",
            )  # fmt: skip
    if any(light["type"] == "spot" for light in scene.lights):
        raise scene_error(
            "lights.type", "point or directional", "spot",
            "transforms.json holds point lights; leave out --as transforms",
        )  # fmt: skip
    if simulated(scene, exposure_brackets):
        raise scene_error(
            "effects.exposure_brackets", "none with --as transforms", "brackets",
            "radiance-field software reads one image a frame; leave out one of the two",
        )  # fmt: skip


def write_transforms(setup: Setup, folder: Path) -> None:
    """Write both splits from a capture's photographs, silhouettes and held-out photographs.

    Parameters
    ----------
    setup : Setup
        What was simulated; its calibration is reported.
    folder : Path
        The capture; ``transforms/`` is made inside.
    """
    train = _photographs(setup)
    test = _held_out(setup.scene)
    if not test:
        train, test = [o for i, o in enumerate(train) if i % TEST_STEP], train[::TEST_STEP]
    for name, images in (("train", train), ("test", test)):
        (folder / FOLDER / name).mkdir(parents=True, exist_ok=True)
        frames = [_write_frame(image, name, setup.scene, folder) for image in images]
        file = folder / FOLDER / f"transforms_{name}.json"
        write_whole(file, write_json, {"camera_model": "OPENCV", "frames": frames})


def _photographs(setup: Setup) -> list[SplitImage]:
    cameras, lights = setup.rig.reported_cameras, setup.rig.reported_lights
    return [
        SplitImage(
            cameras[view],
            lights[light],
            f"photographs/{cameras[view]['id']}_{lights[light]['id']}.exr",
            f"silhouettes/{cameras[view]['id']}.png",
        )
        for view, light in np.argwhere(setup.rig.photographed).tolist()
    ]


def _held_out(scene: Scene) -> list[SplitImage]:
    return [
        SplitImage(
            camera,
            light,
            f"truth/heldout/{camera['id']}.exr",
            f"truth/heldout/{camera['id']}_silhouette.png",
        )
        for camera, light in heldout_pairs(scene)
    ]


def _write_frame(image: SplitImage, split: str, scene: Scene, folder: Path) -> dict[str, Any]:
    """Write one image; returns its frame."""
    stem = f"{split}/{Path(image.photograph).stem}"
    radiance, coverage = _read(folder / image.photograph, folder / image.silhouette)
    pixels = np.concatenate([radiance, coverage[..., None].astype(radiance.dtype)], axis=2)
    write_whole(folder / FOLDER / f"{stem}.exr", write_rgba_exr, pixels)
    light = point_light(image.light, scene.mesh.centre)
    frame = transforms_frame(image.camera, light, stem, "")
    del frame["mask_path"]  # the alpha channel
    intrinsics = [image.camera[key] for key in ("cx", "cy", "fl_x", "fl_y")]
    return {**frame, "file_ext": ".exr", "camera_intrinsics": intrinsics}


def _read(photograph: Path, silhouette: Path) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Radiance and coverage of files that this program wrote."""
    with OpenEXR.File(str(photograph)) as file:
        radiance = file.channels()["RGB"].pixels
    with Image.open(silhouette) as opened:
        coverage = np.asarray(opened, np.float32) / 255.0
    return radiance, coverage


def described(folder: Path) -> Iterable[str]:
    """Lines on what was written."""
    return [
        f"Wrote {folder / FOLDER / f'transforms_{name}.json'}" for name in ("train", "test")
    ]
