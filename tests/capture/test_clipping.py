"""Which values of a photograph are measurements."""

import tracemalloc

import cv2
import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.clipping import BLACK, MEASURED, SATURATED, TRANSPARENT, kinds_of_stored
from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.lights import Light
from reflfield.capture.photographs import Exposure, Photograph

SIZE = 40


@pytest.fixture
def radiance():
    """A smooth highlight, 0 to 2, different in each channel; more than 1 in a disk."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE - 0.5
    falloff = np.exp(-8 * (x**2 + y**2))
    return (falloff[..., None] * [2.0, 1.9, 1.7]).astype(np.float32)


def capture_of(folder, *files):
    camera = Camera("v", "opencv", SIZE, SIZE, 50.0, 50.0, SIZE / 2, SIZE / 2, np.eye(4))
    exposures = tuple(Exposure(folder / name, seconds) for name, seconds in files)
    photograph = Photograph("p", 0, 0, exposures)
    return Capture("c", folder, (camera,), (Light("l", "unknown"),), (photograph,), "plane")


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_each_channel_has_a_limit_of_its_own(rng, channel):
    stored = rng.uniform(0.1, 0.9, (SIZE, SIZE + 1, 3)).astype(np.float32)
    stored[3, 5, channel] = stored[7, 2, channel] = 1
    kinds = kinds_of_stored(stored, integer=True)
    expected = np.full(stored.shape, MEASURED)
    expected[[3, 7], [5, 2], channel] = SATURATED
    np.testing.assert_array_equal(kinds, expected)


@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535)])
def test_integers_at_either_end_are_no_measurements(tmp_path, radiance, dtype, top):
    codes = np.rint(np.clip(encode_srgb(radiance), 0, 1) * top)
    codes[0, :5, 1] = 0
    write_png(tmp_path / "a.png", codes.astype(dtype))
    image, kinds = capture_of(tmp_path, ("a.png", 1.0)).read_kinds(0)
    measured = kinds == MEASURED
    assert np.array_equal(measured, (codes > 0) & (codes < top))
    assert np.array_equal(image[measured], image[measured].clip(0, 0.99999))


def test_floats_saturated_at_one(tmp_path, radiance):
    write_exr(tmp_path / "a.exr", np.minimum(radiance, 1))
    _, kinds = capture_of(tmp_path, ("a.exr", 0.5)).read_kinds(0)
    assert np.array_equal(kinds == MEASURED, radiance < 1)


@pytest.mark.parametrize("level", [0.37, 1.3])
def test_floats_saturated_at_another_level(radiance, level):
    level = np.float32(level)
    measured = kinds_of_stored(np.minimum(radiance, level), integer=False) == MEASURED
    assert np.array_equal(measured, radiance < level)


@pytest.mark.parametrize("shift", [0, 4])
def test_12_bits_in_16(radiance, shift):
    codes = np.clip(np.rint(radiance * 4095), 0, 4095).astype(np.uint16) << shift
    measured = kinds_of_stored(codes.astype(np.float32) / 65535, integer=True) == MEASURED
    assert np.array_equal(measured, (codes < (4095 << shift)) & (codes > 0))


def test_black_floats_are_measured(radiance):
    radiance[:3] = 0
    assert not kinds_of_stored(radiance, integer=False).any()


def test_white_level_said(radiance):
    measured = kinds_of_stored(radiance, integer=False, white_level=0.8) == MEASURED
    assert np.array_equal(measured, radiance < np.float32(0.8))


def test_equal_values_that_are_no_limit(radiance):
    ramp = np.linspace(0, 0.9, 3 * SIZE**2, dtype=np.float32).reshape(SIZE, SIZE, 3)
    tiles = np.where(np.indices((SIZE, SIZE)).sum(0) % 2, 0.3, 0.6).astype(np.float32)
    plate = np.zeros((SIZE, SIZE, 3), np.float32)
    plate[9:30, 9:30] = 0.4
    for image in (radiance, ramp, np.dstack([tiles] * 3), plate, np.ones_like(ramp)):
        assert not kinds_of_stored(image, integer=False).any()


def test_one_of_the_bracketed_exposures_is_enough(tmp_path, radiance):
    radiance[:3, :3], radiance[0, -1] = 1e-5, 50
    files = (("short.png", 0.1), ("long.png", 1.5))
    codes = {n: np.rint(255 * encode_srgb(np.clip(radiance * t, 0, 1))) for n, t in files}
    for name, code in codes.items():
        write_png(tmp_path / name, code.astype(np.uint8))
    image, kinds = capture_of(tmp_path, *files).read_kinds(0)
    measured = kinds == MEASURED
    between = [(c > 0) & (c < 255) for c in codes.values()]
    assert np.array_equal(measured, between[0] | between[1])
    assert measured[SIZE // 2, SIZE // 2].all()  # saturated in the long one
    assert (kinds[0, 0] == BLACK).all()  # in both
    assert (kinds[0, -1] == SATURATED).all()  # in both
    np.testing.assert_allclose(image[measured], radiance[measured], rtol=0.1)  # 8 bits


def test_under_alpha_nothing_is_measured(tmp_path):
    codes = np.full((SIZE, SIZE, 4), 90, np.uint8)
    codes[:, :7, 3] = 0
    assert cv2.imwrite(str(tmp_path / "a.png"), codes)
    _, kinds = capture_of(tmp_path, ("a.png", 1.0)).read_kinds(0)
    assert (kinds[:, :7] == TRANSPARENT).all()
    assert (kinds[:, 7:] == MEASURED).all()


def test_kinds_of_large_photographs_take_a_few_bytes_a_value():
    stored = np.linspace(0, 0.9, 3_000_000, dtype=np.float32).reshape(1000, 1000, 3)
    tracemalloc.start()
    try:
        kinds_of_stored(stored, integer=True)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # One of the result, three of conditions; as whole numbers of eight bytes it was nine.
    assert peak < 5 * stored.size
