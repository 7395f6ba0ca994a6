"""Findings: what a check has to say, how grave it is, on what evidence, and what to do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.util.quoting import listed, printable

# From the least to the gravest; the exit status of the command is the place in the list, but
# for that of nothing and that of notes, which are both 0.
NOTE, WARNING, ERROR = "note", "warning", "error"
SEVERITIES = (NOTE, WARNING, ERROR)


@dataclass(frozen=True, eq=False)
class Evidence:
    """A picture that shows what a finding speaks of.

    Parameters
    ----------
    image : (height, width, 3) uint8
        sRGB.
    label : str
    """

    image: NDArray[np.uint8]
    label: str


@dataclass(frozen=True, eq=False)
class Finding:
    """Something that is wrong, or worth knowing.

    Parameters
    ----------
    kind : str
        What it is, in the words of the table in this package's README, such as "dead light".
    severity : {"note", "warning", "error"}
        An error spoils the result, a warning may, a note is for the reader.
    subjects : tuple of str
        Names of the photographs, cameras or lights.
    words : str
        What was measured, in a sentence without its end.
    remedy : str
        What to do, in the imperative.
    file : str
        Where it is, if it is one file.
    pictures : tuple of Evidence
    """

    kind: str
    severity: str
    subjects: tuple[str, ...]
    words: str
    remedy: str
    file: str = ""
    pictures: tuple[Evidence, ...] = ()

    def line(self) -> str:
        """The finding in one line, its severity first.

        Examples
        --------
        >>> Finding("dead light", "error", ("l03",), "it is dark", "mend it").line()
        'error: dead light l03: it is dark; mend it'
        """
        where = f"{printable(self.file)}: " if self.file else ""
        names = f" {listed(list(self.subjects))}" if self.subjects else ""
        return f"{self.severity}: {where}{self.kind}{names}: {self.words}; {self.remedy}"

    def entry(self) -> dict[str, Any]:
        """The finding for JSON."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "subjects": list(self.subjects),
            "file": self.file,
            "evidence": self.words,
            "remedy": self.remedy,
        }


@dataclass(frozen=True, eq=False)
class Findings:
    """All that was found in a capture.

    Parameters
    ----------
    all : tuple of Finding
        The gravest first.
    measured : dict
        Numbers on the whole capture, for JSON.
    """

    all: tuple[Finding, ...]
    measured: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def sorted(cls, some: Iterable[Finding], measured: dict[str, Any]) -> Findings:
        """Findings, the gravest first, else in the order in which they came."""
        order = sorted(some, key=lambda finding: -SEVERITIES.index(finding.severity))
        return cls(tuple(order), measured)

    @property
    def worst(self) -> str:
        """Severity of the gravest finding; empty if there is none."""
        return self.all[0].severity if self.all else ""

    def count(self, severity: str) -> int:
        """Findings of a severity."""
        return sum(finding.severity == severity for finding in self.all)


def robust_spread(values: Sequence[float] | NDArray[np.floating[Any]]) -> tuple[float, float]:
    """Median, and standard deviation by quantiles of the absolute deviation.

    The larger one of what the median and the 80th percentile of the deviations say: up to a
    fifth of the values may be wrong, and many that stray, as highlights do, are no errors.

    Examples
    --------
    >>> median, deviation = robust_spread([1.0, 2.0, 2.0, 3.0, 4.0, 5.0, 100.0])
    >>> median, round(deviation, 4)
    (3.0, 1.5605)
    """
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    if not known.size:
        return 0.0, 0.0
    median = float(np.median(known))
    half, most = np.quantile(np.abs(known - median), [0.5, 0.8])
    return median, float(max(1.4826 * half, most / 1.2816))
