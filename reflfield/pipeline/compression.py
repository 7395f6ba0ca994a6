"""Stage "compression": a model fitted to samples and photographs, to a field file."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.clustered_pca import HALF_VECTOR
from reflfield.field.file import open_field, write_field
from reflfield.metrics.sample_residual import sample_error
from reflfield.pipeline import results
from reflfield.pipeline.alignment import aligned_frames
from reflfield.pipeline.bounce_fit import gain_counts
from reflfield.pipeline.cache import WARNINGS, plain
from reflfield.pipeline.completion import completion_of
from reflfield.pipeline.context import Context
from reflfield.pipeline.half_vector_fit import write_half_vector_field
from reflfield.pipeline.model_fitting import fitted_model
from reflfield.pipeline.quantisation_search import FieldMaker
from reflfield.pipeline.resampling import ALL_COEFFICIENTS, Resampled
from reflfield.pipeline.saturated_highlights import saturation_counts
from reflfield.util.blas_threads import one_core_blas

Floats = NDArray[np.float32]


def write_compression(context: Context, folder: Path) -> dict[str, Any]:
    """Fit the model that the options name -> field, and see what it makes of highlights."""
    if context.options.compression.model == HALF_VECTOR:
        # Its products are of lists of points.
        with one_core_blas():
            counts = write_half_vector_field(context, folder)
    else:
        counts = write_clustered_field(context, folder)
    told = saturation_counts(context.refined, open_field(folder / "field.rfld"))
    warnings = [*counts.get(WARNINGS, ()), *told.get(WARNINGS, ())]
    return {**counts, **told, WARNINGS: warnings}


def write_clustered_field(context: Context, folder: Path) -> dict[str, Any]:
    """Fit a clustered model in the aligned frames."""
    stored = results.arrays(context, "resampling", "resampling.npz")
    coefficients = stored.pop(ALL_COEFFICIENTS)
    texels = Resampled(aligned_frames(context), completion_of(stored), coefficients)
    maker = FieldMaker(context, context.options.compression, plain(context.options))
    return write_compressed(texels, maker, folder)


def write_compressed(texels: Resampled, maker: FieldMaker, folder: Path) -> dict[str, Any]:
    """Fit a field in the frames of the texels, write it, and measure it on the samples."""
    context = maker.context
    model, reader = fitted_model(maker, texels, context.blocks(folder))
    made = maker.made(model, reader.local_from_world)
    write_field(folder / "field.rfld", made)
    write_model(folder / "model.npz", model, reader.local_from_world)
    size = (folder / "field.rfld").stat().st_size
    raw = results.base_reader(context).store.raw_bytes()
    error = sample_error(made, results.base_reader(context), results.measured_texels(context))
    n_fitted = len(results.measured_texels(context))
    counted = reader.count_fitted(
        np.flatnonzero(results.sampled(context).any(axis=1)), context.resources.workers
    )
    return {
        "texels fitted": n_fitted,
        "texels that repeat another": made.n_texels - n_fitted,
        "samples fitted": counted.fitted,
        "samples not measured": counted.unmeasured,
        "clusters": made.n_clusters,
        "components": made.n_components,
        **gain_counts(made),
        "field bytes": size,
        "raw bytes": raw,
        "compression ratio": raw / size,
        "residual of the transformed samples": float(model.residuals[-1]),
        "relative error of the samples": error.linear,
        "relative error of their cube roots": error.cube_root,
        "LDR PSNR of the samples, dB": error.psnr_ldr,
        "samples measured": error.n_samples,
    }


def write_model(path: Path, model: ClusteredModel, frames: Floats) -> None:
    """Store a model before it is quantised, and its frames."""
    arrays: dict[str, Any] = {
        entry.name: np.asarray(getattr(model, entry.name)) for entry in fields(model)
    }
    np.savez(path, local_from_world=frames, **arrays)


def stored_model(context: Context, stage: str) -> tuple[ClusteredModel, NDArray[np.float32]]:
    """Model of a compression stage before it was quantised, and its frames."""
    arrays: dict[str, Any] = results.arrays(context, stage, "model.npz")
    frames = arrays.pop("local_from_world")
    residuals = tuple(arrays.pop("residuals").tolist())
    return ClusteredModel(**arrays, residuals=residuals), frames
