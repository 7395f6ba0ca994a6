"""Stage "resampling": raw samples again, in the aligned frames, missing ones filled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.factorization import Completion
from reflfield.field.clustered_pca import CompressionOptions
from reflfield.pipeline import results
from reflfield.pipeline.alignment import AlignedFrames, aligned_frames, local_frames
from reflfield.pipeline.completion import arrays_of, completed
from reflfield.pipeline.context import Context
from reflfield.util.blocks import Blocks

Floats = NDArray[np.float32]

# In the results of the resampling: coefficients of all texels, beside those of the completion.
ALL_COEFFICIENTS = "all_coefficients"


@dataclass(frozen=True, eq=False)
class Resampled:
    """Texels on the grids of their frames, what was not observed of them filled.

    Parameters
    ----------
    frames : AlignedFrames
    completion : Completion
        Of the texels that shape the basis.
    coefficients : (n_texels, rank) float32
        Of all texels in that basis; of one view that is fitted in one pass, of those alone
        that shape it.
    """

    frames: AlignedFrames
    completion: Completion
    coefficients: Floats


def fits_in_one_pass(context: Context, options: CompressionOptions) -> bool:
    """Whether texels get clusters and coefficients in one pass (`pipeline.one_view_fit`)."""
    if not context.photometric or options.size > 0 or options.psnr > 0:
        return False
    n = results.observed(context).count() / max(len(results.measured_texels(context)), 1)
    return options.fits_samples(n)


def texels_read(context: Context) -> dict[str, str]:
    """Which texels of one view are completed, as the key of the stage has it."""
    if not context.photometric:
        return {}
    few = fits_in_one_pass(context, context.options.compression)
    return {"texels completed": "those of the basis" if few else "all"}


def write_resampling(context: Context, folder: Path) -> dict[str, Any]:
    """Resample raw samples in the aligned frames, and fill what was not observed."""
    texels = resampled(
        context, aligned_frames(context), context.options.compression, context.blocks(folder)
    )
    arrays: dict[str, Any] = arrays_of(texels.completion)
    np.savez(folder / "resampling.npz", **{**arrays, ALL_COEFFICIENTS: texels.coefficients})
    return {
        "texels that shape the basis": len(texels.completion.coefficients),
        "residual": float(texels.completion.residuals[-1]),
    }


def resampled(
    context: Context, frames: AlignedFrames, options: CompressionOptions, blocks: Blocks
) -> Resampled:
    """Resample all texels from their raw samples in some frames, and complete them."""
    reader = results.base_reader(context).rotated(local_frames(context, frames.local_from_base))
    chosen = results.random_texels(context, options.training_texels)
    completion, coefficients = completed(
        reader,
        chosen,
        chosen if fits_in_one_pass(context, options) else results.measured_texels(context),
        rank=options.rank,
        seed=context.options.seed,
        resources=context.resources,
        blocks=blocks,
    )
    return Resampled(frames, completion, coefficients)
