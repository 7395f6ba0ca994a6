"""Pictures of error against time for RESULTS.md, from the figures in results/.

Three stages: the alignment (`bench_accuracy.py`), the completion of missing samples
(`bench_factorization.py`) and the fit of a field (`bench_methods.py`); and whole runs with
other options (`bench_sweeps.py`). `make_results.py` draws them; nothing is measured here.
"""

from __future__ import annotations

from reflfield.report import plots

CPU = "CPU time, s"
# Rows of `bench_methods.py` in the order in which they are joined: each does more.
FITS = (
    "paper",
    "clusters, grid",
    "clusters, samples",
    "half vector, samples",
    "half vector, images",
    "default",
)
COMPLETIONS = "completion, hemispheric"


def pictures(results):
    """SVG text by file name, of those results that are there."""
    by_name = {result["name"]: result for result in results}
    drawn = {}
    for name, draw in (
        ("accuracy", alignment_picture),
        ("factorization", completion_picture),
        ("methods", fit_picture),
        ("sweeps", sweep_picture),
    ):
        if name in by_name and (picture := draw(by_name[name]["tables"])) is not None:
            drawn[f"{name}.svg"] = picture.data.decode("utf-8")
    return drawn


def alignment_picture(tables):
    """Mean error of the normals over the time of one texel: a curve for each kind of search."""
    series = {}
    for row in tables[0]["rows"]:
        kind, _, what = row["method"].partition(": ")
        if what.startswith("K=") or kind.startswith("brute"):
            kind = f"{kind}, L = {row['L']}"
        series.setdefault(kind, []).append((row["ms per ABRDF"], row["normals"]))
    return error_curves(series, "CPU time of a texel, ms", "error of the normals, degrees")


def completion_picture(tables):
    """Error of the missing values over time: a curve for each method, by its passes."""
    rows = next((t["rows"] for t in tables if t["title"].startswith(COMPLETIONS)), ())
    series = {}
    for row in rows:
        if not row["method"].startswith("("):  # a bound, not a method
            name = row["method"].partition(",")[0]
            series.setdefault(name, []).append((row["CPU, s"], row["error"]))
    return error_curves(series, CPU, "relative error of missing values") if series else None


def error_curves(series, x_label, y_label):
    """Curves on logarithmic axes, each in the order of time."""
    curves = {name: tuple(zip(*sorted(points), strict=True)) for name, points in series.items()}
    return plots.lines(curves, x_label, y_label, log_x=True, log_y=True)


def fit_picture(tables):
    """PSNR of unseen views and lights over time, from the paper's fit to the default."""
    series = {}
    for row in tables[0]["rows"]:
        if row["images"].startswith("unseen") and row["method"] in FITS:
            mark = plots.Mark(
                row[CPU],
                row["PSNR, dB"],
                row["method"],
                is_ringed=row["method"] == "default",
            )
            series.setdefault(row["capture"], []).append(mark)
    for marks in series.values():
        marks.sort(key=lambda mark: FITS.index(mark.label))
    label = "PSNR of unseen views and lights, dB"
    return plots.marked_curves(series, CPU, label, joined=tuple(series)) if series else None


def sweep_picture(tables):
    """Gain over the default of all configurations of a sweep, over their share of its time."""
    series = {}
    for row in tables[1]["rows"]:
        mark = plots.Mark(
            row["of the default's"], row["gain, dB"], is_ringed=row["part"] == "default"
        )
        series.setdefault(row["capture"], []).append(mark)
    x_label, y_label = "CPU time over the default's", "PSNR over the default's, dB"
    return plots.marked_curves(series, x_label, y_label, log_x=True) if series else None
