"""What stages depend on besides options and the results of other stages."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any

from reflfield.pipeline import model_selection
from reflfield.pipeline.cache import plain
from reflfield.pipeline.compared_photographs import compared_photographs
from reflfield.pipeline.context import Context
from reflfield.pipeline.hold_out import held_out_counts
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.quantisation_search import held_out

# Of the options of rendering, what no image depends on.
RENDERING_RESOURCES = ("workers", "block_pixels")
# In the folder of a simulated capture.
TRUTH = "truth"


def silhouettes_digest(context: Context) -> dict[str, str]:
    """Digest of cameras and silhouettes."""
    return {"capture": context.digest_of(context.training, "cameras", "silhouettes")}


def lights_digest(context: Context) -> dict[str, str]:
    """Digest of the lights."""
    return {"lights": context.digest_of(context.training, "lights")}


def photographs_digest(context: Context) -> dict[str, str]:
    """Digest of the photographs that make the field."""
    return {"photographs": context.digest_of(context.training, "photographs")}


def field_metadata_digest(context: Context) -> dict[str, str]:
    """What the metadata of a field say besides its options."""
    return {"name": context.capture.name, "held_out": json.dumps(held_out(context))}


def compared_digests(context: Context) -> dict[str, str]:
    """Digests of the photographs that fields are compared with."""
    sets = compared_photographs(context)
    return {name: context.digest_of(photographs) for name, photographs in sets.items()}


def field_options(options: PipelineOptions) -> tuple[Any, ...]:
    """Options that a field depends on, beside those of the stages before."""
    return options.compression, options.resampling, options.indirect, options.seed


def selection_digests(context: Context) -> dict[str, str]:
    """What candidate runs depend on: the name in their fields, the photographs compared."""
    return {"name": context.capture.name, **compared_digests(context)}


def comparison_digests(context: Context) -> dict[str, str]:
    """What the metrics depend on and say."""
    counts = json.dumps(held_out_counts(context.split))
    return {**compared_digests(context), "held_out": counts}


def error_analysis_digests(context: Context) -> dict[str, str]:
    """What the baselines are made of: the photographs of the field, and those compared."""
    return {**comparison_digests(context), **photographs_digest(context)}


def truth_digest(context: Context) -> dict[str, str]:
    """Digest of all files of the truth that a simulated capture brings."""
    total, files = hashlib.sha256(), sorted((context.capture.root / TRUTH).rglob("*"))
    for path in files:
        if path.is_file():
            total.update(path.relative_to(context.capture.root).as_posix().encode())
            total.update(context.digests.digest(path))
    context.digests.save()
    return {TRUTH: total.hexdigest()} if files else {}


def report_digests(context: Context) -> dict[str, str]:
    """What the report shows besides the results of the stages."""
    sentences = enumerate(model_selection.sentences(context))
    selected = {f"selection {i}": text for i, text in sentences}
    return {**field_metadata_digest(context), **truth_digest(context), **selected}


def rendering_options(options: PipelineOptions) -> dict[str, Any]:
    """Options of rendering that an image depends on."""
    values = asdict(options.relighting)
    return {name: value for name, value in values.items() if name not in RENDERING_RESOURCES}


def report_options(options: PipelineOptions) -> dict[str, Any]:
    """Options as the report lists them."""
    return {**plain(options), "relighting": rendering_options(options)}
