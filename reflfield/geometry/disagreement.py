"""What to say, and to do, about silhouettes that do not agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.geometry.cones import View
from reflfield.geometry.contradictions import CONTRADICTION, Verdict
from reflfield.geometry.explanations import Explanation, examine
from reflfield.util.quoting import listed, printable

Array = NDArray[np.float64]
Corner = tuple[float, float, float]
Bounds = tuple[Corner, Corner]


@dataclass(frozen=True)
class Contradiction:
    """A view that contradicts the others.

    Parameters
    ----------
    view : str
        Name of the camera.
    excluded : float
        Mean share of the other silhouettes that this view alone excludes.
    uncovered : float
        Share of its silhouette that the others exclude.
    explanation : Explanation, optional
        The mistake that explains it, if one was found.
    """

    view: str
    excluded: float
    uncovered: float
    explanation: Explanation | None

    def words(self, n_others: int) -> str:
        """Sentence for messages, without its end.

        Examples
        --------
        >>> Contradiction("v005", 0.42, 0.71, None).words(13)
        'v005: its silhouette contradicts the 13 others (it excludes 42 % of their area, they \
exclude 71 % of its own); check its camera and its silhouette'
        """
        text = (
            f"{printable(self.view)}: its silhouette contradicts the {n_others} others (it "
            f"excludes {_percent(self.excluded)} % of their area, they exclude "
            f"{_percent(self.uncovered)} % of its own)"
        )
        why = self.explanation
        if why is None:
            return f"{text}; check its camera and its silhouette"
        return (
            f"{text}; {why.words}, it seems: so read, it overlaps their hull by "
            f"{why.after:.2f} instead of {why.before:.2f}"
        )


def _percent(share: float) -> str:
    """Percent, with a decimal where there are few."""
    return f"{100 * share:.{0 if share >= 0.1 else 1}f}"


@dataclass(frozen=True, eq=False)
class Disagreement:
    """How the silhouettes of a capture disagree.

    Parameters
    ----------
    verdict : Verdict or None
        None if the silhouettes bound no body at all.
    names : tuple of str
        Of all views.
    """

    verdict: Verdict | None
    names: tuple[str, ...]

    @classmethod
    def of(cls, views: Sequence[View], bounds: Bounds | None = None) -> Disagreement:
        """Compare the silhouettes of views with each other, in a box if it is known."""
        return cls(examine(views, bounds), tuple(view.camera.id for view in views))

    @property
    def outliers(self) -> tuple[int, ...]:
        """Views without which the others agree."""
        return () if self.verdict is None else self.verdict.outliers

    @property
    def agree(self) -> bool:
        """Whether all views agree, but for the outliers."""
        return self.verdict is not None and self.verdict.agree

    @property
    def covered(self) -> float:
        """Median share of the silhouettes that the others do not exclude."""
        return 0.0 if self.verdict is None else 1.0 - float(np.median(self.verdict.uncovered))

    def words(self) -> str:
        """Sentence that names the views that disagree most, without its end."""
        if self.verdict is None:
            return "the silhouettes have no common body"
        uncovered = self.verdict.uncovered
        worst = np.flatnonzero(uncovered > CONTRADICTION)
        worst = worst[np.argsort(-uncovered[worst], kind="stable")]
        shown = [f"{self.names[i]} {100 * uncovered[i]:.0f} %" for i in worst]
        return (
            f"{len(worst)} of {len(uncovered)} silhouettes show parts that the others "
            f"exclude ({listed(shown)} of their areas), and no small group of views explains it"
        )
