import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import sph_harm_y

from reflfield.errors import InputError
from reflfield.sphere.harmonics import real_harmonics


def directions(rng, n):
    v = rng.standard_normal((n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.mark.reference
def test_values_match_scipy(rng, rounding):
    v = directions(rng, 40)
    band_limit = 16
    values = real_harmonics(v, band_limit)
    polar, azimuth = np.arccos(v[:, 2]), np.arctan2(v[:, 1], v[:, 0])
    for ell in range(band_limit):
        for m in range(-ell, ell + 1):
            y = sph_harm_y(ell, abs(m), polar, azimuth)
            part = y.real if m >= 0 else y.imag
            expected = part * (1.0 if m == 0 else np.sqrt(2) * (-1) ** m)
            tolerance = rounding(np.float64, operations=4 * band_limit)
            np.testing.assert_allclose(values[:, ell * ell + ell + m], expected, atol=tolerance)


def test_orthonormal_on_a_quadrature_that_is_exact(rounding):
    band_limit = 33
    z, w = np.polynomial.legendre.leggauss(band_limit)
    phi = 2 * np.pi * np.arange(2 * band_limit) / (2 * band_limit)
    zz, pp = np.meshgrid(z, phi, indexing="ij")
    r = np.sqrt(1 - zz**2)
    v = np.stack([r * np.cos(pp), r * np.sin(pp), zz], axis=-1).reshape(-1, 3)
    y = real_harmonics(v, band_limit)
    gram = y.T @ (y * np.repeat(w * np.pi / band_limit, len(phi))[:, None])
    assert np.abs(gram - np.eye(len(gram))).max() < rounding(np.float64, 4 * band_limit)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 64), st.floats(-1, 1), st.floats(-4, 4))
def test_addition_theorem_holds_everywhere_even_at_poles(band_limit, z, azimuth):
    r = np.sqrt(1 - z * z)
    y = real_harmonics([[r * np.cos(azimuth), r * np.sin(azimuth), z]], band_limit)[0]
    assert np.isclose(np.sum(y**2), band_limit**2 / (4 * np.pi), rtol=1e-11)  # 64^2 terms


def test_degree_256_at_the_equator_is_finite():
    assert np.isfinite(real_harmonics([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 257)).all()


@pytest.mark.parametrize("band_limit", [0, 258, 2.5, True])
def test_band_limit_out_of_range_is_refused(band_limit):
    with pytest.raises(InputError, match="band_limit"):
        real_harmonics([[0.0, 0.0, 1.0]], band_limit)


def test_vectors_that_are_not_unit_are_refused():
    with pytest.raises(InputError, match="directions"):
        real_harmonics([[0.0, 0.0, 2.0]], 3)
