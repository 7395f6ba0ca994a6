"""Matrices in, matrices out: completion, online SVD, local PCA. Knows nothing of captures."""

from reflfield.factorization.completion import Completion, complete
from reflfield.factorization.local_pca import ClusteredBasis, LocalPCA
from reflfield.factorization.online import OnlineSVD
from reflfield.factorization.sources import ArraySource, BlockSource, ColumnSource, as_source

__all__ = [
    "ArraySource",
    "BlockSource",
    "ClusteredBasis",
    "ColumnSource",
    "Completion",
    "LocalPCA",
    "OnlineSVD",
    "as_source",
    "complete",
]
