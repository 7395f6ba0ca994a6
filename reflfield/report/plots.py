"""Plots for the report: small vector drawings on a transparent ground.

Text is drawn as outlines and no date is stored, so the same data give the same
bytes wherever they are drawn.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike

from reflfield.report.page import Picture

# Told apart by lightness too, in print and by the colour-blind.
SERIES_COLOURS = ("#1f5fbf", "#e07b1a", "#3c9d5b", "#8f3f97", "#6b7280")
SIZE_INCHES = (5.6, 3.1)
PIXELS_PER_INCH = 96
# Around the axes, in inches: numbers of six digits, a power of ten above, labels. Fixed, as a
# layout that measures them draws every plot twice.
LEFT, RIGHT, BOTTOM, TOP = 0.76, 0.2, 0.52, 0.16
# Of names left of bars: the mean width of a letter, and the most that they may take.
INCHES_PER_LETTER = 0.078
WIDEST_NAMES = 3.0
# The ends of heavy tails are cut off, so that the bulk can be seen.
HISTOGRAM_PERCENTILE = 99.5

_STYLE = {
    "svg.hashsalt": "reflfield",
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.edgecolor": "#5c6472",
    "axes.labelcolor": "#1b1f27",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#9aa1ad",
    "grid.alpha": 0.35,
    "grid.linewidth": 0.6,
    "xtick.color": "#5c6472",
    "ytick.color": "#5c6472",
    "legend.frameon": False,
}


def lines(
    series: Mapping[str, tuple[ArrayLike, ArrayLike]],
    x_label: str,
    y_label: str,
    *,
    log_x: bool = False,
    log_y: bool = False,
) -> Picture:
    """Curves over a common axis.

    Parameters
    ----------
    series : mapping of name to (x, y)
        Points that are not finite (or not positive on a logarithmic axis) are
        left out.
    x_label, y_label : str
    log_x, log_y : bool
        True for a logarithmic axis.

    Returns
    -------
    Picture

    Examples
    --------
    >>> lines({"a": ([1, 2], [3.0, 4.0])}, "iteration", "score").media_type
    'image/svg+xml'
    """

    def draw(axes: Any) -> None:
        for colour, (name, (x, y)) in zip(_cycle(len(series)), series.items(), strict=True):
            points = _plottable(x, y, log_x=log_x, log_y=log_y)
            marker = "o" if points.shape[1] <= 40 else ""
            axes.plot(*points, color=colour, label=name, marker=marker, markersize=3.5)
        _scale(axes, "x", log_x)
        _scale(axes, "y", log_y)
        if not log_x and all(_whole(x) for x, _ in series.values()):
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))

    return _drawn(draw, x_label, y_label, has_legend=len(series) > 1)


@dataclass(frozen=True)
class Mark:
    """A point of a plot that has a name.

    Attributes
    ----------
    x, y : float
    label : str
    y_error : float
        Half the length of the bar through the point; none if 0.
    is_ringed : bool
        True for the point that others are compared with.
    """

    x: float
    y: float
    label: str = ""
    y_error: float = 0.0
    is_ringed: bool = False


def marked_curves(
    series: Mapping[str, Sequence[Mark]],
    x_label: str,
    y_label: str,
    *,
    log_x: bool = False,
    joined: Collection[str] = (),
) -> Picture:
    """Points with names and error bars; of some series, joined by lines.

    Parameters
    ----------
    series : mapping of name to sequence of Mark
        Points that are not finite (or not positive on a logarithmic axis) are left out.
    x_label, y_label : str
    log_x : bool
        True for a logarithmic axis.
    joined : collection of str
        Names of series whose points are joined in their order.

    Returns
    -------
    Picture

    Examples
    --------
    >>> marks = [Mark(1.0, 20.0, "96"), Mark(2.0, 21.0, "192", is_ringed=True)]
    >>> marked_curves({"hull": marks}, "CPU time, s", "PSNR, dB").media_type
    'image/svg+xml'
    """

    def draw(axes: Any) -> None:
        for colour, (name, marks) in zip(_cycle(len(series)), series.items(), strict=True):
            shown = [
                m for m in marks if _plottable([m.x], [m.y], log_x=log_x, log_y=False).size
            ]
            x, y = [mark.x for mark in shown], [mark.y for mark in shown]
            errors = [mark.y_error for mark in shown]
            line = "-" if name in joined else "none"
            axes.plot(
                *(x, y), color=colour, label=name, linestyle=line, marker="o", markersize=3.5
            )
            axes.errorbar(x, y, errors, fmt="none", ecolor=colour, elinewidth=0.8, alpha=0.5)
            _name_points(axes, shown, colour)
        _scale(axes, "x", log_x)
        axes.margins(0.12, 0.15)

    return _drawn(draw, x_label, y_label, has_legend=len(series) > 1)


def _name_points(axes: Any, marks: Sequence[Mark], colour: str) -> None:
    for mark in marks:
        if mark.is_ringed:
            axes.plot(
                *([mark.x], [mark.y]),
                *("o",),
                markersize=10,
                markerfacecolor="none",
                markeredgecolor=colour,
            )
        axes.annotate(
            _plain(mark.label),
            (mark.x, mark.y),
            xytext=(5, 5),
            textcoords="offset points",
            fontsize=8,
        )


def histogram(
    series: Mapping[str, ArrayLike],
    x_label: str,
    y_label: str,
    *,
    limits: tuple[float, float] | None = None,
    n_bins: int = 60,
) -> Picture:
    """Distributions of values over common bins, in percent of each series.

    Parameters
    ----------
    series : mapping of name to values
        Values that are not finite are left out.
    x_label, y_label : str
    limits : (low, high), optional
        Default: from the smallest value to the 99.5th percentile. Values beyond
        the limits count in the outermost bins.
    n_bins : int

    Returns
    -------
    Picture
    """
    kept = {name: _finite(values) for name, values in series.items()}
    low, high = limits or _range_of(kept)
    edges = np.linspace(low, high, n_bins + 1)

    def draw(axes: Any) -> None:
        for colour, (name, values) in zip(_cycle(len(kept)), kept.items(), strict=True):
            counts, _ = np.histogram(np.clip(values, low, high), edges)
            share = 100.0 * counts / max(1, values.size)
            axes.stairs(share, edges, color=colour, fill=True, alpha=0.25)
            axes.stairs(share, edges, color=colour, label=name, linewidth=1.3)
        axes.set_xlim(low, high)
        if all(_whole(values) for values in kept.values()):
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))

    return _drawn(draw, x_label, y_label, has_legend=len(kept) > 1)


def bars(names: Sequence[str], values: Sequence[float], x_label: str) -> Picture:
    """Horizontal bars, first on top.

    Parameters
    ----------
    names : sequence of str
    values : sequence of float
        One for each name.
    x_label : str

    Returns
    -------
    Picture
    """

    def draw(axes: Any) -> None:
        axes.barh(range(len(names)), values, color=SERIES_COLOURS[0], height=0.62)
        axes.set_yticks(range(len(names)), [_plain(name) for name in names])
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")

    height = 0.9 + 0.27 * max(1, len(names))
    letters = max(map(len, names), default=0)
    left = min(0.15 + INCHES_PER_LETTER * letters, WIDEST_NAMES)
    return _drawn(draw, x_label, "", has_legend=False, size=(SIZE_INCHES[0], height), left=left)


def _drawn(
    draw: Callable[[Any], None],
    x_label: str,
    y_label: str,
    *,
    has_legend: bool,
    size: tuple[float, float] = SIZE_INCHES,
    left: float = LEFT,
) -> Picture:
    width, height = size
    inside = (width - left - RIGHT, height - BOTTOM - TOP)
    with matplotlib.rc_context(_STYLE):
        drawing = Drawing(figsize=size)
        axes = drawing.add_axes(
            (left / width, BOTTOM / height, inside[0] / width, inside[1] / height)
        )
        draw(axes)
        axes.set_xlabel(_plain(x_label))
        axes.set_ylabel(_plain(y_label))
        if has_legend:
            axes.legend()
        stream = io.BytesIO()
        drawing.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    width_px, height_px = (round(inches * PIXELS_PER_INCH) for inches in size)
    return Picture(stream.getvalue(), "image/svg+xml", width_px, height_px, is_plot=True)


def _scale(axes: Any, axis: str, is_logarithmic: bool) -> None:
    """Set a logarithmic scale with ticks in plain numbers."""
    if not is_logarithmic:
        return
    axes.set(**{f"{axis}scale": "log"})
    ticks = axes.xaxis if axis == "x" else axes.yaxis
    low, high = ticks.get_view_interval()
    if high < 100 * low:
        ticks.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ticks.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ticks.set_minor_formatter(NullFormatter())


def _whole(values: ArrayLike) -> bool:
    numbers = np.asarray(values, dtype=np.float64)
    return bool((numbers == np.round(numbers)).all())


def _cycle(count: int) -> list[str]:
    return [SERIES_COLOURS[i % len(SERIES_COLOURS)] for i in range(count)]


def _plain(text: str) -> str:
    """Text that matplotlib will not take for a formula."""
    return text.replace("$", r"\$")


def _finite(values: ArrayLike) -> Any:
    numbers = np.asarray(values, dtype=np.float64).ravel()
    return numbers[np.isfinite(numbers)]


def _range_of(series: Mapping[str, Any]) -> tuple[float, float]:
    filled = [values for values in series.values() if values.size]
    if not filled:
        return 0.0, 1.0
    low = min(float(values.min()) for values in filled)
    high = max(float(np.percentile(values, HISTOGRAM_PERCENTILE)) for values in filled)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _plottable(x: ArrayLike, y: ArrayLike, *, log_x: bool, log_y: bool) -> Any:
    points = np.stack([np.asarray(a, dtype=np.float64).ravel() for a in (x, y)])
    usable = np.isfinite(points).all(axis=0)
    usable &= (points[0] > 0) if log_x else True
    usable &= (points[1] > 0) if log_y else True
    return points[:, usable]
