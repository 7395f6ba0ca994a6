r"""Samples of texels, transformed for the factorization, with directions in their own frames.

The transform is the cube root by default. Samples are divided by the softened cosine of the
light before, and stand between the nodes of the hemisphere grids of each texel's frame: a few
nodes and weights (taps) per direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.sphere.hemisphere import HORIZON_SOFTNESS, HemisphereGrid, softened_cosine

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
Channels = NDArray[np.uint8]
Directions = TypeVar("Directions", NDArray[np.float32], NDArray[np.float64])

POWERS = {"cube_root": 3.0, "square_root": 2.0, "linear": 1.0}
# A view this far below a texel's frame (sine of 12 degrees) tells of another surface.
LOWEST_VIEW = -0.2


def transform(values: NDArray[np.floating], domain: str) -> NDArray[np.floating]:
    """Transform samples into the domain of the factorization; the sign is kept.

    Examples
    --------
    >>> transform(np.array([8.0, -8.0]), "cube_root")
    array([ 2., -2.])
    >>> transform(np.array([9.0, -9.0]), "square_root")
    array([ 3., -3.])
    """
    if domain == "linear":
        return values
    if domain == "cube_root":
        return np.cbrt(values)
    return np.sign(values) * np.sqrt(np.abs(values))


def inverse_transform(values: NDArray[np.floating], domain: str) -> NDArray[np.floating]:
    """Inverse of `transform`.

    Examples
    --------
    >>> inverse_transform(np.array([2.0, -2.0]), "cube_root")
    array([ 8., -8.])
    >>> inverse_transform(np.array([-3.0]), "square_root")
    array([-9.])
    """
    if domain == "linear":
        return values
    if domain == "cube_root":
        return values**3
    return values * np.abs(values)


@dataclass(frozen=True, eq=False)
class TexelSamples:
    """Samples of some texels with their directions, as the resampling takes them.

    Parameters
    ----------
    samples : (n, n_photographs, 3) float
        Radiance over facing irradiance, over `unit`.
    views, lights : (n, n_directions, 3) float32
        Unit directions in the world frame.
    view_seen, light_seen : (n, n_directions) bool
        Which count.
    pairs : PhotographedPairs
        View and light of each photograph.
    unit : float
        What the samples are in, 1/sr.
    has_gaps : bool
        Whether values of samples that count may be NaN: not measured.
    """

    samples: NDArray[np.floating]
    views: Floats
    lights: Floats
    view_seen: Bools
    light_seen: Bools
    pairs: PhotographedPairs
    unit: float = 1.0
    has_gaps: bool = True

    @property
    def seen(self) -> Bools:
        """(n, n_photographs) True where the texel is seen and lit."""
        return self.pairs.both(self.view_seen, self.light_seen)


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


# Bits of `TransformedSamples.channels`, and all of them.
CHANNEL_BITS = np.array([1, 2, 4], np.uint8)
ALL_CHANNELS = 7


def all_channels() -> Channels:
    """What stands for texels of which every channel was measured."""
    return np.zeros((0, 0, 0), np.uint8)


@dataclass(frozen=True, eq=False)
class TransformedSamples:
    """Transformed samples with interpolation taps and weights in the texels' frames.

    Parameters
    ----------
    values : (n, n_views, n_lights, 3) float32
        Transformed samples over softened cosine; zero where they do not count.
    view_taps, light_taps : tuple of ((n, k, 4) int32, (n, k, 4) float32)
        Nodes and weights.
    view_weights, light_weights : (n, k) float32
        What a sample weighs is the product of the two and of its pair.
    pairs : (n_views, n_lights) float32
        1 where photographed.
    channels : (n, n_views, n_lights) uint8, optional
        Bit c is set where channel c was measured; without texels: all, as in most captures.
    """

    values: Floats
    view_taps: tuple[NDArray[np.int32], Floats]
    light_taps: tuple[NDArray[np.int32], Floats]
    view_weights: Floats
    light_weights: Floats
    pairs: Floats
    channels: Channels = field(default_factory=all_channels)

    @property
    def has_gaps(self) -> bool:
        """Whether some channel was not measured."""
        return len(self.channels) > 0

    def measured(self) -> Bools:
        """(n, n_views, n_lights, 3) which channels were measured."""
        if not self.has_gaps:
            return np.ones(self.values.shape, np.bool_)
        return (self.channels[..., None] & CHANNEL_BITS) > 0


def transformed_samples(
    texels: TexelSamples, local_from_world: Floats, sides: tuple[int, int], domain: str
) -> TransformedSamples:
    """Transform samples and find their taps in the texels' frames.

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
    TransformedSamples

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
    # A third of the samples count at a dome: only these are transformed.
    t, photograph = np.nonzero(texels.pairs.both(view_seen, light_seen))
    i, j = texels.pairs.view[photograph], texels.pairs.light[photograph]
    values = np.zeros((*view_seen.shape, light_seen.shape[1], 3), np.float32)
    ratio = texels.samples[t, photograph].astype(np.float32) * np.float32(texels.unit)
    ratio /= safe[t, j][:, None]
    channels = all_channels()
    unmeasured = np.isnan(ratio) if texels.has_gaps else np.zeros(0, np.bool_)
    if unmeasured.any():
        channels = np.zeros(values.shape[:3], np.uint8)
        channels[t, i, j] = ~unmeasured @ CHANNEL_BITS
        ratio[unmeasured] = 0.0
    values[t, i, j] = transform(ratio, domain)
    return TransformedSamples(
        values=values,
        view_taps=direction_taps(view, sides[0]),
        light_taps=direction_taps(light, sides[1]),
        view_weights=view_seen.astype(np.float32),
        light_weights=light_seen * safe ** np.float32(2.0 / POWERS[domain]),
        pairs=texels.pairs.table.astype(np.float32),
        channels=channels,
    )


def above_horizon(
    view_seen: Bools, light_seen: Bools, view: Floats, light: Floats, sides: tuple[int, int]
) -> tuple[Bools, Bools]:
    """Which seen views and lights count in the texels' frames; see `transformed_samples`.

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
