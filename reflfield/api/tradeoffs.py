"""What accuracy costs: plans, sweeps, and options within a time."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection
from pathlib import Path

from reflfield.capture.capture import Capture
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.hold_out import counted
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.tradeoff.cost_fit import fit_costs
from reflfield.tradeoff.measured_ladder import measured_ladder
from reflfield.tradeoff.presets import choose_within, ladder_of
from reflfield.tradeoff.run_plan import RunPlan, plan_run
from reflfield.tradeoff.sweep import Sweep
from reflfield.tradeoff.sweep_results import SweepResult
from reflfield.tradeoff.tradeoff_report import write_tradeoff

log = logging.getLogger(__name__)


def plan(
    capture: Capture,
    *,
    hold_out: HoldOut | None = None,
    options: PipelineOptions | None = None,
    resources: Resources | None = None,
) -> RunPlan:
    """Predict what `reconstruct` will take of time, memory and disk, without running it.

    A few silhouettes are read, and this machine is timed for a few seconds.

    Parameters
    ----------
    capture : Capture
    hold_out, options, resources
        As of `reconstruct`.

    Returns
    -------
    RunPlan
        ``plan.seconds``, ``plan.cpu_seconds``, ``plan.memory``, ``plan.disk`` and the same of
        each of ``plan.stages``; ``plan.lines()`` says it all.

    Raises
    ------
    InputError
        If capture or options cannot be used.
    """
    return plan_run(capture, options or PipelineOptions(), hold_out, resources)


def measure_tradeoff(
    capture: Capture,
    out: Path | str,
    *,
    budget: float | None = None,
    stages: Collection[str] = (),
    hold_out: HoldOut | None = None,
    options: PipelineOptions | None = None,
    resources: Resources | None = None,
    tell: Callable[[str], None] = log.info,
) -> SweepResult:
    """Measure what accuracy costs on a capture, option by option, and write a report.

    What an earlier call has left in `out` is used again as far as it goes.

    Parameters
    ----------
    capture : Capture
    out : Path or str
        Folder for ``index.html``, ``tradeoff.json`` and the runs; created.
    budget : float, optional
        Seconds for all of it; without, everything is run.
    stages : collection of str
        Whose options are varied, such as ``{"hull", "compression"}``; all by default.
    hold_out : HoldOut, optional
        Photographs to report on; as many others are kept apart to choose settings on.
    options : PipelineOptions, optional
        That the sweep begins with.
    resources : Resources, optional
    tell : callable
        Hears, line by line, what will be run and what each run has given.

    Returns
    -------
    SweepResult

    Raises
    ------
    InputError
        If capture or arguments cannot be used, or there are too few photographs.
    """
    folder, started = Path(out), time.perf_counter()
    sweep = Sweep(
        *(capture, folder, options or PipelineOptions()),
        hold_out=hold_out,
        resources=resources,
        budget=budget,
        stages_swept=stages,
    )
    result = sweep.run(tell)
    fit = fit_costs(result, sweep.share, sweep.costs, sweep.slowness)
    write_tradeoff(folder, result, fit)
    tell(f"{counted(len(result.measured), 'run')} in {time.perf_counter() - started:.0f} s")
    return result


def options_within(
    budget: float,
    capture: Capture,
    *,
    hold_out: HoldOut | None = None,
    options: PipelineOptions | None = None,
    resources: Resources | None = None,
    measured: Path | str | None = None,
) -> PipelineOptions:
    """Choose the options of the best field that is expected to be made within a time.

    Parameters
    ----------
    budget : float
        Seconds on an otherwise idle machine.
    capture : Capture
    hold_out, options, resources
        As of `reconstruct`.
    measured : Path or str, optional
        Folder of a `measure_tradeoff` of the capture, from whose front one is chosen; without,
        one of the presets.

    Returns
    -------
    PipelineOptions

    Raises
    ------
    InputError
        If the time suffices for nothing; the message says what would.
    """
    ladder, costs = ladder_of(capture), None
    if measured is not None:
        ladder, costs = measured_ladder(Path(measured))
    selected = choose_within(
        *(budget, capture, options or PipelineOptions(), ladder),
        hold_out=hold_out,
        resources=resources,
        costs=costs,
    )
    log.warning("%s", selected.sentence(budget))
    return selected.options
