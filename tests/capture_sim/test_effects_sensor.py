"""The sensor: mosaic, noise, full wells, pedestal, digitising, exposures."""

import numpy as np
import pytest

from capture_sim.effects import (
    Photograph,
    bayer,
    black_level,
    exposure_brackets,
    quantisation,
    saturation,
    sensor_noise,
    simulated,
)
from capture_sim.effects.sensor import dark_noise, exposed
from capture_sim.scene import parse_scene


def scene(**effects):
    return parse_scene(
        {
            "object": {"preset": "sphere"},
            "material": {"preset": "grey_card"},
            "cameras": {"preset": "rti"},
            "lights": {"preset": "rti", "n": 3},
            "effects": {"simulate": list(effects), **effects},
        }
    )


def photograph(thing, light=0, **more):
    return Photograph(thing.cameras[0], 0, light, **more)


def malvar_by_hand(seen, row, column):
    """Malvar, He and Cutler's figure 2, written out for one pixel: red, green, blue."""
    at = lambda dr, dc: float(seen[row + dr, column + dc])  # noqa: E731
    here = at(0, 0)
    beside, above = at(0, -1) + at(0, 1), at(-1, 0) + at(1, 0)
    beside2, above2 = at(0, -2) + at(0, 2), at(-2, 0) + at(2, 0)
    diagonal = at(-1, -1) + at(-1, 1) + at(1, -1) + at(1, 1)
    if row % 2 == column % 2:  # at red or blue
        green = (2 * (beside + above) + 4 * here - beside2 - above2) / 8
        other = (2 * diagonal + 6 * here - 1.5 * (beside2 + above2)) / 8
        return (here, green, other) if row % 2 == 0 else (other, green, here)
    rows = (4 * beside + 5 * here - diagonal - beside2 + 0.5 * above2) / 8
    columns = (4 * above + 5 * here - diagonal - above2 + 0.5 * beside2) / 8
    return (rows, here, columns) if row % 2 == 0 else (columns, here, rows)


def test_malvar_interpolation_is_that_of_the_paper(rng, rounding):
    seen = rng.random((12, 14)).astype(np.float32)
    image = bayer.malvar(seen)
    expected = [[malvar_by_hand(seen, r, c) for c in range(2, 12)] for r in range(2, 10)]
    tolerance = rounding(np.float32, operations=13, scale=3.0)
    np.testing.assert_allclose(image[2:10, 2:12], expected, atol=tolerance)


@pytest.mark.parametrize("kind", ["malvar", "bilinear"])
def test_demosaicing_keeps_flat_colours_and_what_was_seen(rng, kind):
    thing = scene(bayer={"demosaicing": kind})
    flat = np.broadcast_to(np.float32([0.2, 0.5, 0.9]), (10, 12, 3))
    demosaiced = bayer.apply(bayer.mosaic(flat), thing)
    # Grey is kept by all filters, a colour by those without gradients of others.
    np.testing.assert_allclose(demosaiced[2:-2, 2:-2], flat[2:-2, 2:-2], atol=1e-6)
    image = rng.random((10, 12, 3)).astype(np.float32)
    again = bayer.mosaic(bayer.apply(bayer.mosaic(image), thing))
    np.testing.assert_array_equal(again, bayer.mosaic(image))


def test_quantisation_errs_like_a_uniform_variable(rng):
    thing = scene(quantisation={"bits": 8, "full_scale": 2.0})
    values = rng.random((200, 200)).astype(np.float32)
    error = quantisation.apply(values, thing, photograph(thing)).astype(float) - values
    step = 2.0 / 255
    assert np.abs(error).max() <= step / 2 * (1 + 1e-5)
    assert error.var() == pytest.approx(step**2 / 12, rel=4 * np.sqrt(0.8 / error.size))


def test_a_digitiser_clips_at_full_scale():
    thing = scene(quantisation={"bits": 2, "full_scale": 3.0})
    values = np.array([-0.6, 0.4, 2.4, 2.6, 3.0, 3.4, 3.6, 1e30, np.inf], np.float32)
    codes = quantisation.apply(values, thing, photograph(thing)).tolist()
    assert codes == [-1.0, 0.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0]
    deep = scene(quantisation={"bits": 24, "full_scale": 1.0})
    # The largest code of 24 bits is the largest odd number of a float32.
    assert quantisation.apply(np.ones(1, np.float32), deep, photograph(deep))[0] == 1.0


def test_clipping_calls_for_the_digitiser():
    coarse = {"bits": 24, "full_scale": 1e-3}
    thing = parse_scene(
        {
            "object": {"preset": "sphere"},
            "material": {"preset": "grey_card"},
            "cameras": {"preset": "rti"},
            "lights": {"preset": "rti", "n": 3},
            "effects": {"quantisation": coarse},
        }
    )
    decision = quantisation.needed(thing)
    # Brightness as nobody has measured it: all values up to 1.
    assert decision.bound == pytest.approx(1.0 - 1e-3, rel=1e-6)
    assert simulated(thing, quantisation)


def test_full_wells_cut_off():
    thing = scene(saturation={"radiance": 2.0})
    values = np.array([0.5, 2.0, 7.0], np.float32)
    assert saturation.apply(values, thing, photograph(thing)).tolist() == [0.5, 2.0, 2.0]


def test_noise_below_the_pedestal_is_cut_off():
    """Half-normal remains: its mean is sigma / sqrt(2 pi)."""
    noise = {"electrons_per_radiance": 100.0, "read_noise": 5.0}
    thing = scene(sensor_noise=noise, black_level={"level": 0.0, "drift": 0.0})
    dark = exposed(thing, np.zeros((200, 200, 3), np.float32), photograph(thing))
    assert dark.min() == 0.0
    spread = 0.05 * np.sqrt(0.5 - 0.5 / np.pi) / np.sqrt(dark.size)
    assert dark.mean(dtype=float) == pytest.approx(0.05 / np.sqrt(2 * np.pi), abs=4 * spread)


def test_a_pedestal_keeps_noise_and_drifts():
    thing = scene(black_level={"level": 0.1, "drift": 0.01})
    black = np.zeros((2, 2, 3), np.float32)
    offsets = np.stack(
        [
            black_level.apply(black, thing, photograph(thing, light))[0, 0]
            for light in range(300)
        ]
    )
    assert offsets.std() == pytest.approx(0.01, rel=4 / np.sqrt(2 * offsets.size))
    assert abs(offsets.mean()) < 4 * 0.01 / np.sqrt(offsets.size)


def test_noise_in_the_dark_is_read_noise_and_rounding():
    thing = scene(
        sensor_noise={"electrons_per_radiance": 1e3, "read_noise": 4.0},
        quantisation={"bits": 10, "full_scale": 1.023},
    )
    assert dark_noise(thing) == pytest.approx(np.sqrt(0.004**2 + 0.001**2 / 12))
    assert dark_noise(scene()) == 0.0


@pytest.mark.parametrize("electrons", [1.0, 1e2, 1e4, 1e6])
def test_noise_variance_against_photon_count(rng, electrons):
    noise = sensor_noise.Options(electrons_per_radiance=electrons, read_noise=3.0)
    noisy = sensor_noise.with_noise(np.ones((150, 150), np.float32), noise, rng)
    in_electrons = noisy.astype(float) * electrons
    n = in_electrons.size
    assert in_electrons.mean() == pytest.approx(electrons, abs=4 * np.sqrt((electrons + 9) / n))
    # Fourth moments of Poisson plus normal: 3 v^2 + electrons.
    spread = np.sqrt((2 * (electrons + 9) ** 2 + electrons) / n)
    assert in_electrons.var() == pytest.approx(electrons + 9, abs=4 * spread)


def test_merged_exposures_recover_radiance_within_the_predicted_variance(rng):
    """Maximum likelihood from several exposures: variances add as 1 / sum(1 / variance)."""
    from reflfield.capture.exposures import merge_exposures

    seconds = (0.25, 1.0, 4.0)
    noise = {"electrons_per_radiance": 2e4, "read_noise": 2.0}
    thing = scene(sensor_noise=noise, exposure_brackets={"seconds": list(seconds)})
    radiance = np.geomspace(0.02, 3.0, 16).astype(np.float32)
    image = np.broadcast_to(radiance[:, None, None], (16, 4000, 3))
    encoded = [
        exposure_brackets.apply(
            exposed(thing, image, photograph(thing, exposure=index, seconds=time))
        )
        for index, time in enumerate(seconds)
    ]
    merged = merge_exposures([(e / 255.0).astype(np.float32) for e in encoded], seconds)
    merged = merged.astype(float).reshape(16, -1)
    # Photons, reading and rounding of the sRGB code, of each exposure that does not saturate.
    options = thing.effects.get(sensor_noise.Options)
    information = np.zeros(16)
    for time in seconds:
        linear = radiance.astype(float) * time
        code = np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
        slope = np.maximum(1.055 / 2.4 * linear ** (1 / 2.4 - 1), 1e-9)
        photons = np.array([sensor_noise.standard_deviation(options, v) ** 2 for v in linear])
        variance = (photons + (1 / 255 / slope) ** 2 / 12) / time**2
        information += np.where(code < 0.95, 1 / variance, 0.0)
    predicted = 1 / np.sqrt(information)
    spread, bias = merged.std(axis=1), merged.mean(axis=1) - radiance
    # Weights of the merge are not exactly the best ones; rounding is shared by equal pixels.
    rounding = 0.5 / 255 * 2.4 / 1.055 * radiance
    assert (spread < 1.5 * predicted).all()
    assert (np.abs(bias) < rounding + 4 * predicted / np.sqrt(12000)).all()


def test_best_exposure_errs_by_half_a_code():
    thing = scene(exposure_brackets={"seconds": [0.1, 1.0]})
    radiance = np.linspace(0.01, 9.0, 300, dtype=np.float32).reshape(10, 10, 3)
    merged = exposure_brackets.best_exposure(radiance, thing)
    # Half of 1/255 times the largest slope of the decoding, 2.4 / 1.055, in radiance.
    largest = 0.5 / 255 * 2.4 / 1.055
    assert np.abs(merged - radiance)[radiance < 0.99].max() < largest
    assert np.abs(merged - radiance).max() < largest * 10


@pytest.mark.parametrize("effect", [bayer, black_level, quantisation, saturation])
def test_effects_that_are_off_are_not_called(monkeypatch, effect):
    """Off is free: nothing of the effect runs."""

    def fail(*_):
        raise AssertionError(effect.NAME)

    monkeypatch.setattr(effect, "apply", fail)
    image = np.ones((4, 4, 3), np.float32)
    thing = scene(sensor_noise={})
    assert exposed(thing, image, photograph(thing)).shape == (4, 4, 3)
    on = scene(**{effect.NAME: {}})
    with pytest.raises(AssertionError, match=effect.NAME):
        exposed(on, image, photograph(on))


def test_a_sensor_without_effects_returns_what_arrives():
    image = np.ones((4, 4, 3), np.float32)
    plain = scene()
    assert exposed(plain, image, photograph(plain)) is image
