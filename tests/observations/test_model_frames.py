"""Frames refined against a model: planted frames come back, steps follow the true slopes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.errors import ShapeError
from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.frame_refinement import _add_texel, _gains, _own_function, refined_frames
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
from reflfield.sphere.hemisphere import HemisphereGrid, place_directions, softened_cosine

from .rigs import dome, interpolated, tilted_frames, write_samples

N = 60
SIDES = (7, 7)
SPREAD = np.radians(2.0)


def lobes(grid, axis, sharpness):
    """Product of two lobes (view nodes, light nodes), stretched along one axis."""
    stretched = grid * np.where(axis, 1.0, 0.4)
    half = stretched[:, None] + stretched[None]
    return np.exp(-sharpness * (half[..., 0] ** 2 + half[..., 1] ** 2))


@pytest.fixture
def model(rng):
    """Two clusters with a mean and one basis function; roots of an anisotropic reflectance."""
    grid = HemisphereGrid(7).directions
    table = np.zeros((2, 49, 49, 6), np.float32)
    for k, axis in enumerate(([1, 0, 1], [0, 1, 1])):
        table[k, ..., :3] = 0.4 + 0.8 * lobes(grid, axis, 3.0)[..., None]
        table[k, ..., 3:] = 0.3 * lobes(grid, axis, 6.0)[..., None] * [1.0, 0.5, 0.2]
    return ClusteredModel(
        cluster=rng.integers(0, 2, N).astype(np.int32),
        coefficients=rng.uniform(-0.5, 0.5, (N, 1)).astype(np.float32),
        table=table,
        precision=np.tile(np.eye(1), (2, 1, 1)),
    )


@pytest.fixture
def planted(model, tmp_path, rng):
    """Reader in frames that are off by the spread, and the frames that made the samples."""
    capture = dome(14, 15, missing={(1, 2), (3, 4)})
    truth = tilted_frames(rng, N)
    seen = Observed(
        rng.random((N, 14)) < 0.7, rng.random((N, 15)) < 0.8, PhotographedPairs.of(capture)
    )
    reader = TexelReader(
        store=ObservationStore(tmp_path / "store", seen),
        capture=capture,
        positions=rng.uniform(-0.1, 0.1, (N, 3)),
        local_from_world=truth,
        sides=SIDES,
        options=ResamplingOptions(),
    )
    write_samples(tmp_path / "store", capture, np.zeros((N, 14, 15, 3)))
    taps = reader.transformed(np.arange(N))
    parts = model.table.reshape(2, 49, 49, 2, 3)[model.cluster]
    nodes = parts[..., 0, :] + model.coefficients[:, None, None] * parts[..., 1, :]
    lights = reader.luminance(np.arange(N)).lights
    cosine = softened_cosine(lights[..., 2])[:, None, :, None]
    observed = seen.views[:, :, None] & seen.lights[:, None] & seen.pairs.table
    # What is not observed must be excluded, whatever it holds.
    values = np.where(observed[..., None], cosine * interpolated(taps, nodes) ** 3, 7.0)
    write_samples(tmp_path / "store", capture, values)
    off = Rotation.from_rotvec(SPREAD * rng.normal(size=(N, 3))).as_matrix()
    return reader.rotated((off @ truth).astype(np.float32)), truth


def angles(frames, truth):
    turns = Rotation.from_matrix(frames.astype(float) @ np.swapaxes(truth.astype(float), 1, 2))
    return np.degrees(turns.magnitude())


def test_planted_frames_come_back(planted, model):
    reader, truth = planted
    refined = refined_frames(reader, model, np.arange(N), SPREAD)
    before, after = angles(reader.local_from_world, truth), angles(refined, truth)
    # Half floats, a bilinear target and three steps leave a few hundredths.
    assert before.mean() > 2.5
    assert np.median(after) < 0.02 * np.median(before)
    assert after.mean() < 0.1 * before.mean()


def test_values_not_measured_are_excluded(planted, model, rng):
    """Of half of the values nothing is known: frames come back from the others."""
    reader, truth = planted
    stored = open_samples(reader.store.location)
    values = stored[:]
    values[rng.random(values.shape) < 0.5] = np.nan
    stored[:] = values
    before = angles(reader.local_from_world, truth)
    refined = refined_frames(reader, model, np.arange(N), SPREAD)
    # Less near than with all of them; were NaN a value, none would come back at all.
    assert np.median(angles(refined, truth)) < 0.06 * np.median(before)


def test_a_spread_of_nothing_keeps_the_frames(planted, model):
    reader, _ = planted
    some = np.arange(0, N, 2)
    held = refined_frames(reader, model, some, 1e-9)
    # By less than the spread: observed 3e-13 degrees.
    assert angles(held, reader.local_from_world[some]).max() < np.degrees(1e-9)


def test_blocks_do_not_change_the_frames(planted, model):
    reader, _ = planted
    whole = refined_frames(reader, model, np.arange(N), SPREAD)
    first, last = np.split(np.arange(N), [7])
    blocks = [refined_frames(reader, model, rows, SPREAD) for rows in (first, last)]
    np.testing.assert_array_equal(np.concatenate(blocks), whole)


@pytest.mark.stability
def test_texels_without_samples_keep_their_frames(planted, model):
    reader, _ = planted
    reader.store.observed.views[5] = False
    reader.store.observed.lights[8] = False
    refined = refined_frames(reader, model, np.arange(N), SPREAD)
    assert np.isfinite(refined).all()
    np.testing.assert_array_equal(refined[[5, 8]], reader.local_from_world[[5, 8]])


def test_normal_equations_are_the_slopes_of_the_squares(model, rng):
    """The gradient that the kernel sums is that of the squares, by differences."""
    frame = tilted_frames(rng, 1)[0].astype(float)
    views, lights = (HemisphereGrid(5).directions[[6, 8, 12, 16, 18]] for _ in range(2))
    values = rng.random((5, 5, 3)).astype(np.float32)
    counts = (np.ones(5, bool), np.ones(5, bool), rng.random((5, 5)) < 0.8)
    nodes = np.zeros((49, 49, 3))
    _own_function(model.table[0], model.coefficients[0], nodes)

    def equations(turn, log_gain=0.0):
        turned = Rotation.from_rotvec(turn).as_matrix() @ frame
        taps = (np.zeros(5, np.int64), np.zeros(5, np.int64))
        places = (np.zeros((5, 8)), np.zeros((5, 8)))
        gains, normal = np.zeros((5, 3)), np.zeros((5, 5))
        place_directions(views, turned, 7, taps[0], places[0])
        place_directions(lights, turned, 7, taps[1], places[1])
        _gains(lights, turned, 3.0, 7, gains)
        scale = np.exp(log_gain)
        _add_texel(values, nodes, counts, taps, places, gains, SIDES, scale, normal)
        return normal

    h = 1e-5
    normal = equations(np.zeros(3))
    assert normal[0, 4] == 3 * np.count_nonzero(counts[2])
    slopes = [
        (equations(h * axis)[4, 4] - equations(-h * axis)[4, 4]) / (2 * h) for axis in np.eye(3)
    ]
    slopes.append(
        (equations(np.zeros(3), h)[4, 4] - equations(np.zeros(3), -h)[4, 4]) / (2 * h)
    )
    # Places are differenced over half a degree: they bend by a per cent of their slope.
    np.testing.assert_allclose(
        -2 * normal[4, :4], slopes, rtol=0.02, atol=0.02 * np.abs(slopes).max()
    )


def test_model_of_other_grids_is_refused(planted, model):
    reader, _ = planted
    with pytest.raises(ShapeError, match=r"model\.table"):
        refined_frames(replace(reader, sides=(5, 7)), model, np.arange(N), SPREAD)
