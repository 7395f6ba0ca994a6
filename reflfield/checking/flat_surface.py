r"""Normals of a flat sample from its photographs, to check its lights with.

Photometric stereo (Woodham, 1980): under distant lights :math:`s_l` a matt point shows
:math:`y_l = s_l \cdot b`. Values that deviate most, highlights and shadows, lose their weight.

Normals of a surface have no curl: with :math:`p = -n_x / n_z`, :math:`q = -n_y / n_z`,
:math:`\partial p / \partial y = \partial q / \partial x`. Normals from lights in mirrored or
exchanged axes break this, except where both axes are mirrored, which turns hills into hollows.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.color_spaces import LUMINANCE
from reflfield.checking.findings import ERROR, Finding
from reflfield.checking.photograph_statistics import PhotographSet
from reflfield.checking.surface_samples import N_POINTS, SurfaceSamples, with_luminance
from reflfield.geometry.plane import on_plane

Array = NDArray[np.float64]

# Points along the longer side of the grid of normals.
GRID = 96
ROUNDS = 6
# Lights that determine normals, with some to spare.
FEWEST_LIGHTS = 6
# Correlations of derivatives of normals that tell axes apart.
PLAINLY_MIRRORED, LEAD = -0.25, 0.5


def flat_samples(
    capture: Capture, photographs: PhotographSet
) -> tuple[SurfaceSamples, Array] | None:
    """Samples of a flat surface with its normals, and the grid (rows, columns, 3) of these.

    None where too few lights are known.
    """
    grid = _grid(capture)
    points, places, shape = grid
    n_points = len(points)
    blank = SurfaceSamples(
        points,
        np.tile([0.0, 0.0, 1.0], (n_points, 1)),
        places[None],
        np.ones((1, n_points), bool),
        {},
        np.zeros((0, n_points)),
        np.zeros((0, n_points)),
    )
    dense = with_luminance(blank, capture, photographs, [0])
    indices = [i for i in dense.luminance if capture.lights[_light(capture, i)].known]
    if len({_light(capture, i) for i in indices}) < FEWEST_LIGHTS:
        return None
    values = np.array([dense.luminance[i] for i in indices], dtype=np.float64)
    vectors = np.array([_vectors(capture, _light(capture, i), points) for i in indices])
    towards_camera = 1.0 if capture.cameras[0].forward[2] < 0 else -1.0
    normals = _normals(values, vectors, towards_camera)
    some = slice(None, None, max(1, n_points // N_POINTS))
    kept = SurfaceSamples(
        points[some],
        normals[some],
        places[None, some],
        np.ones((1, len(points[some])), bool),
        {},
        *_lighting(capture, points[some], normals[some]),
    )
    return with_luminance(kept, capture, photographs, [0]), normals.reshape(*shape, 3)


def _light(capture: Capture, index: int) -> int:
    return capture.photographs[index].light


def _grid(capture: Capture) -> tuple[Array, NDArray[np.float32], tuple[int, int]]:
    """Points (n, 3), their places in the image, and rows and columns."""
    camera = capture.cameras[0]
    scale = min(1.0, GRID / max(camera.width, camera.height))
    rows, columns = max(2, int(camera.height * scale)), max(2, int(camera.width * scale))
    row, column = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    places = np.stack([column.ravel(), row.ravel()], axis=1)
    points = on_plane(camera, places * (camera.width, camera.height))
    return points, places.astype(np.float32), (rows, columns)


def _vectors(capture: Capture, light: int, points: Array) -> Array:
    """Directions (n, 3) to a light times its irradiance."""
    lamp = capture.lights[light]
    strength = lamp.irradiance(points) @ LUMINANCE
    vectors: Array = lamp.directions(points) * strength[:, None]
    return vectors


def _normals(values: Array, vectors: Array, up: float) -> Array:
    """Unit normals (n, 3) of points from their values (n_lights, n) under lights."""
    known = np.isfinite(values)
    values = np.where(known, values, 0.0)
    weight = known.astype(np.float64)
    product = np.zeros((values.shape[1], 3))
    for _ in range(ROUNDS):
        system = np.einsum("lp,lpi,lpj->pij", weight, vectors, vectors)
        right = np.einsum("lp,lpi,lp->pi", weight, vectors, values)
        trace = np.trace(system, axis1=1, axis2=2)
        system += np.maximum(1e-6 * trace, 1e-300)[:, None, None] * np.eye(3)
        product = np.linalg.solve(system, right[..., None])[..., 0]
        left = np.abs(values - np.einsum("lpi,pi->lp", vectors, product))
        usual = np.median(left, axis=0) + 1e-3 * values.max(axis=0) + 1e-300
        weight = known / (1 + np.square(left / (2 * usual)))
    length = np.linalg.norm(product, axis=1, keepdims=True)
    return np.where(length > 0, product / np.maximum(length, 1e-300), [0.0, 0.0, up])


def _lighting(capture: Capture, points: Array, normals: Array) -> tuple[Array, Array]:
    """Irradiance and cosine (n_lights, n) of points under all lights; no shadows."""
    irradiance = np.full((capture.n_lights, len(points)), np.nan)
    cosine = irradiance.copy()
    for number, light in enumerate(capture.lights):
        if light.known:
            cosine[number] = (light.directions(points) * normals).sum(axis=1)
            strength = light.irradiance(points) @ LUMINANCE
            irradiance[number] = strength * np.maximum(cosine[number], 0)
    return irradiance, cosine


def axes_findings(capture: Capture, normals: Array) -> Iterator[Finding]:
    """A finding on lights whose axes are mirrored or exchanged, by the curl of normals.

    Parameters
    ----------
    capture : Capture
    normals : (rows, columns, 3) float64
        Of a grid over the image.
    """
    straight, exchanged = _correlations(capture, normals)
    readings = {
        "one axis of the image plane is mirrored": -straight,
        "x and y are exchanged": exchanged,
        "x and y are exchanged and one of them is mirrored": -exchanged,
    }
    words, best = max(readings.items(), key=lambda item: item[1])
    if best < straight + LEAD or best < -PLAINLY_MIRRORED:
        return
    yield Finding(
        "axes of lights",
        ERROR,
        (),
        f"normals from the photographs are those of no surface as the lights are described "
        f"(derivatives correlate by {straight:.2f}), but are if {words} ({best:.2f})",
        "check the axes of the lights: x right, y up in the image, z to the camera",
        str(capture.description or ""),
    )


def _correlations(capture: Capture, normals: Array) -> tuple[float, float]:
    """Correlations of dp/dy with dq/dx, and of dq/dy with dp/dx."""
    right, up = capture.cameras[0].rotation[0], -capture.cameras[0].rotation[1]
    toward = np.abs(normals @ capture.cameras[0].forward)
    steep = toward < 0.25
    p, q = (-(normals @ axis) / np.maximum(toward, 0.25) for axis in (right, up))
    dp_dx, dq_dx = (np.gradient(field, axis=1) for field in (p, q))
    dp_dy, dq_dy = (-np.gradient(field, axis=0) for field in (p, q))
    return _correlation(dp_dy, dq_dx, ~steep), _correlation(dq_dy, dp_dx, ~steep)


def _correlation(first: Array, second: Array, known: NDArray[np.bool_]) -> float:
    """Correlation of two fields whose extreme values are cut off."""
    first, second = first[known], second[known]
    if first.size < 100:
        return 1.0
    cut = 3 * np.median(np.abs(np.concatenate([first, second]))) + 1e-12
    first, second = np.clip(first, -cut, cut), np.clip(second, -cut, cut)
    norm = np.sqrt(np.square(first).sum() * np.square(second).sum())
    return float((first * second).sum() / norm) if norm > 0 else 1.0
