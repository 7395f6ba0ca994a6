"""Pixels of one view as weighted sums of the texels under them.

A saturated value says that the pixel is at least as bright. Its residual counts where the model
is darker than that, and is zero where it is brighter: else highlights, whose middles no
photograph holds, would be fitted to their rims alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.clipping import MEASURED, SATURATED
from reflfield.capture.lights import Light, facing_irradiance
from reflfield.field.half_vector import HalfVectorModel
from reflfield.fitting.pixel_kernels import (
    N_ROTATIONS,
    add_to_unknowns,
    derive,
    mark_used,
    start_step,
    texels_shown,
    weigh_through_pixels,
)
from reflfield.render.camera_rays import FieldSurface, subpixel_offsets

Floats = NDArray[np.float32]
Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Rays through a pixel, along each axis three.
RAYS_PER_PIXEL = 9
# Least coverage of a pixel by the silhouette, and by the surface seen from its front.
LEAST_COVERAGE = 0.99
# A pixel that shows texels at a smaller cosine with more than so much of its area is left out.
GRAZING_COSINE, GRAZING_SHARE = 0.12, 0.05
PIXELS_AT_ONCE = 4096


@dataclass(frozen=True, eq=False)
class Footprint:
    """Texels under the usable pixels of a view.

    Parameters
    ----------
    pixels : (n_pixels, 2) int
        Row and column.
    first : (n_pixels + 1,) int64
        First entry of each pixel.
    texel : (n_entries,) int32
    share : (n_entries,) float32
        Of the pixel; they sum to 1.
    """

    pixels: NDArray[np.int64]
    first: NDArray[np.int64]
    texel: NDArray[np.int32]
    share: Floats


def footprint_of(
    surface: FieldSurface, camera: Camera, usable: Bools, positions: Array, normals: Floats
) -> Footprint:
    """Texels under the pixels that the surface covers, not at a grazing angle.

    Parameters
    ----------
    surface : FieldSurface
    camera : Camera
    usable : (height, width) bool
        Pixels that may be taken.
    positions, normals : (n_texels, 3) float
        Of the texels.
    """
    rows, columns = np.nonzero(usable)
    on_surface = (surface, camera, positions, normals)
    parts = [
        _footprint_part(*on_surface, rows[first:end], columns[first:end])
        for first in range(0, len(rows), PIXELS_AT_ONCE)
        for end in [first + PIXELS_AT_ONCE]
    ]
    if not parts:
        return Footprint(
            np.zeros((0, 2), np.int64),
            np.zeros(1, np.int64),
            np.zeros(0, np.int32),
            np.zeros(0, np.float32),
        )
    pixels, counts, texel, share = (
        np.concatenate(arrays) for arrays in zip(*parts, strict=True)
    )
    return Footprint(pixels, np.append(0, np.cumsum(counts)).astype(np.int64), texel, share)


def _footprint_part(
    surface: FieldSurface,
    camera: Camera,
    positions: Array,
    normals: Floats,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32], Floats]:
    """Pixels that may be used, number of their entries, and texel and share of each entry."""
    at = np.stack([rows, columns], axis=1)
    points = at[:, None, ::-1] + subpixel_offsets(RAYS_PER_PIXEL)
    hits = surface.first_hits(*surface.camera_rays(camera, points.reshape(-1, 2)))
    pixel = hits.ray // RAYS_PER_PIXEL
    transition = surface.transitions(camera, hits, RAYS_PER_PIXEL)
    entries = surface.footprints(hits, pixel, transition)
    pixel, texel = entries.pixel, entries.texel
    weight = entries.summed(hits.front.astype(np.float32))
    covered = np.bincount(pixel, weight, minlength=len(at))
    share = weight / np.maximum(covered, 1e-9)[pixel]
    towards = camera.view_directions(positions[texel])
    cosine = np.einsum("nd,nd->n", towards, normals[texel])
    grazing = np.bincount(pixel, share * (cosine < GRAZING_COSINE), minlength=len(at))
    usable = (covered >= LEAST_COVERAGE * RAYS_PER_PIXEL) & (grazing < GRAZING_SHARE)
    kept = (share > 0) & usable[pixel]
    counts = np.bincount(pixel[kept], minlength=len(at))
    return (
        at[counts > 0],
        counts[counts > 0],
        texel[kept].astype(np.int32),
        share[kept].astype(np.float32),
    )


@dataclass(frozen=True, eq=False)
class ViewPixels:
    """Measured pixels of one view, with the texels under them.

    Parameters
    ----------
    texels : (m,) int32
        Seen by the view, ascending.
    first : (n_pixels + 1,) int64
        First entry of each pixel.
    entry : (n_entries,) int32
        Row in `texels`.
    share : (n_entries,) float32
    values : (n_pixels, n_lights, 3) float32
        Radiance over irradiance, in units of white; NaN where not to be used.
    at_least : (n_pixels, n_lights, 3) bool
        True where a value is a bound from below: the pixel is saturated.
    views : (m, 3) float32
    lights : (m, n_lights, 3) float32
        Unit directions from each texel, world frame.
    """

    texels: NDArray[np.int32]
    first: NDArray[np.int64]
    entry: NDArray[np.int32]
    share: Floats
    values: Floats
    at_least: Bools
    views: Floats
    lights: Floats

    @property
    def n_used(self) -> int:
        """Values that count, all channels of one as one."""
        return int(np.count_nonzero(~np.isnan(self.values).all(axis=2)))

    @property
    def n_bounds(self) -> int:
        """Values that are bounds from below."""
        return int(np.count_nonzero(~np.isnan(self.values[self.at_least])))


def view_pixels(
    capture: Capture,
    view: int,
    shown: NDArray[np.intp],
    footprint: Footprint,
    positions: Array,
    reliable: Bools,
    white: float,
) -> ViewPixels:
    """Read the photographs of a view at the pixels of a footprint.

    Parameters
    ----------
    capture : Capture
    view : int
    shown : (n_lights,) int
        Lights whose photographs are read.
    footprint : Footprint
    positions : (n_texels, 3) float64
    reliable : (n_texels, n_lights) bool
        Lights that reach the texel and its surroundings.
    white : float
        What 1 stands for, 1/sr.
    """
    photographs = capture.photograph_index[view]
    seen = np.zeros(len(positions), np.bool_)
    seen[footprint.texel] = True
    texels = np.flatnonzero(seen)
    values = np.full((len(footprint.pixels), len(shown), 3), np.nan, np.float32)
    at_least = np.zeros(values.shape, np.bool_)
    lights = tuple(capture.lights[i] for i in shown)
    if len(values):
        irradiance, lit = _arriving(footprint, lights, positions, reliable[:, shown])
        row, column = footprint.pixels.T
        for i, photograph in enumerate(photographs[shown]):
            image, kinds = capture.read_kinds(int(photograph))
            value = image[row, column] / (irradiance[:, i] * np.float32(white))
            kind = kinds[row, column]
            at_least[:, i] = kind == SATURATED
            known = (kind == MEASURED) | at_least[:, i]
            good = known & lit[:, [i]] & (irradiance[:, i] > 0)
            values[:, i] = np.where(good, value, np.float32(np.nan))
    points = positions[texels]
    directions = [light.directions(points) for light in lights]
    return ViewPixels(
        texels=texels.astype(np.int32),
        first=footprint.first,
        entry=(np.cumsum(seen, dtype=np.int32) - 1)[footprint.texel],
        share=footprint.share,
        values=values,
        at_least=at_least,
        views=capture.cameras[view].view_directions(points).astype(np.float32),
        lights=np.stack(directions, axis=1).astype(np.float32),
    )


def _arriving(
    footprint: Footprint, lights: tuple[Light, ...], positions: Array, reliable: Bools
) -> tuple[Floats, Bools]:
    """Irradiance (n_pixels, n_lights, 3) at each pixel's point, and which lights reach it."""
    irradiance, lit = [], []
    for first in range(0, len(footprint.pixels), PIXELS_AT_ONCE):
        ends = footprint.first[first : first + PIXELS_AT_ONCE + 1]
        texel = footprint.texel[ends[0] : ends[-1]]
        share, starts = footprint.share[ends[0] : ends[-1]], ends[:-1] - ends[0]
        points = np.add.reduceat(positions[texel] * share[:, None], starts)
        irradiance.append(facing_irradiance(lights, points).astype(np.float32))
        lit.append(np.logical_and.reduceat(reliable[texel], starts))
    return np.concatenate(irradiance), np.concatenate(lit)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Derivatives of the samples of a view's texels by their unknowns.

    Parameters
    ----------
    diffuse : (m, n_lights) float32
        By the diffuse colour, the same for all channels.
    others : (m, K + 3, n_lights, 3) float32
        By the weights of the lobes, then by rotations about the texel's axes; channels last.
    weight : (n_pixels, n_lights, 3) float32
        Of the squared residual of each value; 0 where it does not count.
    """

    diffuse: Floats
    others: Floats
    weight: Floats

    @property
    def by_unknowns(self) -> tuple[Floats, Floats]:
        """Derivatives as the kernels of products take them, lights and channels as one."""
        return self.diffuse, self.others.reshape(*self.others.shape[:2], -1)


@dataclass(frozen=True, eq=False)
class PixelStart:
    """Where a Gauss-Newton step begins in one view.

    Parameters
    ----------
    system : Linearisation
    right, diagonal : (m, 3 + K + 3) float32
    squares : float
        Sum of the weighted squared residuals.
    count : int
        Of the values that count.
    """

    system: Linearisation
    right: Floats
    diagonal: Floats
    squares: float
    count: int


def _geometry(pixels: ViewPixels) -> tuple[Any, Any, Any]:
    return pixels.first, pixels.entry, pixels.share


def _of_lights(values: NDArray[Any]) -> NDArray[Any]:
    """Lights and channels as one axis."""
    return values.reshape(len(values), values.shape[1] * 3)


def _zeros_of_texels(system: Linearisation) -> Floats:
    """One number of each texel, light and channel, (m, n_lights * 3)."""
    m, n_lights = system.diffuse.shape
    return np.zeros((m, 3 * n_lights), np.float32)


def linearised(
    pixels: ViewPixels, model: HalfVectorModel, arrays: Sequence[Floats]
) -> PixelStart:
    """Derivatives, weights and right side of one view's pixels about a model.

    Parameters
    ----------
    pixels : ViewPixels
    model : HalfVectorModel
    arrays : sequence of ndarray
        Of `Linearisation`, zero, written in place; shapes by `linearisation_shapes`.
    """
    system = Linearisation(*arrays)
    used = np.zeros(pixels.lights.shape[:2], np.bool_)
    mark_used(_geometry(pixels), pixels.values, used)
    by_unknowns = (system.diffuse, system.others)
    derive(pixels.texels, pixels.views, pixels.lights, used, model.arrays, by_unknowns)
    x = np.zeros((len(pixels.texels), 3 + model.n_lobes + N_ROTATIONS), np.float32)
    x[:, :3] = model.diffuse[pixels.texels]
    x[:, 3 : 3 + model.n_lobes] = model.weights[pixels.texels]
    shown, residuals, squares = (_zeros_of_texels(system) for _ in range(3))
    texels_shown(x, *system.by_unknowns, shown)
    observed = _of_lights(pixels.values), _of_lights(pixels.at_least)
    error, count = start_step(
        _geometry(pixels), observed, shown, _of_lights(system.weight), (residuals, squares)
    )
    right, diagonal = np.zeros_like(x), np.zeros_like(x)
    add_to_unknowns(residuals, *system.by_unknowns, 1, right)
    add_to_unknowns(squares, *system.by_unknowns, 2, diagonal)
    return PixelStart(system, right, diagonal, error, count)


def linearisation_shapes(pixels: ViewPixels, n_lobes: int) -> tuple[tuple[int, ...], ...]:
    """Shapes of the arrays of a `Linearisation`."""
    m, n = pixels.lights.shape[:2]
    return (m, n), (m, n_lobes + N_ROTATIONS, n, 3), pixels.values.shape


def normal_product(pixels: ViewPixels, system: Linearisation, x: Floats) -> Floats:
    """A^T W A x of one view, (m, 3 + K + 3) float32."""
    shown, weighed = _zeros_of_texels(system), _zeros_of_texels(system)
    texels_shown(x, *system.by_unknowns, shown)
    weigh_through_pixels(_geometry(pixels), _of_lights(system.weight), shown, weighed)
    y = np.zeros_like(x)
    add_to_unknowns(weighed, *system.by_unknowns, 1, y)
    return y
