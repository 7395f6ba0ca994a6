"""A capture once more as radiance-field software reads it: ``transforms/`` in its folder.

``transforms_train.json`` and ``transforms_test.json`` list images, one light each (``pl_pos``,
``pl_intensity``), as NRHints and GS3 take them; ``transforms_val.json``, which NRHints asks
for, lists none. The test split is that of the held-out photographs; where the scene has none,
it is every eighth photograph.

Each image is there twice. ``NAME.exr`` is radiance over black, ``NAME.png`` is sRGB-encoded and
not multiplied by alpha, 1 being a radiance of ``png_white``; alpha is the coverage. Frames name
neither: the others read PNG if not told otherwise, reflfield OpenEXR.
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
from capture_sim.files import write_json, write_png, write_rgba_exr, write_whole
from capture_sim.heldout import heldout_pairs, point_light, transforms_frame
from capture_sim.model import Scene
from capture_sim.photograph import Setup

Table = Mapping[str, Any]

FOLDER = "transforms"
TEST_STEP = 8  # one photograph of so many is a test where none is held out
WHITE_PERCENT = 99.0  # of an object's values, which are not brighter than white


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
    """Write the splits from a capture's photographs, silhouettes and held-out photographs.

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
    white = max((_white(*_read(folder, image)) for image in [*train, *test]), default=0) or 1.0
    common = {
        "camera_model": "OPENCV",
        # Of one camera: loaders ask for them here, and read a frame's own, if at all, later.
        "camera_intrinsics": _intrinsics((train or test)[0].camera),
        "png_white": white,
    }
    for name, images in (("train", train), ("val", []), ("test", test)):
        if images:
            (folder / FOLDER / name).mkdir(parents=True)
        frames = [_write_frame(image, name, setup.scene, folder, white) for image in images]
        file = folder / FOLDER / f"transforms_{name}.json"
        write_whole(file, write_json, {**common, "frames": frames})


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


def _write_frame(
    image: SplitImage, split: str, scene: Scene, folder: Path, white: float
) -> dict[str, Any]:
    """Write one image, as EXR and PNG; returns its frame."""
    stem = f"{split}/{Path(image.photograph).stem}"
    radiance, coverage = _read(folder, image)
    pixels = np.concatenate([radiance, coverage[..., None].astype(radiance.dtype)], axis=2)
    write_whole(folder / FOLDER / f"{stem}.exr", write_rgba_exr, pixels)
    write_whole(folder / FOLDER / f"{stem}.png", write_png, _encoded(radiance, coverage, white))
    light = point_light(image.light, scene.mesh.centre)
    frame = transforms_frame(image.camera, light, stem, "")
    del frame["mask_path"]  # the alpha channel
    return {**frame, "camera_intrinsics": _intrinsics(image.camera)}


def _intrinsics(camera: Table) -> list[float]:
    return [camera[key] for key in ("cx", "cy", "fl_x", "fl_y")]


def _white(radiance: NDArray[Any], coverage: NDArray[np.float32]) -> float:
    """Radiance that an image shows as white: few highlights of the object are brighter."""
    covered = radiance[coverage == 1].astype(np.float64)
    return float(np.percentile(covered, WHITE_PERCENT)) if covered.size else 0.0


def _encoded(
    radiance: NDArray[Any], coverage: NDArray[np.float32], white: float
) -> NDArray[np.uint8]:
    """RGBA of 8 bits, sRGB, not multiplied by alpha: readers multiply."""
    straight = radiance / np.where(coverage > 0, coverage, 1.0)[..., None]
    colour = exposure_brackets.apply((straight / white).astype(np.float32))
    alpha = np.rint(255.0 * coverage).astype(np.uint8)
    return np.concatenate([colour, alpha[..., None]], axis=2)


def _read(folder: Path, image: SplitImage) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Radiance and coverage of files that this program wrote."""
    with OpenEXR.File(str(folder / image.photograph)) as file:
        radiance = file.channels()["RGB"].pixels
    with Image.open(folder / image.silhouette) as opened:
        coverage = np.asarray(opened, np.float32) / 255.0
    return radiance, coverage


def described(folder: Path) -> Iterable[str]:
    """Lines on what was written."""
    return [
        f"Wrote {folder / FOLDER / f'transforms_{name}.json'}" for name in ("train", "test")
    ]
