"""Stage "resampling": raw samples again, in the aligned frames, missing ones filled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.factorization import Completion
from reflfield.field.clustered_pca import CompressionOptions
from reflfield.pipeline.alignment import AlignedFrames, aligned_frames, local_frames
from reflfield.pipeline.completion import arrays_of, completed
from reflfield.pipeline.context import Job
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
        Of all texels in that basis.
    """

    frames: AlignedFrames
    completion: Completion
    coefficients: Floats


def write_resampling(job: Job, folder: Path) -> dict[str, Any]:
    """Raw samples in the aligned frames on the grids, and what was not observed filled."""
    found = resampled(job, aligned_frames(job), job.options.compression, job.blocks(folder))
    arrays: dict[str, Any] = arrays_of(found.completion)
    np.savez(folder / "resampling.npz", **{**arrays, ALL_COEFFICIENTS: found.coefficients})
    return {
        "texels that shape the basis": len(found.completion.coefficients),
        "residual": float(found.completion.residuals[-1]),
    }


def resampled(
    job: Job, frames: AlignedFrames, options: CompressionOptions, blocks: Blocks
) -> Resampled:
    """Resample all texels from their raw samples in the given frames, and complete them."""
    reader = job.base_reader.rotated(local_frames(job, frames.local_from_base))
    found, coefficients = completed(
        reader,
        job.training_texels(options.training_texels),
        job.seen_texels,
        rank=options.rank,
        seed=job.options.seed,
        resources=job.resources,
        blocks=blocks,
    )
    return Resampled(frames, found, coefficients)
