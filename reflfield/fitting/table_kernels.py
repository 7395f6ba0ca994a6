"""Kernels of the fit of tables: rows in the nodes of lobes and diffuse table.

Helpers are inlined: as calls, with all their arrays as arguments, they take half of the time.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from reflfield.field.half_vector import (
    FAST,
    HALF_SIDE,
    N_LIGHT,
    N_VIEW,
    diffuse_value,
    half_taps,
    lobe_values,
)
from reflfield.fitting.robust_weights import TABLE_HUBER, is_evidence, squared_weight


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def linearise_rows(
    first: Any,
    texel: Any,
    share: Any,
    views: Any,
    lights: Any,
    observed: Any,
    model: Any,
    taps: Any,
    factor: Any,
    weight: Any,
) -> None:
    """Taps and factors of entries; weights from the residuals of the model as it is."""
    frames, diffuse, weights, lobes, table = model
    lobe_node, lobe_share, diffuse_node, diffuse_share = taps
    part = np.zeros((lobes.shape[0], 3), np.float32)
    shown = np.zeros(3, np.float32)
    values, at_least = observed
    for row in range(len(values)):
        shown[:] = np.float32(0.0)
        for e in range(first[row], first[row + 1]):
            t = texel[e]
            at_lobe, at_diffuse, cosine, spread = half_taps(frames[t], views[e], lights[e])
            lobe_node[e], fx, fy, fd = at_lobe
            lobe_share[e, 0], lobe_share[e, 1], lobe_share[e, 2] = fx, fy, fd
            diffuse_node[e], gl, gv, gp = at_diffuse
            diffuse_share[e, 0], diffuse_share[e, 1], diffuse_share[e, 2] = gl, gv, gp
            factor[e, 0] = share[e] * cosine
            factor[e, 1] = share[e] * cosine * spread
            base = factor[e, 0] * diffuse_value(table, at_diffuse)
            lobe_values(lobes, at_lobe, factor[e, 1], part)
            for c in range(3):
                shown[c] += base * diffuse[t, c]
                for k in range(lobes.shape[0]):
                    shown[c] += weights[t, k] * part[k, c]
        for c in range(3):
            if is_evidence(values[row, c], at_least[row, c], shown[c]):
                weight[row, c] = squared_weight(values[row, c], shown[c], TABLE_HUBER)


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
        in_lobes[1][m] *= factor[e, 1]
        in_table[1][m] *= factor[e, 0]


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _add_entry(t: int, corners: Any, model: Any, tables: Any, out: Any) -> None:
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
        out[0] += weights[t, k] * red
        out[1] += weights[t, k] * green
        out[2] += weights[t, k] * blue


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _spread_entry(t: int, corners: Any, model: Any, residual: Any, out: Any) -> None:
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
        red, green, blue = weight * residual[0], weight * residual[1], weight * residual[2]
        for m in range(8):
            lobes_out[nodes[m], k, 0] += taps[m] * red
            lobes_out[nodes[m], k, 1] += taps[m] * green
            lobes_out[nodes[m], k, 2] += taps[m] * blue


@numba.njit(cache=True, nogil=True)
def _empty_corners() -> Any:
    """Room for the corners of an entry: (nodes, weights) in the lobes and in the table."""
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
            _add_entry(texel[e], corners, model, tables, shown)
        for c in range(3):
            shown[c] *= weight[row, c]
        for e in range(first[row], first[row + 1]):
            if first[row + 1] - first[row] > 1:
                _place_entry(e, taps, factor, corners)
            _spread_entry(texel[e], corners, model, shown, out)


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
            _spread_entry(texel[e], corners, model, shown, out)


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
                        lobes_out[nodes[m], k, c] += scale * weight[row, c]
