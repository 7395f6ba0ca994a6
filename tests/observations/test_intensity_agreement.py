"""Intensities that do not fit the photographs are noticed, those that do are not."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.lights import Light
from reflfield.observations.intensity_agreement import other_intensities
from tests.observations.test_light_agreement import photographed

N_LIGHTS = 12
TRUE = np.geomspace(1, 20, N_LIGHTS)


def described_as(rng, intensities, true=TRUE, scatter=0.0):
    """Looks at a matt ball under lights of true intensities that are told otherwise."""
    looks = photographed(rng, lambda lamp, camera: lamp, n_looks=N_LIGHTS)
    gains = np.exp(scatter * rng.normal(size=N_LIGHTS))
    return [
        replace(
            look,
            light=replace(look.light, intensity=[told] * 3),
            brightness=look.brightness * gain * strength / told,
        )
        for look, told, strength, gain in zip(looks, intensities, true, gains, strict=True)
    ]


@pytest.mark.parametrize("true", [TRUE, np.ones(N_LIGHTS)])
def test_right_intensities_say_nothing(rng, true):
    assert other_intensities(described_as(rng, true, true)) == ""
    # Of gloss and shadows each light sees other parts.
    assert other_intensities(described_as(rng, true, true, scatter=0.5)) == ""


def test_intensities_in_reverse_order(rng):
    words = other_intensities(described_as(rng, TRUE[::-1]))
    assert "check which intensity belongs to which light" in words


@pytest.mark.parametrize(("factor", "word"), [(1000.0, "strong"), (0.01, "weak")])
def test_one_in_another_unit_is_named(rng, factor, word):
    told, state = np.ones(N_LIGHTS), rng.bit_generator.state
    seen = int(np.argmax([k.brightness.sum() for k in described_as(rng, told, told)]))
    rng.bit_generator.state = state
    told[seen] = factor
    words = other_intensities(described_as(rng, told, np.ones(N_LIGHTS)))
    assert f"most off: 'l{seen}', {max(factor, 1 / factor):.1f} times too {word}" in words


def test_all_in_another_unit_say_nothing(rng):
    assert other_intensities(described_as(rng, 1e4 * TRUE)) == ""


def test_unknown_and_few_lights_say_nothing(rng):
    looks = described_as(rng, TRUE[::-1])
    unknown = [replace(look, light=Light(look.light.id, "unknown")) for look in looks]
    assert other_intensities(unknown) == other_intensities(looks[:3]) == ""
