"""The native capture directory, version 1; `capture_sim.destination` says where it is made."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.brightness import measured
from capture_sim.contributions import contributions, some_pairs
from capture_sim.destination import (
    CAPTURE_FILE,
    begin,
    begun_for,
    check_target,
    finish,
    publish,
    reserved,
)
from capture_sim.effects import Photograph, exposure_brackets, simulated
from capture_sim.effects.sensor import exposed
from capture_sim.errors import scene_error
from capture_sim.files import (
    write_exr,
    write_json,
    write_png,
    write_silhouette,
    write_whole,
)
from capture_sim.fingerprint import fingerprint
from capture_sim.memory import fitted
from capture_sim.model import Scene
from capture_sim.photograph import Setup, photographs, set_up
from capture_sim.rays import RayTracer
from capture_sim.record import write_record
from capture_sim.render import traced_lights
from capture_sim.stopwatch import Stopwatch
from capture_sim.transforms import check_transforms, write_transforms
from capture_sim.truth import write_truth, write_view_truth
from capture_sim.view_samples import sample_view
from capture_sim.visibility import TracedLights

Table = Mapping[str, Any]
Lights = NDArray[np.intp]

GENERATOR = "capture_sim"
MOST_WORKERS = 1024

# (photographs done, photographs in all); first with those that are there already.
Progress = Callable[[int, int], None]


def write_capture(
    scene: Scene,
    folder: Path,
    *,
    workers: int = 1,
    max_memory: int | None = None,
    overwrite: bool = False,
    n_contributions: int = 0,
    as_transforms: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Simulate a scene and write its photographs and truth.

    Parameters
    ----------
    scene : Scene
        What to simulate.
    folder : Path
        Written as a whole at the end; the bytes depend neither on `workers` nor on
        `max_memory`. Photographs of the same scene that an interrupted call left are
        taken over.
    workers : int
        Views rendered at the same time, 1 to 1024.
    max_memory : int, optional
        Ceiling of this process' resident memory, bytes; see `capture_sim.memory`.
    overwrite : bool
        True to replace an earlier capture there; anything else is kept.
    n_contributions : int
        Photographs for which it is written what each effect contributed to them.
    as_transforms : bool
        True to add ``transforms/``; see `capture_sim.transforms`.
    progress : callable, optional
        Called with the photographs done and their total number, by any thread but by one
        at a time.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    SceneError
        If the folder exists and may not be replaced, another process writes to it, the
        memory does not suffice, or ``transforms/`` cannot hold the scene.
    OSError
        If a file cannot be written; names it.
    """
    target, mark = Path(os.path.abspath(folder)), fingerprint(scene)  # noqa: PTH100
    check_workers(workers)
    if as_transforms:
        check_transforms(scene)
    with reserved(target) as part:
        known = begun_for(part) == mark
        if finish(part, target) and known:
            return folder
        check_target(target, overwrite=overwrite)
        # One thread traces at a time, on behalf of all.
        tracer = RayTracer(scene.mesh, n_threads=min(workers, os.cpu_count() or 1))
        ready = measured(scene, tracer)
        if max_memory is not None:
            ready = fitted(ready, workers, max_memory, n_contributions=n_contributions)
        setup = set_up(ready)
        begin(part, mark)
        _write_views(setup, tracer, part, workers, progress or _no_progress)
        _write_rest(setup, tracer, part, n_contributions)
        if as_transforms:
            write_transforms(setup, part)
        publish(part, target, overwrite=overwrite)
    return folder


def check_workers(workers: int) -> None:
    """Refuse numbers of threads that no machine has.

    Parameters
    ----------
    workers : int

    Raises
    ------
    SceneError
        If it is not in the range.
    """
    if not 1 <= workers <= MOST_WORKERS:
        raise scene_error(
            "workers", f"1 to {MOST_WORKERS}", workers, "one for each processor core is most"
        )


def _no_progress(done: int, total: int) -> None:
    """Tell nobody."""


class _Tally:
    """Counts photographs for many threads and reports them.

    Parameters
    ----------
    done, total : int
    progress : callable
    """

    def __init__(self, done: int, total: int, progress: Progress) -> None:
        self._done, self._total, self._progress = done, total, progress
        self._lock = threading.Lock()
        progress(done, total)

    def add_one(self) -> None:
        """One more is there."""
        with self._lock:
            self._done += 1
            self._progress(self._done, self._total)


def _write_views(
    setup: Setup, tracer: RayTracer, folder: Path, workers: int, progress: Progress
) -> None:
    for name in ("photographs", "silhouettes"):
        (folder / name).mkdir(exist_ok=True)
    scene = setup.real
    wanted = setup.rig.photographed & _missing(scene, folder)
    total = int(setup.rig.photographed.sum())
    tally = _Tally(total - int(wanted.sum()), total, progress)
    for lights in _groups(scene):
        traced = traced_lights(scene, tracer, lights) if wanted[:, lights].any() else None

        def write_view(
            view: int, lights: Lights = lights, traced: TracedLights | None = traced
        ) -> None:
            chosen = lights[wanted[view, lights]]
            _write_view(scene, tracer, traced, view, chosen, folder, tally)

        _for_all(len(scene.cameras), write_view, workers)


def _missing(scene: Scene, folder: Path) -> NDArray[np.bool_]:
    """True for photographs that are not there yet, (n_views, n_lights)."""
    there = {path.name for path in (folder / "photographs").iterdir()}

    def missing(camera: Table, light: Table) -> bool:
        return not all(Path(file).name in there for file in _files(scene, camera, light))

    return np.array(
        [[missing(camera, light) for light in scene.lights] for camera in scene.cameras]
    )


def _groups(scene: Scene) -> list[Lights]:
    """Lights that are worked on together; all of them unless memory is short."""
    n_lights, step = len(scene.lights), scene.blocks.lights
    return np.split(np.arange(n_lights), range(step, n_lights, step))


def _for_all(count: int, work: Callable[[int], None], workers: int) -> None:
    """Do some work for all indices, some of them at the same time; stop at an error."""
    with ThreadPoolExecutor(min(workers, count)) as pool:
        futures = [pool.submit(work, index) for index in range(count)]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _write_rest(setup: Setup, tracer: RayTracer, folder: Path, n_contributions: int) -> None:
    """Truth that is not per view, what was simulated, and the description of all."""
    scene = replace(setup.scene, costs=Stopwatch())  # comparing is no part of the cost
    pairs = some_pairs(scene, n_contributions) if n_contributions else []
    contributed = contributions(scene, tracer, pairs) if pairs else []
    (folder / "truth").mkdir(exist_ok=True)
    more = write_record(setup, contributed, folder)
    write_truth(setup.real, tracer, folder, ideal=setup.reported, more=more)
    write_whole(folder / CAPTURE_FILE, write_json, capture_description(setup))


def _write_view(
    scene: Scene,
    tracer: RayTracer,
    traced: TracedLights | None,
    index: int,
    lights: Lights,
    folder: Path,
    tally: _Tally,
) -> None:
    camera = scene.cameras[index]
    silhouette = folder / _silhouette(camera)
    if len(lights) or not silhouette.is_file():
        view = sample_view(scene, tracer, camera)
        for photograph, radiance in photographs(scene, tracer, index, lights, view, traced):
            _write_photograph(scene, folder, photograph, radiance)
            tally.add_one()
        write_whole(silhouette, write_silhouette, view.coverage)
    if scene.truth.per_view:
        write_view_truth(scene, tracer, camera, folder)


def _files(scene: Scene, camera: Table, light: Table) -> list[str]:
    """Files of one photograph."""
    if simulated(scene, exposure_brackets):
        return [exposure["file"] for exposure in _exposures(scene, camera, light)]
    return [_photograph(camera["id"], light["id"])]


def _write_photograph(
    scene: Scene, folder: Path, photograph: Photograph, radiance: NDArray[np.float32]
) -> None:
    camera, light = photograph.camera, scene.lights[photograph.light]
    if not simulated(scene, exposure_brackets):
        values = exposed(scene, radiance, photograph)
        write_whole(folder / _photograph(camera["id"], light["id"]), write_exr, values)
        return
    for index, exposure in enumerate(_exposures(scene, camera, light)):
        bracket = replace(photograph, exposure=index, seconds=exposure["seconds"])
        values = exposed(scene, radiance, bracket)
        write_whole(folder / exposure["file"], write_png, exposure_brackets.apply(values))


def _photograph(camera: str, light: str) -> str:
    return f"photographs/{camera}_{light}.exr"


def _exposures(scene: Scene, camera: Table, light: Table) -> list[dict[str, Any]]:
    """Files and times of a bracketed photograph; empty for linear ones."""
    stem = f"photographs/{camera['id']}_{light['id']}"
    return [
        {"file": f"{stem}_e{index}.png", "seconds": seconds}
        for index, seconds in enumerate(scene.effects.get(exposure_brackets.Options).seconds)
    ]


def _silhouette(camera: Table) -> str:
    return f"silhouettes/{camera['id']}.png"


def capture_description(setup: Setup) -> dict[str, Any]:
    """Contents of `capture.json`.

    Parameters
    ----------
    setup : Setup
        What was simulated; its calibration is reported.

    Returns
    -------
    dict
        Of JSON types, in the order in which it is written.
    """
    scene, rig = setup.scene, setup.rig
    return {
        "format": "reflfield-capture",
        "version": 1,
        "name": scene.name,
        "generator": GENERATOR,
        "base_geometry": scene.base_geometry,
        "cameras": [{**c, "silhouette": _silhouette(c)} for c in rig.reported_cameras],
        "lights": [dict(light) for light in rig.reported_lights],
        "photographs": _photograph_list(setup),
        "truth": "truth/truth.json",
    }


def _photograph_list(setup: Setup) -> dict[str, str] | list[dict[str, Any]]:
    bracketed = simulated(setup.scene, exposure_brackets)
    if setup.rig.photographed.all() and not bracketed:
        return {"pattern": _photograph("{camera}", "{light}")}
    return [
        _listed(setup.scene, setup.scene.cameras[view], setup.scene.lights[light], bracketed)
        for view, light in np.argwhere(setup.rig.photographed).tolist()
    ]


def _listed(scene: Scene, camera: Table, light: Table, bracketed: bool) -> dict[str, Any]:
    names = {"camera": camera["id"], "light": light["id"]}
    if bracketed:
        return {**names, "exposures": _exposures(scene, camera, light)}
    return {**names, "file": _photograph(camera["id"], light["id"])}
