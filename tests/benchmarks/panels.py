"""Pictures of several panels for RESULTS.md: one error over time in each, one legend."""

from __future__ import annotations

import io

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

# The same bytes each time, text as outlines. The ground is white, as points are filled with it.
STYLE = {"svg.hashsalt": "reflfield", "svg.fonttype": "path", "font.size": 9.0}

RING = {"marker": "o", "ms": 13, "mfc": "none", "mec": "black", "mew": 0.9, "ls": ""}


def encoded(draw, size, file_format="svg"):
    """A picture of so many inches that a function has drawn; its bytes."""
    with matplotlib.rc_context(STYLE):
        figure, stream = Figure(figsize=size, layout="constrained"), io.BytesIO()
        draw(figure)
        extra = {"metadata": {"Date": None}} if file_format == "svg" else {"dpi": 110}
        figure.savefig(stream, format=file_format, **extra)
    return stream.getvalue()


def logarithmic(axes, directions):
    """Make axes logarithmic, with ticks in plain numbers, after all is drawn."""
    axes.margins(0.1)
    for direction in directions:
        axes.set(**{f"{direction}scale": "log"})
        ticks = axes.xaxis if direction == "x" else axes.yaxis
        low, high = ticks.get_view_interval()
        if high < 100 * low:
            ticks.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ticks.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ticks.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, alpha=0.25)


def beside(axes, text, point, offset=(5, 4)):
    """Write a few letters beside a point."""
    axes.annotate(text, point, xytext=offset, textcoords="offset points", fontsize=7.5)


def ringed(axes, point):
    """Draw a ring around a point that a default makes."""
    axes.plot(*point, **RING)


def legend(figure, styles, columns):
    """Names of what is drawn, below all panels; styles by name."""
    handles = [Line2D([], [], **{"ls": "", **style}, label=name) for name, style in styles]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)
