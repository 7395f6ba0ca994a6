"""Captures and samples with known answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.capture import Capture
from reflfield.capture.lights import Light
from reflfield.capture.photographs import Photograph
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.store import create_samples
from reflfield.observations.texel_samples import TexelSamples, TransformedSamples
from reflfield.sphere.hemisphere import HemisphereGrid


def hemisphere(n_directions, lowest=0.1):
    """Directions on the upper hemisphere, evenly spread (spiral), z from 1 to `lowest`."""
    i = np.arange(n_directions) + 0.5
    z = 1 - (1 - lowest) * i / n_directions
    azimuth = i * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def dome(n_views, n_lights, *, lights=None, missing=()):
    """Cameras and point lights two metres from the origin; no files."""
    cameras = tuple(
        Camera(f"v{i}", "opencv", 64, 48, 60.0, 60.0, 32.0, 24.0,
               looking_at(2 * d, [0, 0, 0], [0, 1, 0]))
        for i, d in enumerate(hemisphere(n_views))
    )  # fmt: skip
    if lights is None:
        lights = tuple(
            Light(f"l{j}", "point", position=2 * d, intensity=[3, 2, 1])
            for j, d in enumerate(hemisphere(n_lights))
        )
    photographs = tuple(
        Photograph(f"v{i}_l{j}", i, j, ())
        for i in range(n_views)
        for j in range(n_lights)
        if (i, j) not in missing
    )
    return Capture("dome", Path("/"), cameras, lights, photographs)


def tilted_frames(rng, n):
    """Rotations (n, 3, 3) whose normals (last rows) lean less than about 25 degrees."""
    normal = np.array([0, 0, 1.0]) + 0.25 * rng.uniform(-1, 1, size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross(rng.normal(size=(n, 3)), normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([tangent, np.cross(normal, tangent), normal], axis=1).astype(np.float32)


def texel_samples(rng, n, n_views, n_lights, **changes):
    """Random samples of texels that see everything from directions above them."""
    arguments = {
        "samples": rng.random((n, n_views, n_lights, 3)).astype(np.float32),
        "views": np.tile(hemisphere(n_views), (n, 1, 1)).astype(np.float32),
        "lights": np.tile(hemisphere(n_lights), (n, 1, 1)).astype(np.float32),
        "view_seen": np.ones((n, n_views), bool),
        "light_seen": np.ones((n, n_lights), bool),
        "pairs": np.ones((n_views, n_lights), bool),
    }
    arguments |= changes
    pairs = PhotographedPairs.of_table(arguments["pairs"])
    samples = of_photographs(arguments["samples"], pairs)
    return TexelSamples(**(arguments | {"samples": samples, "pairs": pairs}))


def of_photographs(samples, pairs):
    """Of samples (n, n_views, n_lights, 3) those that were photographed, (n, n_pairs, 3)."""
    return samples[:, pairs.view, pairs.light]


def write_samples(location, capture, samples):
    """Store of samples (n, n_views, n_lights, 3), those that the capture has photographs of."""
    pairs = PhotographedPairs.of(capture)
    stored = create_samples(location, len(samples), pairs)
    stored[:] = of_photographs(samples, pairs).astype(np.float16)


def random_taps(rng, n, k, side):
    directions = rng.normal(size=(n * k, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    nodes, weights = HemisphereGrid(side).taps(directions)
    return nodes.reshape(n, k, 4), weights.reshape(n, k, 4)


def random_weights(rng, n, k):
    """A fifth zero, the others between 0.2 and 1."""
    return (rng.uniform(0.2, 1, (n, k)) * (rng.random((n, k)) < 0.8)).astype(np.float32)


def transformed(rng, n, n_views, n_lights, sides, *, pairs=None, values=None):
    """Transformed samples at random directions with random weights, a fifth of them zero."""
    if values is None:
        values = rng.normal(size=(n, n_views, n_lights, 3)).astype(np.float32)
    return TransformedSamples(
        values=values,
        view_taps=random_taps(rng, n, n_views, sides[0]),
        light_taps=random_taps(rng, n, n_lights, sides[1]),
        view_weights=random_weights(rng, n, n_views),
        light_weights=random_weights(rng, n, n_lights),
        pairs=np.ones((n_views, n_lights), np.float32) if pairs is None else pairs,
    )


def interpolated(samples, nodes):
    """Values of node functions (n, n_view_nodes, n_light_nodes, 3) at the samples' taps.

    Gathered tap by tap: shares nothing with the code under test.
    """
    n, k_views = samples.view_weights.shape
    k_lights = samples.light_weights.shape[1]
    out = np.zeros((n, k_views, k_lights, 3))
    texel = np.arange(n)[:, None, None]
    for v in range(4):
        for m in range(4):
            a = samples.view_taps[1][..., v].astype(float)
            b = samples.light_taps[1][..., m].astype(float)
            picked = nodes[
                texel,
                samples.view_taps[0][..., v][:, :, None],
                samples.light_taps[0][..., m][:, None, :],
            ]
            out += a[:, :, None, None] * b[:, None, :, None] * picked
    return out


def dense_interpolation(taps, side):
    """Interpolation matrices (n, k, n_nodes) in float64, one entry after the other."""
    nodes, weights = taps
    dense = np.zeros((*nodes.shape[:2], side * side))
    for index in np.ndindex(*nodes.shape):
        dense[index[0], index[1], nodes[index]] += weights[index]
    return dense


def smoothness_precision(side, smoothness):
    """Inverse prior covariance, neighbour by neighbour."""
    if side == 1:
        return np.full((1, 1), 1e-3 * smoothness)
    precision = 1e-3 * np.eye(side * side)
    for row in range(side):
        for column in range(side):
            for other in ((row + 1, column), (row, column + 1)):
                if max(other) < side:
                    a, b = row * side + column, other[0] * side + other[1]
                    edge = np.zeros(side * side)
                    edge[a], edge[b] = 1, -1
                    precision += np.outer(edge, edge)
    return smoothness * precision


def directions_at(*heights):
    """Unit directions (1, k, 3) of given z."""
    z = np.array(heights)
    return np.stack([np.sqrt(1 - z * z), 0 * z, z], axis=1)[None].astype(np.float32)


def identity(n):
    return np.tile(np.eye(3, dtype=np.float32), (n, 1, 1))
