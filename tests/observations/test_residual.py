"""Error of a field on samples that are its own values with a known error added."""

import numpy as np
import pytest

from reflfield.capture.encoding import encode_srgb
from reflfield.errors import InputError
from reflfield.field.evaluation import evaluate
from reflfield.metrics.sample_residual import sample_error
from reflfield.observations.image_projection import directions_of
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.resampling_options import (
    ResamplingOptions,
)
from reflfield.observations.store import (
    ObservationStore,
    Observed,
    open_samples,
)
from reflfield.observations.texel_reading import TexelReader
from tests.synthetic_fields import baked_field, blinn_phong, square_surface

from .rigs import dome, write_samples


@pytest.fixture
def field():
    return baked_field(square_surface(4, 0.1), blinn_phong(0.3, 0.2, 8.0))


@pytest.fixture
def reader_of(field, tmp_path, rng):
    """Return a function from a factor on the field's own samples to a reader of them."""
    capture = dome(5, 6, missing={(1, 2)})
    n = field.n_texels
    positions = rng.uniform(-0.05, 0.05, (n, 3)) * [1, 1, 0]
    views, lights = directions_of(capture, positions)
    grid = np.indices((n, 5, 6)).reshape(3, -1)
    own = evaluate(field, grid[0], views[grid[0], grid[1]], lights[grid[0], grid[2]])
    own = own.reshape(n, 5, 6, 3)

    def make(factor):
        seen = Observed(
            rng.random((n, 5)) < 0.7, rng.random((n, 6)) < 0.7, PhotographedPairs.of(capture)
        )
        observed = seen.views[:, :, None] & seen.lights[:, None] & seen.pairs.table
        # What is not observed must not count, whatever it holds.
        values = np.where(observed[..., None], factor * own, 1e3)
        write_samples(tmp_path / "store", capture, values)
        return TexelReader(
            store=ObservationStore(tmp_path / "store", seen),
            capture=capture,
            positions=positions,
            local_from_world=field.local_from_world,
            sides=(5, 5),
            options=ResamplingOptions(),
        )

    return make


# Samples are stored as halves: relative error of one, about a third of it after the root.
HALF = 2.0**-11


def test_samples_of_the_field_itself_have_no_error(field, reader_of):
    error = sample_error(field, reader_of(1.0), np.arange(field.n_texels))
    assert error.linear < HALF
    assert error.cube_root < HALF


def test_values_not_measured_do_not_count(field, reader_of, rng):
    """Clipped highlights would be compared with what the field says of them."""
    reader = reader_of(2.0)
    stored = open_samples(reader.store.location)
    values = stored[:]
    values[rng.random(values.shape) < 0.3] = np.nan
    stored[:] = values
    error = sample_error(field, reader, np.arange(field.n_texels))
    assert error.linear == pytest.approx(0.5, abs=2 * HALF)
    observed = reader.store.observed.of_texels(slice(None))
    assert error.n_samples == (observed & ~np.isnan(values).all(axis=2)).sum()


def test_error_is_relative_to_the_samples(field, reader_of):
    reader = reader_of(2.0)
    error = sample_error(field, reader, np.arange(field.n_texels))
    assert error.linear == pytest.approx(0.5, abs=2 * HALF)
    assert error.cube_root == pytest.approx(1 - 0.5 ** (1 / 3), abs=2 * HALF)
    assert error.n_samples == reader.store.observed.count()


def test_psnr_is_that_of_the_radiances_as_they_are_shown(field, reader_of):
    """Sample by sample, against the functions that photographs are compared with."""
    reader = reader_of(1.5)
    error = sample_error(field, reader, np.arange(field.n_texels))
    seen = reader.store.observed
    t, i, j = np.nonzero(seen.views[:, :, None] & seen.lights[:, None] & seen.pairs.table)
    views, lights = directions_of(reader.capture, reader.positions)
    own = evaluate(field, t, views[t, i], lights[t, j])
    irradiance = np.stack(
        [light.irradiance(reader.positions) for light in reader.capture.lights], axis=1
    )[t, j]
    measured, relit = 1.5 * own * irradiance, own * irradiance
    exposure = 1.0 / np.percentile(measured @ [0.2126, 0.7152, 0.0722], 99.5)
    shown = [encode_srgb(np.clip(exposure * x, 0, 1)) for x in (measured, relit)]
    expected = -10 * np.log10(np.mean((shown[0] - shown[1]) ** 2))
    # Halves err by up to 2^-11 of a sample, a hundredth of the error that is measured.
    assert error.psnr_ldr == pytest.approx(expected, abs=0.05)


def test_texels_are_thinned_to_the_samples_asked_for(field, reader_of):
    reader = reader_of(2.0)
    each = reader.store.observed.count() / field.n_texels
    error = sample_error(field, reader, np.arange(field.n_texels), int(4.5 * each))
    assert error.n_texels == 4
    assert error.linear == pytest.approx(0.5, abs=2 * HALF)


def test_no_texel_is_refused(field, reader_of):
    with pytest.raises(InputError, match="texels"):
        sample_error(field, reader_of(1.0), np.zeros(0, int))
