"""Quantisation and construction of a field: errors of codes, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reflfield.errors import InputError, ShapeError
from reflfield.field.model import Quantisation, build_field
from reflfield.field.quantisation import (
    codes_from_rotations,
    quantise,
    rotations_from_codes,
)
from reflfield.sphere.rotations import matrix_from_quaternion, rotation_angle

HALF_STEP = {"int8": 1 / 254, "int16": 1 / 65534, "float16": 2.0**-11}


@pytest.mark.parametrize("kind", ["int8", "int16", "float16"])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_error_is_within_half_a_step_of_each_group(kind, scale, rng):
    values = rng.normal(size=(3, 2, 50)) * scale * np.array([1.0, 1e3, 1e-3])[:, None, None]
    decoded = quantise(values, kind, n_group_axes=2).decode()
    largest = np.abs(values).max(axis=2, keepdims=True)
    # The scale itself is rounded to float32: 2**-23 of the value on top.
    assert (np.abs(decoded - values) <= largest * (HALF_STEP[kind] + 2.0**-22)).all()


def test_zero_stays_zero_and_signs_are_symmetric(rng):
    values = np.concatenate([np.zeros(3), [1.0, -1.0, 0.3, -0.3]])[None]
    decoded = quantise(values, "int8", n_group_axes=1).decode()[0]
    assert not decoded[:3].any()
    assert np.array_equal(decoded[3::2], -decoded[4::2])
    assert not quantise(np.zeros((2, 4)), "int8", n_group_axes=1).decode().any()


def test_rotations_survive_within_the_stated_angle(rng):
    frames = matrix_from_quaternion(rng.normal(size=(20_000, 4)))
    decoded = rotations_from_codes(codes_from_rotations(frames)).astype(float)
    off = np.rad2deg(rotation_angle(decoded @ np.swapaxes(frames, 1, 2)))
    assert off.max() < 0.0087
    # Not zero either: the bound is approached, so the test sees the codes at work.
    assert off.max() > 0.004


@given(st.tuples(*[st.sampled_from([-1.0, -0.5, 0.0, 1e-5, 0.5, 1.0])] * 4))
def test_rotations_with_ties_and_half_turns_survive(quaternion):
    if not any(quaternion):
        quaternion = (1.0, 0.0, 0.0, 0.0)
    frame = matrix_from_quaternion([quaternion])
    decoded = rotations_from_codes(codes_from_rotations(frame)).astype(float)
    assert np.rad2deg(rotation_angle(decoded @ np.swapaxes(frame, 1, 2)))[0] < 0.0087


def test_mirrored_frames_are_refused():
    with pytest.raises(InputError, match="frames: expected right-handed"):
        codes_from_rotations(np.diag([1.0, 1.0, -1.0])[None])
    with pytest.raises(InputError, match="frames: expected right-handed"):
        codes_from_rotations(np.full((1, 3, 3), np.nan))


@pytest.mark.parametrize("kind", ["int8", "int16", "float16"])
def test_parts_survive_quantisation(kind, parts):
    surface, fitted = parts
    field = build_field(surface, fitted, quantisation=Quantisation(kind, kind, kind))
    for name in ("mean", "basis", "coefficients"):
        wanted = getattr(fitted, name)
        largest = np.abs(wanted).max()
        assert np.abs(getattr(field, name) - wanted).max() <= 1.01 * HALF_STEP[kind] * largest
    assert np.array_equal(field.cluster, fitted.cluster)
    assert np.array_equal(field.texel_of_pixel, surface.texel_of_pixel)
    assert (field.view_side, field.light_side) == (4, 3)


def test_every_cluster_has_its_own_coefficient_scale(parts):
    surface, fitted = parts
    loud = np.where((fitted.cluster == 1)[:, None], 1e6, 1.0) * fitted.coefficients
    field = build_field(surface, replace(fitted, coefficients=loud))
    quiet = fitted.cluster != 1
    assert np.abs(field.coefficients - loud)[quiet].max() < 1e-4  # 3.5 sigma / 65534


def test_node_table_holds_mean_then_basis(make_field):
    field = make_field()
    table = field.node_table
    assert np.array_equal(table[..., 0, :], field.mean)
    assert np.array_equal(table[..., 3, :], field.basis[:, 2])


@pytest.mark.parametrize(
    ("part", "value", "text"),
    [
        ("cluster", np.full(60, 3), "cluster: expected indices from 0 to 2"),
        ("cluster", np.full(60, -1), "cluster: expected indices from 0 to 2"),
        ("coefficients", np.zeros((60, 5)), r"coefficients: expected shape \(60, 4\)"),
        ("coefficients", np.full((60, 4), np.nan), "coefficients: expected finite"),
        ("mean", np.zeros((3, 15, 9, 3)), "basis: expected shape"),
        ("local_from_world", np.tile(np.eye(3), (59, 1, 1)), "local_frames: expected shape"),
        ("domain", "logarithm", "domain: expected one of"),
    ],
)
def test_bad_reflectance_is_refused(part, value, text, parts):
    surface, fitted = parts
    with pytest.raises(InputError, match=text):
        build_field(surface, replace(fitted, **{part: value}))


@pytest.mark.parametrize(
    ("part", "value", "text"),
    [
        ("texel_of_pixel", np.array([[60]]), "texel_of_pixel: expected indices from -1 to 59"),
        ("faces", np.array([[0, 1, 5]]), "faces: expected indices from 0 to 4"),
        ("uv", np.full((5, 2), np.inf), "uv: expected finite"),
        ("positions", np.zeros((6, 3)), r"uv: expected shape \(n_vertices = 6, 2\)"),
    ],
)
def test_bad_surfaces_are_refused(part, value, text, parts):
    surface, fitted = parts
    with pytest.raises(InputError, match=text):
        build_field(replace(surface, **{part: value}), fitted)


def test_node_counts_must_be_squares(parts):
    surface, fitted = parts
    odd = replace(fitted, mean=fitted.mean[:, :15], basis=fitted.basis[:, :, :15])
    with pytest.raises(
        ShapeError, match="mean: expected a square number of nodes, received 15"
    ):
        build_field(surface, odd)


def test_unknown_options_are_refused(parts):
    with pytest.raises(InputError, match=r"quantisation\.basis"):
        Quantisation(basis="int4")
    with pytest.raises(InputError, match="visibility"):
        build_field(*parts, visibility="sometimes")
