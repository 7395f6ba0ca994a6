"""Stage "rate_distortion": the fitted models quantised more and more coarsely."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from reflfield.field.file import PackedSizes, open_field
from reflfield.field.reflectance_field import ClusteredField, ReflectanceField
from reflfield.metrics.held_out_photographs import compare_with_photographs
from reflfield.metrics.image_metrics import NothingToMeasure
from reflfield.pipeline import results
from reflfield.pipeline.compared_photographs import compared_photographs
from reflfield.pipeline.comparison import MAIN, variants
from reflfield.pipeline.compression import stored_model
from reflfield.pipeline.context import Context
from reflfield.pipeline.half_vector_fit import HalfVectorFit, stored_half_vector
from reflfield.pipeline.held_out_silhouettes import silhouettes_of
from reflfield.pipeline.memory import within_memory
from reflfield.pipeline.quantisation_search import FieldMaker
from reflfield.report.sections import RatePoint
from reflfield.util.progress import track

# Steps over the residual of the fit.
RELATIVE_STEPS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
CURVES = {MAIN: "with alignment", "without_alignment": "without alignment"}
HALF_VECTOR = "half vector"
PAPER = "half floats, not factored"
POINTS = "points.json"


def write_rate_distortion(context: Context, folder: Path) -> dict[str, Any]:
    """Size and quality of every model at every step, and in the layout of the paper."""
    aligns = context.options.aligns
    points = _clustered_points(context) if aligns else _half_vector_points(context)
    (folder / POINTS).write_text(json.dumps([asdict(point) for point in points], indent=1))
    return {"fields": len(points)}


def _half_vector_points(context: Context) -> list[RatePoint]:
    fit, model = HalfVectorFit(context.refined), stored_half_vector(context)
    indirect = open_field(results.field_file(context)).indirect
    sizes, points = PackedSizes(), []
    for relative_step in track(RELATIVE_STEPS, len(RELATIVE_STEPS), "quality against size"):
        field = fit.build(model, fit.step(relative_step), indirect)
        size = sizes.of(field)
        points.append(_point(context, fit.quality(field), field, HALF_VECTOR, size))
    return points


def _clustered_points(context: Context) -> list[RatePoint]:
    todo = [(v, stage, c) for v, stage in variants(context).items() for c in RELATIVE_STEPS]
    maker = FieldMaker(context, context.options.compression, {})
    sizes, points = PackedSizes(), []
    for variant, stage, relative_step in track(todo, len(todo), "quality against size"):
        model, frames = stored_model(context, stage)
        indirect = open_field(results.field_file(context, stage)).indirect
        field = maker.build(model, frames, relative_step * model.residuals[-1], indirect)
        quality = maker.quality(field)
        points.append(_point(context, quality, field, CURVES[variant], sizes.of(field)))
    model, frames = stored_model(context, "compression")
    indirect = open_field(results.field_file(context)).indirect
    exact = maker.build(model, frames, 0.0, indirect)
    size = unfactored_bytes(exact, sizes)
    return [*points, _point(context, maker.quality(exact), exact, PAPER, size)]


def stored_points(context: Context) -> list[RatePoint]:
    """What the stage has written."""
    stored = json.loads((context.stages.root / "rate_distortion" / POINTS).read_text())
    return [RatePoint(**point) for point in stored]


def unfactored_bytes(field: ClusteredField, sizes: PackedSizes) -> int:
    """Size with mean, basis and coefficients as halves and frames as four, as in the paper.

    Surface and clusters as in ours; nothing else is packed.
    """
    a_texel = 2 * (field.n_components + 4)
    functions = 2 * (field.mean.size + field.basis.size)
    surface = ("positions", "faces", "uv", "texel_of_pixel", "cluster")
    shared = sum(sizes.array_bytes(name, field.arrays[name]) for name in surface)
    return field.n_texels * a_texel + functions + shared


def _point(
    context: Context, quality: float, field: ReflectanceField, curve: str, size: int
) -> RatePoint:
    heldout = None
    sets = compared_photographs(context)
    if "heldout" in sets:
        options = within_memory(context.options.relighting, context.resources)
        with TemporaryDirectory() as scratch:
            photographs = sets["heldout"]
            silhouettes = silhouettes_of(context, "heldout", photographs)
            try:
                heldout = compare_with_photographs(
                    field, photographs, silhouettes, Path(scratch), options
                ).mean["psnr_ldr"]
            except NothingToMeasure:
                heldout = None
    return RatePoint(curve, size, quality, heldout)
