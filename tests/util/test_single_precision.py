"""Elementary functions of single precision beside NumPy's in double precision."""

import numba
import numpy as np
import pytest

from reflfield.util.single_precision import angle_of, exponential, logarithm

SINGLE = np.finfo(np.float32)


@numba.njit
def angles(sines, cosines, out):
    for i in range(len(out)):
        out[i] = angle_of(sines[i], cosines[i])


@numba.njit
def logarithms(x, out):
    for i in range(len(out)):
        out[i] = logarithm(x[i])


@numba.njit
def exponentials(x, out):
    for i in range(len(out)):
        out[i] = exponential(x[i])


def test_angles_from_sines_and_cosines():
    angle = np.linspace(0, np.pi / 2, 100_001)
    sines, cosines = np.sin(angle).astype(np.float32), np.cos(angle).astype(np.float32)
    out = np.zeros(len(angle), np.float32)
    angles(sines, cosines, out)
    # Two units of 90 degrees, and the rounding of sine and cosine.
    assert (
        np.abs(out - np.arctan2(sines, cosines, dtype=float)).max() < 2 * SINGLE.eps * np.pi / 2
    )
    assert out[0] == 0
    # Small angles are as exact as their sines, which an arc cosine is not.
    small = slice(1, 1000)
    np.testing.assert_allclose(out[small], angle[small], rtol=4 * SINGLE.eps)


@pytest.mark.stability
def test_logarithms_of_all_magnitudes():
    x = np.geomspace(SINGLE.tiny, SINGLE.max, 100_001).astype(np.float32)
    x = np.append(x, np.float32(1))
    out = np.zeros(len(x), np.float32)
    logarithms(x, out)
    expected = np.log(x, dtype=float)
    np.testing.assert_allclose(out, expected, rtol=2 * SINGLE.eps, atol=2 * SINGLE.eps)
    assert out[-1] == 0


@pytest.mark.stability
def test_exponentials_are_those_of_numpy_and_bounded():
    # The argument's own rounding, and that of the multiple of log 2 taken from it.
    x = np.linspace(-80, 80, 100_001).astype(np.float32)
    out = np.zeros(len(x), np.float32)
    exponentials(x, out)
    np.testing.assert_allclose(out, np.exp(x, dtype=float), rtol=82 * SINGLE.eps)
    within = np.abs(x) < 1
    np.testing.assert_allclose(out[within], np.exp(x[within], dtype=float), rtol=3 * SINGLE.eps)
    beyond = np.array([-1e4, 1e4], np.float32)
    out = np.zeros(2, np.float32)
    exponentials(beyond, out)
    assert np.isfinite(out).all()
    assert 0 <= out[0] < 1e-30 < 1e30 < out[1]
