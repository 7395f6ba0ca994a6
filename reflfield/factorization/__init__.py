"""Matrices in, matrices out: completion, online SVD, local PCA. Knows nothing of captures."""

from reflfield.factorization.column_sources import (
    ColumnSource,
    MatrixSource,
    as_source,
)
from reflfield.factorization.local_pca import ClusteredBasis, LocalPCA
from reflfield.factorization.online_svd import OnlineSVD
from reflfield.factorization.svd_completion import Completion, complete

__all__ = [
    "ClusteredBasis",
    "ColumnSource",
    "Completion",
    "LocalPCA",
    "MatrixSource",
    "OnlineSVD",
    "as_source",
    "complete",
]
