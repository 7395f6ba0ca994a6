"""What a run will take of time, memory and disk, said before it begins."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from reflfield.capture.capture import Capture
from reflfield.field.clustered_pca import HALF_VECTOR
from reflfield.options import HoldOut, Resources
from reflfield.pipeline import stages
from reflfield.pipeline.context import AUTO, Context
from reflfield.pipeline.hold_out import held_out_sentence
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.report.page import format_bytes, format_seconds
from reflfield.tradeoff.machine_speed import machine_seconds, slowness
from reflfield.tradeoff.stage_costs import (
    CPU,
    DISK,
    MEMORY,
    PARALLEL_SHARE,
    START_SECONDS,
    UnitCosts,
    shipped_costs,
)
from reflfield.tradeoff.work_counts import WorkCounts, counts_of, planned_context


@dataclass(frozen=True)
class PlannedStage:
    """What one stage will take.

    Attributes
    ----------
    name : str
    cpu_seconds, seconds : float
        CPU time of all threads, and wall time on an otherwise idle machine.
    memory, disk : float
        Bytes: peak of the process while the stage runs, and size of its results.
    """

    name: str
    cpu_seconds: float
    seconds: float
    memory: float
    disk: float


@dataclass(frozen=True)
class RunPlan:
    """What a run will take.

    Attributes
    ----------
    capture : str
        Name.
    counts : WorkCounts
    stages : tuple of PlannedStage
        In their order.
    slowness : float
        Time of work on this machine over that on the reference machine.
    workers : int
    held_out : str
        Sentence on the photographs.
    """

    capture: str
    counts: WorkCounts
    stages: tuple[PlannedStage, ...]
    slowness: float
    workers: int
    held_out: str

    @property
    def cpu_seconds(self) -> float:
        """CPU time of the whole command."""
        return START_SECONDS * self.slowness + sum(s.cpu_seconds for s in self.stages)

    @property
    def seconds(self) -> float:
        """Wall time of the whole command on an otherwise idle machine."""
        return START_SECONDS * self.slowness + sum(s.seconds for s in self.stages)

    @property
    def memory(self) -> float:
        """Peak of resident memory, bytes."""
        return max(stage.memory for stage in self.stages)

    @property
    def disk(self) -> float:
        """Size of all results, bytes."""
        return sum(stage.disk for stage in self.stages)

    def lines(self) -> list[str]:
        """Describe the plan, one fact a line, then one stage a line."""
        counts = self.counts
        grid = f"{counts.n_nodes} nodes of the grid" if counts.model != HALF_VECTOR else ""
        work = f"{counts.n_texels:.0f} texels, {counts.n_samples / 1e6:.1f} million samples"
        head = [
            f"capture      {self.capture}",
            f"photographs  {self.held_out}",
            f"work         {', '.join(filter(None, (work, grid)))}; model {counts.model}",
            f"time         about {format_seconds(self.seconds)} with {self.workers} worker"
            f"{'s' * (self.workers > 1)} on an otherwise idle machine "
            f"({format_seconds(self.cpu_seconds)} CPU)",
            f"memory       about {format_bytes(self.memory)}",
            f"disk         about {format_bytes(self.disk)}",
            f"{'stage':<24}{'time':>12}{'CPU':>12}{'memory':>10}{'disk':>10}",
        ]
        return head + [
            f"  {stage.name:<22}{format_seconds(stage.seconds):>12}"
            f"{format_seconds(stage.cpu_seconds):>12}{format_bytes(stage.memory):>10}"
            f"{format_bytes(stage.disk):>10}"
            for stage in self.stages
        ]


def plan_run(
    capture: Capture,
    options: PipelineOptions,
    hold_out: HoldOut | None = None,
    resources: Resources | None = None,
    costs: UnitCosts | None = None,
) -> RunPlan:
    """Predict what a run will take, without running it.

    A few silhouettes are read, and this machine is timed for a few seconds.

    Parameters
    ----------
    capture : Capture
    options : PipelineOptions
    hold_out : HoldOut, optional
    resources : Resources, optional
    costs : UnitCosts, optional
        Those of the package by default.

    Returns
    -------
    RunPlan

    Raises
    ------
    InputError
        If capture or options cannot be used.
    """
    context = planned_context(capture, options, hold_out, resources)
    stages.check(context)
    costs = costs or shipped_costs()
    slower = slowness(machine_seconds(), costs.machine_seconds)
    return plan_of(context, counts_of(context), costs, slower)


def plan_of(context: Context, counts: WorkCounts, costs: UnitCosts, slower: float) -> RunPlan:
    """Predict what a run with known counts will take.

    Parameters
    ----------
    context : Context
        See `work_counts.planned_context`.
    counts : WorkCounts
    costs : UnitCosts
    slower : float
        See `machine_speed.slowness`.

    Returns
    -------
    RunPlan
    """
    context = with_planned_selection(context, counts)
    workers = context.resources.workers
    planned = [
        _planned(name, context, counts, costs, slower) for name in wanted_stages(context)
    ]
    return RunPlan(
        capture=context.capture.name,
        counts=counts,
        stages=tuple(_with_candidates(planned, counts, context, costs, slower)),
        slowness=slower,
        workers=workers,
        held_out=held_out_sentence(context.split),
    )


def with_planned_selection(context: Context, counts: WorkCounts) -> Context:
    """Return the context with what will be selected in place of "auto"."""
    visibility = context.options.resampling.visibility
    asked = replace(
        context.options, compression=replace(context.options.compression, model=counts.model)
    )
    resampling = replace(
        asked.resampling, visibility="factored" if visibility == AUTO else visibility
    )
    return replace(context, options=replace(asked, resampling=resampling), asked=asked)


def wanted_stages(context: Context) -> list[str]:
    """Stages that a run computes, but for the selection of models."""
    return [
        stage.name
        for stage in stages.ORDER
        if stage is not stages.MODEL_SELECTION and stage.wanted(context)
    ]


def _planned(
    name: str, context: Context, counts: WorkCounts, costs: UnitCosts, slower: float
) -> PlannedStage:
    options, workers = context.options, context.resources.workers
    cpu = slower * costs.cost(CPU, name, counts, options)
    return PlannedStage(
        name=name,
        cpu_seconds=cpu,
        seconds=wall_seconds(name, cpu, workers),
        memory=min(
            costs.cost(MEMORY, name, counts, options), float(context.resources.max_memory)
        ),
        disk=costs.cost(DISK, name, counts, options),
    )


def wall_seconds(stage: str, cpu: float, workers: int) -> float:
    """Wall time of so much CPU time by some workers, on an otherwise idle machine (Amdahl).

    Examples
    --------
    >>> wall_seconds("surface", 10.0, 1), wall_seconds("surface", 10.0, 2)
    (10.0, 6.0)
    """
    share = PARALLEL_SHARE.get(stage, 0.0)
    return cpu * (1 - share + share / workers)


def _with_candidates(
    planned: list[PlannedStage],
    counts: WorkCounts,
    context: Context,
    costs: UnitCosts,
    slower: float,
) -> Iterable[PlannedStage]:
    """The stages, and before them what the fields that are not selected take."""
    for stage in planned:
        if stage.name in ("indirect", "surface", "completion") and counts.n_fits > 1:
            others = [s for s in planned if s.name in ("compression", "comparison")]
            extra = [_planned(s.name, context, counts, costs, slower) for s in others]
            yield PlannedStage(
                stages.MODEL_SELECTION.name,
                sum(s.cpu_seconds for s in extra),
                sum(s.seconds for s in extra),
                max(s.memory for s in extra),
                0.0,
            )
            counts = replace(counts, n_fits=1)
        yield stage
