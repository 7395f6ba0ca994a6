"""Figures 4 to 6 of the paper: its synthetic scene, aligned from reflectance alone."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment import align
from reflfield.report.page import (
    Cell,
    ColourBar,
    Figure,
    Panel,
    Section,
    Table,
    encode_picture,
)
from reflfield.report.pictures import directions_coloured, enlarged, false_colour
from reflfield.report.plots import lines
from reflfield.reproduction.paper_scene import (
    ashikhmin_shirley,
    dome_directions,
    frame_errors,
    relief_frames,
    sample_texels,
    with_the_truths_tangents,
)

Array = NDArray[np.float64]

# Texels of which singular values are computed.
MATRIX_TEXELS = 2000
# Components in the plots, and pixels that a texel of a map takes.
MOST_COMPONENTS, ENLARGEMENT = 40, 3
# Largest error in the maps, degrees.
SHOWN_ERROR = 3.0
UNALIGNED, SEARCHED, REFINED = "not aligned", "aligned, search alone", "aligned and refined"


class Recovered(NamedTuple):
    """True frames and those recovered, by the stage of the method."""

    shape: tuple[int, int]
    truth: Array
    frames: dict[str, Array]


@lru_cache(maxsize=2)
def recovered(width: int, height: int, n_threads: int) -> Recovered:
    """Frames of the scene after search and refinement; kept for the next figure."""
    truth, d = relief_frames(width, height), dome_directions()
    samples = sample_texels(truth, d, d)
    frames = {UNALIGNED: np.tile(np.eye(3), (len(truth), 1, 1))}
    for name, refine in ((SEARCHED, False), (REFINED, True)):
        result = align(samples, d, d, refine=refine, n_threads=n_threads)
        frames[name] = with_the_truths_tangents(result.local_from_base, truth)
    return Recovered((height, width), truth, frames)


def matrices(some: Recovered, rows: NDArray[np.intp]) -> dict[str, NDArray[np.float32]]:
    """Data matrices (texels, pairs of directions), the material seen in each set of frames.

    It is sampled from the directions of the recovered frames, so that components tell the
    error of the frames and nothing else.
    """
    d = dome_directions()
    out = {}
    for name, frames in some.frames.items():
        local = np.matmul(d @ frames[rows], np.swapaxes(some.truth[rows], 1, 2))
        parts = [
            ashikhmin_shirley(part, part).astype(np.float32).reshape(len(part), -1)
            for part in np.array_split(local, max(1, len(local) // 128))
        ]
        out[name] = np.concatenate(parts)
    return out


def singular_values(matrix: NDArray[np.floating]) -> Array:
    """Of a matrix with few rows, largest first."""
    wide = matrix.astype(np.float64)
    return np.sqrt(np.linalg.eigvalsh(wide @ wide.T)[::-1].clip(0))


def energy_left(values: Array) -> Array:
    """Share of the energy that 1, 2, .. components leave."""
    return 1.0 - np.cumsum(values**2) / np.sum(values**2)


def equal_components(unaligned: Array, aligned: Array, n: int = 2) -> int:
    """How many unaligned components leave no more energy than n aligned ones."""
    return int(np.argmax(energy_left(unaligned) <= energy_left(aligned)[n - 1])) + 1


def figure_4(some: Recovered) -> Section:
    """The data matrix before and after."""
    height, width = some.shape
    line = height // 2
    shown = matrices(some, np.arange(line * width, (line + 1) * width))
    top = float(np.percentile(shown[UNALIGNED], 99.5))
    n = len(dome_directions())
    panels = []
    for name in (UNALIGNED, REFINED):
        grey = np.sqrt((shown[name].T / top).clip(0, 1))
        for part, label in (
            (grey[:: max(1, len(grey) // 600)], "whole column"),
            (grey[30 * n : 33 * n], "three of the views"),
        ):
            picture = encode_picture(false_colour(part, 0, 1, "gray"))
            panels.append(Panel(picture, f"{name}: {label}"))
    caption = (
        "One line of the map: texels from left to right, views and lights from top to bottom. "
        "In the paper diagonal features become almost perfect horizontal ones; here, too."
    )
    return Section(
        "Figure 4: the data matrix",
        "Features of the reflectance line up once every texel is sampled in its own frame.",
        (Figure(tuple(panels), caption, min_width=300),),
    )


def figure_5(some: Recovered) -> Section:
    """Singular values before and after."""
    rows = np.unique(np.linspace(0, len(some.truth) - 1, MATRIX_TEXELS).astype(np.intp))
    values = {name: singular_values(one) for name, one in matrices(some, rows).items()}
    count = min(MOST_COMPONENTS, len(rows))
    axis = np.arange(1, count + 1)
    plot = lines(
        {name: (axis, one[:count] / one[0]) for name, one in values.items()},
        "component",
        "singular value over the largest",
        log_y=True,
    )
    table = Table(
        ("frames", "energy left by 2 components", "unaligned components that leave as little"),
        (
            ("the paper's", None, 20),
            *(
                (
                    name,
                    float(energy_left(values[name])[1]),
                    equal_components(values[UNALIGNED], values[name]),
                )
                for name in (SEARCHED, REFINED)
            ),
        ),
        "Two aligned components against unaligned ones",
    )
    return Section(
        "Figure 5: singular values of the synthetic scene",
        "Aligned columns need far fewer components. The paper reports 20 unaligned ones for "
        "what 2 aligned ones reach.",
        (Figure((Panel(plot),), "Steeper is better.", min_width=420), table),
    )


def figure_6(some: Recovered) -> Section:
    """Normal maps, true and recovered, and their errors."""
    shape, panels = some.shape, [_normals(some.truth, some.shape, "true normals")]
    rows: list[tuple[Cell, ...]] = []
    for name in (SEARCHED, REFINED):
        frames = some.frames[name]
        normals, tangents = frame_errors(frames, some.truth)
        panels.append(_normals(frames, shape, name))
        error = false_colour(normals.reshape(shape), 0, SHOWN_ERROR)
        panels.append(
            Panel(encode_picture(enlarged(error, ENLARGEMENT), lossless=True), "its error")
        )
        row = (normals.mean(), np.percentile(normals, 95), tangents.mean())
        rows.append((name, *map(float, row)))
    table = Table(
        ("frames", "normals, mean", "95 % of normals below", "tangents, mean"),
        tuple(rows),
        "Errors in degrees; the paper gives none",
    )
    caption = "The paper shows that its map looks like the original; here the error, too."
    bar = ColourBar("viridis", 0, SHOWN_ERROR, "error of the normal, degrees")
    return Section(
        "Figure 6: the normal map",
        "Normals recovered from reflectance alone.",
        (Figure(tuple(panels), caption, colour_bar=bar, min_width=300), table),
    )


def _normals(frames: Array, shape: tuple[int, int], label: str) -> Panel:
    coloured = directions_coloured(frames[:, 2].reshape(*shape, 3))
    return Panel(encode_picture(enlarged(coloured, ENLARGEMENT), lossless=True), label)
