"""Frames where only the light varies, as in RTI."""

import numpy as np
import pytest

from reflfield.alignment import align
from reflfield.alignment.frame_ambiguity import Symmetry, reduce_to_fundamental_zone
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.sphere.rotations import frames_from_normals

TOP = np.array([[0.0, 0.0, 1.0]])
RANK = 3


def glossy(normals, lights):
    """Isotropic: diffuse and a wide lobe, seen from above; (n, 1, n_lights)."""
    half = lights + TOP
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
    cosine = np.maximum((lights @ normals[:, :, None])[..., 0], 0.0)
    lobe = np.exp(((half @ normals[:, :, None])[..., 0] - 1.0) / 0.3)
    return (cosine * (0.2 + 0.3 * lobe))[:, None].astype(np.float32)


@pytest.fixture(scope="module")
def normals():
    slope = np.random.default_rng(3).normal(0.0, 0.25, (150, 2)).clip(-0.6, 0.6)
    tilted = np.concatenate([slope, np.ones((150, 1))], axis=1)
    return tilted / np.linalg.norm(tilted, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def aligned(normals):
    lights = HemisphereGrid(11).directions
    lights = lights[lights[:, 2] > 0.05]
    return align(glossy(normals, lights[None]), TOP, lights, max_tilt=1.0)


def left_over(frames, normals):
    """Share of the energy beyond some components, of samples under common local lights."""
    lights = HemisphereGrid(15).directions
    lights = lights[lights[:, 2] > 0.5]
    samples = glossy(normals, lights @ frames)[:, 0]
    energy = np.linalg.svd(samples, compute_uv=False) ** 2
    return energy[RANK:].sum() / energy.sum()


def test_the_view_lies_over_the_tangent_of_an_isotropic_texel(aligned, rounding):
    assert aligned.symmetries == ("all",)
    local_view = aligned.local_from_base[:, :, 2]
    assert np.abs(local_view[:, 1]).max() < rounding(float, operations=3)
    assert local_view[:, 0].min() >= 0.0
    assert np.linalg.norm(local_view[:, :2], axis=1).max() > 0.3


def test_frames_turned_to_the_view_take_fewer_components(aligned, normals):
    """What the turn is for: samples of all texels are alike but for the tilt."""
    truth = frames_from_normals(normals, np.tile([1.0, 0.0, 0.0], (len(normals), 1)))
    nearest = reduce_to_fundamental_zone(np.swapaxes(truth, 1, 2), Symmetry("all"))
    by_base = left_over(np.swapaxes(nearest, 1, 2), normals)
    azimuth = np.arctan2(truth[:, 1, 2], truth[:, 0, 2])
    cos, sin, zero = np.cos(azimuth), np.sin(azimuth), np.zeros(len(truth))
    about = np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1], axis=1)
    by_view = left_over(about.reshape(-1, 3, 3) @ truth, normals)
    # Measured: 4.6e-5 of exact frames nearest to the base, 3e-9 of exact ones turned to the
    # view; 5e-7 of those found, whose normals are some degrees off.
    assert by_view < 0.01 * by_base
    assert left_over(aligned.local_from_base, normals) < 0.1 * by_base
