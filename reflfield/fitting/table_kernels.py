"""Kernels of the fit of tables: rows in the nodes of lobes and diffuse table.

Helpers are inlined: as calls, with all their arrays as arguments, they take half of the time.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from reflfield.field.half_vector import HALF_SIDE, N_LIGHT, N_VIEW, SKEW_RINGS
from reflfield.field.half_vector_batches import (
    AZIMUTH,
    BATCH,
    COSINE,
    LOBE,
    LOBE_NODE,
    RING,
    SKEW_NODE,
    SPREAD,
    TABLE,
    TABLE_NODE,
    empty_batch,
    place_batch,
    put_pairs,
    sample_at,
    skew_at,
    skew_place,
)
from reflfield.fitting.robust_weights import TABLE_HUBER, is_evidence, squared_weight
from reflfield.util.single_precision import FAST


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _keep_place(e: Any, i: Any, batch: Any, taps: Any) -> None:
    """Nodes and shares of entry e, which is pair i of a batch."""
    numbers, nodes = batch
    lobe_node, lobe_share, diffuse_node, diffuse_share = taps
    lobe_node[e], diffuse_node[e] = nodes[LOBE_NODE + i], nodes[TABLE_NODE + i]
    for d in range(3):
        lobe_share[e, d] = numbers[LOBE + BATCH * d + i]
        diffuse_share[e, d] = numbers[TABLE + BATCH * d + i]


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _keep_factors(
    e: Any, i: Any, share: Any, batch: Any, skews: Any, rings: Any, factor: Any
) -> None:
    """Factors of entry e: of the diffuse part, then of the channels of the lobes."""
    numbers, nodes = batch
    ring_node, ring_share, spread = rings
    ring_node[e] = nodes[SKEW_NODE + i]
    ring_share[e, 0], ring_share[e, 1] = numbers[RING + i], numbers[AZIMUTH + i]
    factor[e, 0] = share * numbers[COSINE + i]
    spread[e] = factor[e, 0] * numbers[SPREAD + i]
    place = skew_place(i, batch)
    for k in range(skews.shape[0]):
        for c in range(3):
            factor[e, 1 + 3 * k + c] = spread[e] * skew_at(place, skews, k, c)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _weigh_rows(observed: Any, weight: Any) -> None:
    """Weights of values where `weight` holds what the model shows."""
    values, at_least = observed
    for row in range(values.shape[0]):
        for c in range(3):
            shown = weight[row, c]
            w = squared_weight(values[row, c], shown, TABLE_HUBER)
            counts = is_evidence(values[row, c], at_least[row, c], shown)
            weight[row, c] = w if counts else np.float32(0.0)


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def linearise_rows(
    first: Any,
    texel: Any,
    share: Any,
    views: Any,
    lights: Any,
    observed: Any,
    model: Any,
    taps: Any,
    rings: Any,
    factor: Any,
    weight: Any,
) -> None:
    """Taps and factors of entries; weights (zero before) from residuals of the model."""
    frames, diffuse, weights, lobes, table = model
    batch, row = empty_batch(), 0
    for begin in range(first[0], first[-1], BATCH):
        n = min(BATCH, first[-1] - begin)
        put_pairs(begin, n, texel, frames, views, lights, batch)
        place_batch(batch)
        for i in range(n):
            e = begin + i
            while e >= first[row + 1]:
                row += 1
            _keep_place(e, i, batch, taps)
            _keep_factors(e, i, share[e], batch, lobes[1], rings, factor)
            red, green, blue = sample_at(i, batch, texel[e], (diffuse, weights), (lobes, table))
            weight[row, 0] += share[e] * red
            weight[row, 1] += share[e] * green
            weight[row, 2] += share[e] * blue
    _weigh_rows(observed, weight)


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _corners(first: Any, share: Any, row_step: Any, layer_step: Any, corners: Any) -> None:
    """Nodes and weights of the eight corners of a cell, into `corners`.

    `first` is its first node, `share` (3,) are the shares of the upper nodes along columns,
    rows and layers.
    """
    nodes, weights = corners
    fx, fy, fd = share[0], share[1], share[2]
    gx, gy, gd = np.float32(1.0) - fx, np.float32(1.0) - fy, np.float32(1.0) - fd
    weights[0], weights[1], weights[2], weights[3] = gx * gy, fx * gy, gx * fy, fx * fy
    nodes[0], nodes[1] = first, first + 1
    nodes[2], nodes[3] = first + row_step, first + row_step + 1
    for m in range(4):
        nodes[4 + m] = nodes[m] + np.uint32(layer_step)
        weights[4 + m] = weights[m] * fd
        weights[m] *= gd


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _place_entry(e: int, taps: Any, factor: Any, corners: Any) -> None:
    """Corners of an entry in the lobes and in the diffuse table, times its factors."""
    lobe_node, lobe_share, diffuse_node, diffuse_share = taps
    in_lobes, in_table = corners
    _corners(lobe_node[e], lobe_share[e], HALF_SIDE, HALF_SIDE * HALF_SIDE, in_lobes)
    _corners(diffuse_node[e], diffuse_share[e], N_LIGHT, N_LIGHT * N_VIEW, in_table)
    for m in range(8):
        in_table[1][m] *= factor[e, 0]


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _add_entry(t: int, corners: Any, factor: Any, model: Any, tables: Any, out: Any) -> None:
    """Add what an entry of texel t shows of tables to `out` (3,)."""
    (nodes, taps), (table_nodes, table_taps) = corners
    diffuse, weights = model
    lobes, table = tables
    base = np.float32(0.0)
    for m in range(8):
        base += table_taps[m] * table[table_nodes[m]]
    for c in range(3):
        out[c] += base * diffuse[t, c]
    for k in range(lobes.shape[1]):
        red = green = blue = np.float32(0.0)
        for m in range(8):
            red += taps[m] * lobes[nodes[m], k, 0]
            green += taps[m] * lobes[nodes[m], k, 1]
            blue += taps[m] * lobes[nodes[m], k, 2]
        out[0] += weights[t, k] * factor[1 + 3 * k] * red
        out[1] += weights[t, k] * factor[2 + 3 * k] * green
        out[2] += weights[t, k] * factor[3 + 3 * k] * blue


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _spread_entry(
    t: int, corners: Any, factor: Any, model: Any, residual: Any, out: Any
) -> None:
    """Adjoint of `_add_entry`: add a residual (3,) to tables."""
    (nodes, taps), (table_nodes, table_taps) = corners
    diffuse, weights = model
    lobes_out, table_out = out
    base = np.float32(0.0)
    for c in range(3):
        base += diffuse[t, c] * residual[c]
    for m in range(8):
        table_out[table_nodes[m]] += table_taps[m] * base
    for k in range(lobes_out.shape[1]):
        weight = weights[t, k]
        red = weight * factor[1 + 3 * k] * residual[0]
        green = weight * factor[2 + 3 * k] * residual[1]
        blue = weight * factor[3 + 3 * k] * residual[2]
        for m in range(8):
            lobes_out[nodes[m], k, 0] += taps[m] * red
            lobes_out[nodes[m], k, 1] += taps[m] * green
            lobes_out[nodes[m], k, 2] += taps[m] * blue


@numba.njit(cache=True, nogil=True)
def _empty_corners() -> Any:
    """Arrays for the corners of an entry: (nodes, weights) in the lobes and in the table."""
    return (
        (np.zeros(8, np.uint32), np.zeros(8, np.float32)),
        (np.zeros(8, np.uint32), np.zeros(8, np.float32)),
    )


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def add_table_product(
    first: Any,
    texel: Any,
    taps: Any,
    factor: Any,
    weight: Any,
    model: Any,
    tables: Any,
    out: Any,
) -> None:
    """Add A^T W A x to `out`; x and `out` are tables."""
    shown, corners = np.zeros(3, np.float32), _empty_corners()
    for row in range(len(weight)):
        shown[:] = np.float32(0.0)
        for e in range(first[row], first[row + 1]):
            _place_entry(e, taps, factor, corners)
            _add_entry(texel[e], corners, factor[e], model, tables, shown)
        for c in range(3):
            shown[c] *= weight[row, c]
        for e in range(first[row], first[row + 1]):
            if first[row + 1] - first[row] > 1:
                _place_entry(e, taps, factor, corners)
            _spread_entry(texel[e], corners, factor[e], model, shown, out)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def add_table_right_side(
    first: Any,
    texel: Any,
    taps: Any,
    factor: Any,
    weight: Any,
    model: Any,
    values: Any,
    out: Any,
) -> None:
    """Add A^T W y to `out`."""
    shown, corners = np.zeros(3, np.float32), _empty_corners()
    for row in range(len(weight)):
        for c in range(3):
            shown[c] = np.float32(0.0)
            if weight[row, c] > 0:
                shown[c] = weight[row, c] * values[row, c]
        for e in range(first[row], first[row + 1]):
            _place_entry(e, taps, factor, corners)
            _spread_entry(texel[e], corners, factor[e], model, shown, out)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def add_table_diagonal(
    first: Any, texel: Any, taps: Any, factor: Any, weight: Any, model: Any, out: Any
) -> None:
    """Add the diagonal of A^T W A to `out`, but for products of entries of one row."""
    diffuse, weights = model
    lobes_out, table_out = out
    corners = _empty_corners()
    (nodes, shares), (table_nodes, table_shares) = corners
    for row in range(len(weight)):
        for e in range(first[row], first[row + 1]):
            t = texel[e]
            _place_entry(e, taps, factor, corners)
            base = np.float32(0.0)
            for c in range(3):
                base += weight[row, c] * diffuse[t, c] ** 2
            for m in range(8):
                table_out[table_nodes[m]] += table_shares[m] ** 2 * base
                for k in range(lobes_out.shape[1]):
                    scale = (shares[m] * weights[t, k]) ** 2
                    for c in range(3):
                        w = weight[row, c] * factor[e, 1 + 3 * k + c] ** 2
                        lobes_out[nodes[m], k, c] += scale * w


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _lobe_parts(t: int, corners: Any, spread: Any, model: Any, tables: Any, parts: Any) -> None:
    """What an entry of texel t shows of each lobe but for its skew, into `parts` (K, 3)."""
    nodes, shares = corners[0]
    weights, lobes = model[1], tables[0]
    for k in range(lobes.shape[1]):
        for c in range(3):
            total = np.float32(0.0)
            for m in range(8):
                total += shares[m] * lobes[nodes[m], k, c]
            parts[k, c] = spread * weights[t, k] * total


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _add_diffuse(t: int, corners: Any, model: Any, tables: Any, out: Any) -> None:
    """Add what an entry of texel t shows of the diffuse table to `out` (3,)."""
    nodes, shares = corners[1]
    base = np.float32(0.0)
    for m in range(8):
        base += shares[m] * tables[1][nodes[m]]
    for c in range(3):
        out[c] += base * model[0][t, c]


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _add_sums(parts: Any, out: Any) -> None:
    """Add the sums of parts (K, 3) over lobes to `out` (3,)."""
    for k in range(parts.shape[0]):
        for c in range(3):
            out[c] += parts[k, c]


@numba.njit(cache=True, nogil=True, forceinline=True)
def _clear(line: Any, touched: Any, n_touched: int) -> None:
    """Put the nodes of `line` that were touched back to zero."""
    for i in range(n_touched):
        for k in range(line.shape[0]):
            for c in range(3):
                line[k, touched[i], c] = 0.0


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _add_rings(
    e: int,
    ring: Any,
    share: Any,
    taps: Any,
    parts: Any,
    line: Any,
    touched: Any,
    n_touched: int,
) -> int:
    """Add derivatives of a row by the skews, through one entry, to `line` (K, nodes, 3).

    The first `n_touched` of `touched` are the nodes that the row depends on; how many they are
    with those of this entry is returned.
    """
    fr, turn, fd = share[e, 0], share[e, 1], taps[1][e, 2]
    for m in range(4):
        w = (fr if m & 1 else 1 - fr) * (fd if m & 2 else 1 - fd) * turn
        node = ring[e] + (m & 1) + (m >> 1) * SKEW_RINGS
        known = False
        for i in range(n_touched):
            known |= touched[i] == node
        if not known:
            touched[n_touched] = node
            n_touched += 1
        for k in range(parts.shape[0]):
            for c in range(3):
                line[k, node, c] += w * parts[k, c]
    return n_touched


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _add_square(
    line: Any, touched: Any, n_touched: int, c: int, weight: Any, residual: Any, out: Any
) -> None:
    """Add one channel of a row to its normal equations: of the nodes of `line` touched.

    Of the matrix, which is symmetric, what lies not above the diagonal in the order of lobes
    and of nodes touched.
    """
    matrices, rights = out
    n_lobes, n_nodes, _ = line.shape
    for k in range(n_lobes):
        for i in range(n_touched):
            x = k * n_nodes + touched[i]
            scaled = weight * line[k, touched[i], c]
            rights[c, x] += scaled * residual
            for m in range(k + 1):
                for j in range(n_touched if m < k else i + 1):
                    y = m * n_nodes + touched[j]
                    matrices[c, x, y] += scaled * line[m, touched[j], c]


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_skew_system(
    first: Any,
    texel: Any,
    taps: Any,
    rings: Any,
    factor: Any,
    observed: Any,
    model: Any,
    tables: Any,
    out: Any,
) -> None:
    """Add the normal equations of the skews, one system for each channel, to `out`.

    `out` is the matrices (3, n, n) and right sides (3, n) of n = K * SKEW_NODES unknowns. Of
    two elements of a matrix that are equal, one gets a part and the other the rest.
    """
    ring_node, ring_share, spread = rings
    values, weight = observed
    n_lobes, n = model[1].shape[1], out[1].shape[1]
    line, corners = np.zeros((n_lobes, n // n_lobes, 3)), _empty_corners()
    touched, n_touched = np.zeros(n // n_lobes, np.int64), 0
    shown, parts = np.zeros(3, np.float32), np.zeros((n_lobes, 3), np.float32)
    for row in range(len(weight)):
        _clear(line, touched, n_touched)
        n_touched = 0
        for c in range(3):
            shown[c] = np.float32(0.0)
        for e in range(first[row], first[row + 1]):
            _place_entry(e, taps, factor, corners)
            _lobe_parts(texel[e], corners, spread[e], model, tables, parts)
            _add_diffuse(texel[e], corners, model, tables, shown)
            _add_sums(parts, shown)
            n_touched = _add_rings(
                e, ring_node, ring_share, taps, parts, line, touched, n_touched
            )
        for c in range(3):
            if weight[row, c] > 0:
                residual = values[row, c] - shown[c]
                _add_square(line, touched, n_touched, c, weight[row, c], residual, out)
