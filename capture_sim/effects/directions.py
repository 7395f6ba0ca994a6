"""Random directions of light paths: cosine-distributed, or mirror images in microfacets.

The numbers are hashes of the point: the same whatever the order of work.

References
----------
E. Veach and L. J. Guibas, "Optimally combining sampling techniques for Monte Carlo
rendering", SIGGRAPH 1995 (the mixture of two densities).
M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018 (the stratified
first directions).
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from capture_sim.materials.analytic import ggx_density
from capture_sim.materials.base import SMALLEST_DENOMINATOR, half_vectors

Array = NDArray[np.float64]


def draw_directions(views: Array, lobes: Array, numbers: Array) -> tuple[Array, Array]:
    r"""Random directions for a point's BRDF, and their density.

    Where there is a lobe, half of the directions are mirror images of the viewer in
    microfacets of density :math:`D(h) h_z`, which makes theirs
    :math:`D(h) h_z / (4\, v \cdot h)`; all others are as dense as
    :math:`\cos\theta / \pi`.

    Parameters
    ----------
    views : (n, 3) float64
        Unit directions to the viewer, shading frame.
    lobes : (n, 2) float64
        From `Material.lobe`.
    numbers : (n, 3 or more) float64
        Independent and uniform in [0, 1).

    Returns
    -------
    outgoing : (n, 3) float64
        Unit directions, shading frame; may lie below the horizon.
    density : (n,) float64
        Per solid angle, > 0.

    Examples
    --------
    Straight up without a lobe: cos 0 / pi.

    >>> up, numbers = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, 0.9]])
    >>> draw_directions(up, np.zeros((1, 2)), numbers)[1].round(4)
    array([0.3183])
    """
    shiny = lobes[:, 0] > 0.0
    alphas = np.where(shiny[:, None], lobes, 1.0)
    outgoing = cosine_directions(numbers[:, :2])
    mirrored = shiny & (numbers[:, 2] < 0.5)
    halves = _microfacets(alphas[mirrored], numbers[mirrored, :2])
    facing = np.sum(views[mirrored] * halves, axis=1, keepdims=True)
    outgoing[mirrored] = 2.0 * facing * halves - views[mirrored]
    cosine_density = np.maximum(outgoing[:, 2], 0.0) / np.pi
    halves, cosine = half_vectors(views, outgoing)
    facets = ggx_density(halves, alphas)[:, 0] * np.abs(halves[:, 2])
    mirror_density = facets / np.maximum(4.0 * cosine[:, 0], SMALLEST_DENOMINATOR)
    mixed = 0.5 * (cosine_density + mirror_density)
    density = np.where(shiny, mixed, cosine_density)
    return outgoing, np.maximum(density, SMALLEST_DENOMINATOR)


def _microfacets(alphas: Array, numbers: Array) -> Array:
    """Unit normals of density D(h) h_z of GGX: slopes stretched by the roughness."""
    slope = np.sqrt(numbers[:, 0] / (1.0 - numbers[:, 0]))
    azimuth = 2.0 * np.pi * numbers[:, 1]
    x, y = slope * np.cos(azimuth) * alphas[:, 0], slope * np.sin(azimuth) * alphas[:, 1]
    normals = np.stack([x, y, np.ones_like(x)], axis=1)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def cosine_directions(numbers: Array) -> Array:
    """Directions above the horizon, as dense as their cosine, from the unit square."""
    radius, azimuth = np.sqrt(numbers[:, 0]), 2.0 * np.pi * numbers[:, 1]
    height = np.sqrt(np.maximum(1.0 - numbers[:, 0], 0.0))
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)


_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
_Values = NDArray[Any]


@_compiled
def _mixed(state: Any) -> Any:
    """One step of the generator splitmix64."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@_compiled
def fill_numbers(
    keys: _Values, row: _Values, n_paths: int, bounce: int, numbers: _Values
) -> None:
    """Four numbers in [0, 1) for each path; the first three stratified on the first bounce."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    unit = 1.0 / 9007199254740992.0  # 2^-53
    for n in range(len(row)):
        state = np.uint64(bounce + 1)
        for c in range(keys.shape[1]):
            state = _mixed(state + golden + keys[row[n], c])
        path = row[n] % n_paths
        if bounce > 0:
            state = _mixed(state + golden * np.uint64(path + 1))
        for c in range(4):
            state = _mixed(state + golden)
            numbers[n, c] = np.float64(state >> np.uint64(11)) * unit
        if bounce == 0:
            # The R2 sequence of Roberts, turned by the point's own random offsets.
            numbers[n, 0] = (numbers[n, 0] + 0.7548776662466927 * path) % 1.0
            numbers[n, 1] = (numbers[n, 1] + 0.5698402909980532 * path) % 1.0
            # Paths of the two densities take turns; one without a partner draws its own.
            if path ^ 1 < n_paths:
                numbers[n, 2] = (0.5 * numbers[n, 2] + 0.5 * path) % 1.0
