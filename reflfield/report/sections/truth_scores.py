"""Section on simulated captures: scores against the truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from reflfield.metrics.completion_error import CompletionError
from reflfield.metrics.frame_errors import FrameErrors
from reflfield.metrics.hull_distance import HullDistance
from reflfield.metrics.image_metrics import (
    Comparison,
)
from reflfield.report import plots
from reflfield.report.page import (
    Cell,
    Figure,
    Item,
    Panel,
    Section,
    Table,
)
from reflfield.report.sections.held_out_images import comparisons_table


def truth_section(
    *,
    surfaces: Mapping[str, HullDistance] | None = None,
    frames: FrameErrors | None = None,
    base_frames: FrameErrors | None = None,
    completion: CompletionError | None = None,
    comparison: Comparison | None = None,
) -> Section:
    """Scores against the truth of a simulated capture; those without a value are left out.

    Parameters
    ----------
    surfaces : mapping of str to HullDistance, optional
        By name, the hull first.
    frames, base_frames : FrameErrors, optional
        Of the recovered local frames, and of the hull's for comparison.
    completion : CompletionError, optional
    comparison : Comparison, optional
        Rendered images against the true ones.

    Returns
    -------
    Section
    """
    items: list[Item] = []
    if surfaces:
        items += _surface_items(surfaces)
    if frames is not None:
        items += _frame_items({"recovered": frames} | _optional("hull", base_frames))
    if completion is not None:
        items.append(_completion_table(completion))
    if comparison is not None:
        items.append(comparisons_table({"images against the truth": comparison}))
    intro = "The capture was simulated, so the true values are known."
    return Section("Against the truth", intro, tuple(items))


def _surface_items(surfaces: Mapping[str, HullDistance]) -> list[Item]:
    millimetres = {name: 1e3 * distance.signed for name, distance in surfaces.items()}
    together = np.concatenate(list(millimetres.values()))
    low, high = (float(p) for p in np.percentile(together, [0.5, 99.5]))
    plot = plots.histogram(
        millimetres,
        "signed distance from the true surface, mm",
        "area, %",
        limits=(low, high) if high > low else None,
    )
    figure = Figure(
        (Panel(plot),),
        "A visual hull encloses the object, so most of its area should lie outside (right of "
        "0), far outside at concavities that no silhouette shows. Area left of 0 was carved "
        "away wrongly or removed by smoothing. A surface from normals has the shape of the "
        "normals; where it lies, the hull decides.",
        title="Surfaces against the true one",
        min_width=300,
    )
    return [figure, _distance_table({n: d.summary() for n, d in surfaces.items()})]


def _distance_table(summaries: Mapping[str, Mapping[str, float]]) -> Table:
    statistics = {"mean": "mean", "rms": "RMS", "p95": "95th percentile", "max": "largest"}
    rows = tuple(
        (name, label, summary[f"{key}_mm"], summary.get(f"{key}_voxels"))
        for name, summary in summaries.items()
        for key, label in statistics.items()
    )
    shares = " ".join(
        f"{summary['outside_share']:.1%} of the area of the {name} lies outside of the object, "
        f"{summary['inside_share']:.1%} inside."
        for name, summary in summaries.items()
    )
    return Table(
        ("surface", "distance", "mm", "voxels"),
        rows,
        f"Unsigned distance from the true surface. {shares}",
    )


def _frame_items(variants: Mapping[str, FrameErrors]) -> list[Item]:
    panels = tuple(
        Panel(
            plots.histogram(
                {name: getattr(errors, kind) for name, errors in variants.items()},
                f"{kind} error, degrees",
                "texels, %",
            ),
            f"{kind}s",
        )
        for kind in ("normal", "tangent")
    )
    figure = Figure(
        panels,
        "Recovered frames should be closer to the truth than the hull's. Tangents are compared "
        "as lines (modulo 180 degrees), after removing one rotation about the normal for each "
        "target and material, which the reflectance does not determine. Random tangents are "
        "uniform from 0 to 90 degrees, as on isotropic materials.",
        title="Frames against the true shading frames",
        min_width=300,
    )
    return [figure, _frame_table(variants), _rotations_table(variants)]


def _frame_table(variants: Mapping[str, FrameErrors]) -> Table:
    labels = sorted({int(label) for errors in variants.values() for label in errors.label})
    groups = {"all": variants}
    if len(labels) > 1:
        groups |= {
            f"material {label}": {n: e.of_material(label) for n, e in variants.items()}
            for label in labels
        }
    return Table(
        (
            "angle",
            "texels of",
            "frames",
            "mean, °",
            "median, °",
            "95th percentile, °",
            "texels",
        ),
        tuple(
            _frame_row(kind, group, name, errors.summary())
            for kind in ("normal", "tangent")
            for group, members in groups.items()
            for name, errors in members.items()
        ),
        "Frame errors over the texels that have a true surface point near them. The "
        "tangents of isotropic materials are undetermined: 45 degrees on average.",
    )


def _frame_row(
    kind: str, group: str, name: str, summary: Mapping[str, float]
) -> tuple[Cell, ...]:
    angles = (summary[f"{kind}_{statistic}_deg"] for statistic in ("mean", "median", "p95"))
    return kind, group, name, *angles, int(summary["n_texels"])


def _rotations_table(variants: Mapping[str, FrameErrors]) -> Table:
    return Table(
        ("frames", "target", "material", "rotation removed, °", "texels"),
        tuple(
            (
                name,
                rotation.target,
                rotation.label,
                f"{rotation.degrees:.1f}",
                rotation.n_texels,
            )
            for name, errors in variants.items()
            for rotation in errors.rotations
        ),
        "Rotations about the normal removed before tangents are compared: rotating a target "
        "and all its frames together does not change the fit.",
    )


def _completion_table(error: CompletionError) -> Table:
    return Table(
        ("entries", "count", "relative error", "relative error, cube root"),
        (
            ("completed", error.n_unobserved, error.unobserved, error.unobserved_cube_root),
            ("measured", error.n_observed, error.observed, error.observed_cube_root),
        ),
        "Relative error of the completion against the true apparent BRDFs. Completed entries "
        "should be nearly as accurate as measured ones; the cube root weighs dark samples "
        "more.",
    )


def _optional(name: str, errors: FrameErrors | None) -> dict[str, FrameErrors]:
    return {} if errors is None else {name: errors}
