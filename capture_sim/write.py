"""The native capture directory, version 1.

Everything goes to a hidden folder beside the target, which is renamed when
complete: a capture is either there and whole, or not there. What was interrupted
stays in the hidden folder, each file of it whole, and the same command goes on from there.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.brightness import measured
from capture_sim.contributions import contributions, some_pairs
from capture_sim.effects import Frame, exposure_brackets, simulated
from capture_sim.effects.sensor import exposed
from capture_sim.errors import scene_error
from capture_sim.files import write_exr, write_json, write_png, write_silhouette
from capture_sim.fingerprint import fingerprint
from capture_sim.model import Scene
from capture_sim.photograph import Setup, photographs, set_up
from capture_sim.rays import RayTracer
from capture_sim.record import write_record
from capture_sim.render import sample_view, traced_lights
from capture_sim.stopwatch import Stopwatch
from capture_sim.truth import write_truth, write_view_truth
from capture_sim.visibility import TracedLights

Table = Mapping[str, Any]

GENERATOR = "capture_sim"
CAPTURE_FILE = "capture.json"
FINGERPRINT_FILE = "scene.sha256"

# (views done, views in all); called once more for the truth that is not per view.
Progress = Callable[[int, int], None]


def write_capture(
    scene: Scene,
    folder: Path,
    *,
    workers: int = 1,
    overwrite: bool = False,
    n_contributions: int = 0,
    progress: Progress | None = None,
) -> Path:
    """Simulate a scene and write its photographs and truth.

    Parameters
    ----------
    scene : Scene
        What to simulate.
    folder : Path
        Written as a whole at the end; the bytes do not depend on `workers`. Photographs
        of the same scene that an interrupted call left are taken over.
    workers : int
        Views rendered at the same time.
    overwrite : bool
        True to replace an earlier capture there; anything else is kept.
    n_contributions : int
        Photographs for which it is written what each effect contributed to them.
    progress : callable, optional
        Called with the steps done and their total number.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    SceneError
        If the folder exists and may not be replaced.
    """
    check_target(folder, overwrite=overwrite)
    part = _begun(scene, folder)
    # One thread traces at a time, on behalf of all.
    tracer = RayTracer(scene.mesh, n_threads=workers)
    setup = set_up(measured(scene, tracer))
    report, steps = progress or _no_progress, len(scene.cameras) + 1
    _write_views(setup, tracer, part, workers, report)
    _write_rest(setup, tracer, part, n_contributions)
    report(steps, steps)
    (part / FINGERPRINT_FILE).unlink()
    _move_into_place(part, folder)
    return folder


def _begun(scene: Scene, folder: Path) -> Path:
    """The hidden folder, with what an interrupted call for the same scene left in it."""
    part = folder.parent / f".{folder.name}.incomplete"
    mark, file = fingerprint(scene), part / FINGERPRINT_FILE
    if file.is_file() and file.read_text(encoding="ascii") == mark:
        return part
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    file.write_text(mark, encoding="ascii")
    return part


def _no_progress(done: int, total: int) -> None:
    """Tell nobody."""


def check_target(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder that may not be written.

    Parameters
    ----------
    folder : Path
        Where a capture is to go.
    overwrite : bool
        True if an earlier capture may be replaced.

    Raises
    ------
    SceneError
        If there is a file, a folder that holds something else, or a capture
        that may not be replaced.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise scene_error(str(folder), "a folder or nothing", "a file", "choose another place")
    if (folder / CAPTURE_FILE).is_file():
        if not overwrite:
            raise scene_error(
                str(folder), "no capture there yet", "one", "pass --overwrite to replace it"
            )
    elif any(folder.iterdir()):
        raise scene_error(
            str(folder),
            "an empty folder or an earlier capture",
            f"a folder without {CAPTURE_FILE}",
            "choose another place; it is not deleted",
        )


def _move_into_place(part: Path, folder: Path) -> None:
    if not folder.exists():
        part.rename(folder)
        return
    old = folder.parent / f".{folder.name}.replaced"
    shutil.rmtree(old, ignore_errors=True)
    folder.rename(old)
    part.rename(folder)
    shutil.rmtree(old)


def _write_views(
    setup: Setup, tracer: RayTracer, folder: Path, workers: int, progress: Progress
) -> None:
    traced = traced_lights(setup.real, tracer)
    for name in ("photographs", "silhouettes"):
        (folder / name).mkdir(exist_ok=True)
    views = range(len(setup.scene.cameras))
    steps = len(views) + 1
    progress(0, steps)
    with ThreadPoolExecutor(workers) as pool:
        futures = [
            pool.submit(_write_view, setup, tracer, traced, view, folder) for view in views
        ]
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                future.result()
                progress(done, steps)
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
    write_json(folder / CAPTURE_FILE, capture_description(setup))


def _write_view(
    setup: Setup, tracer: RayTracer, traced: TracedLights | None, index: int, folder: Path
) -> None:
    scene = setup.real
    camera = scene.cameras[index]
    files = [_files(scene, camera, light) for light in scene.lights]
    missing = [not all((folder / file).is_file() for file in names) for names in files]
    lights = np.flatnonzero(setup.rig.taken[index] & missing)
    silhouette = folder / _silhouette(camera)
    if len(lights) or not silhouette.is_file():
        view = sample_view(scene, tracer, camera)
        for frame, radiance in photographs(scene, tracer, index, lights, view, traced):
            _write_photograph(scene, folder, frame, radiance)
        _whole(silhouette, write_silhouette, view.coverage)
    if scene.truth.per_view:
        write_view_truth(scene, tracer, camera, folder)


def _files(scene: Scene, camera: Table, light: Table) -> list[str]:
    """Files of one photograph."""
    if simulated(scene, exposure_brackets):
        return [exposure["file"] for exposure in _exposures(scene, camera, light)]
    return [_photograph(camera["id"], light["id"])]


def _write_photograph(
    scene: Scene, folder: Path, frame: Frame, radiance: NDArray[np.float32]
) -> None:
    camera, light = frame.camera, scene.lights[frame.light]
    if not simulated(scene, exposure_brackets):
        values = exposed(scene, radiance, frame)
        _whole(folder / _photograph(camera["id"], light["id"]), write_exr, values)
        return
    for index, exposure in enumerate(_exposures(scene, camera, light)):
        bracket = replace(frame, exposure=index, seconds=exposure["seconds"])
        values = exposed(scene, radiance, bracket)
        _whole(folder / exposure["file"], write_png, exposure_brackets.apply(values))


def _whole(path: Path, write: Callable[[Path, Any], None], values: Any) -> None:
    """Write a file under another name first: what has its name is whole."""
    beginning = path.with_name(f".{path.name}")
    write(beginning, values)
    beginning.rename(path)


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
    if setup.rig.taken.all() and not bracketed:
        return {"pattern": _photograph("{camera}", "{light}")}
    return [
        _listed(setup.scene, setup.scene.cameras[view], setup.scene.lights[light], bracketed)
        for view, light in np.argwhere(setup.rig.taken).tolist()
    ]


def _listed(scene: Scene, camera: Table, light: Table, bracketed: bool) -> dict[str, Any]:
    names = {"camera": camera["id"], "light": light["id"]}
    if bracketed:
        return {**names, "exposures": _exposures(scene, camera, light)}
    return {**names, "file": _photograph(camera["id"], light["id"])}
