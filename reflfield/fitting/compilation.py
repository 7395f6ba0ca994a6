"""Kernels of the half-vector fit, compiled before they are needed."""

from __future__ import annotations

import numpy as np

from reflfield.field.half_vector_evaluation import evaluate_half_vector
from reflfield.field.quantisation import codes_from_rotations, rotations_from_codes
from reflfield.fitting.image_fit import image_step, pixel_rows
from reflfield.fitting.pixel_system import ViewPixels
from reflfield.fitting.table_fit import fit_tables
from reflfield.fitting.tangents import with_tangents_along_highlights
from reflfield.fitting.texel_graph import TexelGraph
from reflfield.fitting.texel_sample_fit import (
    SampleBlock,
    SampleBlocks,
    fit_to_samples,
    start_model,
    with_start_colors,
)
from reflfield.util.blas_threads import thread_pool


def compile_kernels() -> None:
    """Run the smallest fit that calls all kernels; numba keeps them on disk."""
    frames = np.tile(np.eye(3, dtype=np.float32), (2, 1, 1))
    up = np.tile(np.array([0, 0, 1], np.float32), (2, 1, 1))
    block = SampleBlock(
        texels=np.arange(2),
        first=np.arange(3),
        view=np.zeros(2, np.int16),
        light=np.zeros(2, np.int16),
        values=np.ones((2, 3), np.float32),
        views=up,
        lights=up,
        camera=np.zeros(2, np.int16),
    )
    pixels = ViewPixels(
        texels=np.arange(2, dtype=np.int32),
        first=np.arange(3),
        entry=np.arange(2, dtype=np.int32),
        share=np.ones(2, np.float32),
        values=np.ones((2, 1, 3), np.float32),
        at_least=np.zeros((2, 1, 3), np.bool_),
        views=up[:, 0].copy(),
        lights=up,
    )
    graph = TexelGraph(2, np.array([[0, 1]]))
    blocks = SampleBlocks(lambda number: block, 1, 1 << 20)
    with thread_pool(1) as pool:
        model = with_start_colors(blocks, start_model(frames, 1), pool)
        model, _ = fit_to_samples(blocks, model, pool, 1, 1e-3)
        model = with_tangents_along_highlights(blocks, model, graph, pool)
        model = image_step([pixels], model, graph, up[:, 0].astype(np.float64), pool).model
        model = fit_tables(pixel_rows([pixels], 10, 0), model, pool)
    rotations_from_codes(codes_from_rotations(frames, 0.01), 0.01)
    out = np.zeros((2, 3), np.float32)
    evaluate_half_vector(*model.arrays, pixels.texels, pixels.views, up[:, 0].copy(), out)
