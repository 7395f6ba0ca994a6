"""Quantisation and construction of a field: errors of codes, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reflfield.errors import InputError, ShapeError
from reflfield.field.build import (
    POSITION_STEPS,
    Quantisation,
    build_field,
    neighbours_in_a_row,
    quantisation_error,
)
from reflfield.field.file import open_field, write_field
from reflfield.field.quantisation import (
    codes_from_rotations,
    lattice_codes,
    lattice_points,
    rotations_from_codes,
    smallest_codes,
)
from reflfield.field.tucker_coding import factor_table, unfactor_table
from reflfield.sphere.rotations import matrix_from_quaternion, rotation_angle


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_lattice_is_half_a_step_off_at_most(scale, rng):
    points = rng.normal(size=(50, 3)) * scale * np.array([1.0, 0.1, 3.0])
    box = lattice_points(points, 1000)
    step = np.ptp(points, axis=0).max() / 1000
    # Corner, step and result are rounded to float32.
    slack = 4 * np.finfo(np.float32).eps * np.abs(points).max()
    assert np.abs(box.decode() - points).max() <= 0.5 * step + slack + 1000 * slack


@pytest.mark.stability
def test_vertices_far_from_the_origin_are_half_a_step_off_at_most(parts, tmp_path):
    """Coordinates of a survey; the corner of the lattice is kept in double precision."""
    surface, fitted = parts
    positions = 0.1 * surface.positions + [441547.5, 5121946.5, 2345.0]
    field = build_field(replace(surface, positions=positions), fitted)
    write_field(tmp_path / "far.rfld", field)
    read = open_field(tmp_path / "far.rfld")
    # Vertices follow their triangles: compared at the corners, whose order may differ as well.
    corners, expected = (
        np.sort(p[f].reshape(-1, 3), axis=0)
        for p, f in ((read.positions, read.faces), (positions, surface.faces))
    )
    step = np.ptp(positions, axis=0).max() / POSITION_STEPS
    # Besides, the rounding of doubles of five million.
    assert np.abs(corners - expected).max() <= 0.5 * step + 4e-9


@pytest.mark.parametrize("step", [1e-4, 0.01, 0.2])
def test_rotations_survive_within_the_stated_angle(step, rng):
    frames = matrix_from_quaternion(rng.normal(size=(20_000, 4)))
    decoded = rotations_from_codes(codes_from_rotations(frames, step), step).astype(float)
    off = rotation_angle(decoded @ np.swapaxes(frames, 1, 2))
    # Half a step about each axis; errors of one texel do not reach the next.
    assert off.max() <= np.sqrt(3) / 2 * step + 1e-6
    # Not zero either: the bound is approached, so the test sees the codes at work.
    assert off.max() > 0.6 * step


@given(st.tuples(*[st.sampled_from([-1.0, -0.5, 0.0, 1e-5, 0.5, 1.0])] * 4))
def test_rotations_with_ties_and_half_turns_survive(quaternion):
    if not any(quaternion):
        quaternion = (1.0, 0.0, 0.0, 0.0)
    frame = matrix_from_quaternion([quaternion])
    decoded = rotations_from_codes(codes_from_rotations(frame, 1e-4), 1e-4).astype(float)
    # Half a step about each axis, and a matrix in singles.
    bound = np.sqrt(3) / 2 * 1e-4 + 8 * np.finfo(np.float32).eps
    assert rotation_angle(decoded @ np.swapaxes(frame, 1, 2))[0] < bound


def test_alike_frames_have_small_codes(rng):
    vectors = 0.01 * rng.normal(size=(500, 3))
    frames = Rotation.from_rotvec(vectors).as_matrix()
    assert np.abs(codes_from_rotations(frames, 0.001)).max() < 100


def test_mirrored_frames_are_refused():
    with pytest.raises(InputError, match="frames: expected right-handed"):
        codes_from_rotations(np.diag([1.0, 1.0, -1.0])[None], 0.1)
    with pytest.raises(InputError, match="frames: expected right-handed"):
        codes_from_rotations(np.full((1, 3, 3), np.nan), 0.1)


def test_too_fine_turns_are_refused():
    with pytest.raises(InputError, match=r"step: expected 0.0001 to 1 radian"):
        codes_from_rotations(np.eye(3)[None], 1e-6)


def functions_of(reflectance):
    table = np.concatenate([reflectance.mean[:, None], reflectance.basis], axis=1)
    ones = np.ones((len(reflectance.cluster), 1))
    factors = np.concatenate([ones, reflectance.coefficients], axis=1)
    return np.einsum("tf,tfvlc->tvlc", factors, table[reflectance.cluster])


@pytest.mark.parametrize("step", [0.0, 1e-3, 1e-2, 1e-1])
def test_texels_survive_quantisation_as_well_as_the_step_says(step, parts):
    surface, fitted = parts
    field = build_field(surface, fitted, quantisation=Quantisation(step))
    error = functions_of(field) - functions_of(fitted)
    # Four coefficients a texel, and the numbers of the functions that its cluster shares.
    n_numbers = 4 + fitted.mean[0].size * 5 * 3 / 60
    wanted = (step or 2e-5) * np.sqrt(n_numbers / 12)
    assert np.sqrt(np.mean(error**2)) < 1.5 * wanted
    assert step == 0 or np.sqrt(np.mean(error**2)) > 0.2 * wanted
    assert np.array_equal(field.cluster, fitted.cluster)
    assert np.array_equal(field.texel_of_pixel, surface.texel_of_pixel)
    assert (field.view_side, field.light_side) == (4, 3)


def test_coefficients_make_up_for_the_rounding_of_the_functions(parts):
    """What is left along the functions as read is the rounding of coefficients alone."""
    surface, fitted = parts
    field = build_field(surface, fitted, quantisation=Quantisation(0.05))
    n_nodes = fitted.mean[0].size
    error = (functions_of(field) - functions_of(fitted)).reshape(60, n_nodes)
    for cluster in range(3):
        functions = field.basis[cluster].reshape(4, n_nodes).astype(float)
        along = np.linalg.qr(functions.T)[0]
        shares = error[fitted.cluster == cluster] @ along / np.sqrt(n_nodes)
        # Half a step in each direction of the nearest plane; float32 for the rest.
        assert np.abs(shares).max() <= 0.5 * 0.05 * (1 + 1e-3)


@pytest.mark.parametrize("step", [1e-3, 0.1])
def test_quantisation_error_is_that_of_all_nodes(step, parts):
    """By Gram matrices as by forming every texel's nodes."""
    surface, fitted = parts
    field = build_field(surface, fitted, quantisation=Quantisation(step))
    direct = np.sqrt(np.mean((functions_of(field) - functions_of(fitted)) ** 2))
    # Squares of size one are subtracted: half the digits of the difference are left.
    assert quantisation_error(fitted, field) == pytest.approx(direct, rel=1e-4, abs=1e-7)


def test_coarser_steps_give_smaller_codes(parts):
    fine, coarse = (build_field(*parts, quantisation=Quantisation(s)) for s in (1e-3, 0.3))
    for name in ("core", "coefficients"):
        assert np.abs(coarse.arrays[name]).max() < np.abs(fine.arrays[name]).max() / 30


def test_shared_functions_need_few_directions(parts, rng):
    """Six clusters' functions made of two profiles each way: that many factors are kept."""
    weights = rng.normal(size=(6, 5, 2, 2, 3))
    view, light = rng.normal(size=(16, 2)), rng.normal(size=(9, 2))
    table = np.einsum("cfabk,va,lb->cfvlk", weights, view, light)
    arrays = factor_table(table, np.full((6, 5), 10.0), 1e-4)
    assert (arrays["view_factor"].shape[1], arrays["light_factor"].shape[1]) == (2, 2)
    assert arrays["core"].shape[0] <= 12
    # The core's 12 x 2 x 2 x 3 numbers are off by half a step each; products of orthonormal
    # factors add them up to 12 half steps at most, times the root of 16 x 9 x 3 over 10.
    steps = 12 * 0.5 * 1e-4 * np.sqrt(16 * 9 * 3) / 10
    np.testing.assert_allclose(unfactor_table(arrays), table, atol=steps)


@pytest.mark.stability
# The domain is the cube root of samples, which are singles.
@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_unit_of_the_data_does_not_matter(scale, parts):
    surface, fitted = parts
    large = replace(fitted, mean=scale * fitted.mean, basis=scale * fitted.basis)
    field = build_field(surface, large)
    error = functions_of(field) - functions_of(large)
    assert np.abs(error).max() < 1e-3 * np.abs(functions_of(large)).max()


@pytest.mark.stability
def test_equal_and_empty_functions_are_left_out(rng):
    functions = rng.normal(size=(3, 40))
    dependent = np.concatenate([functions, functions[:1], np.zeros((1, 40))]) / np.sqrt(40)
    wanted = rng.normal(size=(30, 5)) @ dependent
    gram = dependent @ dependent.T
    codes, scale = lattice_codes(wanted @ dependent.T, gram, 1e-3)
    assert scale[4] == 0
    assert np.isfinite(scale).all()
    error = (codes * scale) @ dependent - wanted
    assert np.sqrt((error**2).sum(axis=1)).max() < 5e-3


def test_rounding_is_made_up_for_by_the_other_coefficients(rng):
    functions = rng.normal(size=(6, 200)) / np.sqrt(200)
    functions[1:] += 2.0 * functions[:1]  # far from orthogonal
    wanted, gram = rng.normal(size=(500, 6)) @ functions, functions @ functions.T
    codes, scale = lattice_codes(wanted @ functions.T, gram, 0.1)
    fed_back = (codes * scale) @ functions - wanted
    alone = np.linalg.solve(gram, (wanted @ functions.T).T).T
    alone = np.rint(alone / scale) * scale @ functions - wanted
    assert np.sum(fed_back**2) < 0.5 * np.sum(alone**2)


def test_vertices_follow_their_triangles(rng):
    faces = rng.integers(0, 30, size=(40, 3))
    vertices, renumbered = neighbours_in_a_row(faces, 32)
    assert np.array_equal(np.sort(vertices), np.arange(32))
    before, after = ({tuple(f) for f in which} for which in (faces, vertices[renumbered]))
    assert before == after
    used = renumbered.ravel()
    assert np.all(used <= np.concatenate([[0], np.maximum.accumulate(used)[:-1] + 1]))


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
        (
            "local_from_world",
            np.tile(np.eye(3), (59, 1, 1)),
            "local_from_world: expected shape",
        ),
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
        ("positions", np.zeros((6, 3)), r"uv: expected shape \(6, 2\)"),
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
    with pytest.raises(InputError, match=r"quantisation\.step: expected >= 0"):
        Quantisation(step=-1.0)
    with pytest.raises(InputError, match="visibility"):
        build_field(*parts, visibility="sometimes")


def test_codes_beyond_32_bits_are_refused():
    with pytest.raises(InputError, match="expected steps whose codes fit 32 bits"):
        smallest_codes(np.array([1, -(2**31)]))
