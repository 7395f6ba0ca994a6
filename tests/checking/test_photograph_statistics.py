"""Photographs at reduced size say the same as whole ones."""

import cv2
import numpy as np
import pytest

from reflfield.capture.image_files import read_image, read_small_kinds
from reflfield.checking.photograph_statistics import reduced, sharpness
from reflfield.errors import CaptureError


@pytest.fixture
def large_jpeg(tmp_path, rng):
    """A smooth JPEG of 1600 x 1200 pixels."""
    coarse = rng.random((6, 8, 3)).astype(np.float32)
    image = cv2.resize(coarse, (1600, 1200), interpolation=cv2.INTER_CUBIC)
    path = tmp_path / "large.jpg"
    cv2.imwrite(str(path), np.clip(40 + 170 * image, 0, 255).astype(np.uint8))
    return path


def test_a_large_jpeg_is_read_small(large_jpeg):
    image, kinds = read_small_kinds(large_jpeg, longest=400)
    assert image.shape == kinds.shape == (300, 400, 3)
    whole = reduced(read_image(large_jpeg), 400)
    # Two codes of 8 bits: the larger one of both decoders' rounding, by the slope of sRGB.
    np.testing.assert_allclose(image, whole, rtol=0, atol=2 * 2.3 / 255)


def test_a_truncated_jpeg_is_refused_though_it_is_read_small(large_jpeg):
    content = large_jpeg.read_bytes()
    large_jpeg.write_bytes(content[: len(content) // 2])
    with pytest.raises(CaptureError, match=r"large\.jpg"):
        read_small_kinds(large_jpeg, longest=400)


def test_blur_lowers_sharpness(rng):
    fine = rng.random((200, 200, 3)).astype(np.float32)
    values = [sharpness(cv2.GaussianBlur(fine, (0, 0), width)) for width in (0.5, 1, 2, 4)]
    assert sharpness(fine) == pytest.approx(
        1.0, abs=0.05
    )  # white noise: both differences alike
    assert all(np.diff(values) < 0)
    # Noise after a Gaussian of 4 pixels; observed 2e-4 of 40,000 pixels.
    assert values[-1] == pytest.approx(np.expm1(-1 / 64) / np.expm1(-4 / 64), abs=1e-3)
