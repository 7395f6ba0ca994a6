r"""Coupled harmonics: functions of two directions that one rotation rotates.

Products :math:`y_{\ell_1 m_1}(\omega_v)\, y_{\ell_2 m_2}(\omega_l)` of real harmonics are
recombined by Clebsch-Gordan coefficients into functions of total degree `j`, one
channel per pair (l1, l2) with ``|l1 - l2| <= j <= l1 + l2``. Under a common
rotation of both directions every channel is rotated by the same :math:`\Delta^j(R)`,
so the correlation of two such functions over all common rotations is one
SO(3) series,

.. math::

    C(R) = \sum_j \langle M^j, \Delta^j(R) \rangle, \qquad M^j = A_j^\top B_j ,

where :math:`A_j` is (channels, 2j+1). All is real: channels with odd
``l1 + l2 - j`` are multiplied by i, which makes the whole recombination one
real orthogonal matrix, block diagonal over the pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from reflfield.sphere.harmonics import check_band_limit
from reflfield.sphere.sparse_recombination import Recombination, recombination
from reflfield.util.validation import check_shape

BandLimits = tuple[int, int]
# Coefficients of degrees up to 15 are zero, but for 1e-14 of rounding, or above 1e-9.
SMALLEST_COEFFICIENT = 1e-12


@lru_cache(maxsize=1024)
def clebsch_gordan(l1: int, l2: int) -> NDArray[np.float64]:
    r"""Coefficients <l1 m1 l2 m2 | j m> of one pair of degrees, all j.

    Parameters
    ----------
    l1, l2 : int
        Non-negative degrees.

    Returns
    -------
    ((2 l1 + 1)(2 l2 + 1), 2 l1 + 1, 2 l2 + 1) float64
        First axis: (j, m) with j from ``|l1 - l2|`` up and m from -j to j; then m1, m2.
        An orthogonal matrix when the last two axes are flattened. Read-only.

    Notes
    -----
    For each m the vectors are eigenvectors of the total angular momentum,
    a symmetric tridiagonal matrix with the well separated eigenvalues j (j + 1):
    about 1e-13 at l = 15, where alternating (Racah) sums lose digits. Signs
    follow Condon and Shortley: <l1 l1 l2 j-l1 | j j> > 0, and lowering keeps the sign.

    Examples
    --------
    The singlet of two vectors, <1 m 1 -m | 0 0> = (-1)^(1-m) / sqrt 3:

    >>> (clebsch_gordan(1, 1)[0] * 3 ** 0.5).round(12) + 0.0
    array([[ 0.,  0.,  1.],
           [ 0., -1.,  0.],
           [ 1.,  0.,  0.]])
    """
    lowest, highest = abs(l1 - l2), l1 + l2
    table = np.zeros(((2 * l1 + 1) * (2 * l2 + 1), 2 * l1 + 1, 2 * l2 + 1))
    above: dict[int, NDArray[np.float64]] = {}
    for m in range(highest, -1, -1):
        m1 = np.arange(max(-l1, m - l2), min(l1, m + l2) + 1)
        vectors = np.linalg.eigh(_total_momentum(l1, l2, m, m1))[1]
        for column, j in enumerate(range(max(lowest, m), highest + 1)):
            full = np.zeros(2 * l1 + 1)
            full[m1 + l1] = vectors[:, column]
            full *= _sign(full, above.get(j), l1, l2, m)
            above[j] = full
            first = j * j - lowest**2 + j
            table[first + m, m1 + l1, m - m1 + l2] = full[m1 + l1]
            parity = -1.0 if (highest - j) % 2 else 1.0
            table[first - m, l1 - m1, l2 - m + m1] = parity * full[m1 + l1]
    table.flags.writeable = False
    return table


def _total_momentum(l1: int, l2: int, m: int, m1: NDArray[np.int64]) -> NDArray[np.float64]:
    """Matrix of the squared total angular momentum over m1, at fixed m."""
    m2 = m - m1
    diagonal = l1 * (l1 + 1) + l2 * (l2 + 1) + 2.0 * m1 * m2
    a, b = m1[:-1].astype(np.float64), m2[:-1].astype(np.float64)
    off = np.sqrt((l1 - a) * (l1 + a + 1) * (l2 + b) * (l2 - b + 1))
    return np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1)


def _sign(
    vector: NDArray[np.float64], above: NDArray[np.float64] | None, l1: int, l2: int, m: int
) -> float:
    """Sign that makes the vector agree with the one of order m + 1 after lowering."""
    if above is None:
        return 1.0 if vector[-1] > 0 or m < 0 else (-1.0 if vector[-1] < 0 else 1.0)
    m1 = np.arange(-l1, l1 + 1, dtype=np.float64)
    m2 = m + 1 - m1
    lowered = above * np.sqrt(np.maximum((l2 + m2) * (l2 - m2 + 1), 0.0))
    lowered[:-1] += (above * np.sqrt((l1 + m1) * (l1 - m1 + 1)))[1:]
    return 1.0 if lowered @ vector >= 0 else -1.0


def _real_from_complex(ell: int) -> NDArray[np.complex128]:
    """Unitary matrix U with y = U Y: real harmonics from complex ones."""
    u = np.zeros((2 * ell + 1, 2 * ell + 1), np.complex128)
    u[ell, ell] = 1.0
    for m in range(1, ell + 1):
        sign = -1.0 if m % 2 else 1.0
        u[ell + m, [ell + m, ell - m]] = np.array([sign, 1.0]) / np.sqrt(2.0)
        u[ell - m, [ell + m, ell - m]] = np.array([sign, -1.0]) / (1j * np.sqrt(2.0))
    return u


@lru_cache(maxsize=1024)
def real_coupling(l1: int, l2: int) -> NDArray[np.float64]:
    """Orthogonal matrix from products of real harmonics to coupled real functions.

    Parameters
    ----------
    l1, l2 : int
        Degrees of view and light.

    Returns
    -------
    ((2 l1 + 1)(2 l2 + 1), (2 l1 + 1)(2 l2 + 1)) float64
        Rows (j, m), columns (m1, m2). Read-only.

    Examples
    --------
    Degree 0 of two vectors is their scalar product, up to sign and scale:

    >>> (real_coupling(1, 1)[0].reshape(3, 3) * 3 ** 0.5).round(12) + 0.0
    array([[-1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0., -1.]])
    """
    u1, u2 = _real_from_complex(l1).conj(), _real_from_complex(l2).conj()
    table = clebsch_gordan(l1, l2)
    products = np.einsum("am,kmn,bn->kab", u1, table, u2, optimize=True)
    out = np.zeros((len(table), len(table)))
    for j in range(abs(l1 - l2), l1 + l2 + 1):
        part = slice(j * j - (l1 - l2) ** 2, (j + 1) ** 2 - (l1 - l2) ** 2)
        block = np.einsum("ij,jab->iab", _real_from_complex(j), products[part])
        phase = 1j if (l1 + l2 - j) % 2 else 1.0
        out[part] = (phase * block).real.reshape(2 * j + 1, -1)
    out.flags.writeable = False
    return out


# Reordering of sums only.
@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _add_squares(rows: NDArray[np.floating], out: NDArray[np.float64]) -> None:
    """Add the sum of squares of each row, in double precision."""
    for i in range(rows.shape[0]):
        total = 0.0
        for k in range(rows.shape[1]):
            total += np.float64(rows[i, k]) * np.float64(rows[i, k])
        out[i] += total


@dataclass(frozen=True, eq=False)
class Coupled:
    """Coupled coefficients of many functions of two directions.

    Parameters
    ----------
    band_limits : (int, int)
        Of view and light, exclusive.
    blocks : tuple of (n, 2j + 1, n_channels(j)) float arrays
        One per total degree j = 0 .. L_view + L_light - 2.

    Examples
    --------
    >>> one = couple(np.ones((3, 16, 16), np.float32))
    >>> len(one), one.n_degrees, one[:2].blocks[1].shape
    (3, 7, (2, 3, 9))
    """

    band_limits: BandLimits
    blocks: tuple[NDArray[np.floating], ...]

    def __len__(self) -> int:
        return len(self.blocks[0])

    def __getitem__(self, rows: slice | NDArray[np.integer] | NDArray[np.bool_]) -> Coupled:
        return Coupled(self.band_limits, tuple(block[rows] for block in self.blocks))

    @property
    def n_degrees(self) -> int:
        """Total degrees 0 .. n_degrees - 1."""
        return len(self.blocks)

    @property
    def dtype(self) -> np.dtype[np.floating]:
        """Type of the coefficients."""
        return self.blocks[0].dtype

    def norms(self) -> NDArray[np.float64]:
        """(n,) root of the sum of squares, the function's L2 norm."""
        total = np.zeros(len(self))
        for block in self.blocks:
            _add_squares(block.reshape(len(self), -1), total)
        return np.sqrt(total)

    def units(self) -> Coupled:
        """Each function over its norm; zero functions stay zero."""
        norms = self.norms()
        return self.scaled(np.where(norms > 0, 1.0 / np.where(norms > 0, norms, 1.0), 0.0))

    def scaled(self, factors: NDArray[np.floating]) -> Coupled:
        """Each function times its factor, (n,)."""
        factors = np.asarray(factors).astype(self.dtype)[:, None, None]
        return Coupled(self.band_limits, tuple(block * factors for block in self.blocks))


def join_coupled(parts: list[Coupled]) -> Coupled:
    """Functions of all parts in one, in their order.

    Examples
    --------
    >>> one = couple(np.ones((3, 16, 16), np.float32))
    >>> len(join_coupled([one, one]))
    6
    """
    blocks = zip(*(part.blocks for part in parts), strict=True)
    return Coupled(parts[0].band_limits, tuple(np.concatenate(block) for block in blocks))


def channels(band_limits: BandLimits) -> list[list[tuple[int, int]]]:
    """Pairs (l1, l2) that make up the channels of each total degree.

    Examples
    --------
    >>> [len(pairs) for pairs in channels((4, 4))]
    [4, 9, 11, 10, 6, 3, 1]
    """
    return [
        [
            (l1, l2)
            for l1 in range(band_limits[0])
            for l2 in range(band_limits[1])
            if abs(l1 - l2) <= j <= l1 + l2
        ]
        for j in range(sum(band_limits) - 1)
    ]


def couple(coefficients: NDArray[np.floating]) -> Coupled:
    r"""Recombine products of harmonics into coupled harmonics; orthogonal, so norms stay.

    Parameters
    ----------
    coefficients : (n, L_view**2, L_light**2) float32 or float64
        Real coefficients of the two directions.

    Returns
    -------
    Coupled
        In the dtype of the input.

    Raises
    ------
    ShapeError
        If an axis is not the square of a band limit.
    InputError
        If a band limit is outside 1 .. 16.

    Notes
    -----
    Of the :math:`(\sum (2\ell+1)^2)^2` entries of the matrices of all pairs (l1, l2) a tenth
    (L = 8) or a twentieth (L = 16) are not zero: orders m1, m2 give :math:`|m_1 \pm m_2|` only.

    Examples
    --------
    >>> a = np.zeros((1, 4, 4)); a[0, 2, 2] = 1.0
    >>> [float(np.abs(b).max().round(3)) for b in couple(a).blocks]
    [0.577, 0.0, 0.816]
    """
    check_shape("coefficients", coefficients, (None, None, None))
    limits = (round(coefficients.shape[1] ** 0.5), round(coefficients.shape[2] ** 0.5))
    check_band_limit("L_view", limits[0])
    check_band_limit("L_light", limits[1])
    check_shape("coefficients", coefficients, (None, limits[0] ** 2, limits[1] ** 2))
    n = len(coefficients)
    parts = _recombinations(limits, str(coefficients.dtype))[0](coefficients.reshape(n, -1))
    blocks = (part.reshape(n, 2 * j + 1, -1) for j, part in enumerate(parts))
    return Coupled(limits, tuple(blocks))


@lru_cache(maxsize=32)
def _recombinations(limits: BandLimits, dtype: str) -> tuple[Recombination, Recombination]:
    """From products, as the samples give them, to degrees j of (m, channel); and back."""
    k = limits[0] ** 2 * limits[1] ** 2
    triples = [_entries_of_pair(limits, pair) for pair in np.ndindex(limits)]
    rows, columns, values = (np.concatenate(one) for one in zip(*triples, strict=True))
    matrix = csr_array((values, (rows, columns)), shape=(k, k))
    sizes = [(2 * j + 1) * len(pairs) for j, pairs in enumerate(channels(limits))]
    back = recombination(matrix.T.tocsr(), [k], dtype)
    return recombination(matrix, sizes, dtype), back


def _entries_of_pair(
    limits: BandLimits, pair: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Rows, columns and values of the coupling of one pair of degrees."""
    (l1, l2), matrix = pair, real_coupling(*pair)
    one, two = np.arange(l1 * l1, (l1 + 1) ** 2), np.arange(l2 * l2, (l2 + 1) ** 2)
    columns = (one[:, None] * limits[1] ** 2 + two).ravel()
    rows, first = [], 0
    for j, pairs in enumerate(channels(limits)):
        if pair in pairs:
            rows.append(first + np.arange(2 * j + 1) * len(pairs) + pairs.index(pair))
        first += (2 * j + 1) * len(pairs)
    r, c = np.nonzero(np.abs(matrix) > SMALLEST_COEFFICIENT)
    return np.concatenate(rows)[r], columns[c], matrix[r, c]


def uncouple(coupled: Coupled) -> NDArray[np.floating]:
    """Inverse of `couple`.

    Returns
    -------
    (n, L_view**2, L_light**2) float

    Examples
    --------
    >>> a = np.arange(16.0).reshape(1, 4, 4)
    >>> bool(np.allclose(uncouple(couple(a)), a))
    True
    """
    limits, n = coupled.band_limits, len(coupled)
    by_degree = np.concatenate([block.reshape(n, -1) for block in coupled.blocks], axis=1)
    back = _recombinations(limits, str(coupled.dtype))[1]
    return back(by_degree)[0].reshape(n, limits[0] ** 2, limits[1] ** 2)


def rotate_coupled(coupled: Coupled, blocks: NDArray[np.floating]) -> Coupled:
    r"""Coefficients of functions rotated by :math:`R`, from `rotation_blocks` of R.

    Parameters
    ----------
    coupled : Coupled
        n functions, or one that all rotations apply to.
    blocks : (n, ...) or (1, ...) float
        `reflfield.sphere.wigner.rotation_blocks` with ``degree_limit = coupled.n_degrees``.

    Returns
    -------
    Coupled
    """
    rotated, offset = [], 0
    for j, block in enumerate(coupled.blocks):
        size = 2 * j + 1
        delta = blocks[:, offset : offset + size * size].astype(block.dtype)
        if len(block) == 1:
            product = delta.reshape(-1, size) @ block[0]
            rotated.append(product.reshape(len(delta), size, -1))
        else:
            rotated.append(np.matmul(delta.reshape(-1, size, size), block))
        offset += size * size
    return Coupled(coupled.band_limits, tuple(rotated))
