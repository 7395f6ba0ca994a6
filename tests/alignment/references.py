"""The paper's forms of the correlation, as plainly as they are written there."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from reflfield.sphere.harmonics import real_harmonics


def turn_matrix(rotation, band_limit):
    """Matrix of f(R^T w) on real harmonics, fitted to values: no Wigner function involved."""
    rng = np.random.default_rng(5)
    points = rng.standard_normal((4 * band_limit**2 + 20, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    here = real_harmonics(points, band_limit)
    there = real_harmonics(points @ rotation, band_limit)
    return np.linalg.lstsq(here, there, rcond=None)[0]


def double_wigner_sum(a, b, rotation):
    """Eq. 10 at one rotation: sum of a D(R) b D(R)^T, all degrees of both directions."""
    turn = turn_matrix(rotation, round(len(a) ** 0.5))
    return float(np.sum(a * (turn @ b @ turn.T)))


def rank_k_sum(a, b, rotation, rank):
    """Eq. 11 at one rotation: K products of each, K^2 pairs of 2D correlations."""
    turn = turn_matrix(rotation, round(len(a) ** 0.5))
    ua, sa, va = np.linalg.svd(a)
    ub, sb, vb = np.linalg.svd(b)
    total = 0.0
    for i in range(rank):
        for j in range(rank):
            view = ua[:, i] @ turn @ ub[:, j]
            light = va[i] @ turn @ vb[j]
            total += sa[i] * sb[j] * view * light
    return float(total)


def quadrature_sum(a, b, rotation, n_directions=64):
    """Eq. 5 on both spheres: numerical integration of a(v, l) b(R^T v, R^T l)."""
    band_limit = round(len(a) ** 0.5)
    nodes, weights = np.polynomial.legendre.leggauss(band_limit)
    azimuth = 2 * np.pi * np.arange(2 * band_limit) / (2 * band_limit)
    z, phi = np.meshgrid(nodes, azimuth, indexing="ij")
    area = np.repeat(weights, len(azimuth)) * 2 * np.pi / len(azimuth)
    r = np.sqrt(1 - z**2)
    points = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).reshape(-1, 3)
    y, turned = (
        real_harmonics(points, band_limit),
        real_harmonics(points @ rotation, band_limit),
    )
    left, right = y @ a @ y.T, turned @ b @ turned.T
    return float(np.sum(left * right * area[:, None] * area[None, :]))


def spline_matrix(local, side):
    """Dense interpolation matrix of directions, by SciPy's B-splines on Lambert's map."""
    up = np.maximum(local[:, 2:], 0.0)
    position = 1.0 + 0.5 * (side - 3) * (1.0 + local[:, :2] / np.sqrt(1.0 + up))
    element = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    weights = np.nan_to_num(element(position[:, :, None] - np.arange(side)))
    out = weights[:, 1, :, None] * weights[:, 0, None, :]
    return np.where(local[:, 2:] > 0, out.reshape(len(local), -1), 0)
