"""What is told of clipped photographs, and photographs that say nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.lights import Light
from reflfield.capture.photographs import Photograph
from reflfield.errors import InputError
from reflfield.observations.image_projection import VALUE_KINDS, LookedInto, Projected
from reflfield.pipeline.clipped_values import (
    check_measured,
    clipping_lines,
    stored_measured,
    write_measured,
)


@pytest.fixture
def capture():
    cameras = tuple(
        Camera(name, "orthographic", 4, 4, 1.0, 1.0, 2.0, 2.0, np.eye(4))
        for name in ("left", "right")
    )
    return Capture("vase", Path("/"), cameras, (Light("l0", "directional"),), ())


def projected(darkest=0.0, peak=0.9, **kinds):
    """Values of two cameras by kind."""
    values = np.zeros((2, len(VALUE_KINDS)), np.int64)
    for kind, counts in kinds.items():
        values[:, VALUE_KINDS.index(kind)] = counts
    none = np.zeros(0, np.int64)
    nothing = LookedInto(none, none, np.zeros((0, 3), np.float32), np.zeros((0, 3), bool))
    peaks = np.array([[0.8], [peak]], np.float32)
    return Projected(2, values, np.ones((3, 1), bool), 1.0, darkest, peaks, nothing)


def test_worst_camera_is_named_where_more_than_a_trace_is_saturated(capture):
    (line,) = clipping_lines(
        capture, projected(measured=[9_000, 400], saturated=[0, 100], black=[1, 0])
    )
    assert line.startswith("photographs: 1.05% of the values on the object are saturated")
    assert "20.0%, of camera 'right'" in line


def test_a_trace_is_not_told(capture):
    assert not list(clipping_lines(capture, projected(measured=[9_999, 0], saturated=[5, 0])))


def test_negative_values_are_told_but_not_noise_about_black(capture):
    assert not list(clipping_lines(capture, projected(darkest=-0.05, measured=[9, 9])))
    (line,) = clipping_lines(capture, projected(darkest=-0.8, measured=[9, 9]))
    assert "values on the object are negative, down to -80% of the brightest" in line


def test_an_absurd_pixel_is_told_with_its_photograph(capture):
    photographs = tuple(Photograph(name, i, 0, ()) for i, name in enumerate(("one", "two")))
    both = replace(capture, photographs=photographs)
    assert not list(clipping_lines(both, projected(peak=1e6, measured=[9, 9])))
    (line,) = clipping_lines(both, projected(peak=1e38, measured=[9, 9]))
    assert line.startswith("photographs: 'two' has values up to 1e+38")
    assert not list(clipping_lines(both, replace(projected(), peaks=np.zeros((2, 1)))))


@pytest.mark.parametrize("kind", ["saturated", "transparent", "dark"])
def test_photographs_that_measure_nothing_are_refused(capture, kind):
    with pytest.raises(InputError, match=f"vase: photographs: .* none of 7 \\(7 {kind}\\)"):
        check_measured(capture, projected(**{kind: [3, 4]}))


def test_dark_lights_are_refused(capture):
    dark = replace(capture, lights=(Light("l0", "directional", intensity=[0, 0, 0]),))
    with pytest.raises(InputError, match="vase: lights: expected one with an intensity"):
        check_measured(dark, projected(unlit=[3, 4]))


def test_black_is_a_measurement(capture):
    check_measured(capture, projected(black=[3, 4]))


def test_what_was_measured_is_stored(tmp_path, rng):
    measured = rng.random((5, 11)) < 0.5
    write_measured(tmp_path, measured)
    with np.load(tmp_path / "measured.npz") as stored:
        np.testing.assert_array_equal(stored_measured(dict(stored)), measured)
