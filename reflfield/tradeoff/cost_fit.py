"""The model of costs fitted to the runs of a sweep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any

from reflfield.options import HoldOut
from reflfield.pipeline.context import Context
from reflfield.tradeoff.measured_run import cpu_of
from reflfield.tradeoff.run_plan import with_planned_selection
from reflfield.tradeoff.stage_costs import CPU, StageMeasured, UnitCosts, fitted
from reflfield.tradeoff.sweep_results import Measured, SweepResult
from reflfield.tradeoff.work_counts import WorkCounts, counts_of, planned_context


@dataclass(frozen=True)
class CostFit:
    """Unit costs fitted to runs, and what they predict.

    Attributes
    ----------
    costs : UnitCosts
    measured, before, after : tuple of float
        CPU seconds of every run: measured, predicted before the fit, and after.
    """

    costs: UnitCosts
    measured: tuple[float, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]

    def summary(self) -> dict[str, Any]:
        """Factors by which predictions were off: median and largest, before and after."""
        return {
            "runs": len(self.measured),
            **{
                f"{when}, {what}": round(of(self._factors(predicted)), 3)
                for when, predicted in (("before", self.before), ("after", self.after))
                for what, of in (("median factor", median), ("largest factor", max))
            },
        }

    def _factors(self, predicted: tuple[float, ...]) -> list[float]:
        ratios = [p / m for p, m in zip(predicted, self.measured, strict=True)]
        return [max(ratio, 1 / ratio) for ratio in ratios]

    def sentence(self) -> str:
        """How far off predictions were."""
        words = self.summary()
        return (
            "Predictions of the CPU times of these runs were off by a factor of "
            f"{words['before, median factor']:.2f} (the median; the largest is "
            f"{words['before, largest factor']:.2f}) as the model comes, and of "
            f"{words['after, median factor']:.2f} ({words['after, largest factor']:.2f}) after "
            "it was fitted to them."
        )


def fit_costs(result: SweepResult, share: float, prior: UnitCosts, slowness: float) -> CostFit:
    """Fit unit costs to the runs of a sweep.

    Parameters
    ----------
    result : SweepResult
    share : float
        Of the pixels that the object covers; see `work_counts.covered_share`.
    prior : UnitCosts
        Holds what the runs do not show.
    slowness : float
        Of this machine, see `machine_speed`; times are fitted as those of the reference.

    Returns
    -------
    CostFit
    """
    runs = [m for m in result.measured if m.measures]
    prepared = [(m, *_prepared(result, m, share)) for m in runs]
    rows = [row for run in prepared for row in _rows(*run, slowness)]
    costs = fitted(rows, prior, prior.machine_seconds)
    totals = [
        [
            slowness
            * sum(c.cost(CPU, r["name"], counts, context.options) for r in m.outcome["stages"])
            for m, context, counts in prepared
        ]
        for c in (prior, costs)
    ]
    measured = tuple(sum(cpu_of(r) for r in m.outcome["stages"]) for m in runs)
    return CostFit(costs, measured, *map(tuple, totals))


def _prepared(
    result: SweepResult, measured: Measured, share: float
) -> tuple[Context, WorkCounts]:
    """Context with what would be selected, and the counts, of a run."""
    configuration = measured.configuration
    capture = result.groups.with_fewer(configuration.views, configuration.lights)
    options = configuration.applied_to(result.context.options)
    context = planned_context(capture, options, HoldOut(test=True), result.context.resources)
    counts = counts_of(context, share)
    return with_planned_selection(context, counts), counts


def _rows(
    measured: Measured, context: Context, counts: WorkCounts, slowness: float
) -> Iterator[StageMeasured]:
    """Stages that this run itself has computed, in seconds of the reference machine."""
    for record in measured.outcome["stages"]:
        if not record["reused"]:
            yield StageMeasured(
                record["name"],
                counts,
                context.options,
                cpu_of(record) / slowness,
                record["peak_bytes"],
                record["size_bytes"],
            )
