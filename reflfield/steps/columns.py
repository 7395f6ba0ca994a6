"""Resampled texels as columns for the factorization, within a ceiling of memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.observations.reading import NodeColumns, TexelReader

Floats = NDArray[np.float32]
Halves = NDArray[np.float16]
Indices = NDArray[np.intp]

# Copies of a texel's nodes that live while it is resampled: both half-way products,
# the result, what is handed on of it.
COPIES_WHILE_RESAMPLING = 6
MOST_TEXELS_AT_ONCE = 256


def texels_at_once(reader: TexelReader, block_bytes: int) -> int:
    """Texels that are resampled together."""
    each = reader.sample_bytes_per_texel + COPIES_WHILE_RESAMPLING * 12 * reader.n_pairs
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
    def run_length(self) -> int:
        """Columns that are best read together."""
        return self._nodes.run_length

    @property
    def _nodes(self) -> NodeColumns:
        return NodeColumns(self.reader, self.texels)

    def read(self, columns: Indices) -> tuple[Floats, Floats]:
        """Values (n_rows, k) and weights (n_rows // 3, k) of some columns."""
        rows = self.shape[0]
        values = np.zeros((len(columns), rows), np.float32)
        weights = np.zeros((len(columns), rows // 3), np.float32)
        step = texels_at_once(self.reader, self.block_bytes)
        for first in range(0, len(columns), step):
            part = slice(first, first + step)
            found, share = self._nodes.read(columns[part])
            values[part], weights[part] = found.T, share.T
        return values.T, weights.T


@dataclass(frozen=True, eq=False)
class HalfColumns:
    """Columns that several passes read, as halves, in memory or in two files.

    Parameters
    ----------
    values : (n_columns, n_rows) float16
        An array, or the file of one.
    weights : (n_columns, n_rows // 3) float16
    shape : (int, int)
        Rows and columns.
    """

    values: Halves | Path
    weights: Halves | Path
    shape: tuple[int, int]

    def read(self, columns: Indices) -> tuple[Floats, Floats]:
        """Values (n_rows, k) and weights (n_rows // 3, k) of some columns."""
        rows = self.shape[0]
        return self._read(self.values, rows, columns), self._read(
            self.weights, rows // 3, columns
        )

    def _read(self, stored: Halves | Path, rows: int, columns: Indices) -> Floats:
        if isinstance(stored, Path):
            # Mapped for this block only, so that its pages do not pile up in memory.
            stored = np.memmap(stored, np.float16, "r", shape=(self.shape[1], rows))
        return np.asarray(stored[columns], np.float32).T


def half_columns(source: BlockedColumns, memory: int, folder: Path) -> HalfColumns:
    """Read all columns once.

    Parameters
    ----------
    source : BlockedColumns
    memory : int
        Bytes up to which they are held in memory.
    folder : Path
        Where they are put otherwise; the caller removes it.

    Returns
    -------
    HalfColumns
        The same values in both cases.
    """
    rows, n = source.shape
    paths = (folder / "values", folder / "weights")
    fits = n * (rows + rows // 3) * 2 <= memory
    kept = [np.zeros((n if fits else 0, width), np.float16) for width in (rows, rows // 3)]
    for first in range(0, n, source.run_length):
        part = np.arange(first, min(first + source.run_length, n))
        for i, block in enumerate(source.read(part)):
            if fits:
                kept[i][part] = block.T
            else:
                with paths[i].open("ab") as file:
                    np.ascontiguousarray(block.T, np.float16).tofile(file)
    values, weights = kept if fits else paths
    return HalfColumns(values, weights, source.shape)
