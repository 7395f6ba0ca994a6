"""The paper's forms of the correlation over a whole grid of rotations, computed well.

G. Müller, R. Sarlette, R. Klein, "Data-driven local coordinate systems for image-based
rendering", Eurographics 2006: equations 3, 5, 8, 10 and 11. The same sums one rotation at a
time, as plainly as they are written there, are what the tests check these by.

Coefficients are real and orthonormal, index ``ell * ell + ell + m``.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from reflfield.alignment.correlation import spectrum
from reflfield.sphere.coupling import Coupled
from reflfield.sphere.hemisphere import first_tap, square_from_xyz
from reflfield.sphere.wigner import block_offsets, degree_tables, fill_wigner_d, rotation_blocks

Array = NDArray[np.float64]
Reals = NDArray[np.floating]
Complexes = NDArray[np.complexfloating]

# Rotations of the exact series worked on at once: their Wigner matrices take 0.3 GB at L = 16.
SERIES_AT_ONCE = 2048
# Rotations and ABRDFs worked on at once: both factors of the product stay in the cache.
ROTATIONS_AT_ONCE = 256
ABRDFS_AT_ONCE = 32


def grid_angles(band_limit: int) -> tuple[Array, Array]:
    """Alpha (gamma alike) and beta of the (2L)^3 rotations of the paper's grid."""
    count = 2 * band_limit
    return np.pi * np.arange(count) / band_limit, np.pi * (np.arange(count) + 0.5) / count


def rotations_zyz(alpha: Array, beta: Array, gamma: Array) -> Array:
    """(n, 3, 3) rotations Rz(alpha) @ Ry(beta) @ Rz(gamma) of arrays of angles."""
    angles = np.stack([alpha.ravel(), beta.ravel(), gamma.ravel()], axis=1)
    rotations: Array = Rotation.from_euler("ZYZ", angles).as_matrix()
    return rotations


def paper_grid(band_limit: int) -> Array:
    """(8 L^3, 3, 3) rotations of the paper's grid: beta slowest, then gamma, then alpha."""
    alpha, beta = grid_angles(band_limit)
    b, c, a = np.meshgrid(beta, alpha, alpha, indexing="ij")
    return rotations_zyz(a, b, c)


def parts(n: int, size: int) -> list[slice]:
    """Slices of 0 .. n."""
    return [slice(first, min(first + size, n)) for first in range(0, n, size)]


def degree(ell: int) -> slice:
    """Coefficients of one degree."""
    return slice(ell * ell, (ell + 1) ** 2)


# --- one function of direction (Table 1) ----------------------------------------------------


def turned(columns: Reals, rotations: Array, dtype: str = "float64") -> Reals:
    """(n_rotations, L^2, k): the functions in the columns (L^2, k), turned by each rotation."""
    band_limit = round(len(columns) ** 0.5)
    blocks = rotation_blocks(rotations, band_limit, dtype)
    offsets = block_offsets(band_limit)
    parts = []
    for ell in range(band_limit):
        size = 2 * ell + 1
        block = blocks[:, offsets[ell] : offsets[ell + 1]].reshape(-1, size, size)
        parts.append(np.matmul(block, columns[degree(ell)].astype(dtype)))
    return np.concatenate(parts, axis=1)


def direct_correlations(a: Reals, b: Reals, rotations: Array) -> Reals:
    """Eq. 8 as it stands: (n_rotations,) sums over degree and orders; Wigner-D made anew."""
    band_limit = round(len(a) ** 0.5)
    pairs = [np.outer(a[degree(ell)], b[degree(ell)]).ravel() for ell in range(band_limit)]
    series = np.concatenate(pairs)
    values = [
        rotation_blocks(rotations[some], band_limit) @ series
        for some in parts(len(rotations), ROTATIONS_AT_ONCE)
    ]
    return np.concatenate(values)


def complex_coefficients(real: Reals) -> Complexes:
    """Orders m >= 0 of complex harmonics from real ones: (..., L, L), [ell, m]."""
    band_limit = round(real.shape[-1] ** 0.5)
    out = np.zeros(
        (*real.shape[:-1], band_limit, band_limit), np.result_type(real, np.complex64)
    )
    for ell in range(band_limit):
        centre, m = ell * ell + ell, np.arange(1, ell + 1)
        out[..., ell, 0] = real[..., centre]
        sign = (np.where(m % 2, -1.0, 1.0) * np.sqrt(0.5)).astype(real.dtype)
        out[..., ell, 1 : ell + 1] = sign * (real[..., centre + m] - 1j * real[..., centre - m])
    return out


def both_signs(half: Complexes) -> Complexes:
    """Orders -(L-1) .. L-1 from those m >= 0 of a real function."""
    m = np.arange(half.shape[-1] - 1, 0, -1)
    sign = np.where(m % 2, -1.0, 1.0).astype(half.real.dtype)
    negative = sign * half[..., m].conj()
    return np.concatenate([negative, half], axis=-1)


def separation_kernel(band_limit: int, dtype: str = "float32") -> Reals:
    """(L, 2L-1, L, 2L): d^ell_mn(beta) of the paper's grid, [m >= 0, n, ell, beta]."""
    _, beta = grid_angles(band_limit)
    kernel = np.zeros((band_limit, 2 * band_limit - 1, band_limit, len(beta)), dtype)
    tables = degree_tables(band_limit, "float64")
    for k, angle in enumerate(beta):
        d = np.zeros(tables.recursion.shape[1])
        turn = (np.cos(angle), np.sin(angle))
        fill_wigner_d(turn, tables.row_start, tables.recursion, tables.edge, d)
        for ell in range(band_limit):
            rows = d[tables.row_start[ell] : tables.row_start[ell + 1]].reshape(ell + 1, -1)
            centre = rows.shape[1] // 2
            n = slice(band_limit - 1 - ell, band_limit + ell)
            kernel[: ell + 1, n, ell, k] = rows[:, centre - ell : centre + ell + 1]
    return kernel


def separated_correlations(a: Reals, b: Reals, kernel: Reals, n_threads: int = 1) -> Reals:
    """Eq. 8 for pairs of functions by separation of variables.

    Sums over degree are one matrix product per pair of orders, sums over orders a fast
    Fourier transform (Kostelec and Rockmore, "FFTs on the rotation group", 2008).

    Parameters
    ----------
    a, b : (n, L^2) float32 or float64
    kernel : (L, 2L-1, L, 2L)
        `separation_kernel`.

    Returns
    -------
    (n, 8 L^3)
        In the order of `paper_grid`.
    """
    band_limit, n = len(kernel), len(a)
    left, right = complex_coefficients(a), both_signs(complex_coefficients(b)).conj()
    products = left.transpose(2, 0, 1)[:, None] * right.transpose(2, 0, 1)[None]
    # Real and imaginary parts of (m, n, pair, ell) as rows: one real matrix product each.
    rows = np.concatenate([products.real, products.imag], axis=2)
    real, imaginary = np.split(np.matmul(rows, kernel), 2, axis=2)
    count = 2 * band_limit
    orders = np.zeros((n, count, count, band_limit + 1), products.dtype)
    signed = np.arange(-band_limit + 1, band_limit)
    orders[:, :, signed, :band_limit] = (real + 1j * imaginary).transpose(2, 3, 1, 0)
    cube = scipy.fft.irfft2(
        orders, (count, count), axes=(2, 3), norm="forward", workers=n_threads
    )
    flat: Reals = cube.reshape(n, -1)
    return flat


@numba.njit(cache=True, nogil=True)
def sampled_correlations(
    samples: Reals, directions: Array, nodes: Reals, side: int, rotations: Array
) -> Array:
    """Eq. 5: sum over directions of a(w) b(R^T w), b bilinear on hemisphere nodes, 0 below."""
    out = np.zeros(len(rotations))
    for i in range(len(rotations)):
        r = rotations[i]
        for k in range(len(directions)):
            d = directions[k]
            z = r[0, 2] * d[0] + r[1, 2] * d[1] + r[2, 2] * d[2]
            if z <= 0.0:
                continue
            x = r[0, 0] * d[0] + r[1, 0] * d[1] + r[2, 0] * d[2]
            y = r[0, 1] * d[0] + r[1, 1] * d[1] + r[2, 1] * d[2]
            u, v = square_from_xyz(x, y, z)
            column, s = first_tap(u, side)
            row, t = first_tap(v, side)
            node = row * side + column
            low = nodes[node] + s * (nodes[node + 1] - nodes[node])
            node += side
            high = nodes[node] + s * (nodes[node + 1] - nodes[node])
            out[i] += samples[k] * (low + t * (high - low))
    return out


# --- ABRDFs (Table 2) -----------------------------------------------------------------------


def factors(coefficients: Reals, rank: int) -> tuple[Reals, Reals]:
    """Rank-K factors (n, K, L^2) of both directions, the root of the singular value in each."""
    u, s, vt = np.linalg.svd(coefficients, full_matrices=False)
    root = np.sqrt(s[:, :rank, None])
    return np.swapaxes(u[:, :, :rank], 1, 2) * root, vt[:, :rank] * root


class TurnedTarget(NamedTuple):
    """Factors of one target, turned by every rotation of a grid: what Eq. 11 needs of it.

    Parameters
    ----------
    view, light : (n_parts, L^2, K * rotations)
        Parts of the grid, each ready for one matrix product.
    """

    view: list[Reals]
    light: list[Reals]


def turn_target(
    target: Reals, rank: int, rotations: Array, dtype: str = "float32"
) -> TurnedTarget:
    """Prepare a target (L_view^2, L_light^2) for `factored_maxima`, once for all ABRDFs."""
    tables = [
        [
            np.ascontiguousarray(turned(side[0].T, rotations[some], dtype).transpose(1, 2, 0))
            for some in parts(len(rotations), ROTATIONS_AT_ONCE)
        ]
        for side in factors(target[None], rank)
    ]
    return TurnedTarget(*tables)


def factored_correlations(view: Reals, light: Reals, target: TurnedTarget, part: int) -> Reals:
    """Eq. 11 for some ABRDFs at one part of the grid: (n, rotations)."""
    sides = []
    for own, table in ((view, target.view[part]), (light, target.light[part])):
        n, rank, size = own.shape
        product = own.reshape(n * rank, size) @ table.reshape(size, -1)
        sides.append(product.reshape(n, rank * rank, -1))
    np.multiply(sides[0], sides[1], out=sides[0])
    total: Reals = sides[0].sum(axis=1)
    return total


def factored_maxima(view: Reals, light: Reals, target: TurnedTarget) -> NDArray[np.int64]:
    """Index of the highest of the grid's rotations by Eq. 11.

    For one target the 2 K^2 correlations of an ABRDF are two matrix products: its factors
    against the target's, turned beforehand by every rotation.

    Parameters
    ----------
    view, light : (n, K, L^2) float32
        `factors` of the ABRDFs.
    target : TurnedTarget
    """
    best = np.full(len(view), -np.inf)
    index = np.zeros(len(view), np.int64)
    for rows in parts(len(view), ABRDFS_AT_ONCE):
        first = 0
        for part in range(len(target.view)):
            values = factored_correlations(view[rows], light[rows], target, part)
            top = values.argmax(axis=1)
            height = np.take_along_axis(values, top[:, None], axis=1)[:, 0]
            better = height > best[rows]
            index[rows] = np.where(better, first + top, index[rows])
            best[rows] = np.where(better, height, best[rows])
            first += values.shape[1]
    return index


def exact_maxima(source: Coupled, target: Coupled, rotations: Array) -> NDArray[np.int64]:
    """Index of the highest of some rotations by the exact series: no coarse step, no ascent.

    Parameters
    ----------
    source, target : Coupled
        n functions and one.
    """
    series = spectrum(source, target)
    best = np.full(len(series), -np.inf)
    index = np.zeros(len(series), np.int64)
    for some in parts(len(rotations), SERIES_AT_ONCE):
        values = series @ rotation_blocks(rotations[some], target.n_degrees, "float32").T
        top = values.max(axis=1)
        index = np.where(top > best, some.start + values.argmax(axis=1), index)
        best = np.maximum(best, top)
    return index


def direct_abrdf_correlations(a: Reals, b: Reals, rotations: Array) -> Reals:
    """Eq. 10: (n_rotations,) sums of a * (D b D^T), Wigner-D made anew for each rotation."""
    values = [
        np.einsum("rij,ij->r", turned_both(b, rotations[some], str(a.dtype)), a)
        for some in parts(len(rotations), ROTATIONS_AT_ONCE // 4)
    ]
    return np.concatenate(values)


def turned_both(b: Reals, rotations: Array, dtype: str) -> Reals:
    """(n_rotations, L_view^2, L_light^2) coefficients with both directions turned."""
    left = turned(b, rotations, dtype)
    band_limit = round(b.shape[1] ** 0.5)
    blocks, offsets = rotation_blocks(rotations, band_limit, dtype), block_offsets(band_limit)
    for ell in range(band_limit):
        size = 2 * ell + 1
        block = blocks[:, offsets[ell] : offsets[ell + 1]].reshape(-1, size, size)
        left[:, :, degree(ell)] = np.matmul(left[:, :, degree(ell)], block.swapaxes(1, 2))
    return left


@numba.njit(cache=True, nogil=True, fastmath=True)
def sampled_abrdf_correlations(
    samples: NDArray[np.float32],
    directions: Array,
    nodes: NDArray[np.float32],
    side: int,
    rotations: Array,
) -> Array:
    """Eq. 3: sum over views and lights of a(v, l) b(R^T v, R^T l); b is 0 below the horizon.

    Parameters
    ----------
    samples : (k, k) float32
        For views and lights from the same k directions.
    nodes : (side^2, side^2) float32
        The target on hemisphere nodes, bilinear between them.
    """
    out, k = np.zeros(len(rotations)), len(directions)
    node, s, t = np.zeros(k, np.int64), np.zeros(k, np.float32), np.zeros(k, np.float32)
    line = np.zeros(nodes.shape[1], np.float32)
    for i in range(len(rotations)):
        place_all(directions, rotations[i], side, node, s, t)
        for v in range(k):
            if node[v] < 0:
                continue
            first, a, b = node[v], s[v], t[v]
            w0, w1, w2, w3 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
            for j in range(len(line)):
                line[j] = w0 * nodes[first, j] + w1 * nodes[first + 1, j]
                line[j] += w2 * nodes[first + side, j] + w3 * nodes[first + side + 1, j]
            for m in range(k):
                j = node[m]
                if j >= 0:
                    low = line[j] + s[m] * (line[j + 1] - line[j])
                    j += side
                    high = line[j] + s[m] * (line[j + 1] - line[j])
                    out[i] += samples[v, m] * (low + t[m] * (high - low))
    return out


@numba.njit(cache=True, nogil=True)
def place_all(
    directions: Array,
    rotation: Array,
    side: int,
    node: NDArray[np.int64],
    s: NDArray[np.float32],
    t: NDArray[np.float32],
) -> None:
    """First node and shares of R^T w for each direction; node -1 below the horizon."""
    for k in range(len(directions)):
        d = rotation.T @ directions[k]
        node[k] = -1
        if d[2] > 0.0:
            u, v = square_from_xyz(d[0], d[1], d[2])
            column, s[k] = first_tap(u, side)
            row, t[k] = first_tap(v, side)
            node[k] = row * side + column
