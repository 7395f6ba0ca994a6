"""Pictures of error against time for RESULTS.md, from the figures in results/.

Three stages: the alignment (`bench_accuracy.py`), the completion of missing samples
(`bench_factorization.py`) and the fit of a field (`bench_methods.py`); and whole runs with
other options (`bench_sweeps.py`). `make_results.py` draws them; nothing is measured here.
"""

from __future__ import annotations

from benchmarks import panels

from reflfield.report import plots

CPU = "CPU time, s"
BLUE, ORANGE, GREEN, PURPLE, GREY = plots.SERIES_COLOURS
# Searches of `bench_accuracy.py` as they are drawn.
SEARCHES = {
    "exact": {"color": BLUE, "marker": "o", "ms": 7, "zorder": 4},
    "Eq. 11, highest of the grid": {"color": ORANGE, "marker": "s"},
    "Eq. 11, then Newton steps": {"color": ORANGE, "marker": "D", "mfc": "white"},
    "brute force, highest of the grid": {"color": GREEN, "marker": "^", "ms": 7},
    "brute force, then Newton steps": {"color": GREEN, "marker": "v", "mfc": "white"},
    "all of align, refined": {"color": PURPLE, "marker": "P"},
}
RINGED = "the paper's K and L; the default of align"
# Rows of `bench_methods.py` in the order in which they are joined: each does more.
FITS = {
    "paper": {"color": GREY, "marker": "v"},
    "clusters, grid": {"color": ORANGE, "marker": "s"},
    "clusters, samples": {"color": ORANGE, "marker": "o"},
    "half vector, samples": {"color": GREEN, "marker": "o"},
    "half vector, images": {"color": GREEN, "marker": "D"},
    "default": {"color": BLUE, "marker": "P"},
}
FIT_NAMES = {
    "paper": "the paper's clusters, fitted to the grid",
    "clusters, grid": "our clusters, fitted to the grid",
    "clusters, samples": "our clusters, fitted to samples",
    "half vector, samples": "half-vector model, fitted to samples",
    "half vector, images": "half-vector model, fitted in image space",
    "default": "the same with geometry from its normals (default)",
}
# Methods of `bench_factorization.py`, by the begin of their names; numbers are passes.
COMPLETIONS = {
    "MAP recursive least squares": {"color": BLUE, "marker": "o"},
    "Brand": {"color": ORANGE, "marker": "s"},
    "softImpute-ALS": {"color": GREEN, "marker": "D"},
    "IncrementalPCA": {"color": PURPLE, "marker": "^"},
    "randomized_svd": {"color": GREY, "marker": "v"},
    "(bound": {"color": "black", "marker": "*", "ms": 9},
}
COMPLETION_NAMES = {
    "MAP recursive least squares": "ours: MAP recursive least squares, by passes",
    "Brand": "Brand's online SVD, by passes",
    "softImpute-ALS": "softImpute-ALS, by iterations",
    "IncrementalPCA": "IncrementalPCA, row means filled in",
    "randomized_svd": "randomized SVD, row means filled in",
    "(bound": "bound: the true subspace is known",
}


def pictures(results):
    """SVG text by file name, of those results that are there."""
    by_name = {result["name"]: result for result in results}
    drawn = {}
    for name, draw in (
        ("accuracy", alignment_picture),
        ("factorization", completion_picture),
        *((name, fit_picture) for name in by_name if name.startswith("methods_")),
        *((name, sweep_picture) for name in by_name if name.startswith("sweep_")),
    ):
        if name in by_name and (picture := draw(by_name[name]["tables"])) is not None:
            drawn[f"{name}.svg"] = picture.decode("utf-8")
    return drawn


def alignment_picture(tables, file_format="svg"):
    """Errors of frames over the time of one texel, a column of panels for each band limit."""
    rows = tables[0]["rows"]
    limits = sorted({row["L"] for row in rows})

    def draw(figure):
        grid = figure.subplots(2, len(limits), sharex=True, sharey="row", squeeze=False)
        for axes, error in zip(grid, ("normals", "tangents"), strict=True):
            for panel, limit in zip(axes, limits, strict=True):
                draw_searches(panel, [row for row in rows if row["L"] == limit], error)
            axes[0].set_ylabel(f"mean error of {error}, degrees")
        for panel, limit in zip(grid[0], limits, strict=True):
            panel.set_title(f"L = {limit}", fontsize=10)
        for panel in grid[-1]:
            panel.set_xlabel("CPU time of a texel, ms")
        panels.legend(figure, [*SEARCHES.items(), (RINGED, panels.RING)], 4)

    return panels.encoded(draw, (11.0, 7.0), file_format)


def draw_searches(axes, rows, error):
    """One panel: what each search errs, by K or rounds, and whose choice a point is."""
    for search, style in SEARCHES.items():
        some = [row for row in rows if row["search"] == search]
        x, y = ([row[name] for row in some] for name in ("ms per texel", error))
        axes.plot(x, y, lw=1, **style)
        for i, (row, point) in enumerate(zip(some, zip(x, y, strict=True), strict=True)):
            if row["remark"]:
                panels.ringed(axes, point)
            if row["K or rounds"] and (row["remark"] or i in (0, len(some) - 1)):
                panels.beside(axes, row["K or rounds"], point)
    panels.logarithmic(axes, "xy")


def completion_picture(tables):
    """Error of the missing values over time, a panel for each pattern; curves by passes."""
    patterns = {
        table["title"].split(",")[1].strip(): table["rows"]
        for table in tables
        if table["title"].startswith("completion,")
    }

    def draw(figure):
        axes = figure.subplots(1, len(patterns), sharey=True, squeeze=False)[0]
        for panel, (pattern, rows) in zip(axes, patterns.items(), strict=True):
            panel.set(title=f"missing: {pattern}", xlabel=CPU)
            draw_completions(panel, rows)
        axes[0].set_ylabel("relative error of missing values")
        panels.legend(figure, [(COMPLETION_NAMES[n], s) for n, s in COMPLETIONS.items()], 3)

    return panels.encoded(draw, (10.0, 4.6)) if patterns else None


def draw_completions(axes, rows):
    """One panel."""
    for name, style in COMPLETIONS.items():
        some = sorted(
            (row["CPU, s"], row["error"], row["method"])
            for row in rows
            if row["method"].startswith(name)
        )
        axes.plot([x for x, *_ in some], [y for _, y, _ in some], lw=1, **style)
        for x, y, method in some:
            counts = [word for word in method.split(", ")[-1].split() if word.isdigit()]
            panels.beside(axes, "".join(counts), (x, y))
    panels.logarithmic(axes, "xy")


def fit_picture(tables):
    """PSNR over time, from the paper's fit to the default, a panel for each capture."""
    curves = fit_curves(tables[0]["rows"])
    captures = list(dict.fromkeys(capture for capture, _ in curves))

    def draw(figure):
        axes = figure.subplots(1, len(captures), squeeze=False)[0]
        for panel, capture in zip(axes, captures, strict=True):
            panel.set(title=capture, xlabel=CPU, ylabel="PSNR, dB")
            draw_fits(panel, curves, capture)
        styles = [(FIT_NAMES[name], style) for name, style in FITS.items()]
        lines = [(what, {"color": "black", "ls": ls}) for what, ls in LINES.items()]
        panels.legend(figure, styles + lines, 2)

    return panels.encoded(draw, (9.0, 5.2)) if curves else None


# Of images that the row says: held out of the capture, or of views and lights not in it.
LINES = {"held out": "--", "unseen views and lights": "-"}


def fit_curves(rows):
    """Points (method, CPU seconds, dB) by capture and images, of captures with all fits."""
    curves = {}
    for row in rows:
        if row["method"] in FITS:
            images = "held out" if row["images"] == "held out" else "unseen views and lights"
            point = row["method"], row[CPU], row["PSNR, dB"]
            curves.setdefault((row["capture"], images), []).append(point)
    order = list(FITS)
    return {
        key: sorted(points, key=lambda point: order.index(point[0]))
        for key, points in curves.items()
        if any(name.startswith("half vector") for name, *_ in points)
    }


def draw_fits(axes, curves, capture):
    """One panel."""
    for images, line in LINES.items():
        points = curves.get((capture, images), ())
        axes.plot([x for _, x, _ in points], [y for *_, y in points], line, color=GREY, lw=1)
        for name, x, y in points:
            inside = {} if line == "-" else {"mfc": "white"}
            axes.plot([x], [y], ls="", ms=8, **FITS[name], **inside)
    panels.logarithmic(axes, "x")


def sweep_picture(tables):
    """Gain over the default of all configurations of a sweep, over their share of its time."""
    series = {}
    for row in tables[1]["rows"]:
        mark = plots.Mark(
            row["of the default's"], row["gain, dB"], is_ringed=row["part"] == "default"
        )
        series.setdefault(row["capture"], []).append(mark)
    x_label, y_label = "CPU time over the default's", "PSNR over the default's, dB"
    if not series:
        return None
    return plots.marked_curves(series, x_label, y_label, log_x=True).data
