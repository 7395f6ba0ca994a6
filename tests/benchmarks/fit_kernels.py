"""Kernels of the fit and of evaluation with inputs made up at random, and their operations.

Operations are counted by hand from the source, by the rules of `roofline`; K lobes or
components. What several texels, lights or channels share is counted once where the source
computes it once, and so are products of shares that the compiler finds to be the same.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from benchmarks.roofline import DIVISION, FUNCTION, ROOT, Kernel, size
from scipy.interpolate import RegularGridInterpolator

from reflfield.field.evaluation import _evaluate
from reflfield.field.half_vector import HALF_SIDE, N_LIGHT, N_VIEW
from reflfield.field.half_vector_evaluation import evaluate_half_vector
from reflfield.fitting.pixel_kernels import HALF_ANGLE, N_ROTATIONS, derive
from reflfield.fitting.pixel_system import (
    Linearisation,
    ViewPixels,
    linearisation_shapes,
    normal_product,
)
from reflfield.fitting.table_fit import TableRows, _linearised
from reflfield.fitting.table_kernels import add_table_product
from reflfield.sphere.hemisphere import softened_cosine
from tests.field.test_half_vector import reference as by_interpolation
from tests.fitting.conftest import frames_about, random_model, unit

N_LOBES, N_PHOTOGRAPHS, N_TEXELS = 2, 24, 65_536
# Texels under a pixel; each texel is seen by two pixels.
UNDER_PIXEL, STEP = 4, 2
# Clustered model: clusters, sides of the grids of views and lights, components with the mean.
N_CLUSTERS, SIDE, N_COMPONENTS = 8, 9, 9

# half_taps: both directions in the frame 30; the half vector 3, its square 6, scaled 4 by a
# root and a division; its sine^2 3, cosine of the difference 7; the radius 3 and two functions,
# across 1, a root and a division; column and row 6 each, layer 4 and a function, ring 4;
# sines^2 3; the turn 5 and a division, its bound 1; cosines 4, i and j 8, k 5, raised 1; V 3
# and a division.
HALF_TAPS = 30 + 13 + 3 + 7 + 3 + 1 + 12 + 4 + 4 + 3 + 6 + 4 + 8 + 5 + 1 + 3
HALF_TAPS += 2 * ROOT + 4 * DIVISION + 3 * FUNCTION
# Weights of eight corners: 3 complements, 4 products, 8 products. Of a skew's four: 2 and 4.
CORNERS, SKEW_CORNERS = 15, 6
# A table in eight nodes; a channel of a skew in four, the cosine of the azimuth and 1.
IN_TABLE, SKEW = 16, 10
DIFFUSE = CORNERS + IN_TABLE
# add_sample: a diffuse part of 1 + 6; of each lobe three sums of eight, three skews, the factor
# 2, and 3 a channel. The corners are the same for all lobes.
SAMPLE = HALF_TAPS + DIFFUSE + 7 + CORNERS + SKEW_CORNERS
SAMPLE += N_LOBES * (3 * IN_TABLE + 3 * SKEW + 2 + 9)
# lobe_values: corners times the factor 8, and 1 a channel for the skew.
LOBES = CORNERS + 8 + SKEW_CORNERS + N_LOBES * (3 * IN_TABLE + 3 * SKEW + 3)


# --- steps on the photographs -----------------------------------------------------------------


def view_of(rng, n_pixels):
    """Pixels of one view and the model of the texels under them."""
    m = STEP * n_pixels
    model = random_model(rng, m, N_LOBES)
    entry = (STEP * np.arange(n_pixels)[:, None] + np.arange(UNDER_PIXEL)) % m
    values = rng.uniform(0.1, 1.0, (n_pixels, N_PHOTOGRAPHS, 3)).astype(np.float32)
    pixels = ViewPixels(
        texels=np.arange(m, dtype=np.int32),
        first=np.arange(0, UNDER_PIXEL * n_pixels + 1, UNDER_PIXEL),
        entry=entry.ravel().astype(np.int32),
        share=np.full(entry.size, 1 / UNDER_PIXEL, np.float32),
        values=values,
        at_least=np.zeros(values.shape, np.bool_),
        views=unit(rng, m),
        lights=unit(rng, m, N_PHOTOGRAPHS),
    )
    return pixels, model


def linearisation(n_pixels, seed):
    """Derivatives of samples by colour, weights and rotations; item: texel and light."""
    pixels, model = view_of(np.random.default_rng(seed), n_pixels)
    shapes = linearisation_shapes(pixels, N_LOBES)
    used = np.ones(shapes[0], np.bool_)
    out = tuple(np.zeros(shape, np.float32) for shape in shapes[:2])
    inputs = (pixels.texels, pixels.views, pixels.lights, used, model.arrays)

    def work():
        out[1][:] = 0
        derive(*inputs, out)
        return out

    # The sample's own derivatives with two factors, six samples in rotated frames, and 2 for
    # each of nine differences. The frames' rotation is shared by all lights and left out.
    own = HALF_TAPS + DIFFUSE + 2 + LOBES
    return Kernel(
        item="texel and light",
        precision="float32",
        n_items=used.size,
        operations=own + 2 * N_ROTATIONS * SAMPLE + 2 * 3 * N_ROTATIONS,
        bytes_read=size(*inputs),
        bytes_written=size(out),
        work=work,
        reference=lambda: differenced(pixels, model),
    )


def differenced(pixels, model):
    """Derivatives from samples of models with one unknown, and in rotated frames."""
    texels = np.repeat(pixels.texels, N_PHOTOGRAPHS)
    views, lights = pixels.views[texels], pixels.lights.reshape(-1, 3)

    def samples(**changed):
        shown = by_interpolation(replace(model, **changed), texels, views, lights)
        return shown.reshape(*pixels.lights.shape[:2], 3)

    white, none = np.ones_like(model.diffuse), np.zeros_like(model.weights)
    by_lobes = [
        samples(diffuse=0 * white, weights=none + np.eye(N_LOBES)[k]) for k in range(N_LOBES)
    ]
    by_rotations = [
        (samples(frames=turned(model, r, 1)) - samples(frames=turned(model, r, -1)))
        / (2 * float(HALF_ANGLE))
        for r in range(N_ROTATIONS)
    ]
    by_diffuse = samples(diffuse=white, weights=none)[..., 0]
    return by_diffuse, np.stack(by_lobes + by_rotations, axis=1)


def turned(model, axis, sign):
    """Frames turned about one of their axes by the step of the differences."""
    turn = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(float(HALF_ANGLE)), sign * np.sin(float(HALF_ANGLE))
    turn[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return turn @ model.frames.astype(np.float64)


def pixel_product(n_pixels, seed):
    """A^T W A x of the pixels of a view; item: pixel, light and texel."""
    rng = np.random.default_rng(seed)
    pixels, _ = view_of(rng, n_pixels)
    shapes = linearisation_shapes(pixels, N_LOBES)
    system = Linearisation(*(rng.random(shape, np.float32) for shape in shapes))
    x = rng.random((len(pixels.texels), 3 + N_LOBES + N_ROTATIONS), np.float32)
    # To a channel: the colour 1, 2 for each lobe and rotation, the share 2; back the same. At
    # a pixel, of whose texels each has a part, 2 sums and 3 weights.
    channel = 3 + 2 * (N_LOBES + N_ROTATIONS)
    indices = (pixels.first, pixels.entry, pixels.share)
    return Kernel(
        item="pixel, light and texel",
        precision="float32",
        n_items=pixels.entry.size * N_PHOTOGRAPHS,
        operations=2 * 3 * channel + 5 / UNDER_PIXEL,
        bytes_read=size(system.diffuse, system.others, system.weight, *indices, x, x),
        bytes_written=x.nbytes,
        work=lambda: (normal_product(pixels, system, x),),
        reference=lambda: (dense_product(pixels, system, x),),
    )


def dense_product(pixels, system, x):
    """The same over whole arrays."""
    by_diffuse, weight, x = (a.astype(np.float64) for a in (system.diffuse, system.weight, x))
    others = np.moveaxis(system.others, 1, 2).astype(np.float64)
    entry = pixels.entry.reshape(-1, UNDER_PIXEL)
    value = by_diffuse[..., None] * x[:, None, :3]
    value += np.einsum("mu,mjuc->mjc", x[:, 3:], others)
    shown = weight * value[entry].sum(axis=1) / UNDER_PIXEL
    back = np.zeros_like(value)
    np.add.at(back, entry, shown[:, None] / UNDER_PIXEL)
    by_colour = np.einsum("mj,mjc->mc", by_diffuse, back)
    return np.concatenate([by_colour, np.einsum("mjuc,mjc->mu", others, back)], axis=1)


# --- tables -----------------------------------------------------------------------------------


def rows_of(rng, model, n_rows):
    """Rows of one sample each, as those that tables are fitted to."""
    return TableRows(
        first=np.arange(n_rows + 1),
        texel=np.sort(rng.integers(model.n_texels, size=n_rows)).astype(np.int32),
        share=np.ones(n_rows, np.float32),
        views=unit(rng, n_rows),
        lights=unit(rng, n_rows),
        values=rng.uniform(0.1, 1.0, (n_rows, 3)).astype(np.float32),
        at_least=np.zeros((n_rows, 3), np.bool_),
    )


def table_product(n_rows, seed):
    """A^T W A x of the tables; item: sample."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, N_TEXELS, N_LOBES)
    with ThreadPoolExecutor(1) as pool:
        rows = _linearised(rows_of(rng, model, n_rows), model, pool)
    of_rows = (rows.rows.first, rows.rows.texel, rows.taps, rows.factor, rows.weight)
    coefficients = (model.diffuse, model.weights)
    tables = (np.ascontiguousarray(np.moveaxis(model.lobes, 0, 1)), model.diffuse_table)
    out = tuple(np.zeros_like(table) for table in tables)

    def work():
        for table in out:
            table[:] = 0
        add_table_product(*of_rows, coefficients, tables, out)
        return out

    # Corners of lobes and table, the latter times a factor 8; shown: the table 16, the colour
    # 6, of each lobe three sums and 3 a channel; weights 3; back: the colour 6, the table 16,
    # of each lobe 2 a channel and three sums.
    shown = IN_TABLE + 6 + N_LOBES * (3 * IN_TABLE + 9)
    back = 6 + IN_TABLE + N_LOBES * (6 + 3 * IN_TABLE)
    return Kernel(
        item="sample",
        precision="float32",
        n_items=n_rows,
        operations=2 * CORNERS + 8 + shown + 3 + back,
        bytes_read=size(*of_rows, coefficients, tables, out),
        bytes_written=size(out),
        work=work,
        reference=lambda: scattered_product(rows, model, tables),
    )


def cell_corners(first, shares, row_step, layer_step):
    """Nodes and weights (n, 8) of the corners of cells."""
    high = (np.arange(8)[:, None] >> np.arange(3)) & 1
    nodes = first[:, None].astype(np.int64) + high @ np.array([1, row_step, layer_step])
    shares = shares[:, None].astype(np.float64)
    return nodes, np.where(high, shares, 1 - shares).prod(axis=2)


def scattered_product(rows, model, tables):
    """The same over whole arrays."""
    nodes, taps = cell_corners(rows.lobe_node, rows.lobe_share, HALF_SIDE, HALF_SIDE**2)
    in_table = cell_corners(rows.diffuse_node, rows.diffuse_share, N_LIGHT, N_LIGHT * N_VIEW)
    lobes, table = (array.astype(np.float64) for array in tables)
    factor, texel = rows.factor.astype(np.float64), rows.rows.texel
    diffuse = factor[:, :1] * model.diffuse[texel]
    shine = factor[:, 1:].reshape(-1, N_LOBES, 3) * model.weights[texel][..., None]
    shown = diffuse * (in_table[1] * table[in_table[0]]).sum(axis=1)[:, None]
    shown += np.einsum("nkc,nm,nmkc->nc", shine, taps, lobes[nodes])
    shown *= rows.weight
    out = np.zeros_like(lobes), np.zeros_like(table)
    np.add.at(out[0], nodes, np.einsum("nkc,nm,nc->nmkc", shine, taps, shown))
    np.add.at(out[1], in_table[0], in_table[1] * (diffuse * shown).sum(axis=1)[:, None])
    return out


# --- evaluation -------------------------------------------------------------------------------


def half_vector(n_samples, seed):
    """Samples of a half-vector field; item: sample."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, N_TEXELS, N_LOBES)
    texels = np.sort(rng.integers(N_TEXELS, size=n_samples)).astype(np.int32)
    views, lights = unit(rng, 2, n_samples)
    out = np.zeros((n_samples, 3), np.float32)

    def work():
        out[:] = 0
        evaluate_half_vector(*model.arrays, texels, views, lights, out)
        return (out,)

    return Kernel(
        item="sample",
        precision="float32",
        n_items=n_samples,
        operations=SAMPLE,
        bytes_read=size(model.arrays, texels, views, lights, out),
        bytes_written=out.nbytes,
        work=work,
        reference=lambda: (by_interpolation(model, texels, views, lights),),
    )


def clustered(n_samples, seed):
    """Samples of a clustered field; item: sample."""
    rng = np.random.default_rng(seed)
    table = rng.random((N_CLUSTERS, SIDE**2, SIDE**2, N_COMPONENTS, 3), np.float32)
    weights = rng.random((N_TEXELS, N_COMPONENTS), np.float32)
    cluster = rng.integers(N_CLUSTERS, size=N_TEXELS).astype(np.int32)
    frames = frames_about(rng, N_TEXELS)
    texels = np.sort(rng.integers(N_TEXELS, size=n_samples)).astype(np.int32)
    views, lights = unit(rng, 2, n_samples)
    out = np.zeros((n_samples, 3), np.float32)
    arrays = (table, weights, cluster, frames)

    def work():
        _evaluate(*arrays, (SIDE, SIDE), 3, texels, views, lights, out)
        return (out,)

    # A direction: in the frame 15, the square 5, a root, a division and a function, a cell of
    # each axis 6; its corners 6. All 16 taps: their weights, and 2 for each component and
    # channel. Then 2 for each component and channel, the cube 2 and the cosine 1 a channel.
    direction = 15 + 5 + ROOT + DIVISION + FUNCTION + 2 * 6 + 6
    return Kernel(
        item="sample",
        precision="float32",
        n_items=n_samples,
        operations=2 * direction + 16 + 16 * 6 * N_COMPONENTS + 6 * N_COMPONENTS + 9,
        bytes_read=size(*arrays, texels, views, lights),
        bytes_written=out.nbytes,
        work=work,
        reference=lambda: (in_grids(*arrays, texels, views, lights),),
    )


def in_grids(table, weights, cluster, frames, texels, views, lights):
    """The same by SciPy's interpolation over both grids at once."""
    local = [np.einsum("nij,nj->ni", frames[texels], d, dtype=float) for d in (views, lights)]
    at = np.concatenate([square(direction) for direction in local], axis=1)
    axis = np.linspace(-1, 1, SIDE)
    parts = np.zeros((len(texels), N_COMPONENTS, 3))
    for c in range(N_CLUSTERS):
        grid = table[c].reshape(*[SIDE] * 4, N_COMPONENTS, 3).astype(np.float64)
        of_cluster = cluster[texels] == c
        parts[of_cluster] = RegularGridInterpolator([axis] * 4, grid)(at[of_cluster])
    value = np.einsum("nk,nkc->nc", weights[texels], parts)
    return softened_cosine(local[1][:, 2])[:, None] * np.maximum(value, 0) ** 3


def square(direction):
    """Rows and columns (n, 2) of P. Shirley's concentric map, in [-1, 1]."""
    x, y, z = direction.T
    wide = np.abs(x) >= np.abs(y)
    radius = np.sqrt(1 - np.maximum(z, 0)) * np.sign(np.where(wide, x, y))
    ratio = np.where(wide, y, x) / np.where(wide, x, y)
    along = radius * np.arctan(ratio) * 4 / np.pi
    return np.stack([np.where(wide, along, radius), np.where(wide, radius, along)], axis=1)
