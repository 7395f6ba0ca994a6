"""Which effects a scene calls for, why, and what the rendering will cost.

Costs are measured, not guessed: a few views are traced, a few lights shaded
and one photograph written, and the times and sizes scaled to the whole.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from capture_sim.brightness import coarser, measured, spread
from capture_sim.effects import Cost, Effect, Workload, simulated
from capture_sim.effects.effect_registry import EFFECTS
from capture_sim.files import write_exr
from capture_sim.memory import fitted
from capture_sim.model import Scene
from capture_sim.rays import RayTracer
from capture_sim.record import bound_text
from capture_sim.render import arriving_light, shade
from capture_sim.truth import write_view_truth
from capture_sim.view_samples import ViewSamples, sample_view

# Timed in earnest: enough to average over the sides of the object.
SAMPLE_VIEWS = 3
SAMPLE_LIGHTS = 6
# Pixels along the larger side of the images that are tried; counts grow with the pixels.
SAMPLE_SIDE = 512

Table = Mapping[str, Any]
Result = TypeVar("Result")


@dataclass(frozen=True)
class PlannedEffect:
    """Decision about one effect.

    Attributes
    ----------
    name : str
    simulated : bool
    reason : str
    bound : float
        Largest change of any photograph if it is left out, as a part of the
        photograph's 99th percentile.
    cost : Cost
        What it adds to the rendering; nothing if it is not simulated.
    """

    name: str
    simulated: bool
    reason: str
    bound: float
    cost: Cost


@dataclass(frozen=True)
class Plan:
    """What will be simulated, and its cost.

    Attributes
    ----------
    scene : str
        Name of the scene.
    work : Workload
        Counts; those of points and lit pairs are estimates.
    effects : tuple of PlannedEffect
    seconds : float
        Estimated time of one worker on this machine.
    bytes : int
        Estimated size of the capture.
    repairs : tuple of str
        What was wrong with the object's mesh and has been repaired.
    """

    scene: str
    work: Workload
    effects: tuple[PlannedEffect, ...]
    seconds: float
    bytes: int
    repairs: tuple[str, ...] = ()

    @property
    def rays(self) -> int:
        """Rays of all effects."""
        return sum(effect.cost.rays for effect in self.effects)

    def lines(self) -> list[str]:
        """Describe the plan, one fact a line."""
        work = self.work
        counts = [
            f"scene        {self.scene}",
            f"photographs  {work.n_photographs} ({work.n_views} views, {work.n_lights} lights)",
            f"rays         {self.rays / 1e6:.1f} million",
            f"shading      {work.n_lit / 1e6:.1f} million lit pairs of point and light",
            f"time         about {_seconds_text(self.seconds)} on one worker",
            f"size         about {self.bytes / 1e6:.1f} MB",
            *(f"repaired     {note}" for note in self.repairs),
            "effects      name                 leaving it out    cost  why",
        ]
        return counts + [
            f"  {'on' if effect.simulated else 'off':3}  {effect.name:20} "
            f"{bound_text(effect.bound):>12}  {_cost_text(effect.cost):>8}  {effect.reason}"
            for effect in self.effects
        ]


def _seconds_text(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def _cost_text(cost: Cost) -> str:
    """Millions of rays, or else of other evaluations."""
    if cost.rays:
        return f"{cost.rays / 1e6:.1f}M rays"
    return f"{cost.operations / 1e6:.1f}M" if cost.operations else "0"


def plan(scene: Scene, *, max_memory: int | None = None) -> Plan:
    """Decide on the effects of a scene and estimate its cost on this machine.

    Parameters
    ----------
    scene : Scene
    max_memory : int, optional
        Ceiling of this process' resident memory, bytes, with one worker.

    Returns
    -------
    Plan
        Its times depend on how busy the machine is.

    Raises
    ------
    SceneError
        If the memory does not suffice for the scene.
    """
    tracer = RayTracer(scene.mesh)
    scene = measured(scene, tracer)
    if max_memory is not None:
        scene = fitted(scene, 1, max_memory)
    sample_run = _run_sample(scene, tracer)
    n_views, n_lights = len(scene.cameras), len(scene.lights)
    points = sample_run.points_per_view * n_views
    work = Workload(
        n_views=n_views,
        n_lights=n_lights,
        n_pixels=sum(int(camera["w"]) * int(camera["h"]) for camera in scene.cameras),
        n_points=int(points),
        n_lit=int(points * n_lights * sample_run.lit_fraction),
    )
    n_photographs = work.n_photographs + scene.heldout_photographs
    fixed_bytes = 4 * scene.truth.points * work.n_photographs  # samples, deflated to a third
    fixed_bytes += 32 * len(scene.mesh.vertices) + 13 * len(scene.mesh.faces)  # the mesh
    return Plan(
        scene=scene.name,
        work=work,
        effects=tuple(_planned(effect, scene, work) for effect in EFFECTS),
        seconds=n_views * sample_run.view_seconds
        + n_photographs * sample_run.photograph_seconds,
        repairs=scene.mesh.notes,
        bytes=int(n_views * sample_run.view_bytes + n_photographs * sample_run.photograph_bytes)
        + fixed_bytes,
    )


def _planned(effect: Effect, scene: Scene, work: Workload) -> PlannedEffect:
    decision, is_on = effect.needed(scene), simulated(scene, effect)
    cost = effect.cost(scene, work) if is_on else Cost()
    reason = "; ".join(filter(None, (decision.reason, cost.note)))
    return PlannedEffect(effect.NAME, is_on, reason, decision.bound, cost)


@dataclass(frozen=True)
class _SampleRun:
    """Means over a few views and lights."""

    points_per_view: float
    lit_fraction: float
    view_seconds: float
    view_bytes: float
    photograph_seconds: float
    photograph_bytes: float


def _run_sample(scene: Scene, tracer: RayTracer) -> _SampleRun:
    cameras = spread(len(scene.cameras), SAMPLE_VIEWS)
    lights = tuple(scene.lights[i] for i in spread(len(scene.lights), SAMPLE_LIGHTS))
    columns = [_one_view(scene, tracer, camera, lights) for camera in cameras]
    return _SampleRun(*(float(column) for column in np.mean(columns, axis=0)))


def _one_view(
    scene: Scene, tracer: RayTracer, camera: int, lights: tuple[Table, ...]
) -> tuple[float, ...]:
    """Points, lit part, seconds and bytes of a view, and of a photograph."""
    whole = scene.cameras[camera]
    identity = coarser(whole, SAMPLE_SIDE)
    more = whole["w"] * whole["h"] / (identity["w"] * identity["h"])
    view, view_seconds = _timed(lambda: sample_view(scene, tracer, identity))
    images, shade_seconds = _timed(lambda: shade(scene, tracer, view, lights))
    with tempfile.TemporaryDirectory() as folder:
        sample = Path(folder) / "sample.exr"
        brightest = images[np.argmax(images.sum(axis=(1, 2, 3)))]
        _, write_seconds = _timed(lambda: write_exr(sample, brightest))
        size, truth_bytes, truth_seconds = sample.stat().st_size, 0, 0.0
        if scene.truth.per_view:
            _, truth_seconds = _timed(
                lambda: write_view_truth(scene, tracer, identity, Path(folder))
            )
            truth_bytes = (Path(folder) / f"truth/views/{identity['id']}.npz").stat().st_size
    return (
        more * len(view.points),
        _lit_fraction(scene, view, lights),
        more * (view_seconds + truth_seconds),
        more * truth_bytes,
        more * (shade_seconds / len(lights) + write_seconds),
        more * size,
    )


def _lit_fraction(scene: Scene, view: ViewSamples, lights: tuple[Table, ...]) -> float:
    """Part of the pairs of point and light with the light above the horizon."""
    points = view.points[:: max(1, len(view.points) // 4096)]
    if len(points) == 0:
        return 0.0
    directions = arriving_light(scene, lights, points.position).directions
    cosine = np.einsum("nlj,nj->nl", directions, points.shading_from_world[:, 2])
    return float((cosine > 0.0).mean())


def _timed(work: Callable[[], Result]) -> tuple[Result, float]:
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start
