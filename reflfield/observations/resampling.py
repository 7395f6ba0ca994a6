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

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.sphere.hemisphere import HORIZON_SOFTNESS, HemisphereGrid, softened_cosine

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
Directions = TypeVar("Directions", NDArray[np.float32], NDArray[np.float64])

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
    """Samples into the domain of the factorization; the sign is kept.

    Examples
    --------
    >>> root(np.array([8.0, -8.0]), "cube_root"), root(np.array([9.0, -9.0]), "square_root")
    (array([ 2., -2.]), array([ 3., -3.]))
    """
    if domain == "linear":
        return values
    if domain == "cube_root":
        return np.cbrt(values)
    return np.sign(values) * np.sqrt(np.abs(values))


def unroot(values: NDArray[np.floating], domain: str) -> NDArray[np.floating]:
    """Inverse of `root`.

    Examples
    --------
    >>> unroot(np.array([2.0, -2.0]), "cube_root"), unroot(np.array([-3.0]), "square_root")
    (array([ 8., -8.]), array([-9.]))
    """
    if domain == "linear":
        return values
    if domain == "cube_root":
        return values**3
    return values * np.abs(values)


@lru_cache(maxsize=16)
def prior_covariance(side: int, smoothness: float) -> NDArray[np.float64]:
    """Covariance (n_nodes, n_nodes) of a smooth function on a hemisphere grid.

    The inverse of ``smoothness * (sum of squared differences between neighbours)
    + 1e-3 * smoothness``, in units of a sample's variance.

    Examples
    --------
    Two by two nodes: a constant has variance 1000 / 4 at each node, smoothness 1.

    >>> prior_covariance(2, 1.0).mean().round(3)
    np.float64(250.0)
    """
    if side == 1:
        return np.full((1, 1), 1e3 / smoothness, np.float64)
    node = np.arange(side * side).reshape(side, side)
    first = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
    second = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
    difference = np.zeros((len(first), side * side))
    rows = np.arange(len(first))
    difference[rows, first], difference[rows, second] = 1.0, -1.0
    precision = smoothness * (difference.T @ difference + 1e-3 * np.eye(side * side))
    return np.linalg.solve(precision, np.eye(side * side)).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Nodes:
    """Resampled texels.

    Parameters
    ----------
    values : (n, n_view_nodes, n_light_nodes, 3) float32
        In the domain, without the light's cosine; smooth continuation where not observed.
    view_support, light_support : (n, n_nodes) float32
        Share in [0, 1] to which each node was observed.
    pair_support : (n, n_view_nodes, n_light_nodes) float32, optional
        Summed interpolation weight of the pairs photographed; None where all were.
    """

    values: Floats
    view_support: Floats
    light_support: Floats
    pair_support: Floats | None = None

    @property
    def weights(self) -> Floats:
        """(n, n_view_nodes, n_light_nodes) share to which each pair of nodes is observed."""
        product = self.view_support[:, :, None] * self.light_support[:, None, :]
        return product if self.pair_support is None else np.minimum(product, self.pair_support)


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


def local_directions(local_from_world: Directions, directions: Directions) -> Directions:
    """Directions (n, k, 3) of the world in the texels' frames (n, 3, 3), in their precision.

    Examples
    --------
    A frame whose normal is +x of the world:

    >>> frame = np.array([[[0, 1, 0], [0, 0, 1], [1, 0, 0]]], np.float32)
    >>> local_directions(frame, np.array([[[1, 0, 0]]], np.float32))
    array([[[0., 0., 1.]]], dtype=float32)
    """
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

    Notes
    -----
    Views below `LOWEST_VIEW` and lights more than half the softened band below the
    texel's horizon do not count, where the direction varies.
    """
    view = local_directions(local_from_world, texels.views)
    light = local_directions(local_from_world, texels.lights)
    view_seen, light_seen = above_horizon(
        texels.view_seen, texels.light_seen, view, light, sides
    )
    cosine = np.ones(light.shape[:2], np.float32)
    if sides[1] > 1:
        cosine = softened_cosine(light[..., 2]).astype(np.float32)
    safe = np.where(light_seen, cosine, np.float32(1.0))
    ratio = texels.samples.astype(np.float32) / safe[:, None, :, None]
    return RootedSamples(
        values=root(ratio, domain),
        view_taps=direction_taps(view, sides[0]),
        light_taps=direction_taps(light, sides[1]),
        view_weights=view_seen.astype(np.float32),
        light_weights=light_seen * safe ** np.float32(2.0 / POWERS[domain]),
        pairs=texels.pairs.astype(np.float32),
    )


def above_horizon(
    view_seen: Bools, light_seen: Bools, view: Floats, light: Floats, sides: tuple[int, int]
) -> tuple[Bools, Bools]:
    """Which seen views and lights count in the texels' frames; see `rooted_samples`.

    Parameters
    ----------
    view_seen, light_seen : (n, k) bool
    view, light : (n, k, 3) float
        Directions in the texels' frames.
    sides : (int, int)
        1 for a direction that does not vary.

    Returns
    -------
    view_counts, light_counts : (n, k) bool
    """
    if sides[0] > 1:
        view_seen = view_seen & (view[..., 2] > LOWEST_VIEW)
    if sides[1] > 1:
        light_seen = light_seen & (light[..., 2] > -0.5 * HORIZON_SOFTNESS)
    return view_seen, light_seen


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
    were never photographed are filled from the fit, `FILLING_SWEEPS` times, and count as
    observed only as far as photographed ones lie near them.
    """
    from_views, view_support = _operator(
        rooted.view_taps, rooted.view_weights, sides[0], smoothness
    )
    from_lights, light_support = _operator(
        rooted.light_taps, rooted.light_weights, sides[1], smoothness
    )
    if rooted.pairs.all():
        nodes = apply_both(from_views, from_lights, rooted.values)
        return Nodes(nodes, view_support, light_support)
    to_views = interpolation_matrices(rooted.view_taps, sides[0])
    to_lights = interpolation_matrices(rooted.light_taps, sides[1])
    photographed = (rooted.pairs > 0)[None, :, :, None]
    values = np.where(photographed, rooted.values, _means(rooted)[:, None, None])
    for _ in range(FILLING_SWEEPS):
        nodes = apply_both(from_views, from_lights, values)
        values = np.where(photographed, values, apply_both(to_views, to_lights, nodes))
    nodes = apply_both(from_views, from_lights, values)
    support = _pair_support(rooted, to_views, to_lights)
    return Nodes(nodes, view_support, light_support, support)


def _means(rooted: RootedSamples) -> Floats:
    """Weighted mean (n, 3) of each texel's samples: where the filling starts."""
    weights = rooted.view_weights[:, :, None] * rooted.pairs * rooted.light_weights[:, None]
    total = np.einsum("tij,tijc->tc", weights, rooted.values)
    return total / np.maximum(weights.sum(axis=(1, 2)), np.float32(1e-6))[:, None]


def _pair_support(rooted: RootedSamples, to_views: Floats, to_lights: Floats) -> Floats:
    """Interpolation weight (n, n_view_nodes, n_light_nodes) of the pairs photographed."""
    seen = (rooted.view_weights > 0)[:, :, None] & (rooted.light_weights > 0)[:, None]
    counted = (seen * rooted.pairs)[..., None]
    support = apply_both(np.swapaxes(to_views, 1, 2), np.swapaxes(to_lights, 1, 2), counted)
    return np.where(support < LEAST_SUPPORT, np.float32(0), support)[..., 0]


def apply_both(left: Floats, right: Floats, values: Floats) -> Floats:
    """Products left @ values @ right^T for each texel and channel.

    Parameters
    ----------
    left : (n, a, b) float32
    right : (n, c, d) float32
    values : (n, b, d, n_channels) float32

    Returns
    -------
    (n, a, c, n_channels) float32

    Examples
    --------
    >>> left, right = np.ones((1, 1, 2)), np.full((1, 1, 3), 10.0)
    >>> apply_both(left, right, np.ones((1, 2, 3, 1))).ravel()
    array([60.])
    """
    n, a, b, c = values.shape
    halfway = (left @ values.reshape(n, a, b * c)).reshape(n, -1, b, c)
    # (n, nodes, b, c) -> contract b by batched GEMM with channels folded into rows.
    folded = np.swapaxes(halfway, 2, 3).reshape(n, -1, b) @ np.swapaxes(right, 1, 2)
    return np.swapaxes(folded.reshape(n, halfway.shape[1], c, -1), 2, 3)


def interpolation_matrices(taps: tuple[NDArray[np.int32], Floats], side: int) -> Floats:
    """Dense interpolation matrices (n, k, n_nodes) of taps (n, k, 4).

    Examples
    --------
    >>> zenith = np.array([[[0, 0, 1]]], np.float32)
    >>> interpolation_matrices(direction_taps(zenith, 3), 3).reshape(3, 3)
    array([[0., 0., 0.],
           [0., 1., 0.],
           [0., 0., 0.]], dtype=float32)
    """
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
    """Matrices (n, n_nodes, k) from samples to nodes, and the nodes' support.

    A constant may vary 1e5 times as much as a sample: in float32 the solve would lose
    three of seven digits.
    """
    interpolation = interpolation_matrices(taps, side)
    half = np.sqrt(weights)[:, :, None]
    weighted = (interpolation * half).astype(np.float64)
    spread = weighted @ prior_covariance(side, smoothness)
    system = spread @ np.swapaxes(weighted, 1, 2)
    diagonal = np.arange(weights.shape[1])
    system[:, diagonal, diagonal] += 1.0
    operator = np.linalg.solve(system, spread).astype(np.float32)
    support = np.minimum((interpolation * (weights > 0)[:, :, None]).sum(axis=1), 1.0)
    support[support < LEAST_SUPPORT] = 0.0
    return np.swapaxes(operator * half, 1, 2), support.astype(np.float32)
