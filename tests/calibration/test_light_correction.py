"""Lights corrected by what a matt object looks like: planted errors, and what is left."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from reflfield.calibration.light_adjustment import LitPoints, adjust_lights
from reflfield.calibration.light_correction import correct_lights
from reflfield.capture.conversion import convert_capture
from reflfield.capture.lights import DirectionalLight
from reflfield.capture.readers import open_capture
from reflfield.cli import app
from reflfield.errors import InputError
from tests.calibration.planted_lights import light_errors, simulate, with_light_errors


@pytest.fixture(scope="session")
def dome(made_once):
    """The capture of an amphora by twelve cameras under 24 lights."""
    return open_capture(made_once("light-dome", simulate)[0])


def test_planted_errors_are_removed(dome):
    wrong = with_light_errors(dome, 5.0, np.random.default_rng(1))
    correction = correct_lights(wrong)
    assert correction.is_kept
    assert correction.misfit_after < 0.5 * correction.misfit_before
    before, after = (light_errors(x.lights, dome.lights) for x in (wrong, correction))
    assert after.degrees < 0.65 * before.degrees
    # What the photographs tell: reflections within the object, which is no matt surface under
    # one lamp, change luminance by the per mille that make up hundredths of a degree.
    assert after.degrees_told < 0.4 * before.degrees_told


def test_right_lights_are_kept(dome):
    correction = correct_lights(dome)
    assert correction.lights is dome.lights
    assert "gain nothing" in correction.lines()[0]


def test_directions_of_a_matt_sphere_are_exact(rng):
    normals = rng.normal(size=(800, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points, albedo = 0.1 * normals, rng.uniform(0.2, 0.8, 800)
    true = rng.normal(size=(30, 3))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    lit = LitPoints(points, normals, np.ones((30, 800)), np.ones(30))
    luminance = np.einsum("lnc,nc->ln", lit.factors(true), albedo[:, None] * normals)
    luminance[luminance <= 0.05] = np.nan
    luminance[rng.random(luminance.shape) < 0.05] *= 2  # highlights
    lit = replace(lit, luminance=luminance)
    shifts = 0.005 * rng.normal(size=true.shape)
    shifts -= (shifts * true).sum(axis=1, keepdims=True) * true
    start = true + shifts
    fitted, _ = adjust_lights(lit, start)
    assert lit.misfit(fitted) < 0.35 * lit.misfit(start)


def test_command(dome, tmp_path):
    wrong = with_light_errors(dome, 5.0, np.random.default_rng(2))
    convert_capture(wrong, tmp_path / "wrong", link=True)
    arguments = ["calibrate", str(tmp_path / "wrong"), "-o", str(tmp_path / "out"), "--link"]
    done = CliRunner().invoke(app, [*arguments, "--lights"])
    assert done.exit_code == 0, done.output
    assert "lights: 24 moved" in done.output
    entry = json.loads((tmp_path / "out/calibration.json").read_text())
    assert entry["cameras"] is None
    assert entry["lights"]["kept"]
    before, after = (
        light_errors(lights, dome.lights).degrees
        for lights in (wrong.lights, open_capture(tmp_path / "out").lights)
    )
    assert after < 0.65 * before


def test_distant_lights_are_refused(dome):
    distant = DirectionalLight([0, 0, 1], id="sun")
    with pytest.raises(InputError, match="expected point lights, received 'sun'"):
        correct_lights(replace(dome, lights=(distant, *dome.lights[1:])))
    even = replace(dome.lights[0], falls_off=False)
    with pytest.raises(InputError, match="of type 'point' with a constant irradiance"):
        correct_lights(replace(dome, lights=(even, *dome.lights[1:])))
