r"""Scattered directions of each texel onto the common nodes of its own frame.

A texel sees the same lights from every camera that sees it, so its samples stand on
a product of directions and the least squares problem separates: with the prior
covariance P of a smooth function on the nodes (both directions alike),

.. math:: X = R_v Y R_l^\top, \quad R = P A^\top (A P A^\top + W^{-1})^{-1},

A being the interpolation from nodes to the texel's directions. Values are
resampled in the domain of the factorization (cube root by default) after division
by the softened cosine of the light.

A node counts as observed as far as directions actually seen lie near it
(`Nodes.weights`); what the prior continues beyond them carries weight 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.sphere.hemisphere import HORIZON_SOFTNESS, HemisphereGrid, softened_cosine

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]

POWERS = {"cube_root": 3.0, "square_root": 2.0, "linear": 1.0}

# A node with less than this summed interpolation weight was not observed.
LEAST_SUPPORT = 0.1
# Sweeps that fill pairs never photographed before the separable solve.
FILLING_SWEEPS = 4
# A view this far below a texel's frame (sine of 12 degrees) tells of another surface.
LOWEST_VIEW = -0.2


@dataclass(frozen=True)
class ResamplingOptions:
    """Grids and smoothness of the resampling.

    Parameters
    ----------
    view_side, light_side : int
        Nodes along each side of the two hemisphere grids. 0 chooses from the
        number of views or lights (`side_for`); directions that do not vary get 1.
    domain : {"cube_root", "square_root", "linear"}
        What is applied to samples before they are resampled and factored.
    smoothness : float
        Weight of the squared differences between neighbouring nodes against one sample.
    visibility : {"factored", "kept"}
        "factored": samples in cast shadow do not count and shadows are traced again when
        rendering. "kept": shadows are part of the data, as in the paper.
    """

    view_side: int = 0
    light_side: int = 0
    domain: str = "cube_root"
    smoothness: float = 0.03
    visibility: str = "factored"

    def __post_init__(self) -> None:
        for name in ("view_side", "light_side"):
            if not 0 <= getattr(self, name) <= 64:
                raise InputError(f"{name}: expected 0 to 64, received {getattr(self, name)}")
        if self.domain not in POWERS:
            known = list(POWERS)
            raise InputError(f"domain: expected one of {known}, received {self.domain!r}")
        if not self.smoothness > 0:
            raise InputError(f"smoothness: expected > 0, received {self.smoothness}")
        if self.visibility not in ("factored", "kept"):
            raise InputError(
                f"visibility: expected 'factored' or 'kept', received {self.visibility!r}"
            )


def side_for(n_directions: int) -> int:
    """Side of a grid about as dense as `n_directions` on the upper hemisphere.

    Odd, so that the zenith is a node; at least 5, at most 13.

    Examples
    --------
    >>> [side_for(n) for n in (1, 12, 32, 81, 151)]
    [1, 5, 7, 11, 13]
    """
    if n_directions <= 1:
        return 1
    return int(np.clip(int(1.2 * np.sqrt(n_directions)) | 1, 5, 13))


def root(values: NDArray[np.floating], domain: str) -> NDArray[np.floating]:
    """Samples into the domain of the factorization; the sign is kept."""
    if domain == "linear":
        return values
    if domain == "cube_root":
        return np.cbrt(values)
    return np.sign(values) * np.sqrt(np.abs(values))


def unroot(values: NDArray[np.floating], domain: str) -> NDArray[np.floating]:
    """Inverse of `root`."""
    if domain == "linear":
        return values
    if domain == "cube_root":
        return values**3
    return values * np.abs(values)


@lru_cache(maxsize=16)
def prior_covariance(side: int, smoothness: float) -> Floats:
    """Covariance (n_nodes, n_nodes) of a smooth function on a hemisphere grid.

    The inverse of ``smoothness * (sum of squared differences between neighbours)
    + 1e-3 * smoothness``, in units of a sample's variance.
    """
    if side == 1:
        return np.full((1, 1), 1e3 / smoothness, np.float32)
    node = np.arange(side * side).reshape(side, side)
    first = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
    second = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
    difference = np.zeros((len(first), side * side))
    rows = np.arange(len(first))
    difference[rows, first], difference[rows, second] = 1.0, -1.0
    precision = smoothness * (difference.T @ difference + 1e-3 * np.eye(side * side))
    return np.linalg.solve(precision, np.eye(side * side)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Nodes:
    """Resampled texels.

    Parameters
    ----------
    values : (n, n_view_nodes, n_light_nodes, 3) float32
        In the domain, without the light's cosine; smooth continuation where not observed.
    view_support, light_support : (n, n_nodes) float32
        Share in [0, 1] to which each node was observed.
    """

    values: Floats
    view_support: Floats
    light_support: Floats

    @property
    def weights(self) -> Floats:
        """(n, n_view_nodes, n_light_nodes) share to which each pair of nodes is observed."""
        return self.view_support[:, :, None] * self.light_support[:, None, :]


@dataclass(frozen=True, eq=False)
class TexelSamples:
    """Samples of some texels with their directions, as the resampling takes them.

    Parameters
    ----------
    samples : (n, n_views, n_lights, 3) float
        Radiance over facing irradiance.
    views, lights : (n, n_directions, 3) float32
        Unit directions in the world frame.
    view_seen, light_seen : (n, n_directions) bool
        Which count.
    pairs : (n_views, n_lights) bool
        Which were photographed.
    """

    samples: NDArray[np.floating]
    views: Floats
    lights: Floats
    view_seen: Bools
    light_seen: Bools
    pairs: Bools


def local_directions(local_from_world: Floats, directions: Floats) -> Floats:
    """Directions (n, k, 3) of the world in the texels' frames (n, 3, 3)."""
    return directions @ np.swapaxes(local_from_world, 1, 2)


@dataclass(frozen=True, eq=False)
class RootedSamples:
    """Samples in the domain with interpolation taps and weights in the texels' frames.

    Parameters
    ----------
    values : (n, n_views, n_lights, 3) float32
        Samples over softened cosine, in the domain.
    view_taps, light_taps : tuple of ((n, k, 4) int32, (n, k, 4) float32)
        Nodes and weights.
    view_weights, light_weights : (n, k) float32
        What a sample weighs is the product of the two and of its pair.
    pairs : (n_views, n_lights) float32
        1 where photographed.
    """

    values: Floats
    view_taps: tuple[NDArray[np.int32], Floats]
    light_taps: tuple[NDArray[np.int32], Floats]
    view_weights: Floats
    light_weights: Floats
    pairs: Floats


def rooted_samples(
    texels: TexelSamples, local_from_world: Floats, sides: tuple[int, int], domain: str
) -> RootedSamples:
    """Bring samples into the domain and find their taps in the texels' frames.

    A sample y = s D^-1(u) with cosine s; an error of D^-1(u) counts s times, so in the
    domain with power p the weight of u is ``s ** (2 / p)``.

    Parameters
    ----------
    texels : TexelSamples
    local_from_world : (n, 3, 3) float32
        Frames to resample in.
    sides : (int, int)
        Sides of the view and light grids; 1 for a direction that does not vary.
    domain : str

    Returns
    -------
    RootedSamples
    """
    view = local_directions(local_from_world, texels.views)
    light = local_directions(local_from_world, texels.lights)
    cosine = np.ones(light.shape[:2], np.float32)
    light_seen = texels.light_seen
    if sides[1] > 1:
        cosine = softened_cosine(light[..., 2]).astype(np.float32)
        light_seen = light_seen & (light[..., 2] > -0.5 * HORIZON_SOFTNESS)
    view_seen = texels.view_seen & (view[..., 2] > LOWEST_VIEW) if sides[0] > 1 else None
    safe = np.where(light_seen, cosine, np.float32(1.0))
    ratio = texels.samples.astype(np.float32) / safe[:, None, :, None]
    return RootedSamples(
        values=root(ratio, domain),
        view_taps=direction_taps(view, sides[0]),
        light_taps=direction_taps(light, sides[1]),
        view_weights=(texels.view_seen if view_seen is None else view_seen).astype(np.float32),
        light_weights=light_seen * safe ** np.float32(2.0 / POWERS[domain]),
        pairs=texels.pairs.astype(np.float32),
    )


def direction_taps(directions: Floats, side: int) -> tuple[NDArray[np.int32], Floats]:
    """Nodes and weights (n, k, 4) that interpolate at local directions (n, k, 3)."""
    nodes, weights = HemisphereGrid(side).taps(directions.reshape(-1, 3))
    shape = (*directions.shape[:2], 4)
    return nodes.reshape(shape), weights.reshape(shape)


def resample(rooted: RootedSamples, sides: tuple[int, int], smoothness: float) -> Nodes:
    """Smooth functions on the nodes that explain the samples, texel by texel.

    Parameters
    ----------
    rooted : RootedSamples
    sides : (int, int)
        Sides of the view and light grids.
    smoothness : float
        See `ResamplingOptions`.

    Returns
    -------
    Nodes

    Notes
    -----
    Two solves of the size of the number of views and of lights per texel. Pairs that
    were never photographed are filled from the fit, `FILLING_SWEEPS` times.
    """
    from_views, view_support = _operator(
        rooted.view_taps, rooted.view_weights, sides[0], smoothness
    )
    from_lights, light_support = _operator(
        rooted.light_taps, rooted.light_weights, sides[1], smoothness
    )
    values = rooted.values
    missing = rooted.pairs == 0
    to_views = interpolation_matrices(rooted.view_taps, sides[0])
    to_lights = interpolation_matrices(rooted.light_taps, sides[1])
    if missing.any():
        values = np.where(missing[None, :, :, None], np.float32(0), values)
        for _ in range(FILLING_SWEEPS):
            nodes = apply_both(from_views, from_lights, values)
            fitted = apply_both(to_views, to_lights, nodes)
            values = np.where(missing[None, :, :, None], fitted, values)
    return Nodes(apply_both(from_views, from_lights, values), view_support, light_support)


def apply_both(left: Floats, right: Floats, values: Floats) -> Floats:
    """Products left @ values @ right^T for each texel and channel."""
    n, a, b, c = values.shape
    halfway = (left @ values.reshape(n, a, b * c)).reshape(n, -1, b, c)
    # (n, nodes, b, c) -> contract b by batched GEMM with channels folded into rows.
    folded = np.swapaxes(halfway, 2, 3).reshape(n, -1, b) @ np.swapaxes(right, 1, 2)
    return np.swapaxes(folded.reshape(n, halfway.shape[1], c, -1), 2, 3)


def interpolation_matrices(taps: tuple[NDArray[np.int32], Floats], side: int) -> Floats:
    """Dense interpolation matrices (n, k, n_nodes)."""
    nodes, weights = taps
    n, k, _ = nodes.shape
    dense = np.zeros((n * k, side * side), np.float32)
    row = np.arange(n * k)
    for tap in range(4 if side > 1 else 1):
        dense[row, nodes[..., tap].ravel()] += weights[..., tap].ravel()
    return dense.reshape(n, k, side * side)


def _operator(
    taps: tuple[NDArray[np.int32], Floats], weights: Floats, side: int, smoothness: float
) -> tuple[Floats, Floats]:
    """Matrices (n, n_nodes, k) from samples to nodes, and the nodes' support."""
    interpolation = interpolation_matrices(taps, side)
    covariance = prior_covariance(side, smoothness)
    half = np.sqrt(weights)[:, :, None]
    weighted = interpolation * half
    spread = weighted @ covariance
    system = spread @ np.swapaxes(weighted, 1, 2) + np.eye(weights.shape[1], dtype=np.float32)
    operator = np.swapaxes(np.linalg.solve(system, spread), 1, 2)
    support = np.minimum((interpolation * (weights > 0)[:, :, None]).sum(axis=1), 1.0)
    support[support < LEAST_SUPPORT] = 0.0
    return operator * np.swapaxes(half, 1, 2), support.astype(np.float32)


def texel_blocks(
    n_texels: int, bytes_per_texel: int, budget: int = 128 << 20
) -> Iterator[slice]:
    """Slices of texels of which a block's working memory stays below `budget` bytes."""
    step = int(np.clip(budget // max(bytes_per_texel, 1), 16, 4096))
    for first in range(0, n_texels, step):
        yield slice(first, min(first + step, n_texels))
