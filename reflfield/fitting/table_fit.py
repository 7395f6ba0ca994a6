"""Tables of the half-vector model: least squares by conjugate gradients.

A row is one measured value per channel, and the mean of one or several entries (a texel for a
pair of directions, with its share of the row). Samples have one entry, pixels some.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.half_vector import (
    DIFFUSE_NODES,
    HALF_SIDE,
    LARGEST_SKEW,
    LOBE_NODES,
    N_DIFFERENCE,
    N_LIGHT,
    N_PHASE,
    N_VIEW,
    SKEW_NODES,
    SKEW_RINGS,
    HalfVectorModel,
)
from reflfield.fitting.table_kernels import (
    add_skew_system,
    add_table_diagonal,
    add_table_product,
    add_table_right_side,
    linearise_rows,
)

Floats = NDArray[np.float32]

# Rows are summed in so many parts, whatever the number of threads.
PARTS = 8
# Of conjugate gradients, in so many rounds between which the nodes at zero are told anew.
ITERATIONS, ROUNDS = 15, 3
# Smoothness of the lobes, relative to what the rows weigh; of the diffuse table.
LOBE_SMOOTHNESS, DIFFUSE_SMOOTHNESS = 3e-4, 0.02
# Nodes of neighbouring difference angles are tied more firmly than those of a layer.
ACROSS_LAYERS = 0.2
# Least value of the diffuse table, whose mean is 1.
LEAST_DIFFUSE = 0.02
# Tie of every node to zero, relative to what a row weighs per node; of a skew, and that of its
# neighbouring nodes over it.
RIDGE = 1e-6
SKEW_TIE, SKEW_BENDING = 1e-4, 3.0


@dataclass(frozen=True, eq=False)
class TableRows:
    """Rows that tables are fitted to.

    Parameters
    ----------
    first : (n_rows + 1,) int64
        First entry of each row.
    texel : (n_entries,) int32
    share : (n_entries,) float32
    views, lights : (n_entries, 3) float32
        Unit directions, world frame.
    values : (n_rows, 3) float32
        In units of white; NaN where not measured.
    at_least : (n_rows, 3) bool
        True where a value is a bound from below.
    """

    first: NDArray[np.int64]
    texel: NDArray[np.int32]
    share: Floats
    views: Floats
    lights: Floats
    values: Floats
    at_least: NDArray[np.bool_]

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.values)

    def parts(self) -> list[slice]:
        """Rows by parts."""
        ends = np.linspace(0, self.n_rows, PARTS + 1).astype(int)
        return [slice(a, b) for a, b in pairwise(ends)]


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Rows in the tables' nodes: taps and factors of all entries, weights of the values."""

    rows: TableRows
    lobe_node: NDArray[np.int32]
    lobe_share: Floats
    diffuse_node: NDArray[np.int32]
    diffuse_share: Floats
    ring_node: NDArray[np.int32]
    ring_share: Floats  # (n_entries, 2): along the rings; cosine of twice the azimuth
    spread: Floats  # (n_entries,): what lobes are multiplied by, but for their skew
    factor: Floats  # (n_entries, 1 + 3 K): of the diffuse part, and of the lobes' channels
    weight: Floats  # (n_rows, 3): of the squared residual

    @property
    def taps(self) -> tuple[Any, Any, Any, Any]:
        """Nodes and shares of lobes and diffuse table, as kernels take them."""
        return self.lobe_node, self.lobe_share, self.diffuse_node, self.diffuse_share

    @property
    def rings(self) -> tuple[Any, Any, Any]:
        """Places in the skews, and what they change, as kernels take them."""
        return self.ring_node, self.ring_share, self.spread


def _edges(shape: tuple[int, ...], strengths: tuple[float, ...]) -> tuple[Any, Any]:
    """Pairs (n, 2) of neighbouring nodes of a grid and the strength of their tie."""
    nodes = np.arange(np.prod(shape)).reshape(shape)
    pairs, ties = [], []
    for axis, strength in enumerate(strengths):
        lower = np.take(nodes, range(shape[axis] - 1), axis).ravel()
        upper = np.take(nodes, range(1, shape[axis]), axis).ravel()
        pairs.append(np.stack([lower, upper], axis=1))
        ties.append(np.full(len(lower), strength, np.float32))
    return np.concatenate(pairs), np.concatenate(ties)


LOBE_EDGES, LOBE_TIES = _edges((N_DIFFERENCE, HALF_SIDE, HALF_SIDE), (ACROSS_LAYERS, 1.0, 1.0))
DIFFUSE_EDGES, _ = _edges((N_PHASE, N_VIEW, N_LIGHT), (1.0, 1.0, 1.0))


def _skew_prior() -> NDArray[np.float64]:
    """Ties of a skew's nodes to zero and, more firmly, to each other."""
    edges, _ = _edges((N_DIFFERENCE, SKEW_RINGS), (1.0, 1.0))
    matrix = np.eye(SKEW_NODES)
    for i, j in edges:
        matrix[[i, j], [i, j]] += SKEW_BENDING
        matrix[[i, j], [j, i]] -= SKEW_BENDING
    return matrix


SKEW_PRIOR = _skew_prior()
# Where the half vector is the normal, or the difference angle is zero, there is no azimuth.
FREE_SKEWS = np.outer(np.arange(N_DIFFERENCE) > 0, np.arange(SKEW_RINGS) > 0).ravel()


def _laplacian(edges: NDArray[Any], ties: NDArray[Any], x: NDArray[Any]) -> NDArray[Any]:
    """Sum over neighbours of tie times difference; columns (n_nodes, m) apart."""
    difference = (x[edges[:, 0]] - x[edges[:, 1]]) * ties
    columns = [
        np.bincount(edges[:, 0], difference[:, i], len(x))
        - np.bincount(edges[:, 1], difference[:, i], len(x))
        for i in range(x.shape[1])
    ]
    return np.stack(columns, axis=1)


@dataclass(frozen=True, eq=False)
class _TableSystem:
    """Normal equations of the tables: rows by parts, smoothness and ridge.

    Lobes are (LOBE_NODES, K, 3) here: what a row reads of a node lies together.
    """

    linearised: _Linearised
    model: HalfVectorModel
    lobe_ties: Floats  # (n_edges, K * 3)
    diffuse_tie: float
    ridge: float
    pool: ThreadPoolExecutor

    def _over_rows(self, add: Callable[[slice, Any], None]) -> tuple[Any, Any]:
        """Sum of what is added by each part of the rows, in their order."""

        def one(part: slice) -> tuple[Floats, Floats]:
            lobes = np.zeros((LOBE_NODES, self.model.n_lobes, 3), np.float32)
            out = lobes, np.zeros_like(self.model.diffuse_table)
            add(part, out)
            return out

        sums = list(self.pool.map(one, self.linearised.rows.parts()))
        lobes = np.sum([lobes for lobes, _ in sums], axis=0, dtype=np.float64)
        return lobes, np.sum([table for _, table in sums], axis=0, dtype=np.float64)

    def _arguments(self, part: slice) -> tuple[Any, ...]:
        of, rows = self.linearised, self.linearised.rows
        first = rows.first[part.start : part.stop + 1]
        coefficients = (self.model.diffuse, self.model.weights)
        return first, rows.texel, of.taps, of.factor, of.weight[part], coefficients

    def right_side(self) -> tuple[Any, Any]:
        """A^T W y."""
        values = self.linearised.rows.values
        return self._over_rows(
            lambda part, out: add_table_right_side(*self._arguments(part), values[part], out)
        )

    def product(self, lobes: NDArray[Any], table: NDArray[Any]) -> tuple[Any, Any]:
        """Normal matrix times tables."""
        single = (lobes.astype(np.float32), table.astype(np.float32))
        lobes_out, table_out = self._over_rows(
            lambda part, out: add_table_product(*self._arguments(part), single, out)
        )
        smooth = _laplacian(LOBE_EDGES, self.lobe_ties, lobes.reshape(LOBE_NODES, -1))
        lobes_out += smooth.reshape(lobes.shape) + self.ridge * lobes
        ties = np.full((len(DIFFUSE_EDGES), 1), self.diffuse_tie)
        table_out += _laplacian(DIFFUSE_EDGES, ties, table[:, None])[:, 0]
        return lobes_out, table_out

    def diagonal(self) -> tuple[Any, Any]:
        """About the diagonal of the normal matrix, above zero."""
        lobes, table = self._over_rows(
            lambda part, out: add_table_diagonal(*self._arguments(part), out)
        )
        ends = [
            np.bincount(LOBE_EDGES.ravel(), np.repeat(column, 2), LOBE_NODES)
            for column in self.lobe_ties.T
        ]
        lobes += np.stack(ends, axis=1).reshape(lobes.shape) + self.ridge
        tiny = np.finfo(np.float32).tiny
        return lobes + tiny, table + 4 * self.diffuse_tie + tiny


def fit_tables(
    rows: TableRows,
    model: HalfVectorModel,
    pool: ThreadPoolExecutor,
    smoothness: float = LOBE_SMOOTHNESS,
    iterations: int = ITERATIONS,
) -> HalfVectorModel:
    """Model with tables and skews that fit the rows better, and normalised.

    Parameters
    ----------
    rows : TableRows
    model : HalfVectorModel
        Its frames and coefficients stay, its tables are where the fit starts.
    pool : ThreadPoolExecutor
        Threads; the tables do not depend on their number.
    smoothness : float
        Of the lobes, relative to what the rows weigh.
    iterations : int
        Of conjugate gradients.

    Returns
    -------
    HalfVectorModel
        See `normalised_tables`.
    """
    if not rows.n_rows:
        return model
    linearised = _linearised(rows, model, pool)
    system = _TableSystem(
        linearised,
        model,
        _lobe_ties(rows.n_rows, model, smoothness),
        DIFFUSE_SMOOTHNESS * rows.n_rows * _mean_square(model.diffuse) / DIFFUSE_NODES * 10,
        RIDGE * rows.n_rows / LOBE_NODES,
        pool,
    )
    start = (np.ascontiguousarray(np.moveaxis(model.lobes, 0, 1)), model.diffuse_table)
    lobes, table = _non_negative_solution(system, start, iterations)
    tables = (lobes.astype(np.float32), np.maximum(table, LEAST_DIFFUSE).astype(np.float32))
    return normalised_tables(
        replace(
            model,
            lobes=np.ascontiguousarray(np.moveaxis(tables[0], 1, 0)),
            skews=_skews(linearised, model, tables, pool),
            diffuse_table=tables[1],
        )
    )


def _skews(
    linearised: _Linearised,
    model: HalfVectorModel,
    tables: tuple[Floats, Floats],
    pool: ThreadPoolExecutor,
) -> Floats:
    """Skews (K, SKEW_NODES, 3) of lobes (LOBE_NODES, K, 3), by ridge regression."""
    rows, n = linearised.rows, model.n_lobes * SKEW_NODES
    coefficients = (model.diffuse, model.weights)

    def one(part: slice) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        out = np.zeros((3, n, n)), np.zeros((3, n))
        add_skew_system(
            rows.first[part.start : part.stop + 1],
            *(rows.texel, linearised.taps, linearised.rings, linearised.factor),
            (rows.values[part], linearised.weight[part]),
            *(coefficients, tables, out),
        )
        return out

    sums = list(pool.map(one, rows.parts()))
    lower, right = (np.sum([part[i] for part in sums], axis=0) for i in (0, 1))
    diagonal = np.eye(n) * lower
    matrix = lower + np.swapaxes(lower, 1, 2) - diagonal
    free = np.tile(FREE_SKEWS, model.n_lobes)
    prior = np.kron(np.eye(model.n_lobes), SKEW_PRIOR) * (SKEW_TIE * rows.n_rows / SKEW_NODES)
    skews = np.zeros((3, n))
    for c in range(3):
        system = (matrix[c] + prior)[np.ix_(free, free)]
        skews[c, free] = np.linalg.solve(system, right[c, free])
    bounded = np.clip(skews.T, -LARGEST_SKEW, LARGEST_SKEW)
    return np.ascontiguousarray(bounded.reshape(-1, SKEW_NODES, 3), np.float32)


def normalised_tables(model: HalfVectorModel) -> HalfVectorModel:
    """Same model with a diffuse table of mean 1 and lobes whose weights have mean square 1."""
    mean = np.float32(model.diffuse_table.mean())
    size = np.sqrt(np.mean(np.square(model.weights, dtype=np.float64), axis=0))
    size = np.where(size > 1e-9, size, 1.0).astype(np.float32)
    return replace(
        model,
        diffuse=model.diffuse * mean,
        diffuse_table=model.diffuse_table / mean,
        lobes=model.lobes * size[:, None, None],
        weights=model.weights / size,
    )


def _mean_square(values: Floats) -> float:
    return float(np.mean(np.square(values, dtype=np.float64)))


def _lobe_ties(n_rows: int, model: HalfVectorModel, smoothness: float) -> Floats:
    """Ties of neighbouring nodes: weak where the lobe is bright, as residuals are."""
    size = np.abs(model.lobes)
    mean = 0.5 * (size[:, LOBE_EDGES[:, 0]] + size[:, LOBE_EDGES[:, 1]])
    mean += 1e-3 * size.max(axis=(1, 2), keepdims=True) + 1e-6
    square = np.mean(np.square(model.weights, dtype=np.float64), axis=0)[:, None, None]
    strength = 30 * smoothness * n_rows * square / LOBE_NODES * 0.45**2
    ties = strength * LOBE_TIES[:, None] / mean.astype(np.float64) ** 1.16
    return np.moveaxis(ties, 0, 1).reshape(len(LOBE_EDGES), -1).astype(np.float32)


def _linearised(
    rows: TableRows, model: HalfVectorModel, pool: ThreadPoolExecutor
) -> _Linearised:
    n = len(rows.texel)
    linearised = _Linearised(
        rows,
        lobe_node=np.zeros(n, np.int32),
        lobe_share=np.zeros((n, 3), np.float32),
        diffuse_node=np.zeros(n, np.int32),
        diffuse_share=np.zeros((n, 3), np.float32),
        ring_node=np.zeros(n, np.int32),
        ring_share=np.zeros((n, 2), np.float32),
        spread=np.zeros(n, np.float32),
        factor=np.zeros((n, 1 + 3 * model.n_lobes), np.float32),
        weight=np.zeros((rows.n_rows, 3), np.float32),
    )

    def one(part: slice) -> None:
        linearise_rows(
            rows.first[part.start : part.stop + 1],
            *(rows.texel, rows.share, rows.views, rows.lights),
            (rows.values[part], rows.at_least[part]),
            *(model.arrays, linearised.taps, linearised.rings),
            *(linearised.factor, linearised.weight[part]),
        )

    list(pool.map(one, rows.parts()))
    return linearised


def _non_negative_solution(
    system: _TableSystem, start: tuple[Floats, Floats], iterations: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Some steps towards the solution among non-negative tables.

    Conjugate gradients over the nodes that are free: those above zero and those that the
    gradient lifts; then the nodes below zero are put there, and the free ones told anew.
    Clamped only at the end, a solution that swings below zero beside a highlight is far too
    bright in the dark: its other nodes had balanced what is cut off.
    """
    x = [np.maximum(part, 0.0).astype(np.float64) for part in start]
    diagonal, right = system.diagonal(), system.right_side()
    for _ in range(ROUNDS):
        gradient = [b - q for b, q in zip(right, system.product(*x), strict=True)]
        free = [(a > 0) | (g > 0) for a, g in zip(x, gradient, strict=True)]
        change = _conjugate_gradients(system, gradient, diagonal, free, iterations // ROUNDS)
        x = [np.maximum(a + b, 0.0) for a, b in zip(x, change, strict=True)]
    return x[0], x[1]


def _conjugate_gradients(
    system: _TableSystem,
    gradient: list[NDArray[Any]],
    diagonal: tuple[Any, Any],
    free: list[NDArray[np.bool_]],
    iterations: int,
) -> list[NDArray[Any]]:
    """Change of the free nodes after some steps from zero, preconditioned by the diagonal."""
    change = [np.zeros_like(g) for g in gradient]
    residual = [g * f for g, f in zip(gradient, free, strict=True)]
    scaled = [r / d for r, d in zip(residual, diagonal, strict=True)]
    direction = [z.copy() for z in scaled]
    energy = _dot(residual, scaled)
    for _ in range(iterations):
        image = [q * f for q, f in zip(system.product(*direction), free, strict=True)]
        curvature = _dot(direction, image)
        if not curvature > 0:
            break
        step = energy / curvature
        change = [a + step * p for a, p in zip(change, direction, strict=True)]
        residual = [r - step * q for r, q in zip(residual, image, strict=True)]
        scaled = [r / d for r, d in zip(residual, diagonal, strict=True)]
        before, energy = energy, _dot(residual, scaled)
        if not energy > 0:
            break
        direction = [z + energy / before * p for z, p in zip(scaled, direction, strict=True)]
    return change


def _dot(a: Any, b: Any) -> float:
    return float(sum(np.vdot(x, y) for x, y in zip(a, b, strict=True)))
