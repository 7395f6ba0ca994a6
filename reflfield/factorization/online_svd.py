"""Online SVD of columns that arrive in blocks: Brand's update, thresholded."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from reflfield.errors import InputError
from reflfield.util.validation import check_shape

Array = NDArray[Any]
# Residual directions below this share of the largest column norm are rounding, not data.
THRESHOLD = {np.dtype(np.float32): 3e-6, np.dtype(np.float64): 1e-13}
# Blocks are folded in parts of at least so many columns: the cost of a column grows with the
# width of its part, and matrix products are efficient from about here on.
SMALL_BLOCK = 64


def fixed_signs(vectors: Array) -> Array:
    """Signs that make the largest entry of every column positive, (k,)."""
    largest = vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])]
    return np.where(largest < 0, -1.0, 1.0).astype(vectors.dtype)


class OnlineSVD:
    r"""Truncated SVD of a matrix whose columns arrive in blocks.

    A block X is split into what the basis holds, M = U^T X, and the rest
    R = X - U M; the SVD of the small matrix [[S, M], [0, R']] rotates the basis
    extended by an orthonormal basis of R [1]_. Directions of R below 3e-6
    (float32) or 1e-13 (float64) of the largest column norm so far are dropped:
    without that, data of exactly low rank make the basis lose orthogonality
    within a thousand columns, in any precision.

    Parameters
    ----------
    rank : int
        Singular vectors kept.
    dtype : float32 or float64
        Precision of the basis; small matrices are always float64.

    Attributes
    ----------
    n_columns : int
        Columns seen.

    Raises
    ------
    InputError
        If an option is out of range.

    Notes
    -----
    Cost per block of k columns is O(n_rows (rank + k)^2), memory O(n_rows (rank + k)).
    The batch form is a loop over `update`; there is no other.

    References
    ----------
    .. [1] M. Brand, "Incremental singular value decomposition of uncertain data with
       missing values", ECCV 2002.

    Examples
    --------
    >>> svd = OnlineSVD(rank=1, dtype=np.float64).update(np.array([[3.0, 0.0], [4.0, 0.0]]))
    >>> svd.singular_values.round(12), svd.basis.ravel().round(12)
    (array([5.]), array([0.6, 0.8]))
    """

    def __init__(self, rank: int, dtype: DTypeLike = np.float32) -> None:
        if rank < 1:
            raise InputError(f"rank: expected at least 1, received {rank}")
        self.rank = rank
        self.dtype = np.dtype(dtype)
        if self.dtype not in THRESHOLD:
            raise InputError(f"dtype: expected float32 or float64, received {self.dtype}")
        self.n_columns = 0
        self._basis: Array | None = None
        self._values = np.zeros(0)
        self._largest_norm = 0.0

    # --- results ---

    @property
    def basis(self) -> Array:
        """Left singular vectors, (n_rows, k), k <= rank; their largest entries positive."""
        basis = self._started()
        return basis * fixed_signs(basis)

    @property
    def singular_values(self) -> NDArray[np.float64]:
        """Singular values, descending, (k,)."""
        return self._values.copy()

    def _started(self) -> Array:
        if self._basis is None:
            raise InputError("OnlineSVD: expected a block of columns first; call update")
        return self._basis

    # --- update ---

    def update(self, block: Array) -> OnlineSVD:
        """Fold a block of columns into the SVD.

        Parameters
        ----------
        block : (n_rows, n_new) float

        Returns
        -------
        OnlineSVD
            This object, so that calls can be chained.

        Raises
        ------
        ShapeError
            If the rows are not those of earlier blocks.
        InputError
            If a value is not finite.
        """
        check_shape("block", block, (None if self._basis is None else len(self._basis), None))
        if not np.isfinite(block).all():
            raise InputError("block: expected finite values, received NaN or inf")
        columns = block.astype(self.dtype, copy=False)
        for start in range(0, columns.shape[1], max(SMALL_BLOCK, self.rank)):
            part = columns[:, start : start + max(SMALL_BLOCK, self.rank)]
            self._fold(part)
            self.n_columns += part.shape[1]
        return self

    def _fold(self, columns: Array) -> None:
        """Append columns to U S and truncate."""
        if self._basis is None:
            self._basis = np.zeros((len(columns), 0), dtype=self.dtype)
        norms = column_norms(columns)
        self._largest_norm = max(self._largest_norm, float(norms.max()))
        if self._largest_norm == 0.0:
            return
        # In units of the largest norm squares stay in range, whatever the caller's unit.
        unit = float(2.0 ** np.round(np.log2(self._largest_norm)))
        columns = columns / np.asarray(unit, dtype=self.dtype)
        floor = THRESHOLD[self.dtype] * self._largest_norm / unit
        extra = orthonormal_range(outside(self._basis, columns), self._basis, floor)
        inside = self._basis.T @ columns
        self._rotate(inside, extra, extra.T @ columns, unit)

    def _rotate(self, inside: Array, extra: Array, beyond: Array, unit: float) -> None:
        """SVD of [[S, M], [0, R']] and the new basis, orthonormal to rounding."""
        old = len(self._values)
        small = np.zeros((old + extra.shape[1], old + inside.shape[1]))
        small[:old, :old] = np.diag(self._values / unit)
        small[:old, old:] = inside
        small[old:, old:] = beyond
        u, values, _ = np.linalg.svd(small, full_matrices=False)
        kept = min(self.rank, len(values), int(np.count_nonzero(values > 0)))
        rotated = np.hstack([self._basis, extra]) @ u[:, :kept].astype(self.dtype)  # type: ignore[list-item]
        q, r = np.linalg.qr(rotated)
        # QR may flip signs; R is diag(+-1) to rounding.
        self._basis = q * np.sign(np.diag(r))
        self._values = values[:kept] * unit


def column_norms(columns: Array) -> Array:
    """Euclidean norms without overflow, (k,) float64."""
    return np.linalg.norm(columns.astype(np.float64), axis=0)


def outside(basis: Array, columns: Array) -> Array:
    """Components of the columns orthogonal to the basis; projected twice."""
    rest = columns - basis @ (basis.T @ columns)
    return rest - basis @ (basis.T @ rest)


def orthonormal_range(rest: Array, basis: Array, floor: float) -> Array:
    """Orthonormal basis of the residual directions longer than `floor`, (n_rows, k)."""
    q, r = np.linalg.qr(rest)
    vectors, values, _ = np.linalg.svd(r.astype(np.float64))
    most_new = len(basis) - basis.shape[1]
    n_kept = min(int(np.count_nonzero(values > floor)), most_new)
    directions = q @ vectors[:, :n_kept].astype(rest.dtype)
    for _ in range(2):
        directions = directions - basis @ (basis.T @ directions)
        directions = np.linalg.qr(directions)[0]
    return directions
