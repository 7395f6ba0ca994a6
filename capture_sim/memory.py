"""A ceiling of resident memory: what is worked on at once is made to fit under it.

What has to be there at once, whatever the blocks: the program and the mesh; the shaded
points of the view that a worker is at, and one of its photographs; what is kept of one lamp
for all views; the apparent BRDFs that are written in the end. The rest is cut into blocks.
"""

from __future__ import annotations

import math
from dataclasses import replace

import psutil

from capture_sim.contributions import n_described
from capture_sim.effects import (
    environment,
    interreflection,
    light_extent,
    simulated,
    subsurface,
)
from capture_sim.errors import scene_error
from capture_sim.inputs import megabytes
from capture_sim.model import Blocks, Scene
from capture_sim.render import BYTES_PER_VALUE, lookup_nodes
from capture_sim.shading import BYTES_PER_PAIR
from capture_sim.view_samples import rays_per_side
from capture_sim.visibility import pixels_across

# Compiling what has not been compiled before, libraries' buffers, memory that is freed but
# not given back.
RESERVE = 150 << 20
# Of a shaded point while a view is sampled; of a pixel: truth of the view, copies of one
# photograph in lens, sensor and file.
BYTES_PER_POINT = 700
BYTES_PER_PIXEL = 450
# Outlines cross so many pixels for each across the object.
OUTLINE = 12.0
# Of an apparent BRDF's sample while they are written.
BYTES_PER_SAMPLE = 40
SMALLEST_BLOCK = 4 << 20
# Part of the ceiling that may go into what is kept for all views.
TABLES = 1 / 3

_UNITS = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def parse_bytes(text: str) -> int:
    """Size in bytes from text such as ``500MB`` or ``1.5GB``.

    Parameters
    ----------
    text : str

    Returns
    -------
    int

    Raises
    ------
    SceneError
        If the text has another form.

    Examples
    --------
    >>> parse_bytes("1.5GB")
    1610612736
    """
    digits = text.strip().upper().removesuffix("B")
    try:
        size = float(digits[:-1]) * _UNITS[digits[-1:]]
    except (ValueError, KeyError):
        size = math.nan
    if not 0.0 < size < math.inf:
        raise scene_error("--max-memory", "a number with MB or GB, such as 4GB", text)
    return int(size)


def fitted(scene: Scene, workers: int, max_memory: int, *, n_contributions: int = 0) -> Scene:
    """The scene with blocks that keep the process below a ceiling.

    Parameters
    ----------
    scene : Scene
        Its effects decided.
    workers : int
        Views rendered at the same time.
    max_memory : int
        Ceiling of resident memory, bytes, of this process with all that it holds by now.
    n_contributions : int
        Photographs for which contributions are written.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If what has to be there at once does not fit.
    """
    least = least_memory(scene, workers, n_contributions=n_contributions)
    if max_memory < least:
        single = least_memory(scene, 1, n_contributions=n_contributions)
        raise scene_error(
            "--max-memory",
            f"at least {megabytes(least)} for {workers} workers, {megabytes(single)} for one",
            megabytes(max_memory),
            "raise it, or lower --workers, the size of the images or truth.points",
        )
    spare = max_memory - least
    lights = _lights_at_once(scene, spare)
    tables = _kept(scene, lights)
    share = (spare - (tables - _kept(scene, 1))) // workers
    default, depth = Blocks(), _blocks_inside_each_other(scene)
    block = min(default.block, SMALLEST_BLOCK + share // (2 * depth))
    images = min(default.images, _photograph(scene) + share // 2)
    blocks = Blocks(block=block, images=images, tables=max(tables, 1), lights=lights)
    return replace(scene, blocks=blocks)


def least_memory(scene: Scene, workers: int, *, n_contributions: int = 0) -> int:
    """Smallest ceiling, bytes, by estimate.

    Parameters
    ----------
    scene : Scene
        Its effects decided.
    workers, n_contributions : int
        As for `fitted`.

    Returns
    -------
    int
    """
    views = workers * _view(scene) + _kept(scene, 1)
    n_photographs = len(scene.cameras) * len(scene.lights)
    truth = scene.truth.points * (
        BYTES_PER_SAMPLE * n_photographs + BYTES_PER_PAIR * len(scene.lights)
    )
    pixels = max(int(camera["w"]) * int(camera["h"]) for camera in scene.cameras)
    compared = 12 * n_contributions * pixels * (n_described(scene) + 3)
    afterwards = _view(scene) + max(truth, compared)
    return psutil.Process().memory_info().rss + RESERVE + max(views, afterwards)


def _view(scene: Scene) -> int:
    """What one worker needs, with the smallest blocks."""
    inside, edge = rays_per_side(scene)
    sizes = []
    for camera in scene.cameras:
        n_pixels = int(camera["w"]) * int(camera["h"])
        shown = min(n_pixels, math.pi / 4.0 * pixels_across(scene, camera) ** 2)
        points = shown * inside**2 + OUTLINE * math.sqrt(shown) * edge**2
        each = BYTES_PER_PIXEL + len(scene.lights)  # a byte a light: which are visible
        sizes.append(BYTES_PER_POINT * points + each * n_pixels)
    smallest = _blocks_inside_each_other(scene) * SMALLEST_BLOCK + _photograph(scene)
    if simulated(scene, interreflection):  # the paths of a point are traced together
        smallest += interreflection.bytes_per_point(scene, len(scene.lights))
    return int(max(sizes)) + smallest


def _photograph(scene: Scene) -> int:
    pixels = max(int(camera["w"]) * int(camera["h"]) for camera in scene.cameras)
    return 3 * BYTES_PER_VALUE * pixels


def _blocks_inside_each_other(scene: Scene) -> int:
    """Blocks of one worker at the same time: paths have their own inside the shading."""
    return 3 if simulated(scene, interreflection) else 1


def _kept(scene: Scene, lights: int) -> int:
    """What is kept for all views of some lamps, and of the room."""
    nodes = lookup_nodes(scene)
    total = 0 if nodes is None else 8 * len(nodes) * -(-lights // 64)
    if simulated(scene, subsurface):
        each, room = 1, 0
        if simulated(scene, light_extent):
            each = scene.effects.get(light_extent.Options).samples
        if simulated(scene, environment):
            room = scene.effects.get(environment.Options).samples
        total += subsurface.bytes_per_light(scene) * (lights * each + room)
    return total


def _lights_at_once(scene: Scene, spare: int) -> int:
    """As many lamps as fit into their part of the memory; at least one."""
    least, n_lights = _kept(scene, 1), len(scene.lights)
    fits = [n for n in (n_lights, *range(64 * (n_lights // 64), 0, -64), *range(63, 0, -1))
            if n <= n_lights and _kept(scene, n) - least <= TABLES * spare]  # fmt: skip
    return max(fits, default=1)
