"""Few bits per number: scaled integers, scaled halves, 48-bit rotations.

Arrays are scaled so that the largest magnitude of each group becomes the
largest code. Rotations are stored as the three smaller components of their
quaternion, 15 bits each, and two bits that say which one is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from reflfield.checks import check_shape
from reflfield.errors import InputError
from reflfield.sphere.rotations import matrix_from_quaternion, quaternion_from_matrix

CodeKind = Literal["int8", "int16", "float16"]

# Value of the code that the largest magnitude of a group is given.
LARGEST_CODE = {"int8": 127.0, "int16": 32767.0, "float16": 1.0}

# The three smaller components of a unit quaternion lie in +-1/sqrt(2); they are
# spread over the codes 0 .. 32766, so that 0 has a code of its own.
HALF_RANGE_CODE = 16383
SMALLEST_THREE_BOUND = float(np.sqrt(0.5))


@dataclass(frozen=True, eq=False)
class QuantisedArray:
    """Numbers as codes times a scale of their group.

    Parameters
    ----------
    codes : (*group, ...) int8, int16 or float16
        One code a number.
    scale : (*group) float32
        One scale for each index of the leading axes.

    Examples
    --------
    >>> quantised = quantise(np.array([[0.5, -1.0], [100.0, 50.0]]), "int8", n_group_axes=1)
    >>> quantised.codes
    array([[  64, -127],
           [ 127,   64]], dtype=int8)
    >>> quantised.decode().round(2)
    array([[  0.5 ,  -1.  ],
           [100.  ,  50.39]], dtype=float32)
    """

    codes: NDArray[np.generic]
    scale: NDArray[np.float32]

    def decode(self) -> NDArray[np.float32]:
        """Return the numbers, float32, in the shape of `codes`."""
        trailing = (1,) * (self.codes.ndim - self.scale.ndim)
        decoded = self.codes.astype(np.float32)
        decoded *= self.scale.reshape(self.scale.shape + trailing)
        return decoded


def check_kind(name: str, kind: str) -> None:
    """Demand one of the known code kinds.

    Raises
    ------
    InputError
        If `kind` is another word.
    """
    if kind not in LARGEST_CODE:
        raise InputError(f"{name}: expected one of {sorted(LARGEST_CODE)}, received {kind!r}")


def encode(
    values: NDArray[np.floating], scale: NDArray[np.floating], kind: CodeKind
) -> NDArray[np.generic]:
    """Codes of `values` for a scale that broadcasts against them."""
    ratio = np.divide(values, scale, out=np.zeros(values.shape), where=scale > 0)
    if kind == "float16":
        return ratio.astype(np.float16)
    limit = LARGEST_CODE[kind]
    # The scale was rounded to float32; the largest ratio may pass the limit by that much.
    return np.clip(np.rint(ratio), -limit, limit).astype(kind)


def scale_of(largest: NDArray[np.floating], kind: CodeKind) -> NDArray[np.float32]:
    """Scale at which the given largest magnitudes get the largest code."""
    return (largest / LARGEST_CODE[kind]).astype(np.float32)


def quantise(
    values: NDArray[np.floating], kind: CodeKind, *, n_group_axes: int
) -> QuantisedArray:
    """Quantise with one scale for each index of the leading axes.

    The error is at most half a step, ``max |group| / 254`` for int8 and
    ``/ 65534`` for int16; relative 2**-11 for float16.

    Parameters
    ----------
    values : (...) float
        Finite numbers.
    kind : {"int8", "int16", "float16"}
        Type of a code.
    n_group_axes : int
        Leading axes whose indices have scales of their own.

    Returns
    -------
    QuantisedArray

    Raises
    ------
    InputError
        If a value is not finite, or `kind` is unknown.
    """
    check_kind("kind", kind)
    array = np.asarray(values, dtype=np.float64)
    check_finite("values", array)
    inner = tuple(range(n_group_axes, array.ndim))
    largest = np.abs(array).max(axis=inner, initial=0.0)
    scale = scale_of(largest, kind)
    spread = scale.astype(np.float64).reshape(scale.shape + (1,) * len(inner))
    return QuantisedArray(encode(array, spread, kind), scale)


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


def codes_from_rotations(rotations: NDArray[np.floating]) -> NDArray[np.uint16]:
    r"""48-bit codes of rotation matrices.

    The largest of the four quaternion components is made positive and left
    out. A half step of the others is 2.2e-5, and the largest is at least 1/2,
    so the decoded rotation is off by less than
    :math:`2\sqrt{12}\cdot 2.2\cdot 10^{-5}` rad = 0.0086 degrees.

    Parameters
    ----------
    rotations : (n, 3, 3) float
        Proper rotations.

    Returns
    -------
    (n, 3) uint16
        15 bits of a component each; the top bits of the first two hold the
        index (w, x, y, z) of the component left out.

    Raises
    ------
    ShapeError
        If the shape is not (n, 3, 3).
    InputError
        If a matrix is not a rotation.
    """
    check_shape("rotations", rotations, (None, 3, 3))
    matrices = np.asarray(rotations, dtype=np.float64)
    check_rotations(matrices)
    if not len(matrices):
        return np.zeros((0, 3), np.uint16)
    quaternion = quaternion_from_matrix(matrices)
    largest = np.argmax(np.abs(quaternion), axis=1)
    sign = np.where(np.take_along_axis(quaternion, largest[:, None], 1) < 0, -1.0, 1.0)
    kept = np.take_along_axis(quaternion * sign, _OTHERS[largest], 1)
    steps = np.rint(kept / SMALLEST_THREE_BOUND * HALF_RANGE_CODE).astype(np.int64)
    codes = (steps + HALF_RANGE_CODE).astype(np.uint16)
    codes[:, 0] |= ((largest >> 1) << 15).astype(np.uint16)
    codes[:, 1] |= ((largest & 1) << 15).astype(np.uint16)
    return codes


def rotations_from_codes(codes: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Rotation matrices of 48-bit codes; inverse of `codes_from_rotations`.

    Parameters
    ----------
    codes : (n, 3) uint16
        Any bits give a rotation.

    Returns
    -------
    (n, 3, 3) float32

    Raises
    ------
    ShapeError
        If the shape is not (n, 3).

    Examples
    --------
    >>> rotations_from_codes(codes_from_rotations(np.eye(3)[None]))[0]
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]], dtype=float32)
    """
    check_shape("codes", codes, (None, 3))
    if not len(codes):
        return np.zeros((0, 3, 3), np.float32)
    largest = (codes[:, 0] >> 15) * 2 + (codes[:, 1] >> 15)
    steps = (codes & 0x7FFF).astype(np.float64) - HALF_RANGE_CODE
    kept = steps * (SMALLEST_THREE_BOUND / HALF_RANGE_CODE)
    left_out = np.sqrt(np.maximum(1.0 - np.sum(kept**2, axis=1), 0.0))
    quaternion = np.zeros((len(codes), 4))
    np.put_along_axis(quaternion, _OTHERS[largest], kept, 1)
    np.put_along_axis(quaternion, largest[:, None].astype(np.int64), left_out[:, None], 1)
    return matrix_from_quaternion(quaternion).astype(np.float32)


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


# The other three components, in order, for each one left out.
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
