"""A sweep: options varied one at a time, then along the best path, within a budget of time.

Every configuration is a run in a process of its own (`measured_run`), which takes over what
earlier ones have computed with the same inputs and options. What is done is kept; the same
call goes on from it.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Collection
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from reflfield.capture.capture import Capture
from reflfield.errors import InputError, ReflfieldError
from reflfield.options import HoldOut, Resources
from reflfield.pipeline import stages
from reflfield.pipeline.cache import plain
from reflfield.pipeline.code_digests import code_digest
from reflfield.pipeline.context import Context
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.report.page import format_bytes, format_seconds
from reflfield.tradeoff.machine_speed import machine_seconds, slowness
from reflfield.tradeoff.measured_run import OUTCOME, Job, cpu_of, run_in_process
from reflfield.tradeoff.photograph_groups import photograph_groups
from reflfield.tradeoff.run_plan import plan_of, wanted_stages, with_planned_selection
from reflfield.tradeoff.stage_costs import START_SECONDS, UnitCosts, shipped_costs
from reflfield.tradeoff.sweep_results import (
    MOST_COMBINED,
    Measured,
    SweepResult,
    better_half,
    front_of,
    is_whole,
    paths,
    picks,
)
from reflfield.tradeoff.swept_options import (
    LIGHTS,
    VIEWS,
    Configuration,
    SweptOption,
    Value,
    check_stages,
    one_at_a_time,
    options_to_sweep,
)
from reflfield.tradeoff.work_counts import (
    WorkCounts,
    counts_of,
    covered_share,
    planned_context,
)
from reflfield.util.file_digests import FileDigests
from reflfield.util.files import read_bytes
from reflfield.util.folders import only_run
from reflfield.util.progress import report

# In the folder of a sweep: runs, and digests of the files that were read.
RUNS, FILES = "runs", "files.json"
LARGEST_OUTCOME = 16 << 20
# Shares of the budget after which no more options are varied alone, and together,
# nor timed again.
ALONE_UNTIL, TOGETHER_UNTIL, AGAIN_UNTIL = 0.6, 0.8, 0.92
# Share of the lights, or views, in the first round of halving.
FIRST_ROUND = 0.5
# Complete runs of each configuration of the front, its first one included, that times are of.
REPEATS = 3

Tell = Callable[[str], None]


# --- the sweep -------------------------------------------------------------------------------


class Sweep:
    """A sweep of one capture in one folder.

    Parameters
    ----------
    capture : Capture
    out : Path
    options : PipelineOptions
        Of the default configuration.
    hold_out : HoldOut, optional
        What is reported; see `photograph_groups`.
    resources : Resources
    budget : float, optional
        Seconds; no limit without.
    stages_swept : collection of str
        Whose options are varied; all if empty.
    costs : UnitCosts, optional
        That times are predicted with.

    Raises
    ------
    InputError
        If the photographs are too few, or an argument cannot be used.
    """

    def __init__(
        self,
        capture: Capture,
        out: Path,
        options: PipelineOptions,
        *,
        hold_out: HoldOut | None = None,
        resources: Resources | None = None,
        budget: float | None = None,
        stages_swept: Collection[str] = (),
        costs: UnitCosts | None = None,
    ) -> None:
        check_stages(stages_swept)
        if budget is not None and not budget > 0:
            raise InputError(f"budget: expected a time above 0, received {budget} s")
        self.started = time.monotonic()
        self.out, self.options, self.budget = out, options, budget
        self.resources = resources or Resources()
        self.groups = photograph_groups(capture, hold_out)
        self.costs = costs or shipped_costs()
        self.slowness = slowness(machine_seconds(), self.costs.machine_seconds)
        self.share = covered_share(self.groups.trained)
        self.context = self._context(Configuration())
        stages.check(self.context)
        self.counts = counts_of(self.context, self.share)
        self.swept = options_to_sweep(self.counts, stages_swept)
        self.digests = FileDigests(out / FILES)
        self.measured: list[Measured] = []
        self.left: list[Configuration] = []

    # --- what is expected

    @property
    def alone(self) -> list[tuple[SweptOption, Value]]:
        """Changes of one option."""
        return list(one_at_a_time(self.options, self.swept))

    def _context(self, configuration: Configuration) -> Context:
        capture = self.groups.with_fewer(configuration.views, configuration.lights)
        options = configuration.applied_to(self.options)
        return planned_context(capture, options, HoldOut(test=True), self.resources)

    def expected_seconds(self, configuration: Configuration) -> float:
        """Wall time of a run after that of the default, on an otherwise idle machine."""
        context = self._context(configuration)
        counts = counts_of(context, self.share)
        plan = plan_of(context, counts, self.costs, self.slowness)
        again = set(self.changed_stages(configuration, context, counts))
        return START_SECONDS * self.slowness + sum(
            stage.seconds for stage in plan.stages if stage.name in again
        )

    def changed_stages(
        self, configuration: Configuration, context: Context, counts: WorkCounts
    ) -> list[str]:
        """Stages up to the comparison that the default's results do not serve."""
        last = stages.ORDER.index(stages.COMPARISON) + 1
        wanted = set(wanted_stages(with_planned_selection(context, counts)))
        names = {stage.name for stage in stages.ORDER[:last]} & wanted
        fewer = configuration.views < 1 or configuration.lights < 1
        if fewer or configuration == Configuration():
            return [stage.name for stage in stages.ORDER if stage.name in names]
        before = with_planned_selection(self.context, self.counts).options
        after = with_planned_selection(context, counts).options
        changed: list[str] = []
        for stage in stages.ORDER[:last]:
            differs = plain(stage.options(before)) != plain(stage.options(after))
            follows = any(one.name in changed for one in stage.after)
            if stage.name in names and (differs or follows):
                changed.append(stage.name)
        return changed

    def announcement(self) -> list[str]:
        """What the sweep will run, and how long that takes, one fact a line."""
        context, alone = self.context, self.alone
        disk = plan_of(context, self.counts, self.costs, self.slowness).disk
        expected = [
            self.expected_seconds(Configuration().having(option.name, value))
            for option, value in alone
        ]
        first = self.expected_seconds(Configuration())
        total = first + sum(expected)
        within = "" if self.budget is None else f"; the budget is {format_seconds(self.budget)}"
        values: dict[str, list[str]] = {}
        for option, value in alone:
            values.setdefault(option.name, []).append(
                f"{value:.0%}" if option.name in (VIEWS, LIGHTS) else str(value)
            )
        return [
            f"capture      {context.capture.name}: {self.groups.sentence()}",
            f"default      about {format_seconds(first)}, {self.counts.n_texels:.0f} texels, "
            f"model {self.counts.model}",
            f"one at once  {len(alone)} runs of {len(values)} options, about "
            f"{format_seconds(total)} on an otherwise idle machine{within}",
            *(f"  {name:<44} {', '.join(tried)}" for name, tried in values.items()),
            f"then         up to {2 * (MOST_COMBINED - 1)} combinations by halving, and "
            f"{REPEATS} timed runs of each on the front, interleaved",
            f"disk         up to {format_bytes(disk * (1 + len(alone) / 2))} in "
            f"{self.out}; at the end {format_bytes(disk)}",
        ]

    # --- running

    def run(self, tell: Tell = lambda line: None) -> SweepResult:
        """Run all, as far as the budget goes; what is done already is not run again.

        Parameters
        ----------
        tell : callable
            Hears what is going to be run, and of each run what it gave.

        Raises
        ------
        InputError
            If not even the default can be run.
        """
        for line in self.announcement():
            tell(line)
        with only_run(self.out / RUNS):
            self._measure(Configuration(), None, "default", tell)
            if not self.measured[0].measures:
                reason = self.measured[0].failed or "no photograph could be measured"
                raise InputError(f"{self.context.capture.name}: {reason}")
            self._vary_alone(tell)
            self._vary_together(tell)
            self._repeat(tell)
            self._report_picks(tell)
            self._tidy()
        return self._result()

    def _result(self) -> SweepResult:
        return SweepResult(
            self.groups,
            self.context,
            self.counts,
            tuple(self.measured),
            tuple(self.left),
            time.monotonic() - self.started,
        )

    def _vary_alone(self, tell: Tell) -> None:
        changes = self.alone
        for i, (option, value) in enumerate(changes):
            report("options, one at a time", i, len(changes))
            configuration = Configuration().having(option.name, value)
            if self._fits(configuration, ALONE_UNTIL):
                self._measure(configuration, (option.name, value), "alone", tell)
        report("options, one at a time", len(changes), len(changes))

    def _vary_together(self, tell: Tell) -> None:
        """Combine the changes that pay, by halving: first with fewer photographs."""
        alone = [m for m in self.measured[1:] if is_whole(m)]
        done = {m.configuration for m in self.measured}
        combined = [c for c in dict.fromkeys(paths(self.measured[0], alone)) if c not in done]
        combined = [c for c in combined if self._fits(c, TOGETHER_UNTIL)]
        if len(combined) > 2:
            combined = self._halved(combined, tell)
        for i, configuration in enumerate(combined):
            report("combinations", i, len(combined))
            if self._fits(configuration, TOGETHER_UNTIL):
                self._measure(configuration, None, "together", tell)

    def _halved(self, combined: list[Configuration], tell: Tell) -> list[Configuration]:
        """The better half, by runs with fewer lights, or views."""
        fewer = LIGHTS if len(self.groups.training_lights) > 1 else VIEWS
        tried = []
        for i, configuration in enumerate(combined):
            report("combinations, with fewer photographs", i, len(combined))
            first = configuration.having(fewer, FIRST_ROUND)
            if self._fits(first, TOGETHER_UNTIL):
                measured = self._measure(first, None, "halving", tell)
                if measured.measures:
                    tried.append((configuration, measured))
        kept = better_half([(m.cpu_seconds, m.psnr) for _, m in tried])
        return [tried[i][0] for i in kept]

    def _repeat(self, tell: Tell) -> None:
        """Time complete runs of the default and the front, in turns."""
        whole = [m for m in self.measured if is_whole(m)]
        front = [whole[i] for i in front_of([(m.cpu_seconds, m.psnr) for m in whole])]
        timed = [self.measured[0], *(m for m in front if m is not self.measured[0])]
        for turn in range(1, REPEATS):
            for i, measured in enumerate(timed):
                report("timed again", (turn - 1) * len(timed) + i, (REPEATS - 1) * len(timed))
                seconds = self._expected_here(measured.seconds)
                if self._has_time(seconds, AGAIN_UNTIL) or self._is_done(measured, turn):
                    self._time_again(measured, turn, tell)

    def _time_again(self, measured: Measured, turn: int, tell: Tell) -> None:
        configuration = measured.configuration
        outcome = self._outcome(configuration, self._folder(configuration, turn), ())
        if "failed" in outcome:
            return
        measured.repeats.append(
            {
                "cpu": sum(cpu_of(record) for record in outcome["stages"]),
                "wall": sum(record["seconds"] for record in outcome["stages"]),
            }
        )
        for name in ("cpu_seconds", "seconds"):  # medians of what is measured anew
            measured.__dict__.pop(name, None)
        shutil.rmtree(self._folder(configuration, turn) / "stages", ignore_errors=True)
        tell(f"again        {measured.repeats[-1]['cpu']:8.1f} s CPU  {configuration.name}")

    def _is_done(self, measured: Measured, turn: int) -> bool:
        return (self._folder(measured.configuration, turn) / OUTCOME).is_file()

    def _report_picks(self, tell: Tell) -> None:
        """Measure what was chosen on photographs that no choice has seen."""
        for picked in {
            id(m): m for m in (self.measured[0], *picks(self._result()).values())
        }.values():
            configuration = picked.configuration
            if "reported" in picked.outcome:
                continue
            context = self._context(configuration)
            job = Job(
                str(picked.outcome["key"]),
                context.capture,
                self._folder(configuration),
                context.options,
                self.resources,
                reported=self.groups.reported,
            )
            picked.outcome.update(run_in_process(job))
            mean = picked.outcome.get("reported", {}).get("mean", {})
            if mean:
                tell(f"reported     {mean['psnr_ldr']:8.2f} dB      {configuration.name}")

    def _tidy(self) -> None:
        """Remove what only further runs would have used."""
        kept = {Configuration(), *(m.configuration for m in picks(self._result()).values())}
        for measured in self.measured:
            if measured.configuration not in kept:
                folder = self._folder(measured.configuration)
                shutil.rmtree(folder / "stages", ignore_errors=True)

    def _measure(
        self,
        configuration: Configuration,
        changed: tuple[str, Value] | None,
        stage_of_sweep: str,
        tell: Tell,
    ) -> Measured:
        reuse = tuple(self._folder(m.configuration) for m in self.measured if not m.failed)
        outcome = self._outcome(configuration, self._folder(configuration), reuse)
        measured = Measured(configuration, outcome, changed, stage_of_sweep)
        self.measured.append(measured)
        tell(self._line(measured))
        return measured

    def _line(self, measured: Measured) -> str:
        name = measured.configuration.name
        if measured.failed:
            return f"failed       {name}: {measured.failed}"
        if not measured.measures:
            return f"not measured {name}"
        return (
            f"{measured.psnr:8.2f} dB {measured.cpu_seconds:8.1f} s CPU "
            f"{format_bytes(measured.peak_bytes):>8}  {name}"
        )

    def _folder(self, configuration: Configuration, turn: int = 0) -> Path:
        return self.out / RUNS / (configuration.folder + (f"-{turn}" if turn else ""))

    def _outcome(
        self, configuration: Configuration, folder: Path, reuse: tuple[Path, ...]
    ) -> dict[str, Any]:
        """What an earlier sweep has left of the same run, or that of a new one."""
        context = self._context(configuration)
        key = self._key(context)
        earlier = stored_outcome(folder, key)
        if earlier is not None:
            return earlier
        job = Job(key, context.capture, folder, context.options, self.resources, reuse)
        return run_in_process(job)

    def _key(self, context: Context) -> str:
        """SHA-256 of everything that an outcome depends on."""
        parts = (
            context.digest_of(context.capture),
            replace(context, digests=self.digests).digest_of(self.groups.reported),
            json.dumps(plain(context.options), sort_keys=True),
            json.dumps(asdict(self.resources), sort_keys=True),
            code_digest("reflfield.tradeoff.measured_run"),
        )
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    # --- the budget

    def _fits(self, configuration: Configuration, until: float) -> bool:
        """Whether a run is done already, or can be expected to end in time; else note it."""
        if (self._folder(configuration) / OUTCOME).is_file():
            return True
        fits = self._has_time(self._expected_here(self.expected_seconds(configuration)), until)
        if not fits:
            self.left.append(configuration)
        return fits

    def _has_time(self, seconds: float, until: float) -> bool:
        if self.budget is None:
            return True
        return time.monotonic() - self.started + seconds <= until * self.budget

    def _expected_here(self, seconds: float) -> float:
        """Expected time on this machine, as busy as it was for the runs before."""
        first = self.measured[0].outcome["command seconds"]
        return seconds * first / max(self.expected_seconds(Configuration()), 1e-3)


def stored_outcome(folder: Path, key: str) -> dict[str, Any] | None:
    """Outcome of a finished run with the same key; None without one."""
    path = folder / OUTCOME
    if not path.is_file():
        return None
    try:
        stored = json.loads(read_bytes(path, LARGEST_OUTCOME))
    except (ReflfieldError, ValueError, RecursionError):
        return None
    complete = isinstance(stored, dict) and "command seconds" in stored
    return stored if complete and stored.get("key") == key else None
