"""The number of lobes by views left out: planted materials, views that have no sample."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from reflfield.field.half_vector import half_angles
from reflfield.fitting.lobe_count import (
    MOST_LOBES,
    fewest_lobes,
    left_out_errors,
    of_views,
    views_left_out,
)
from reflfield.fitting.texel_sample_fit import start_model
from tests.fitting.conftest import frames_about
from tests.fitting.test_texel_sample_fit import N_VIEWS, block_of, blocks_of

LEFT_OUT = views_left_out(N_VIEWS)


def shine(degrees, height):
    lobe = height * np.exp(-((half_angles() / np.radians(degrees)) ** 2)).ravel()
    return np.tile(lobe, 6)[:, None].repeat(3, 1).astype(np.float32)


def painted(rng, shares):
    """Texels of a sharp and a wide lobe, in shares (n, 2)."""
    truth = start_model(frames_about(rng, len(shares)), 2)
    diffuse = rng.uniform(0.1, 0.5, (len(shares), 3)).astype(np.float32)
    lobes = np.stack([shine(10, 0.6), shine(40, 0.4)])
    return replace(truth, diffuse=diffuse, lobes=lobes, weights=shares.astype(np.float32))


def errors_of(block, frames):
    with ThreadPoolExecutor(2) as pool:
        return left_out_errors(blocks_of(block), frames, LEFT_OUT, pool, 3e-4)[0]


@pytest.mark.parametrize("materials", [1, 2])
def test_lobes_follow_the_number_of_materials(small_rng, materials):
    """A second material is worth more lobes; one material by itself is not."""
    truth = painted(small_rng, np.eye(2)[np.arange(120) % materials])
    errors = errors_of(block_of(small_rng, truth), truth.frames)
    assert errors.shape == (MOST_LOBES,)
    # Measured: .0023 to .0024 of one material whatever the number; .031, .019, .010 and .010
    # of two, between whose lobes two begin at unlike widths.
    if materials == 1:
        assert fewest_lobes(errors) == 1
    else:
        assert fewest_lobes(errors) > 1
        assert errors.min() < 0.5 * errors[0]


def test_samples_of_views_left_out_take_no_part_in_the_fit(small_rng):
    """Garbage in the views left out changes the errors, and not the model."""
    truth = painted(small_rng, np.ones((30, 2)))
    block = block_of(small_rng, truth)
    fitted, measured = (of_views(blocks_of(block), among)[0] for among in (~LEFT_OUT, LEFT_OUT))
    assert not LEFT_OUT[fitted.view].any()
    assert LEFT_OUT[measured.view].all()
    assert len(fitted.view) + len(measured.view) == len(block.view)
    for part in (fitted, measured):
        texel = np.repeat(np.arange(30), np.diff(part.first))
        whole = np.repeat(np.arange(30), np.diff(block.first))
        order = {(t, v, n): value for t, v, n, value in zip(
            whole, block.view, block.light, block.values[:, 0], strict=True)}  # fmt: skip
        kept = [order[key] for key in zip(texel, part.view, part.light, strict=True)]
        np.testing.assert_array_equal(kept, part.values[:, 0])


@pytest.mark.stability
def test_views_left_out_without_samples_are_a_defined_answer(small_rng):
    truth = painted(small_rng, np.ones((10, 2)))
    only = of_views(blocks_of(block_of(small_rng, truth)), ~LEFT_OUT)[0]
    errors = errors_of(only, truth.frames)
    assert np.array_equal(errors, np.zeros(MOST_LOBES))
    assert fewest_lobes(errors) == 1
