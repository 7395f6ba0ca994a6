"""Small half-vector models and rows with known answers."""

import numpy as np
import pytest

from reflfield.field.half_vector import DIFFUSE_NODES, LOBE_NODES, SKEW_NODES, HalfVectorModel
from reflfield.fitting.table_fit import FREE_SKEWS


def unit(rng, *shape):
    vectors = rng.normal(size=(*shape, 3))
    vectors[..., 2] = np.abs(vectors[..., 2]) + 0.3
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def frames_about(rng, n, tilt=0.2):
    """Frames whose normals are near z."""
    normal = np.array([0.0, 0, 1]) + tilt * rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross(rng.normal(size=(n, 3)), normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([tangent, np.cross(normal, tangent), normal], axis=1).astype(np.float32)


def random_skews(rng, n_lobes, size=0.5):
    """Skews that are zero where there is no azimuth, as those that are fitted."""
    skews = rng.uniform(-size, size, (n_lobes, SKEW_NODES, 3)).astype(np.float32)
    skews[:, ~FREE_SKEWS] = 0
    return skews


def random_model(rng, n=5, n_lobes=2):
    return HalfVectorModel(
        frames=frames_about(rng, n),
        diffuse=rng.uniform(0.1, 1.0, (n, 3)).astype(np.float32),
        weights=rng.uniform(0.1, 1.0, (n, n_lobes)).astype(np.float32),
        lobes=rng.uniform(0.0, 1.0, (n_lobes, LOBE_NODES, 3)).astype(np.float32),
        skews=random_skews(rng, n_lobes),
        diffuse_table=rng.uniform(0.5, 1.5, DIFFUSE_NODES).astype(np.float32),
    )


@pytest.fixture
def small_rng():
    return np.random.default_rng(7)
