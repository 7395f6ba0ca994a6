"""Stage "completion": samples on a common grid, missing ones filled."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from reflfield.factorization import Completion, complete
from reflfield.observations.texel_reading import TexelReader
from reflfield.options import Resources
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import columns_at_once
from reflfield.pipeline.texel_columns import Resampling, half_columns, inferred
from reflfield.util.blocks import Blocks

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Share of the memory that the columns of a completion may take while it is fitted.
COLUMNS_SHARE = 1 / 3


def write_completion(context: Context, folder: Path) -> dict[str, Any]:
    """Resample texels in their base frames, and fill what was not observed of them."""
    options = context.options.completion
    chosen = results.random_texels(context, options.training_texels)
    completion, coefficients = completed(
        results.base_reader(context),
        chosen,
        results.measured_texels(context),
        rank=options.rank,
        passes=options.passes,
        method=options.method,
        seed=context.options.seed,
        resources=context.resources,
        blocks=context.blocks(folder),
    )
    write_completion_arrays(folder / "completion.npz", completion, coefficients)
    return {
        "texels that shape the basis": len(chosen),
        "texels completed": len(results.measured_texels(context)),
        "texels without samples": results.base_reader(context).n_texels
        - len(results.measured_texels(context)),
        "samples observed": results.observed(context).count(),
        "share of nodes observed": float(completion.coverage.mean()),
        "residual": float(completion.residuals[-1]),
    }


def completed(
    reader: TexelReader,
    chosen: Indices,
    seen: Indices,
    *,
    rank: int,
    resources: Resources,
    blocks: Blocks,
    passes: int = 4,
    method: Literal["map", "brand"] = "map",
    seed: int = 0,
) -> tuple[Completion, Floats]:
    """Return the completion shaped by the chosen texels, and coefficients of all.

    The columns of the chosen texels are kept in memory, or in a temporary folder where they
    are too many; the result depends on neither.

    Returns
    -------
    completion : Completion
    coefficients : (n_texels, rank) float32
        Zero (the mean) for texels without samples.
    """
    resampling = Resampling(reader, resources.block_bytes)

    def basis() -> dict[str, NDArray[Any]]:
        blocks.folder.mkdir(exist_ok=True)
        with TemporaryDirectory(dir=blocks.folder, prefix="columns.") as folder:
            columns = half_columns(
                blocks,
                resampling,
                chosen,
                int(resources.max_memory * COLUMNS_SHARE),
                Path(folder),
            )
            completion = complete(
                columns,
                rank=rank,
                passes=passes,
                method=method,
                n_channels=3 // reader.weight_channels,
                seed=seed,
            )
        return arrays_of(completion)

    completion = completion_of(blocks.once("basis", basis))
    coefficients = np.zeros((reader.n_texels, completion.rank), np.float32)
    coefficients[chosen] = completion.coefficients
    others = np.setdiff1d(seen, chosen)
    if len(others):
        parts = blocks.map(
            "completing all texels",
            inferred,
            (completion, resampling),
            reader.product_blocks_of(others),
            at_once=columns_at_once(resources, reader.n_pairs),
        )
        coefficients[others] = parts.joined("coefficients")
    return completion, coefficients


def arrays_of(completion: Completion) -> dict[str, NDArray[Any]]:
    """Entries of a completion as arrays."""
    return {
        entry.name: np.asarray(getattr(completion, entry.name)) for entry in fields(completion)
    }


def completion_of(stored: dict[str, Any]) -> Completion:
    """Completion from its entries as arrays."""
    numbers: dict[str, Any] = {
        "noise": float(stored["noise"]),
        "residuals": tuple(stored["residuals"].tolist()),
        "restarts": int(stored["restarts"]),
    }
    return Completion(**{**stored, **numbers})


def write_completion_arrays(path: Path, completion: Completion, coefficients: Floats) -> None:
    """Store what later stages need of a completion."""
    np.savez(
        path,
        basis=completion.basis.astype(np.float32),
        mean=completion.mean.astype(np.float32),
        coefficients=coefficients,
        noise=np.array(completion.noise),
        residuals=np.array(completion.residuals),
    )
