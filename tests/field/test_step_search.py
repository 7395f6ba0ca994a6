"""The search for a size and for a quality: against the files and errors themselves."""

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.field.build import Quantisation, build_field, quantisation_error
from reflfield.field.file import PackedSizes, write_field
from reflfield.field.step_search import field_of_quality, field_of_size


@pytest.fixture
def build(parts):
    surface, fitted = parts
    return lambda step: build_field(surface, fitted, quantisation=Quantisation(step))


def test_size_is_that_of_the_file(build, tmp_path):
    field = build(0.01)
    write_field(tmp_path / "f.rfld", field)
    assert PackedSizes().of(field) == (tmp_path / "f.rfld").stat().st_size


@pytest.mark.parametrize("start", [1e-4, 0.02, 0.5])
@pytest.mark.parametrize("size", [9_000, 13_000])
def test_field_of_a_size_comes_close_from_below_wherever_it_begins(build, start, size):
    reached = PackedSizes().of(field_of_size(build, start, size))
    assert 0.98 * size < reached <= size


def test_search_for_a_size_begins_without_a_residual(build):
    """A model that explains its samples exactly has a residual, and so a step, of 0."""
    reached = PackedSizes().of(field_of_size(build, 0.0, 9_000))
    assert 0.98 * 9_000 < reached <= 9_000


def test_search_for_a_quality_begins_without_a_residual(build, parts):
    def quality(field):
        return -20 * np.log10(quantisation_error(parts[1], field))

    assert 35.0 <= quality(field_of_quality(build, quality, 0.0, 35.0)) < 36.5


@pytest.mark.parametrize("step", [np.nan, -1.0, np.inf])
def test_steps_that_are_no_numbers_are_refused(build, step):
    with pytest.raises(InputError, match="step: expected a number >= 0"):
        field_of_size(build, step, 9_000)
    with pytest.raises(InputError, match="step: expected a number >= 0"):
        field_of_quality(build, lambda _: 1.0, step, 35.0)


def test_sizes_below_the_surface_are_refused(build):
    with pytest.raises(InputError, match=r"size: expected at least [0-9,]+ bytes"):
        field_of_size(build, 0.1, 1000)


def test_field_of_a_quality_just_reaches_it(build, parts):
    def quality(field):
        return -20 * np.log10(quantisation_error(parts[1], field))

    field = field_of_quality(build, quality, 0.02, 35.0)
    # A tenth of the step is half a dB; the error is not quite smooth in the step.
    assert 35.0 <= quality(field) < 36.5


def test_a_quality_out_of_reach_gives_the_finest(build, parts):
    def quality(field):
        return -20 * np.log10(quantisation_error(parts[1], field))

    field = field_of_quality(build, quality, 0.02, 500.0)
    assert field.arrays["core_scale"][0] == np.float32(0.02 / 64)


def test_a_size_beyond_the_finest_gives_the_finest(build):
    assert PackedSizes().of(field_of_size(build, 1.0, 10**6)) < 20_000
