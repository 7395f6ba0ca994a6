"""Presets: sets of options from measured fronts, and the best of them within a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from reflfield.capture.capture import Capture
from reflfield.errors import InputError
from reflfield.field.clustered_pca import CLUSTERED
from reflfield.options import HoldOut, Resources, with_tables
from reflfield.pipeline import stages
from reflfield.pipeline.context import Context
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.report.page import format_seconds
from reflfield.tradeoff.machine_speed import machine_seconds, slowness
from reflfield.tradeoff.run_plan import RunPlan, plan_of
from reflfield.tradeoff.stage_costs import UnitCosts, shipped_costs
from reflfield.tradeoff.swept_options import Value, nested
from reflfield.tradeoff.work_counts import (
    counts_of,
    covered_share,
    planned_context,
    planned_model,
)

Settings = Mapping[str, Value]

PREVIEW, STANDARD, BEST = "preview", "standard", "best"
# From sweeps and whole runs (`tests/benchmarks/bench_presets.py`), by rising time. What does
# not matter to the model that a run fits changes nothing.
LADDER: dict[str, Settings] = {
    PREVIEW: {
        "hull.resolution": 96,
        "hull.n_triangles": 5_000,
        "texture.texels_per_pixel": 0.8,
        "texture.largest": 256,
        "indirect.n_components": 2,
        "indirect.bounce": False,
        "completion.passes": 1,
        "completion.rank": 6,
        "alignment.iterations": 1,
        "alignment.refine": False,
        "alignment.band_limit": 6,
        "compression.half_vector.n_lobes": 1,
        "compression.half_vector.image_steps": 1,
        "compression.half_vector.surface_from_normals": False,
        "compression.rank": 8,
        "relighting.samples_per_pixel": 4,
    },
    STANDARD: {},
    BEST: {
        "texture.texels_per_pixel": 2.0,
        "compression.half_vector.n_lobes": 4,
        "compression.half_vector.image_steps": 4,
        "compression.n_components": 12,
        "compression.samples.rounds": 8,
    },
}
PRESETS = (PREVIEW, STANDARD, BEST)
# Of a preview by clusters: one fit, the quick one, which to ask for of other captures would ask
# for clusters; and nodes of the grids along a side, where there would be more.
QUICK_FIT: Settings = {"compression.fit": "grid"}
# Of the best of one view under known lights, where it is worth the time.
ONE_VIEW_BEST: Settings = {"compression.rank": 48, "compression.n_components": 16}
MOST_NODES = 7


@dataclass(frozen=True)
class PlannedRun:
    """Options, and what a run with them is expected to take.

    Attributes
    ----------
    name : str
        Of the preset, or of the configuration of a sweep.
    options : PipelineOptions
    plan : RunPlan
    """

    name: str
    options: PipelineOptions
    plan: RunPlan

    def sentence(self, budget: float) -> str:
        """What was chosen, and how long it is expected to take."""
        return (
            f"budget of {format_seconds(budget)}: {self.name}, expected to take "
            f"{format_seconds(self.plan.seconds)} on an otherwise idle machine"
        )


def preset_settings(name: str, capture: Capture | None = None) -> dict[str, Value]:
    """Settings of a preset, by ``stage.option``.

    Parameters
    ----------
    name : {"preview", "standard", "best"}
    capture : Capture, optional
        With what suits the model that its fields have.

    Raises
    ------
    InputError
        If there is none of this name.

    Examples
    --------
    >>> preset_settings("standard")
    {}
    """
    if name not in PRESETS:
        raise InputError(f"preset: expected one of {', '.join(PRESETS)}, received {name!r}")
    settings = dict(LADDER[name])
    if name == PREVIEW and capture is not None:
        settings |= quick_clusters(capture)
    if name == BEST and capture is not None and default_context(capture).photometric:
        settings |= ONE_VIEW_BEST
    return settings


def default_context(capture: Capture) -> Context:
    """Return the context of a run with the default of every option."""
    return planned_context(capture, PipelineOptions())


def quick_clusters(capture: Capture) -> dict[str, Value]:
    """Settings of a preview by clusters; none where fields of the capture have none."""
    context = default_context(capture)
    if planned_model(context) != CLUSTERED:
        return {}
    sides = zip(("view_side", "light_side"), context.grid_sides, strict=True)
    fewer = {f"resampling.{name}": MOST_NODES for name, side in sides if side > MOST_NODES}
    return {**QUICK_FIT, **fewer}


def ladder_of(capture: Capture) -> Mapping[str, Settings]:
    """Settings of all presets for a capture, by rising time."""
    return {name: preset_settings(name, capture) for name in LADDER}


def choose_within(
    budget: float,
    capture: Capture,
    options: PipelineOptions,
    ladder: Mapping[str, Settings],
    *,
    hold_out: HoldOut | None = None,
    resources: Resources | None = None,
    costs: UnitCosts | None = None,
) -> PlannedRun:
    """Choose the best configuration that is expected to end within a time.

    Parameters
    ----------
    budget : float
        Seconds.
    capture : Capture
    options : PipelineOptions
        What the configurations change.
    ladder : mapping of str to settings
        By rising quality.
    hold_out : HoldOut, optional
    resources : Resources, optional
    costs : UnitCosts, optional
        Those of the package by default.

    Returns
    -------
    PlannedRun

    Raises
    ------
    InputError
        If even the fastest takes longer; the message says how long.
    """
    costs = costs or shipped_costs()
    slower = slowness(machine_seconds(), costs.machine_seconds)
    share, candidates = None, []
    for name, settings in ladder.items():
        changed = with_tables(options, nested(settings))
        context = planned_context(capture, changed, hold_out, resources)
        stages.check(context)
        share = covered_share(context.training) if share is None else share
        plan = plan_of(context, counts_of(context, share), costs, slower)
        candidates.append(PlannedRun(name, changed, plan))
    for candidate in reversed(candidates):
        if candidate.plan.seconds <= budget:
            return candidate
    least = min(candidate.plan.seconds for candidate in candidates)
    raise InputError(
        f"budget: expected at least {format_seconds(least)}, which the fastest of "
        f"{', '.join(ladder)} is expected to take, received {format_seconds(budget)}"
    )
