"""Stage "left_out_views": what the half-vector model tells of views left out of the fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from reflfield.field.clustered_pca import HALF_VECTOR
from reflfield.fitting.lobe_count import views_left_out
from reflfield.pipeline import model_selection
from reflfield.pipeline.context import AUTO, Context
from reflfield.pipeline.half_vector_fit import HalfVectorFit
from reflfield.pipeline.results import LEFT_OUT_ERRORS

# In the record of the stage.
LOBE_ERRORS = "weighted error of views left out, by the number of lobes"
NEAREST_ERROR = "that of the mean of a texel's nearest samples under other lights"


def write_left_out_views(context: Context, folder: Path) -> dict[str, Any]:
    """Fit some texels without some views, and measure the error on those."""
    options = context.options
    if options.resampling.visibility == AUTO:
        resampling = replace(options.resampling, visibility="factored")
        options = replace(options, resampling=resampling)
        context = replace(context, options=options, asked=context.asked_options)
    measured = HalfVectorFit(context).left_out_errors()
    np.savez(folder / LEFT_OUT_ERRORS, **measured)  # type: ignore[arg-type]
    return {
        LOBE_ERRORS: measured["errors"].round(6).tolist(),
        NEAREST_ERROR: round(float(measured["nearest"]), 6),
    }


def leaves_views_out(context: Context) -> bool:
    """Whether the number of lobes is asked of the views, and some can be left out."""
    asked = context.asked_options.compression
    if asked.half_vector.n_lobes != AUTO or not context.training.lights_known:
        return False
    if not views_left_out(context.training.n_views).any():
        return False
    return asked.model == HALF_VECTOR or model_selection.may_take_half_vector(context)
