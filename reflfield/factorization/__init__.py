"""Matrices in, matrices out: completion, online SVD, local PCA. Knows nothing of captures."""

from reflfield.factorization.completion import Completion, complete
from reflfield.factorization.online import OnlineSVD
from reflfield.factorization.sources import ArraySource, BlockSource, ColumnSource, as_source

__all__ = [
    "ArraySource",
    "BlockSource",
    "ColumnSource",
    "Completion",
    "OnlineSVD",
    "as_source",
    "complete",
]
