"""Resampled texels as columns for the factorization, within a ceiling of memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.factorization import Completion
from reflfield.factorization.column_sources import blocks_of
from reflfield.factorization.inference import infer_coefficients
from reflfield.observations.texel_reading import NodeColumns, TexelReader
from reflfield.util.blocks import Blocks

Floats = NDArray[np.float32]
Halves = NDArray[np.float16]
Indices = NDArray[np.intp]

# Copies of a texel's nodes that live while it is resampled: both half-way products,
# the result, what is handed on of it.
COPIES_WHILE_RESAMPLING = 6
MOST_TEXELS_AT_ONCE = 256
# Columns of one block of a completion.
COLUMNS_AT_ONCE = 256


def texels_at_once(reader: TexelReader, block_bytes: int) -> int:
    """Texels that are resampled together."""
    each = reader.product_bytes_per_texel + COPIES_WHILE_RESAMPLING * 12 * reader.n_pairs
    return int(np.clip(block_bytes // each, 1, MOST_TEXELS_AT_ONCE))


@dataclass(frozen=True, eq=False)
class BlockedColumns:
    """Resampled texels, a few at a time whatever is asked for.

    Parameters
    ----------
    reader : TexelReader
    texels : (n,) int
        What the columns are.
    block_bytes : int
        Working memory; values do not depend on it.
    """

    reader: TexelReader
    texels: Indices
    block_bytes: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self._nodes.shape

    @property
    def _nodes(self) -> NodeColumns:
        return NodeColumns(self.reader, self.texels)

    def read(self, columns: Indices) -> tuple[Floats, Floats]:
        """Values (n_rows, k) and weights (n_weights, k) of some columns."""
        rows = self.shape[0]
        values = np.zeros((len(columns), rows), np.float32)
        n_weights = self.reader.n_pairs * self.reader.weight_channels
        weights = np.zeros((len(columns), n_weights), np.float32)
        step = texels_at_once(self.reader, self.block_bytes)
        for first in range(0, len(columns), step):
            part = slice(first, first + step)
            nodes, share = self._nodes.read(columns[part])
            values[part], weights[part] = nodes.T, share.T
        return values.T, weights.T


@dataclass(frozen=True, eq=False)
class HalfColumns:
    """Columns that several passes read, as halves, in memory or in two files.

    Parameters
    ----------
    values : (n_columns, n_rows) float16
        An array, or the file of one.
    weights : (n_columns, n_weights) float16
    shape : (int, int)
        Rows and columns.
    n_weights : int
        Of a column: as many as rows, or one for three of them.
    unit : float
        What the values are in; a power of two.
    """

    values: Halves | Path
    weights: Halves | Path
    shape: tuple[int, int]
    n_weights: int
    unit: float

    def read(self, columns: Indices) -> tuple[Floats, Floats]:
        """Values (n_rows, k) and weights (n_weights, k) of some columns."""
        values = self._read(self.values, self.shape[0], columns) * np.float32(self.unit)
        return values, self._read(self.weights, self.n_weights, columns)

    def _read(self, stored: Halves | Path, rows: int, columns: Indices) -> Floats:
        if isinstance(stored, Path):
            # Mapped for this block only, so that its pages do not pile up in memory.
            stored = np.memmap(stored, np.float16, "r", shape=(self.shape[1], rows))
        return np.asarray(stored[columns], np.float32).T


@dataclass(frozen=True, eq=False)
class Resampling:
    """What all blocks of texels that are resampled share.

    Parameters
    ----------
    reader : TexelReader
    block_bytes : int
        Working memory; values do not depend on it.
    """

    reader: TexelReader
    block_bytes: int

    def columns(self, texels: Indices) -> tuple[Floats, Floats]:
        """Values (n_rows, k) and weights (n_weights, k) of some texels."""
        source = BlockedColumns(self.reader, texels, self.block_bytes)
        return source.read(np.arange(len(texels)))


def resampled_halves(resampling: Resampling, texels: Indices) -> dict[str, Halves]:
    """Resampled texels as rows of halves: a block of `half_columns`."""
    values, weights = resampling.columns(texels)
    values = values.T / np.float32(resampling.reader.domain_unit)
    return {"values": values.astype(np.float16), "weights": weights.T.astype(np.float16)}


def half_columns(
    blocks: Blocks, resampling: Resampling, texels: Indices, memory: int, folder: Path
) -> HalfColumns:
    """Resample texels once, for several passes.

    Parameters
    ----------
    blocks : Blocks
        Who resamples them; what an interrupted run has done is kept.
    resampling : Resampling
    texels : (n,) int
        Ascending.
    memory : int
        Bytes up to which they are held in memory.
    folder : Path
        Where they are put otherwise; the caller removes it.

    Returns
    -------
    HalfColumns
        The same values in both cases.
    """
    reader, n = resampling.reader, len(texels)
    widths = (reader.n_pairs * 3, reader.n_pairs * reader.weight_channels)
    parts = [texels[i : i + COLUMNS_AT_ONCE] for i in range(0, n, COLUMNS_AT_ONCE)]
    halves = blocks.map("resampling for the basis", resampled_halves, resampling, parts)
    fits = n * sum(widths) * 2 <= memory
    kept = [np.zeros((n if fits else 0, width), np.float16) for width in widths]
    paths = (folder / "values", folder / "weights")
    for i, part in enumerate(halves):
        for array, path, name in zip(kept, paths, ("values", "weights"), strict=True):
            block = part[name]
            if fits:
                array[i * COLUMNS_AT_ONCE : i * COLUMNS_AT_ONCE + len(block)] = block
            else:
                with path.open("ab") as file:
                    block.tofile(file)
    values, weights = kept if fits else paths
    return HalfColumns(values, weights, (widths[0], n), widths[1], reader.domain_unit)


def inferred(shared: tuple[Completion, Resampling], texels: Indices) -> dict[str, Floats]:
    """Return coefficients of some texels that did not shape a completion."""
    completion, resampling = shared
    parts = []
    for some in blocks_of(texels, COLUMNS_AT_ONCE):
        # Row by row, as the arithmetic goes.
        values, weights = map(np.ascontiguousarray, resampling.columns(some))
        coefficients, _ = infer_coefficients(
            completion,
            values,
            weights=weights,
            n_channels=3 // resampling.reader.weight_channels,
        )
        parts.append(coefficients)
    return {"coefficients": np.concatenate(parts)}
