"""Matrices with known answers: low rank, gaps shaped like occlusion, clusters of subspaces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Problem(NamedTuple):
    """A matrix of low rank, what was measured of it, and where."""

    truth: np.ndarray
    measured: np.ndarray
    observed: np.ndarray


def hemisphere(n_directions):
    """Directions on the upper hemisphere, evenly spread (spiral), z from 1 to 0.05."""
    i = np.arange(n_directions) + 0.5
    z = 1 - 0.95 * i / n_directions
    azimuth = i * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def hemispheric(n_directions, n_columns, rng, horizon=0.1):
    """True where a tilted texel sees both view and light above `horizon` (cosine)."""
    normals = rng.standard_normal((n_columns, 3))
    normals[:, 2] = np.abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    above = hemisphere(n_directions) @ normals.T > horizon
    return (above[:, None, :] & above[None, :, :]).reshape(n_directions**2, n_columns)


def smooth_rows(n_directions, rank, rng):
    """Rows (view, light) of products of linear functions of the two directions."""
    linear = np.column_stack([np.ones(n_directions), hemisphere(n_directions)])
    mixing = rng.standard_normal((4, 4, rank))
    return np.einsum("va,lb,abr->vlr", linear, linear, mixing).reshape(-1, rank)


def problem(pattern, rng, *, n_directions=31, n_columns=600, rank=6, noise=0.01, horizon=0.1):
    """A truth of unit variance; `pattern` is "random", "hemispheric" or "smooth"."""
    n_rows = n_directions**2
    smooth = pattern == "smooth"
    left = (
        smooth_rows(n_directions, rank, rng) if smooth else rng.standard_normal((n_rows, rank))
    )
    right = rng.standard_normal((rank, n_columns)) * np.linspace(1, 0.3, rank)[:, None]
    truth = left @ right
    truth /= truth.std()
    measured = truth + noise * rng.standard_normal(truth.shape)
    if pattern == "random":
        observed = rng.random(truth.shape) < 0.5
    else:
        observed = hemispheric(n_directions, n_columns, rng, horizon)
    return Problem(truth.astype(np.float32), measured.astype(np.float32), observed)


def unobserved_error(reconstruction, data, at_least=0):
    """Error relative to the truth over unobserved entries of rows seen `at_least` times."""
    chosen = ~data.observed & (data.observed.sum(axis=1) >= at_least)[:, None]
    error = (reconstruction - data.truth)[chosen]
    return float(np.sqrt((error**2).mean() / (data.truth[chosen] ** 2).mean()))


def clustered_subspaces(
    rng, *, n_rows=64, n_columns=1500, n_clusters=6, n_components=3, noise=0.01
):
    """Columns in subspaces of their own; truth, labels."""
    labels = rng.integers(n_clusters, size=n_columns)
    centres = rng.standard_normal((n_clusters, n_rows))
    columns = np.zeros((n_rows, n_columns))
    for cluster in range(n_clusters):
        basis = np.linalg.qr(rng.standard_normal((n_rows, n_components)))[0]
        members = labels == cluster
        scale = np.sqrt(n_rows) * 0.6 ** np.arange(n_components)[:, None]
        spread = scale * rng.standard_normal((n_components, members.sum()))
        columns[:, members] = centres[cluster][:, None] + basis @ spread
    columns += noise * rng.standard_normal(columns.shape)
    return columns.astype(np.float32), labels


def reconstructed(fit, columns=slice(None)):
    """Columns (n_rows, k) of a `Completion` or a `ClusteredBasis`; all by default."""
    coefficients = np.atleast_2d(fit.coefficients[columns])
    if not hasattr(fit, "labels"):
        return fit.mean[:, None] + fit.basis @ coefficients.T
    labels = np.atleast_1d(fit.labels[columns])
    return fit.means[labels].T + np.einsum("krc,kc->rk", fit.bases[labels], coefficients)
