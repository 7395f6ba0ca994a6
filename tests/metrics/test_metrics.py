"""Metrics: hand-checkable values, the reference packages, invariances, refusals."""

import json
import math
import subprocess
import sys
from dataclasses import replace

import flip_evaluator
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from skimage.metrics import structural_similarity

from reflfield.capture.color_spaces import luminance
from reflfield.errors import InputError, ShapeError
from reflfield.metrics.image_errors import PIXELS_PER_DEGREE, PSNR_CAP_DB
from reflfield.metrics.image_metrics import (
    Comparison,
    ImagePair,
    NothingToMeasure,
    common_exposure,
    compare_images,
    flip_errors,
)
from reflfield.render.exposure import ThinnedValues, display, object_pixels

DB = 10 / math.log(10)  # decibels of a relative error of a mean square


def disk(size, radius):
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return np.clip(radius - np.hypot(x, y) + 0.5, 0, 1)


@pytest.fixture
def frames(rng):
    """Three frames of textured disks, relit with noise and a small bias."""
    pairs = []
    for i in range(3):
        silhouette = disk(40, 13 + 2 * i)
        photograph = rng.uniform(0.05, 1.5, (40, 40, 3)) * silhouette[..., None]
        relit = photograph * [1.05, 0.95, 1.0] + rng.normal(0, 0.02, photograph.shape)
        pairs.append(ImagePair(f"frame_{i}", photograph, relit, silhouette))
    return pairs


# --- exact ------------------------------------------------------------------------


def test_constant_error_gives_the_psnr_worked_out_by_hand(rounding):
    """Percentile 0.5, so e = 2; HDR error 2 * 0.05 = 0.1 is 20 dB."""
    photograph = np.full((20, 20, 3), 0.5)
    result = compare_images([ImagePair("a", photograph, photograph - 0.05, np.ones((20, 20)))])
    assert result.exposure == 2.0
    sums = rounding(float, operations=3 * 16 * 16, scale=DB)
    assert result.images[0].psnr_hdr == pytest.approx(20.0, abs=sums)
    # LDR: sRGB(1) = 1 against sRGB(0.9) = 1.055 * 0.9^(1/2.4) - 0.055.
    error = 1 - (1.055 * 0.9 ** (1 / 2.4) - 0.055)
    assert result.images[0].psnr_ldr == pytest.approx(-20 * math.log10(error), abs=sums)
    assert result.images[0].n_pixels == 16 * 16


def test_overexposure_counts_in_hdr_only(rounding):
    photograph = np.ones((20, 20, 3))
    frame = compare_images([ImagePair("a", photograph, 3 * photograph, np.ones((20, 20)))])
    assert frame.mean["psnr_ldr"] == PSNR_CAP_DB
    assert frame.mean["psnr_hdr"] == pytest.approx(
        -20 * math.log10(2), abs=rounding(float, scale=DB)
    )


def test_exposure_is_the_percentile_over_all_frames(frames, rounding):
    values = np.concatenate(
        [luminance(p.photograph)[object_pixels(p.silhouette)] for p in frames]
    )
    got = common_exposure((p.photograph, p.silhouette) for p in frames)
    expected = 1 / np.percentile(values, 99.5)  # of luminances of three terms
    assert got == pytest.approx(expected, rel=rounding(float, operations=3))


@pytest.mark.reference
def test_erosion_keeps_what_is_farther_than_two_pixels_from_the_outside(rng):
    silhouette = (rng.uniform(size=(60, 60)) < 0.97).astype(float) * disk(60, 25)
    padded = np.pad(silhouette >= 0.5, 1)
    expected = distance_transform_edt(padded)[1:-1, 1:-1] > 2
    assert np.array_equal(object_pixels(silhouette), expected)


# --- reference packages -----------------------------------------------------------


@pytest.mark.reference
def test_ssim_and_flip_are_those_of_their_packages(frames, rounding):
    result = compare_images(frames)
    for pair, got in zip(frames, result.images, strict=True):
        counted = object_pixels(pair.silhouette)
        covered = (pair.silhouette >= 0.5)[..., None]
        shown = [
            display(np.where(covered, x, 0), result.exposure)
            for x in (pair.photograph, pair.relit)
        ]
        _, similarity = structural_similarity(
            *shown, data_range=1, channel_axis=2, full=True, win_size=7
        )
        error, _, used = flip_evaluator.evaluate(
            *(x.astype(np.float32) for x in shown), "LDR", applyMagma=False
        )
        # FLIP's own default viewing conditions are the ones stated.
        assert used["ppd"] == pytest.approx(PIXELS_PER_DEGREE, rel=1e-6)
        assert got.ssim == pytest.approx(similarity[counted].mean(), abs=rounding(float, 3))
        # One rounding of each pixel's error, of at most 1; over pixels they average out.
        assert got.flip == pytest.approx(error[counted].mean(), abs=rounding(np.float32))


def test_equal_pictures_are_perfect_and_the_file_stays_valid(frames):
    same = [ImagePair(p.name, p.photograph, p.photograph, p.silhouette) for p in frames]
    mean = json.loads(compare_images(same).to_json())["mean"]
    assert mean["psnr_ldr"] == mean["psnr_hdr"] == PSNR_CAP_DB
    assert mean["ssim"] == 1  # x / x everywhere
    assert mean["flip"] == 0


def test_file_holds_exactly_what_is_promised(frames, rounding):
    content = json.loads(compare_images(frames).to_json())
    keys = {"name", "psnr_ldr", "psnr_hdr", "ssim", "flip", "n_pixels"}
    assert set(content) == {"images", "mean", "measured", "extra"}
    assert all(
        set(image) == keys | {"n_excluded", "silhouette_from"} for image in content["images"]
    )
    assert content["measured"] == {
        "images": 3,
        "pixels": sum(int(object_pixels(pair.silhouette).sum()) for pair in frames),
        "saturated_pixels_left_out": 0,
        "silhouettes": {"given": 3},
        "images_not_measured": [],
    }
    for key in keys - {"name"}:
        values = [image[key] for image in content["images"]]
        assert content["mean"][key] == pytest.approx(np.mean(values), rel=rounding(float, 3))
    # Planted: 5 % too red, 5 % too little green; the noise averages out to < 1 %.
    assert content["extra"]["colour_ratio"] == pytest.approx([1.05, 0.95, 1.0], abs=0.01)


# --- invariances ------------------------------------------------------------------


@settings(max_examples=8, deadline=None)
@given(exponent=st.integers(-40, 40))
def test_a_common_scale_changes_nothing(exponent):
    rng = np.random.default_rng(3)
    photograph = rng.uniform(0.01, 1, (24, 24, 3))
    pair = ImagePair("a", photograph, photograph * 0.9, disk(24, 10))
    # Powers of two: the products are the same to the last bit.
    scaled = ImagePair(
        "a", *(x * 2.0**exponent for x in (photograph, pair.relit)), disk(24, 10)
    )
    a, b = compare_images([pair]), compare_images([scaled])
    assert [one.to_dict() for one in a.images] == [one.to_dict() for one in b.images]
    assert a.colour_ratio == b.colour_ratio
    assert a.exposure == b.exposure * 2.0**exponent


def test_a_dark_photograph_does_not_make_the_ratio(rng):
    """Of sums over all photographs: one that is hardly lit counts by its light."""
    bright = rng.uniform(0.5, 1, (24, 24, 3))
    pairs = [ImagePair("bright", bright, bright, disk(24, 10)),
             ImagePair("dark", 1e-3 * bright, 5e-4 * bright, disk(24, 10))]  # fmt: skip
    # Half of a thousandth of the light of both is missing.
    assert compare_images(pairs).colour_ratio == pytest.approx([1 - 5e-4 / 1.001] * 3, rel=1e-9)


def test_backdrop_does_not_matter(frames, rng):
    def with_backdrop(pair):
        outside = (pair.silhouette < 0.5)[..., None]
        noise = rng.uniform(0, 5, pair.photograph.shape)
        noise[0, 0] = np.nan
        return ImagePair(
            pair.name, np.where(outside, noise, pair.photograph), pair.relit, pair.silhouette
        )

    assert compare_images(map(with_backdrop, frames)) == compare_images(frames)


def test_iterators_sequences_and_known_exposure_agree(frames):
    expected = compare_images(frames)
    assert compare_images(iter(frames)) == expected
    assert compare_images(iter(frames), exposure=expected.exposure) == expected


def test_frames_can_be_read_one_at_a_time(frames):
    class OnDemand:
        read = 0

        def __iter__(self):
            for pair in frames:
                self.read += 1
                yield pair

    source = OnDemand()
    assert compare_images(source) == compare_images(frames)
    assert source.read == 2 * len(frames)


# --- stability --------------------------------------------------------------------


@pytest.mark.stability
def test_black_photographs_are_measured_with_a_warning(rounding):
    black = np.zeros((16, 16, 3))
    result = compare_images([ImagePair("a", black, black + 0.1, np.ones((16, 16)))])
    assert result.exposure == 1
    assert "black" in result.warnings[0]
    sums = rounding(float, operations=3 * 12 * 12, scale=DB)
    assert result.images[0].psnr_hdr == pytest.approx(20, abs=sums)
    content = json.loads(result.to_json())
    assert content["extra"]["colour_ratio"] == [None, None, None]


@pytest.mark.stability
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_huge_radiance_stays_finite(dtype, rng):
    top = float(np.finfo(dtype).max) / 4
    photograph = rng.uniform(0, 1, (16, 16, 3)).astype(dtype)
    photograph[8, 8] = 1
    photograph *= dtype(min(top, 1e100))
    result = compare_images([ImagePair("a", photograph, photograph / 2, np.ones((16, 16)))])
    assert all(math.isfinite(v) for v in json.loads(result.to_json())["mean"].values())


@pytest.mark.stability
def test_one_firefly_does_not_set_the_exposure():
    photograph = np.full((60, 60, 3), 0.5)
    photograph[30, 30] = 1e6
    result = compare_images([ImagePair("a", photograph, photograph, np.ones((60, 60)))])
    assert result.exposure == 2


@pytest.mark.stability
@pytest.mark.parametrize("size", [5, 6, 7])
def test_smallest_pictures_that_have_object_pixels(size, rng):
    photograph = rng.uniform(size=(size, size, 3))
    result = compare_images([ImagePair("a", photograph, photograph, np.ones((size, size)))])
    assert result.images[0].n_pixels == (size - 4) ** 2
    assert result.images[0].ssim == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("what", ["relit", "photograph"])
def test_values_that_are_not_finite_are_refused_by_name(frames, what, value):
    pictures = {"photograph": frames[1].photograph.copy(), "relit": frames[1].relit.copy()}
    pictures[what][20, 21, 2] = value
    bad = ImagePair("dome/v07_l11", silhouette=frames[1].silhouette, **pictures)
    with pytest.raises(InputError, match=rf"dome/v07_l11.*{what}.*row 20, column 21"):
        compare_images([frames[0], bad])


def test_a_frame_without_object_is_left_out_by_name(frames):
    empty = ImagePair("left_out", frames[0].photograph, frames[0].relit, np.zeros((40, 40)))
    result = compare_images([frames[0], empty])
    assert result.not_measured == ("left_out",)
    assert result.images == compare_images([frames[0]]).images
    assert json.loads(result.to_json())["measured"]["images_not_measured"] == ["left_out"]
    with pytest.raises(NothingToMeasure, match="object pixel"):
        compare_images([empty])
    with pytest.raises(NothingToMeasure, match="left_out have none"):
        compare_images([empty], exposure=1.0)


def test_saturated_pixels_are_not_counted_and_change_nothing_else(frames):
    a, b = frames[:2]
    saturated = np.zeros((40, 40), bool)
    saturated[18:21, 17:20] = True
    # Whatever the field shows where the sensor was full: neither the pixels nor the windows
    # of SSIM and FLIP around them see it.
    results = []
    for bright in (1.0, 50.0):
        relit = np.where(saturated[..., None], bright * b.photograph, b.relit)
        pair = replace(b, relit=relit, excluded=saturated)
        results.append(compare_images([a, pair], exposure=0.5).images[1])
    assert results[0] == results[1]
    plain = compare_images([a, b], exposure=0.5).images[1]
    counted = object_pixels(b.silhouette) & ~saturated
    n = int((object_pixels(b.silhouette) & saturated).sum())
    assert n == 9
    assert (results[0].n_pixels, results[0].n_excluded) == (plain.n_pixels - n, n)
    error = 0.5 * (b.photograph[counted] - b.relit[counted])
    # The definition, computed here: rounding of a mean of a few thousand doubles.
    assert results[0].psnr_hdr == pytest.approx(-10 * np.log10(np.mean(error**2)), rel=1e-12)


def test_without_saturated_pixels_nothing_changes(frames):
    none = [replace(pair, excluded=np.zeros((40, 40), bool)) for pair in frames]
    assert compare_images(none) == compare_images(frames)


def test_metrics_come_back_from_their_file(frames):
    result = compare_images(frames)
    assert Comparison.from_dict(json.loads(result.to_json())) == result


def test_sizes_that_differ_are_refused_by_name(frames):
    small = ImagePair("v3", frames[0].photograph, frames[0].relit[:39], frames[0].silhouette)
    with pytest.raises(ShapeError, match=r"v3.*relit.*\(39, 40, 3\)"):
        compare_images([small])


def test_no_frame_is_refused():
    with pytest.raises(InputError, match="at least one photograph"):
        compare_images([], exposure=1.0)
    with pytest.raises(InputError, match="at least one"):
        compare_images([])


def test_wide_backdrops_change_nothing_but_time(frames, rounding):
    """Only rows and columns around the object are looked at."""
    apart = [
        replace(pair, excluded=np.arange(1600).reshape(40, 40) % 97 == 0) for pair in frames
    ]

    def padded(image, fill):
        widths = ((70, 20), (5, 90)) + ((0, 0),) * (image.ndim - 2)
        return np.pad(image, widths, constant_values=fill)

    wide = [
        replace(
            pair,
            photograph=padded(pair.photograph, 0.7),
            relit=padded(pair.relit, 3.0),
            silhouette=padded(pair.silhouette, 0.0),
            excluded=padded(pair.excluded, True),
        )
        for pair in apart
    ]
    near, far = compare_images(apart), compare_images(wide)
    for name in ("psnr_ldr", "psnr_hdr", "ssim", "flip", "n_pixels"):
        # FLIP is single precision, its filters' sums begin elsewhere.
        assert far.mean[name] == pytest.approx(near.mean[name], rel=1e-5)
    errors, around = flip_errors(apart[0], 1.0), flip_errors(wide[0], 1.0)
    filters = rounding(np.float32, operations=2 * 2 * 21)
    assert np.abs(around[70:110, 5:45] - errors).max() < filters
    outside = np.ones(around.shape, bool)
    outside[70 - 32 : 110 + 32, : 45 + 32] = False
    assert not around[outside].any()


def test_strips_measure_what_whole_frames_do(frames, monkeypatch, rng, rounding):
    """FLIP reaches 10 pixels, SSIM 3; a strip of 32 rows sees 32 more on both sides."""
    tall = [
        replace(
            pair,
            photograph=np.tile(pair.photograph, (4, 1, 1)),
            relit=np.tile(pair.relit, (4, 1, 1)),
            silhouette=np.tile(pair.silhouette, (4, 1)),
            excluded=rng.random((160, 40)) < 0.01,
        )
        for pair in frames
    ]
    whole, errors = compare_images(tall), flip_errors(tall[0], 1.0)
    monkeypatch.setattr("reflfield.metrics.image_errors.PIXELS_AT_ONCE", 1)
    by_strips = compare_images(tall)
    for name in ("psnr_ldr", "psnr_hdr", "ssim", "flip", "n_pixels"):
        # FLIP is single precision, its filters' sums begin elsewhere.
        assert by_strips.mean[name] == pytest.approx(whole.mean[name], rel=1e-5)
    # NumPy sums 6,400 pixels by halves: 13 additions, and 15 of strips.
    sums = rounding(float, operations=13 + 15)
    assert by_strips.colour_ratio == pytest.approx(whole.colour_ratio, rel=sums)
    # Colours and features pass two filters of 21 taps along each axis.
    filters = rounding(np.float32, operations=2 * 2 * 21)
    assert np.abs(flip_errors(tall[0], 1.0) - errors).max() < filters


def test_many_values_are_thinned_evenly(rng):
    kept = ThinnedValues(most=1000)
    values = np.arange(50_000.0)
    for part in np.split(values, np.sort(rng.choice(50_000, 40, replace=False))):
        kept.add(part)
    assert 500 <= len(kept.values) <= 1000
    assert np.array_equal(kept.values, np.arange(0.0, 50_000.0, 64))


COMPARES_LARGE_FRAMES = """
import resource
import numpy as np
from reflfield.metrics import image_errors
from reflfield.metrics.image_metrics import ImagePair, compare_images

SIZE = 900
image_errors.PIXELS_AT_ONCE = 1 << 17


class Frames:
    def __iter__(self):
        for i in range(1):
            picture = np.full((SIZE, SIZE, 3), 0.5 + 0.1 * i, np.float32)
            picture[::7] = 0.2
            yield ImagePair(str(i), picture, picture * np.float32(0.9),
                            np.ones((SIZE, SIZE), np.float32))


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


small = np.full((64, 64, 3), 0.5)
compare_images([ImagePair("s", small, 0.9 * small, np.ones((64, 64)))])
before = peak()
result = compare_images(Frames())
print(peak() - before, result.mean["psnr_hdr"])
"""


def test_memory_of_large_frames_is_that_of_a_strip_and_one_frame():
    """A million pixels measured whole took 650 bytes each; strips of 145 rows and 64 beside."""
    words = [sys.executable, "-c", COMPARES_LARGE_FRAMES]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120)
    peak, psnr_hdr = (float(word) for word in done.stdout.split())
    # Two frames (one is made while the other is still there) of 28 bytes a pixel, masks and
    # numbers of the exposure of 40, and 650 bytes for a strip's pixels.
    assert peak < 900**2 * (2 * 28 + 40) + 650 * 210 * 900
    assert 15 < psnr_hdr < 30
