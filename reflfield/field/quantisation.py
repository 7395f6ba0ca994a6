"""Integer codes of numbers: coefficients, points on a lattice, rotations.

Each rotation is coded as the rotation vector that leads to it from the one before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import DTypeLike, NDArray

from reflfield.errors import InputError
from reflfield.sphere.rotations import matrix_from_quaternion, quaternion_from_matrix
from reflfield.util.validation import check_shape

# Half a revolution in steps of this fits the codes of a rotation.
SMALLEST_TURN = 1e-4
# A function whose component orthogonal to the others is below this share of the strongest is
# linearly dependent on them.
RANK_TOLERANCE = 1e-5


def check_finite(name: str, values: NDArray[np.floating]) -> None:
    """Demand finite numbers.

    Raises
    ------
    InputError
        If one is NaN or infinite.
    """
    bad = int(np.size(values) - np.count_nonzero(np.isfinite(values)))
    if bad:
        raise InputError(f"{name}: expected finite numbers, received {bad} that are not")


@numba.njit(cache=True)
def _rotation_vector(
    a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Rotation vector of the unit quaternion a times the inverse of b, at most half a turn."""
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = -a[0] * b[1] + a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    y = -a[0] * b[2] + a[1] * b[3] + a[2] * b[0] - a[3] * b[1]
    z = -a[0] * b[3] - a[1] * b[2] + a[2] * b[1] + a[3] * b[0]
    sign = -1.0 if w < 0.0 else 1.0
    length = np.sqrt(x * x + y * y + z * z)
    share = sign * 2.0
    if length > 1e-12:
        share = sign * 2.0 * np.arctan2(length, abs(w)) / length
    out[0], out[1], out[2] = share * x, share * y, share * z


@numba.njit(cache=True)
def _turn_by(q: NDArray[np.float64], vector: NDArray[np.float64]) -> None:
    """Replace q by the quaternion of a rotation vector times q, of unit length."""
    angle = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    share = np.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    w, x, y, z = np.cos(0.5 * angle), share * vector[0], share * vector[1], share * vector[2]
    a, b, c, d = q[0], q[1], q[2], q[3]
    q[0] = w * a - x * b - y * c - z * d
    q[1] = w * b + x * a + y * d - z * c
    q[2] = w * c - x * d + y * a + z * b
    q[3] = w * d + x * c - y * b + z * a
    norm = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] /= norm


@numba.njit(cache=True)
def _encode_turns(
    quaternions: NDArray[np.float64], step: float, codes: NDArray[np.int16]
) -> None:
    at, vector = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    for t in range(len(quaternions)):
        _rotation_vector(quaternions[t], at, vector)
        for i in range(3):
            codes[t, i] = np.int16(np.rint(vector[i] / step))
            vector[i] = codes[t, i] * step
        _turn_by(at, vector)


@numba.njit(cache=True)
def _decode_turns(
    codes: NDArray[np.int16], step: float, quaternions: NDArray[np.float64]
) -> None:
    at, vector = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    for t in range(len(codes)):
        for i in range(3):
            vector[i] = codes[t, i] * step
        _turn_by(at, vector)
        for i in range(4):
            quaternions[t, i] = at[i]


def codes_from_rotations(rotations: NDArray[np.floating], step: float) -> NDArray[np.int16]:
    r"""Turns from each rotation to the next, as integer rotation vectors.

    Neighbours are alike, so that most codes are small. Each turn starts from the rotation that
    will be decoded, not from the given one: errors do not add up, and stay below
    :math:`\sqrt{3}/2` steps.

    Parameters
    ----------
    rotations : (n, 3, 3) float
        Proper rotations.
    step : float
        Of each entry of a rotation vector, radians; at least 1e-4.

    Returns
    -------
    (n, 3) int16

    Raises
    ------
    ShapeError
        If the shape is not (n, 3, 3).
    InputError
        If a matrix is not a rotation, or the step too small for the codes.
    """
    check_shape("rotations", rotations, (None, 3, 3))
    matrices = np.asarray(rotations, dtype=np.float64)
    check_rotations(matrices)
    if not SMALLEST_TURN <= step <= 1.0:
        raise InputError(
            f"step: expected {SMALLEST_TURN} to 1 radian for a turn's codes, received {step}"
        )
    codes = np.zeros((len(matrices), 3), np.int16)
    if len(matrices):
        _encode_turns(quaternion_from_matrix(matrices), float(np.float32(step)), codes)
    return codes


def rotations_from_codes(codes: NDArray[np.int16], step: float) -> NDArray[np.float32]:
    """Rotation matrices of codes; inverse of `codes_from_rotations`.

    Parameters
    ----------
    codes : (n, 3) int16
        Any numbers give rotations.
    step : float
        Radians.

    Returns
    -------
    (n, 3, 3) float32

    Raises
    ------
    ShapeError
        If the shape is not (n, 3).

    Examples
    --------
    >>> rotations_from_codes(codes_from_rotations(np.eye(3)[None], 0.01), 0.01)[0]
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]], dtype=float32)
    """
    check_shape("codes", codes, (None, 3))
    quaternions = np.zeros((len(codes), 4))
    if not len(codes):
        return np.zeros((0, 3, 3), np.float32)
    # A copy: kernels are compiled again for arrays that cannot be written.
    _decode_turns(codes.astype(np.int16, order="C"), float(np.float32(step)), quaternions)
    return matrix_from_quaternion(quaternions).astype(np.float32)


def lattice_points(
    values: NDArray[np.floating], n_steps: int, dtype: DTypeLike = np.float32
) -> QuantisedBox:
    """Points as integers of a lattice over their bounding box, one step for all axes.

    Parameters
    ----------
    values : (n, d) float
        Finite.
    n_steps : int
        Along the longest side of the box, at most 65535.
    dtype : float32 or float64
        Of the box, and of the points as they are read; float64 where the box may be far from
        the origin.

    Returns
    -------
    QuantisedBox

    Raises
    ------
    InputError
        If a value is not finite.

    Examples
    --------
    >>> box = lattice_points(np.array([[0.0, 5.0], [2.0, 5.5]]), 200)
    >>> box.codes.tolist(), box.decode().tolist()
    ([[0, 0], [200, 50]], [[0.0, 5.0], [2.0, 5.5]])
    """
    array = np.asarray(values, dtype=np.float64)
    check_finite("values", array)
    low = array.min(axis=0, initial=np.inf) if len(array) else np.zeros(array.shape[1])
    size = float((array - low).max(initial=0.0))
    step = np.float32(size / n_steps) if size > 0 else np.float32(1.0)
    low = low.astype(dtype)
    ratio = np.rint((array - low.astype(np.float64)) / np.float64(step))
    codes = np.clip(ratio, 0, np.iinfo(np.uint16).max).astype(np.uint16)
    return QuantisedBox(codes, np.concatenate([low, [step]]).astype(dtype))


@dataclass(frozen=True, eq=False)
class QuantisedBox:
    """Points as integers of a lattice.

    Parameters
    ----------
    codes : (n, d) uint16
    box : (d + 1,) float32 or float64
        Lowest corner, then the step.
    """

    codes: NDArray[np.uint16]
    box: NDArray[np.floating]

    def decode(self) -> NDArray[np.floating]:
        """Return the points, (n, d), in the precision of the box."""
        wide = self.codes.astype(np.float64) * np.float64(self.box[-1])
        return (wide + self.box[:-1]).astype(self.box.dtype)


def check_rotations(matrices: NDArray[np.float64]) -> None:
    """Demand orthonormal, right-handed matrices.

    Raises
    ------
    InputError
        If one is not a rotation to 1e-3: frames pass through float32 and
        products of a few rotations, so anything farther off is no rounding.
    """
    gram = np.einsum("nij,nkj->nik", matrices, matrices)
    off = ~(np.abs(gram - np.eye(3)).max(axis=(1, 2)) < 1e-3)
    across = np.cross(matrices[:, 0], matrices[:, 1])
    off |= ~(np.einsum("nj,nj->n", across, matrices[:, 2]) > 0)
    if off.any():
        row = int(np.flatnonzero(off)[0])
        raise InputError(
            f"frames: expected right-handed orthonormal matrices, received "
            f"{matrices[row].tolist()} in row {row}"
        )


# --- coefficients ------------------------------------------------------------------------


def smallest_codes(array: NDArray[Any]) -> NDArray[Any]:
    """Integers in the smallest signed type that holds them; other arrays unchanged.

    Raises
    ------
    InputError
        If one needs more than 32 bits.

    Examples
    --------
    >>> smallest_codes(np.array([1, -200])).dtype
    dtype('int16')
    """
    if array.dtype.kind != "i":
        return array
    largest = int(np.abs(array.astype(np.int64)).max(initial=0))
    kinds = [kind for kind in (np.int8, np.int16, np.int32) if largest <= np.iinfo(kind).max]
    if not kinds:
        raise InputError(
            f"quantisation: expected steps whose codes fit 32 bits, received some of "
            f"{largest}; "
            "make them coarser (compression.relative_step)"
        )
    return np.ascontiguousarray(array, dtype=kinds[0])


def lattice_codes(
    moments: NDArray[np.floating], gram: NDArray[np.float64], step: float
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    r"""Integer coefficients whose sum of functions comes close to given functions.

    Babai's nearest plane: with the Gram matrix :math:`B B^\top = R^\top R`, coefficients are
    rounded from the last to the first, each after the rounding errors of those before it were
    subtracted [1]_.

    Parameters
    ----------
    moments : (n, K) float
        Products of the given functions with the K functions B, mean over the nodes.
    gram : (K, K) float64
        Products of the functions with each other, mean over the nodes.
    step : float
        In root mean square over the nodes.

    Returns
    -------
    codes : (n, K) int32
    scale : (K,) float32
        Coefficients are codes times this; zero for a function that is linearly dependent.

    References
    ----------
    .. [1] L. Babai, "On Lovász' lattice reduction and the nearest lattice point problem",
       Combinatorica 6, 1986.

    Examples
    --------
    >>> functions, wanted = np.array([[1.0, 0.0], [0.6, 0.8]]), np.array([[0.25, -0.5]])
    >>> codes, scale = lattice_codes(wanted @ functions.T, functions @ functions.T, 0.1)
    >>> codes.tolist(), ((codes * scale) @ functions).round(2).tolist()
    ([[6, -5]], [[0.23, -0.5]])
    """
    n, k = moments.shape
    codes, scale = np.zeros((n, k), np.int32), np.zeros(k, np.float32)
    largest = float(np.diagonal(gram).max(initial=0.0))
    if not largest > 0:
        return codes, scale
    root = np.linalg.cholesky(gram + 1e-12 * largest * np.eye(k)).T
    aims = np.linalg.solve(root.T, moments.T.astype(np.float64)).T
    independent = np.diagonal(root) > RANK_TOLERANCE * np.sqrt(largest)
    scale[independent] = step / np.diagonal(root)[independent]
    decoded = np.zeros((n, k))
    for i in reversed(np.flatnonzero(independent)):
        rest = (aims[:, i] - decoded @ root[i]) / root[i, i]
        codes[:, i] = np.rint(rest / np.float64(scale[i]))
        decoded[:, i] = codes[:, i] * np.float64(scale[i])
    return codes, scale
