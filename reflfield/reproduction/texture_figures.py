"""Figures 7 and 8 of the paper: a BTF on 151 x 151 directions, before and after alignment.

The paper's BTFs are not public. In their place stand a relief of one plastic-like material,
simulated on the same directions, and, where its folder is given, the measured felt of UBO2014,
of which only the mean over all texels is at hand: it is turned by the frames of the relief.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.alignment import align
from reflfield.report.page import Cell, Figure, Panel, Picture, Section, Table, encode_picture
from reflfield.report.pictures import enlarged, false_colour
from reflfield.report.plots import lines
from reflfield.reproduction import paper_forms
from reflfield.reproduction.measured_felt import Felt, read_felt
from reflfield.reproduction.paper_scene import (
    RINGS_151,
    ashikhmin_shirley,
    dome_directions,
    relief_frames,
    sample_texels,
)
from reflfield.reproduction.synthetic_figures import (
    REFINED,
    SEARCHED,
    UNALIGNED,
    energy_left,
    singular_values,
)
from reflfield.sphere.coupling import couple
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.util.progress import report, track

Array = NDArray[np.float64]
# Views and lights in the frames of texels to samples, (n, k, 3), (n, m, 3) to (n, k, m).
Material = Callable[[Array, Array], NDArray[np.float32]]

FACTORED = "aligned, Eq. 11 with K = 4 on the grid"
BRUTE = "aligned, exact series on the grid"
BAND_LIMIT, RANK = 8, 4
COMPARING = "maxima on the paper's grid"
# Nodes that aligned columns are sampled on, to be interpolated between.
SIDE, LEAST_Z = 13, 1e-3
COMPONENTS = (1, 2, 4, 8)
# Components of the pictures, and the view and light, of the dome's, that they show.
SHOWN_COMPONENTS, SHOWN_VIEW, SHOWN_LIGHT = 2, 20, 60
MOST_COMPONENTS, ENLARGEMENT = 40, 6
PLASTIC = {"nu": 40.0, "nv": 40.0, "diffuse": 0.15, "specular": 0.1}


class Texture(NamedTuple):
    """A BTF: samples of texels in a map, and what they are samples of."""

    name: str
    shape: tuple[int, int]
    directions: Array
    truth: Array
    material: Material
    samples: NDArray[np.float32]


def simulated_texture(width: int, height: int) -> Texture:
    """A relief of one glossy material on the 151 directions of the dome."""
    frames, d = relief_frames(width, height), dome_directions(RINGS_151)
    name = f"simulated relief, {width} x {height} texels"

    def material(views: Array, lights: Array) -> NDArray[np.float32]:
        return ashikhmin_shirley(views, lights, **PLASTIC).astype(np.float32)

    samples = sample_texels(frames, d, d, **PLASTIC)
    return Texture(name, (height, width), d, frames, material, samples)


def measured_texture(folder: Path, width: int, height: int) -> Texture:
    """The measured felt, turned by the frames of the relief."""
    directions, reflectance = read_felt(folder)
    felt, frames = Felt(directions, reflectance), relief_frames(width, height)
    blocks = np.array_split(np.arange(len(frames)), max(1, len(frames) // 64))
    samples = []
    for rows in blocks:
        local = np.einsum("nij,kj->nki", frames[rows], directions)
        samples.append(felt.samples(local, local))
    name = f"measured felt, turned by {width} x {height} known frames"
    whole = np.concatenate(samples)
    return Texture(name, (height, width), directions, frames, felt.samples, whole)


def frames_by_method(texture: Texture, n_threads: int) -> dict[str, Array]:
    """Frames by the paper's way, by the exact series on its grid, and by ours."""
    d, samples = texture.directions, texture.samples
    frames = {UNALIGNED: np.tile(np.eye(3), (len(samples), 1, 1))}
    for name, refine in ((SEARCHED, False), (REFINED, True)):
        result = align(samples, d, d, refine=refine, n_threads=n_threads)
        frames[name] = result.local_from_base
    report(COMPARING, 0, 3)
    projector = Projector(d, d, (BAND_LIMIT, BAND_LIMIT))
    coefficients = projector.project(samples)
    # Both sums over the grid against the target that the search has found: the mean of all
    # texels, each in its recovered frame.
    upright = _resampled(texture, frames[SEARCHED]).mean(axis=0)
    target = projector.project(upright[None].astype(np.float32))[0]
    report(COMPARING, 1, 3)
    grid = paper_forms.paper_grid(BAND_LIMIT)
    view, light = paper_forms.factors(coefficients, RANK)
    table = paper_forms.turn_target(target, RANK, grid)
    best = paper_forms.factored_maxima(view, light, table)
    frames[FACTORED] = np.swapaxes(grid[best], 1, 2)
    report(COMPARING, 2, 3)
    best = paper_forms.exact_maxima(couple(coefficients), couple(target[None]), grid)
    frames[BRUTE] = np.swapaxes(grid[best], 1, 2)
    report(COMPARING, 3, 3)
    return frames


def _resampled(texture: Texture, frames: Array) -> NDArray[np.float32]:
    """Samples (n, k, k) of the texels at the dome's directions in the given frames."""
    return _in_frames(texture, frames, texture.directions)


def _in_frames(texture: Texture, frames: Array, directions: Array) -> NDArray[np.float32]:
    """Samples of the texels at common directions of the given frames."""
    parts = []
    for rows in np.array_split(np.arange(len(frames)), max(1, len(frames) // 64)):
        local = np.matmul(directions @ frames[rows], np.swapaxes(texture.truth[rows], 1, 2))
        parts.append(texture.material(local, local))
    return np.concatenate(parts)


def figure_7(texture: Texture, frames: dict[str, Array]) -> Section:
    """Singular values of the data matrix by how frames were found."""
    curves: dict[str, tuple[ArrayLike, ArrayLike]] = {}
    rows: list[tuple[Cell, ...]] = []
    for name, one in track(frames.items(), len(frames), "singular values"):
        values = singular_values(_resampled(texture, one).reshape(len(one), -1))
        count = min(MOST_COMPONENTS, len(values))
        curves[name] = (np.arange(1, count + 1), values[:count] / values[0])
        left = energy_left(values)
        rows.append((name, *(float(np.sqrt(left[n - 1])) for n in COMPONENTS)))
    plot = lines(curves, "component", "singular value over the largest", log_y=True)
    table = Table(
        ("frames", *(f"{n} components" for n in COMPONENTS)),
        tuple(rows),
        "Root mean square error of so many components over that of none",
    )
    return Section(
        f"Figure 7: singular values, {texture.name}",
        "The paper: the improvement on a measured BTF is less dramatic than on the synthetic "
        "one, and its fast form is no worse than the sum by brute force.",
        (Figure((Panel(plot),), "Steeper is better.", min_width=420), table),
    )


def figure_8(texture: Texture, frames: dict[str, Array]) -> Section:
    """Extreme compression: pictures of so few components, with and without alignment."""
    d = texture.directions
    view, light = d[[SHOWN_VIEW]], d[[SHOWN_LIGHT]]
    truth = texture.samples[:, SHOWN_VIEW, SHOWN_LIGHT]
    pictures = {"all data": truth}
    rows: list[tuple[Cell, ...]] = []
    for name in (UNALIGNED, REFINED):
        pictures[name], error = compressed(texture, frames[name], view, light)
        rows.append((name, float(error), float(_relative(pictures[name], truth))))
    top = float(np.percentile(truth, 99.5))
    panels = tuple(
        Panel(_grey(values.reshape(texture.shape) / top), name)
        for name, values in pictures.items()
    )
    table = Table(
        ("frames", "error over all directions", "error of the picture"),
        tuple(rows),
        f"{SHOWN_COMPONENTS} components a texel, relative root mean square; aligned texels "
        "store three numbers of their frame besides",
    )
    caption = (
        "In the paper structure is drastically smoothed or disappears by compression alone, "
        "and most of it is kept after alignment."
    )
    return Section(
        f"Figure 8: extreme compression, {texture.name}",
        f"One view and light of the BTF from {SHOWN_COMPONENTS} components.",
        (Figure(panels, caption, min_width=240), table),
    )


def compressed(
    texture: Texture, frames: Array, view: Array, light: Array
) -> tuple[NDArray[np.float32], float]:
    """One picture from few components in the given frames, and the error on all directions."""
    grid = HemisphereGrid(SIDE)
    columns = _in_frames(texture, frames, _raised(grid.directions))
    n = len(columns)
    flat = columns.reshape(n, -1)
    mean = flat.mean(axis=0)
    centred = flat - mean
    _, vectors = np.linalg.eigh(centred.astype(np.float64) @ centred.T)
    kept = vectors[:, -SHOWN_COMPONENTS:].astype(np.float32)
    whole = (kept @ (kept.T @ centred) + mean).reshape(columns.shape)
    picture = _shown(grid, whole, frames @ view[0], frames @ light[0])
    return picture, _relative(whole, columns)


def _raised(directions: Array) -> Array:
    """Directions a little above the horizon: on it, rounding decides what is seen."""
    raised = directions + np.array([0.0, 0.0, LEAST_Z])
    return raised / np.linalg.norm(raised, axis=1, keepdims=True)


def _shown(
    grid: HemisphereGrid, columns: NDArray[np.float32], views: Array, lights: Array
) -> NDArray[np.float32]:
    """(n,) values of columns (n, nodes, nodes) at a view and a light of each texel."""
    (at_view, of_view), (at_light, of_light) = grid.taps(views), grid.taps(lights)
    texel = np.arange(len(columns))[:, None, None]
    corners = columns[texel, at_view[:, :, None], at_light[:, None, :]]
    above = (views[:, 2] > 0) & (lights[:, 2] > 0)
    return np.einsum("nvl,nv,nl->n", corners, of_view, of_light) * above


def _relative(values: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    difference = np.linalg.norm((values - truth).ravel())
    return float(difference / max(float(np.linalg.norm(truth.ravel())), 1e-300))


def _grey(values: NDArray[np.floating]) -> Picture:
    grey = false_colour(np.sqrt(values.clip(0, 1)), 0, 1, "gray")
    return encode_picture(enlarged(grey, ENLARGEMENT), lossless=True)
