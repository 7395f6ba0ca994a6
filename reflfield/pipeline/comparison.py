"""Stage "comparison": the field relit against held-out photographs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from reflfield.errors import InputError
from reflfield.field.file import open_field
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.metrics.held_out_photographs import RelitPairs, compare_with_photographs
from reflfield.metrics.image_metrics import Comparison, NothingToMeasure, metrics_text
from reflfield.pipeline.compared_photographs import compared_photographs, unseen_photographs
from reflfield.pipeline.context import Context
from reflfield.pipeline.held_out_silhouettes import silhouettes_of
from reflfield.pipeline.hold_out import held_out_counts
from reflfield.pipeline.memory import within_memory

# Folders of the comparison: of the field itself, and of the one that it is compared with.
MAIN, WITHOUT = "field", "without_alignment"
PROBLEMS = "problems"


def write_comparison(context: Context, folder: Path) -> dict[str, Any]:
    """Relight held-out photographs and measure the images; without any, say so."""
    counts: dict[str, Any] = {}
    problems = [problem for _, problem in [unseen_photographs(context)] if problem]
    for variant, stage in variants(context).items():
        field = open_field(context.stages.root / stage / "field.rfld")
        measured, failed = _compare(context, field, folder / variant, variant)
        counts |= measured
        problems += failed if variant == MAIN else []
    compared = [folder / MAIN / f"{name}.json" for name in ("heldout", "truth")]
    main = next((json.loads(path.read_text()) for path in compared if path.is_file()), None)
    (folder / "metrics.json").write_text(
        metrics_text(main, held_out=held_out_counts(context.split))
    )
    n_photographs = sum(len(f.photographs) for f in compared_photographs(context).values())
    return {"photographs": n_photographs, **counts, PROBLEMS: problems}


def _compare(
    context: Context, field: ReflectanceField, folder: Path, variant: str
) -> tuple[dict[str, float], list[str]]:
    """Compare one field with all sets; counts, and why a set was not compared."""
    folder.mkdir(exist_ok=True)
    options = within_memory(context.options.relighting, context.resources)
    counts, problems = {}, []
    for name, photographs in compared_photographs(context).items():
        silhouettes = silhouettes_of(context, name, photographs)
        try:
            comparison = compare_with_photographs(
                field, photographs, silhouettes, folder / name, options
            )
        except InputError as error:
            # Without the truth, or where nothing can be measured, the run goes on.
            if name == "heldout" and not isinstance(error, NothingToMeasure):
                raise
            problems.append(f"{name}: not compared: {error}")
            continue
        (folder / f"{name}.json").write_text(comparison.to_json())
        count = f"{name} PSNR, dB" if variant == MAIN else f"{name} PSNR {variant}, dB"
        counts[count.replace("_", " ")] = comparison.mean["psnr_ldr"]
    return counts, problems


def variants(context: Context) -> dict[str, str]:
    """Stage that makes the field of each variant that is compared."""
    stages = {MAIN: "compression"}
    if context.options.compares_without_alignment:
        stages[WITHOUT] = "without_alignment"
    return stages


def relit_pairs(context: Context, variant: str = MAIN) -> dict[str, RelitPairs]:
    """What the comparison stage has relit and measured."""
    root = context.stages.root / "comparison" / variant
    pairs = {}
    for name, photographs in compared_photographs(context).items():
        comparison = comparison_of(context, name, variant)
        if comparison is not None:
            silhouettes = silhouettes_of(context, name, photographs)
            relit = RelitPairs(photographs, root / name, silhouettes)
            pairs[name] = relit.measured_in(comparison)
    return pairs


def comparison_of(context: Context, name: str, variant: str = MAIN) -> Comparison | None:
    """Metrics of one set of photographs that the comparison stage has measured."""
    return read_comparison(context.stages.root / "comparison" / variant / f"{name}.json")


def read_comparison(path: Path) -> Comparison | None:
    """Metrics as the comparison stage writes them; None where it has not."""
    return Comparison.from_dict(json.loads(path.read_text())) if path.is_file() else None
