"""Silhouettes of photographs that are compared: made once, from more than they show."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import PLANE, Capture
from reflfield.errors import CaptureError
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.ray_scene import RayScene
from reflfield.render.exposure import COVERAGE_OF_OBJECT
from reflfield.util.files import load_arrays

Float32 = NDArray[np.float32]

# Where a silhouette comes from.
GIVEN, ALPHA, PHOTOGRAPHS, HULL, IMAGE = "given", "alpha", "photographs", "hull", "image"
# Under fewer lamps a side of the object may be dark in all photographs of a view.
LEAST_PHOTOGRAPHS = 4
ORIGINS = "origins.json"
HEADER_BYTES = 4096


@dataclass(frozen=True, eq=False)
class ComparisonSilhouettes:
    """Silhouettes of the views of some photographs, on disk.

    Parameters
    ----------
    folder : Path
        As `write_comparison_silhouettes` leaves it.
    cameras : tuple of Camera
        Of the views.
    origins : tuple of {"given", "alpha", "photographs", "hull", "image"}
        Where the silhouette of each view comes from.
    """

    folder: Path
    cameras: tuple[Camera, ...]
    origins: tuple[str, ...]

    def read(self, view: int) -> Float32:
        """Coverage of a view in [0, 1], (h, w) float32, in steps of 1/255."""
        camera = self.cameras[view]
        most = camera.width * camera.height + HEADER_BYTES
        stored = load_arrays(_file(self.folder, view), most)
        return stored["coverage"].astype(np.float32) / np.float32(255)


def open_comparison_silhouettes(folder: Path, compared: Capture) -> ComparisonSilhouettes:
    """Open what `write_comparison_silhouettes` has left of the same photographs."""
    origins = json.loads((folder / ORIGINS).read_text())
    return ComparisonSilhouettes(folder, compared.cameras, tuple(origins))


def write_comparison_silhouettes(
    compared: Capture, around: Capture, mesh: Mesh, folder: Path, threads: int = 0
) -> ComparisonSilhouettes:
    """Make and store the silhouette of every view of some photographs.

    The one given for the view; else the alpha of its photographs; else, where the base
    surface is a plane, the whole image; else one made from all photographs of its camera,
    held out or not, if they are `LEAST_PHOTOGRAPHS` or more, or taken in the one unknown light
    that the field holds, and show an object; else the mesh as the camera sees it.

    Parameters
    ----------
    compared : Capture
        Photographs that are compared.
    around : Capture
        What they are part of, with cameras of the same names: all photographs.
    mesh : Mesh
        Base surface of the field.
    folder : Path
        Gets the silhouettes; made if absent.
    threads : int
        Of the rays; 0 takes all.

    Returns
    -------
    ComparisonSilhouettes
    """
    folder.mkdir(parents=True, exist_ok=True)
    scene, ids = RayScene(mesh, threads), [camera.id for camera in around.cameras]
    origins = []
    for view, camera in enumerate(compared.cameras):
        coverage, origin = _coverage(around, ids.index(camera.id), scene)
        pixels = np.rint(np.clip(coverage, 0, 1) * 255).astype(np.uint8)
        np.savez_compressed(_file(folder, view), coverage=pixels)
        origins.append(origin)
    (folder / ORIGINS).write_text(json.dumps(origins))
    return ComparisonSilhouettes(folder, compared.cameras, tuple(origins))


def _file(folder: Path, view: int) -> Path:
    return folder / f"{view}.npz"


def _coverage(capture: Capture, view: int, scene: RayScene) -> tuple[Float32, str]:
    """Silhouette of one view, and where it comes from."""
    if capture.silhouettes[view] is not None:
        return capture.read_silhouette(view), GIVEN
    alpha = capture.read_alpha(view)
    if alpha is not None and (alpha > COVERAGE_OF_OBJECT).any():
        return alpha, ALPHA
    if capture.base_geometry == PLANE:
        return capture.read_silhouette(view), IMAGE
    enough = LEAST_PHOTOGRAPHS if capture.lights_known else 1
    if sum(p.camera == view for p in capture.photographs) >= enough:
        try:
            return capture.read_silhouette(view), PHOTOGRAPHS
        except CaptureError:  # all dark: no object is found in them
            pass
    return projected_coverage(scene, capture.cameras[view]), HULL


def projected_coverage(scene: RayScene, camera: Camera) -> Float32:
    """1 where the ray through a pixel's centre meets the mesh, else 0; (h, w) float32."""
    return scene.silhouette(camera).astype(np.float32)
