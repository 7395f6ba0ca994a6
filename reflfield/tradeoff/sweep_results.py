"""What the runs of a sweep have given: times, errors, the front, what is picked from it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import zip_longest
from statistics import median
from typing import Any

import numpy as np

from reflfield.pipeline.context import Context
from reflfield.tradeoff.measured_run import cpu_of
from reflfield.tradeoff.photograph_groups import PhotographGroups
from reflfield.tradeoff.swept_options import SHOWING, Configuration, Value
from reflfield.tradeoff.work_counts import WorkCounts

# Changes that are combined at most, in either direction.
MOST_COMBINED = 4
# Of the time: changes by less than this share are none.
SAME_TIME = 0.03
# By so much the PSNR of an image scatters between fields that differ in nothing that matters.
CHANCE_DB = 1.0


@dataclass(frozen=True, eq=False)
class Measured:
    """A configuration and what its run gave.

    Parameters
    ----------
    configuration : Configuration
    outcome : mapping
        See `measured_run`.
    changed : (str, value), optional
        The one option that was varied, where it was one.
    stage_of_sweep : {"default", "alone", "halving", "together"}
    repeats : list of dict
        CPU and wall seconds of complete runs.
    """

    configuration: Configuration
    outcome: dict[str, Any]
    changed: tuple[str, Value] | None = None
    stage_of_sweep: str = "default"
    repeats: list[dict[str, float]] = field(default_factory=list)

    @property
    def failed(self) -> str:
        """Why the configuration cannot be used; empty where it can."""
        return str(self.outcome.get("failed", ""))

    @cached_property
    def cpu_seconds(self) -> float:
        """CPU time of all stages, as if nothing had been taken over; median of the runs."""
        return median(self.cpu_times)

    @property
    def cpu_times(self) -> list[float]:
        """CPU time of all stages of the first run, and of each that was complete again."""
        once = sum(cpu_of(record) for record in self.outcome["stages"])
        return [once, *(repeat["cpu"] for repeat in self.repeats)]

    @cached_property
    def seconds(self) -> float:
        """Wall time of all stages, as if nothing had been taken over; median of the repeats."""
        once = sum(record["seconds"] for record in self.outcome["stages"])
        return median([once, *(repeat["wall"] for repeat in self.repeats)])

    @property
    def peak_bytes(self) -> int:
        """Largest memory of a stage."""
        return max(int(record["peak_bytes"]) for record in self.outcome["stages"])

    @property
    def field_bytes(self) -> int:
        """Size of the field."""
        return int(self.outcome["field bytes"])

    @property
    def psnr(self) -> float:
        """Mean over the photographs that settings are chosen on, dB."""
        return float(np.mean(self.outcome["chosen on"]["psnr"]))

    @property
    def measures(self) -> bool:
        """Whether it was run, and an image could be measured."""
        return not self.failed and bool(self.outcome["chosen on"])


@dataclass(frozen=True, eq=False)
class SweepResult:
    """What a sweep has measured.

    Parameters
    ----------
    groups : PhotographGroups
    context : Context
        Planned, of the default configuration.
    counts : WorkCounts
    measured : tuple of Measured
        In the order of the runs, the default first.
    left : tuple of Configuration
        For which the budget did not suffice.
    seconds : float
    """

    groups: PhotographGroups
    context: Context
    counts: WorkCounts
    measured: tuple[Measured, ...]
    left: tuple[Configuration, ...]
    seconds: float

    @property
    def default(self) -> Measured:
        """The run with the options that the sweep is about."""
        return self.measured[0]

    @property
    def whole(self) -> list[Measured]:
        """Configurations of all photographs that do not only change how fields are shown."""
        return [m for m in self.measured if is_whole(m)]


def is_whole(measured: Measured) -> bool:
    """Whether a run is of all photographs, and its images are made as usual."""
    shares = measured.configuration.views == measured.configuration.lights == 1.0
    showing = any(name in SHOWING for name, _ in measured.configuration.settings)
    return measured.measures and shares and not showing


# --- Pareto front ----------------------------------------------------------------------------


def front_of(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of points that no other beats in both, by rising cost.

    Parameters
    ----------
    points : sequence of (cost, quality)

    Returns
    -------
    list of int

    Examples
    --------
    >>> front_of([(1.0, 20.0), (2.0, 19.0), (3.0, 25.0), (3.0, 24.0)])
    [0, 2]
    """
    order = sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1]))
    kept: list[int] = []
    for i in order:
        if not kept or points[i][1] > points[kept[-1]][1]:
            kept.append(i)
    return kept


def better_half(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of half of the points, rounded up: of the front first, then of the next one.

    Of the last front with a place, from both of its ends: the best, the cheapest, and so on.

    Examples
    --------
    >>> better_half([(1.0, 20.0), (2.0, 19.0), (3.0, 25.0), (4.0, 24.0)])
    [0, 2]
    """
    left, kept = list(range(len(points))), []
    while left:
        front = [left[i] for i in front_of([points[i] for i in left])]
        half = len(front) // 2
        ends = zip_longest(reversed(front[half:]), front[:half])
        kept += [i for pair in ends for i in pair if i is not None]
        left = [i for i in left if i not in front]
    return sorted(kept[: -(-len(points) // 2)])


def paths(default: Measured, alone: Iterable[Measured]) -> Iterator[Configuration]:
    """Yield combinations of changes: ever cheaper ones, and ever better ones.

    Cheaper changes are combined in the order of what they lose for each halving of the time,
    better ones of what they gain for each doubling.
    """
    moves = []
    for measured in alone:
        ratio = np.log2(measured.cpu_seconds / default.cpu_seconds)
        moves.append((float(ratio), measured.psnr - default.psnr, measured))
    cheaper = [(gain / -ratio, m) for ratio, gain, m in moves if ratio < -SAME_TIME]
    better = [
        (gain / max(ratio, SAME_TIME), m) for ratio, gain, m in moves if gain > 0 and m.changed
    ]
    for ranked in (cheaper, better):
        combined = Configuration()
        names: set[str] = set()
        for _, measured in sorted(ranked, key=lambda move: -move[0]):
            name, value = measured.changed or ("", 0)
            if not name or name in names or len(names) == MOST_COMBINED:
                continue
            combined = combined.having(name, value)
            names.add(name)
            if len(names) > 1:
                yield combined


# --- what is picked --------------------------------------------------------------------------

# dB that a pick may be below the best: to look at while one works, and for good.
# Less than the last is no difference.
FAST_LOSS, BALANCED_LOSS, BEST_LOSS = 3.0, 0.5, 0.05
FAST, BALANCED, BEST = "fast", "balanced", "best"


def picks(result: SweepResult) -> dict[str, Measured]:
    """Pick three configurations of the front, by the photographs that settings are chosen on.

    Returns
    -------
    dict of str to Measured
        "fast": the least time at most 3 dB below the best; "balanced": at most 0.5 dB;
        "best": at most 0.05 dB.
    """
    whole = result.whole
    front = [whole[i] for i in front_of([(m.cpu_seconds, m.psnr) for m in whole])]
    losses = {FAST: FAST_LOSS, BALANCED: BALANCED_LOSS, BEST: BEST_LOSS}
    return {
        name: next(m for m in front if m.psnr >= front[-1].psnr - loss)
        for name, loss in losses.items()
    }


def gain(measured: Measured, default: Measured) -> tuple[float, float]:
    """Mean gain over the default in dB, and the error of this mean.

    The images are the same: their differences scatter less than they do, but not less than
    fields do that differ in nothing that matters.
    """
    ours, usual = (run.outcome["chosen on"]["psnr"] for run in (measured, default))
    differences = np.subtract(ours, usual)
    n = len(differences)
    scatter = max(CHANCE_DB, float(differences.std(ddof=1)) if n > 1 else 0.0)
    return float(differences.mean()), scatter / float(np.sqrt(n))
