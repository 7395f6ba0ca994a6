"""The mean of nearest samples: against sums in NumPy, and where there is nothing to average."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from reflfield.fitting import nearest_samples
from reflfield.fitting.lobe_count import of_views, views_left_out
from reflfield.fitting.nearest_samples import LEAST_WEIGHT, WIDTHS, nearest_samples_error
from reflfield.fitting.robust_weights import HUBER, squared_weight
from reflfield.fitting.texel_sample_fit import start_model
from tests.fitting.conftest import frames_about
from tests.fitting.test_texel_sample_fit import N_VIEWS, block_of, blocks_of

LEFT_OUT = views_left_out(N_VIEWS)


@pytest.fixture
def block(small_rng):
    block = block_of(small_rng, start_model(frames_about(small_rng, 9), 1))
    block.values[small_rng.random(len(block.values)) < 0.1] = np.nan
    return block


def parts_of(block):
    return of_views(blocks_of(block), ~LEFT_OUT), of_views(blocks_of(block), LEFT_OUT)


def error_of(fitted, measured):
    with ThreadPoolExecutor(2) as pool:
        return nearest_samples_error(fitted, measured, pool)


def samples_of(block, texel):
    """Directions (n, 6), values (n, 3) and numbers of the lights of one texel's samples."""
    own = slice(block.first[texel], block.first[texel + 1])
    views, lights = block.views[texel, block.view[own]], block.lights[texel, block.light[own]]
    directions = np.concatenate([views, lights], axis=1, dtype=np.float64)
    return directions, block.values[own], block.light[own]


@pytest.mark.parametrize("n_lights", ["many", "one"])
def test_error_is_that_of_the_weighted_means_under_other_lights(block, n_lights):
    """Of one light there are no others: its own samples are taken."""
    if n_lights == "one":
        block.lights[:] = block.lights[:, :1]
    fitted, measured = parts_of(block)
    squares = np.zeros((len(WIDTHS), 2))
    for texel in range(len(block.texels)):
        known, values, of_known = samples_of(fitted[0], texel)
        asked, truth, of_asked = samples_of(measured[0], texel)
        square = np.square(asked[:, None] - known[None]).sum(axis=2)
        for width, out in zip(WIDTHS, squares, strict=True):
            weight = np.exp(-square / (2 * width**2)) + LEAST_WEIGHT
            if n_lights == "many":
                weight *= of_asked[:, None] != of_known
            weight = weight[..., None] * np.isfinite(values)
            shown = (weight * np.nan_to_num(values)).sum(axis=1) / weight.sum(axis=1)
            for y, s in zip(truth.ravel(), shown.astype(np.float32).ravel(), strict=True):
                if np.isfinite(y):
                    out += squared_weight(y, s, HUBER) * (y - s) ** 2, 1
    expected = np.sqrt((squares[:, 0] / squares[:, 1]).min())
    # Weights are float32, of residuals that are rounded to it: some eps of the values.
    assert error_of(fitted, measured) == pytest.approx(expected, rel=1e-5)


def test_of_many_samples_some_are_predicted(block, monkeypatch):
    """Every third of each texel, begun at another one: a third of the sums, about as large."""
    whole = error_of(*parts_of(block))
    fitted, measured = parts_of(block)
    pairs = sum(np.diff(fitted[0].first) * np.diff(measured[0].first))
    monkeypatch.setattr(nearest_samples, "MOST_PAIRS", int(pairs // 3) + 1)
    some = error_of(fitted, measured)
    assert some != whole
    # A third of some hundred squares of like size: two of three scatter by a third at most.
    assert some == pytest.approx(whole, rel=0.35)


def test_samples_that_do_not_vary_are_shown(block):
    block.values[:] = 0.25
    assert error_of(*parts_of(block)) == 0  # a quarter of any sum of weights is exact


@pytest.mark.stability
@pytest.mark.parametrize("known", [True, False])
def test_nothing_to_average_or_to_show_is_no_error(block, known):
    fitted, measured = parts_of(block)
    nothing = of_views(blocks_of(block), np.zeros(N_VIEWS, np.bool_))
    assert error_of(*((fitted, nothing) if known else (nothing, measured))) == 0.0


@pytest.mark.stability
def test_directions_far_from_all_samples_still_have_a_mean(block):
    """The weights of all samples underflow, so each counts alike."""
    fitted, measured = parts_of(block)
    measured[0].views[:] *= 100.0
    assert np.isfinite(error_of(fitted, measured))
    assert error_of(fitted, measured) > 0.0


def test_views_of_a_matt_texel_say_nothing_of_other_lights(block):
    """Each light shows it as bright from all sides: another view of it tells no more."""
    block.values[:] = np.random.default_rng(5).random(32)[block.light][:, None]
    assert error_of(*parts_of(block)) > 0.05
