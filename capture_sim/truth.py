"""The truth of every stage: what a perfect processing would have found.

``truth/truth.json`` names the files, all relative to the capture:

=================  ==========================================================
mesh               the true surface, PLY with normals and texture coordinates
views              npz per camera, for the rays through the pixels' centres
heldout            transforms.json of unseen views under unseen lights
abrdf              npz of surface points with their full apparent BRDFs
effects            which effects were simulated, why, what they took and changed
contributions      EXR per effect and photograph: with the effect less without it
rig                cameras and lights as they were, if not as reported
=================  ==========================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.files import (
    write_exr,
    write_json,
    write_npz,
    write_ply,
    write_silhouette,
    write_whole,
)
from capture_sim.heldout import heldout_pairs, transforms_frame
from capture_sim.model import Scene
from capture_sim.rays import Hits, RayTracer, camera_rays, towards_camera, world_from_camera
from capture_sim.render import arriving_light, lit_pairs, reflectance_of_pairs, shade
from capture_sim.shading import BYTES_PER_PAIR
from capture_sim.surface import SurfacePoints, spread_points, surface_points
from capture_sim.view_samples import sample_view

Table = Mapping[str, Any]
Arrays = dict[str, NDArray[Any]]


def write_truth(
    scene: Scene, tracer: RayTracer, folder: Path, *, ideal: Scene, more: Mapping[str, str]
) -> None:
    """Write all truth that is not per view, and the list of what there is.

    Parameters
    ----------
    scene : Scene
        With cameras and lights as they are.
    tracer : RayTracer
        Of the scene's mesh.
    folder : Path
        The capture; ``truth/`` is made inside.
    ideal : Scene
        With cameras and lights as calibrated: held-out photographs are free of the rig's
        errors, of the lens' and of the sensor's.
    more : dict of str to str
        Further entries of the list of what there is.
    """
    truth = folder / "truth"
    truth.mkdir(exist_ok=True)
    listing: dict[str, Any] = {"version": 1, "mesh": "truth/mesh.ply"}
    write_whole(truth / "mesh.ply", write_ply, scene.mesh)
    if scene.truth.per_view:
        listing["views"] = "truth/views/{camera}.npz"
    if ideal.heldout_photographs:
        listing["heldout"] = "truth/heldout.json"
        _write_heldout(ideal, tracer, truth)
    if scene.truth.points:
        listing["abrdf"] = "truth/abrdf.npz"
        write_whole(truth / "abrdf.npz", write_npz, apparent_brdfs(scene, tracer))
    write_whole(truth / "truth.json", write_json, {**listing, **more})


def write_view_truth(scene: Scene, tracer: RayTracer, camera: Table, folder: Path) -> None:
    """Write the truth of one camera to ``truth/views/<camera>.npz``, unless it is there.

    Parameters
    ----------
    scene : Scene
    tracer : RayTracer
        Of the scene's mesh.
    camera : dict
        Camera of the native capture format.
    folder : Path
        The capture.
    """
    target = folder / "truth" / "views" / f"{camera['id']}.npz"
    target.parent.mkdir(parents=True, exist_ok=True)
    if not target.is_file():
        write_whole(target, write_npz, view_truth(scene, tracer, camera))


def view_truth(scene: Scene, tracer: RayTracer, camera: Table) -> Arrays:
    """What the rays through the centres of the pixels meet.

    Parameters
    ----------
    scene : Scene
    tracer : RayTracer
        Of the scene's mesh.
    camera : dict
        Camera of the native capture format.

    Returns
    -------
    dict of arrays
        ``depth`` (h, w) float32, metres along the ray, infinite for a miss;
        ``position``, ``normal``, ``tangent`` (h, w, 3) float32, world, of the
        shading frame, zero for a miss; ``label`` (h, w) int16, -1 for a miss;
        ``light_visible`` (h, w, ceil(n_lights / 8)) uint8: bits, lowest
        first, 1 where the light is above the shading horizon and not hidden;
        ``n_lights`` () int32.
    """
    height, width = int(camera["h"]), int(camera["w"])
    hits = tracer.first_hits(*_central_rays(camera, height, width))
    points = surface_points(
        scene.mesh, scene.material, hits.face[hits.hit], hits.barycentric[hits.hit]
    )
    frame = points.shading_from_world
    visible = np.packbits(lights_visible(scene, tracer, points), axis=1, bitorder="little")

    def image(values: NDArray[Any], missing: float = 0.0) -> NDArray[Any]:
        return _as_image(hits, values, missing).reshape(height, width, *values.shape[1:])

    return {
        "depth": hits.distance.reshape(height, width),
        "position": image(points.position.astype(np.float32)),
        "normal": image(frame[:, 2].astype(np.float32)),
        "tangent": image(frame[:, 0].astype(np.float32)),
        "label": image(points.label, missing=-1),
        "light_visible": image(visible),
        "n_lights": np.array(len(scene.lights), dtype=np.int32),
    }


def _central_rays(camera: Table, height: int, width: int) -> tuple[NDArray[Any], NDArray[Any]]:
    row, column = np.divmod(np.arange(height * width), width)
    return camera_rays(camera, np.stack([column, row], axis=1) + 0.5)


def _as_image(hits: Hits, values: NDArray[Any], missing: float) -> NDArray[Any]:
    full = np.full((len(hits.face), *values.shape[1:]), missing, dtype=values.dtype)
    full[hits.hit] = values
    return full


def lights_visible(scene: Scene, tracer: RayTracer, points: SurfacePoints) -> NDArray[np.bool_]:
    """Which lights reach which points.

    Parameters
    ----------
    scene : Scene
    tracer : RayTracer
        Of the scene's mesh.
    points : SurfacePoints
        n points.

    Returns
    -------
    (n, n_lights) bool
        True where the light is above the shading horizon and not hidden.
    """
    visible = np.zeros((len(points), len(scene.lights)), dtype=bool)
    step = scene.blocks.items(len(scene.lights) * BYTES_PER_PAIR)
    for first in range(0, len(points), step):
        block = points[first : first + step]
        arriving = arriving_light(scene, scene.lights, block.position)
        visible[first : first + step] = lit_pairs(scene, tracer, block, arriving)[0]
    return visible


def apparent_brdfs(scene: Scene, tracer: RayTracer) -> Arrays:
    """Full apparent BRDFs of points spread evenly over the surface.

    Parameters
    ----------
    scene : Scene
        Gives their number and the seed.
    tracer : RayTracer
        Of the scene's mesh.

    Returns
    -------
    dict of arrays
        ``position`` (n, 3) and ``frame``, ``surface_frame`` (n, 3, 3) float32,
        rows tangent, binormal, normal in the world, with and without what the
        material does to the frame; ``label`` (n,) int16; ``views``
        (n, n_views, 3) and ``lights`` (n, n_lights, 3) float32, unit
        directions from the point, world; ``view_visible``, ``light_visible``
        bool, above the shading horizon and not hidden; ``samples``
        (n, n_views, n_lights, 3) float32 in 1/sr, BRDF times cosine times
        visibility of the light, without noise and whether or not the camera
        sees the point; ``observed`` (n, n_views, n_lights) bool, True where it
        does.
    """
    points = area_uniform_points(scene, np.random.default_rng((scene.seed, 2)))
    views = np.stack([towards_camera(c, points.position) for c in scene.cameras], axis=1)
    arriving = arriving_light(scene, scene.lights, points.position)
    lit, cosine = lit_pairs(scene, tracer, points, arriving)
    samples = np.zeros((len(points), len(scene.cameras), len(scene.lights), 3), np.float32)
    for view in range(len(scene.cameras)):
        samples[:, view] = reflectance_of_pairs(
            scene.material, points, views[:, view], arriving.directions, lit, cosine
        )
    view_visible = _view_visible(scene, tracer, points, views)
    seen_by_any_light = np.ones((1, 1, len(scene.lights)), dtype=bool)
    return {
        "position": points.position.astype(np.float32),
        "frame": points.shading_from_world.astype(np.float32),
        "surface_frame": points.surface_from_world.astype(np.float32),
        "label": points.label,
        "views": views.astype(np.float32),
        "lights": arriving.directions.astype(np.float32),
        "view_visible": view_visible,
        "light_visible": lit,
        "samples": samples,
        "observed": view_visible[:, :, None] & seen_by_any_light,
    }


def _view_visible(
    scene: Scene, tracer: RayTracer, points: SurfacePoints, views: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """True where a camera sees a point, whatever its frame shows; (n, n_views)."""
    visible = np.einsum("nvj,nj->nv", views, points.shading_from_world[:, 2]) > 0.0
    for view, camera in enumerate(scene.cameras):
        starts = points.position + tracer.start_offset * points.face_normal
        reach = _distance_to_camera(camera, points.position)
        targets = points.position + views[:, view] * reach[:, None]
        visible[:, view] &= ~tracer.occluded(starts, targets)
    return visible


def _distance_to_camera(camera: Table, points: NDArray[np.float64]) -> NDArray[np.float64]:
    world = world_from_camera(camera)
    if camera["model"] == "orthographic":
        return (points - world[:3, 3]) @ world[:3, 2]
    return np.asarray(np.linalg.norm(points - world[:3, 3], axis=1))


def area_uniform_points(scene: Scene, rng: np.random.Generator) -> SurfacePoints:
    """Random points, equally dense everywhere on the surface.

    Parameters
    ----------
    scene : Scene
        Gives surface, material and number of points.
    rng : numpy.random.Generator

    Returns
    -------
    SurfacePoints
    """
    face, barycentric = spread_points(scene.mesh, scene.truth.points, rng)
    return surface_points(scene.mesh, scene.material, face, barycentric)


def _write_heldout(scene: Scene, tracer: RayTracer, truth: Path) -> None:
    (truth / "heldout").mkdir(exist_ok=True)
    frames = []
    for camera, light in heldout_pairs(scene):
        view = sample_view(scene, tracer, camera)
        image = f"heldout/{camera['id']}.exr"
        silhouette = f"heldout/{camera['id']}_silhouette.png"
        write_whole(truth / image, write_exr, shade(scene, tracer, view, (light,))[0])
        write_whole(truth / silhouette, write_silhouette, view.coverage)
        frames.append(transforms_frame(camera, light, image, silhouette))
    description = {"camera_model": "OPENCV", "frames": frames}
    write_whole(truth / "heldout.json", write_json, description)
