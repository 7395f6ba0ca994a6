"""Rotations, harmonics and grids under whatever rotations and directions Hypothesis finds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reflfield.sphere.coupling import couple, uncouple
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.sphere.rotations import (
    frames_from_normals,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_angle,
)
from reflfield.sphere.wigner import block_offsets, rotation_blocks

pytestmark = pytest.mark.stability
# Examples of one law; more are drawn with `--hypothesis-seed` of another day.
SEARCH = settings(max_examples=60, deadline=None)

# Angles with their special values and what lies just beside them.
SPECIAL = [0.0, 1e-300, 1e-16, 1e-9, 1e-8, 1e-4, np.pi / 2, np.pi - 1e-8, np.pi]
ANGLES = st.one_of(st.sampled_from(SPECIAL), st.floats(0.0, np.pi))
TURNS = st.one_of(st.sampled_from([0.0, 1e-12, np.pi, -np.pi]), st.floats(-np.pi, np.pi))
COMPONENTS = st.one_of(
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e-300, 1e-160, 1e-13, 1e150]), st.floats(-1, 1)
)


def about(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    if axis == "z":
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])


def from_euler(alpha, beta, gamma):
    """R = Rz(alpha) Ry(beta) Rz(gamma)."""
    return about("z", alpha) @ about("y", beta) @ about("z", gamma)


def unit(*components):
    """Unit vector without overflow; z where all vanish."""
    vector = np.array(components)
    largest = np.abs(vector).max()
    vector = vector / largest if largest > 0 else np.array([0.0, 0, 1])
    return vector / np.linalg.norm(vector)


def block(flat, offsets, j):
    return flat[offsets[j] : offsets[j + 1]].reshape(2 * j + 1, 2 * j + 1)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_matrices_of_every_degree_are_orthogonal(dtype, bounded):
    degree_limit, offsets, errors = 64, block_offsets(64), [0.0]

    @SEARCH
    @given(TURNS, ANGLES, TURNS)
    def search(alpha, beta, gamma):
        rotation = from_euler(alpha, beta, gamma)[None]
        flat = rotation_blocks(rotation, degree_limit, np.dtype(dtype).name)[0]
        for j in (1, 2, 31, 63):
            matrix = block(flat, offsets, j).astype(np.float64)
            errors.append(np.abs(matrix @ matrix.T - np.eye(2 * j + 1)).max())

    search()
    bounded.at_most(
        errors,
        1e-12 if dtype is np.float64 else 1e-12 * 2.0**29,
        case="any rotation, any degree",
        quantity="largest entry of D D^T - 1, degrees to 63",
        source="demanded of Wigner d by the design; in float32 times the ratio of eps",
        dtype=dtype,
    )


def test_matrices_multiply_as_rotations_do(bounded):
    offsets, errors = block_offsets(16), [0.0]

    @SEARCH
    @given(TURNS, ANGLES, ANGLES, TURNS)
    def search(alpha, beta, other, gamma):
        first, second = from_euler(alpha, beta, gamma), from_euler(gamma, other, alpha)
        flat = rotation_blocks(np.stack([first, second, first @ second]), 16)
        for j in range(16):
            a, b, product = (block(one, offsets, j) for one in flat)
            errors.append(np.abs(a @ b - product).max())

    search()
    # Angles of float64 rotations are known to eps, which order 15 multiplies; at the poles
    # alpha + gamma and the recursion's rounding, of the degree squared, add up.
    bounded.at_most(
        errors,
        15**2 * 16 * np.finfo(float).eps,
        case="any rotation, any degree",
        quantity="D(R1) D(R2) - D(R1 R2), degrees to 15",
        source="16 eps times the degree squared",
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_coupling_keeps_norms_and_comes_back(dtype, bounded):
    errors = [0.0]

    @SEARCH
    @given(st.integers(1, 5), st.integers(1, 5), st.integers(-12, 12), st.integers(0, 2**31))
    def search(view_limit, light_limit, exponent, seed):
        rng = np.random.default_rng(seed)
        shape = (2, view_limit**2, light_limit**2)
        few = rng.standard_normal(shape) * (rng.random(shape) < 0.5) * 10.0**exponent
        few = few.astype(dtype)
        coupled = couple(few)
        size = float(np.linalg.norm(few.astype(np.float64))) or 1.0
        errors.append(np.abs(uncouple(coupled) - few).max() / size)
        norms = np.linalg.norm(few.astype(np.float64).reshape(2, -1), axis=1)
        errors.append(np.abs(coupled.norms() - norms).max() / size)

    search()
    bounded.at_most(
        errors,
        64 * np.finfo(dtype).eps,
        case="any rotation, any degree",
        quantity="coupling there and back, over the norm",
        source="two orthogonal products of some dozen terms: 64 eps",
        dtype=dtype,
    )


def test_frames_are_rotations_whatever_the_hint(bounded):
    errors = [0.0]

    @SEARCH
    @given(*[COMPONENTS] * 6)
    def search(x, y, z, a, b, c):
        normal = unit(x, y, z)
        frame = frames_from_normals(normal[None], np.array([[a, b, c]]))[0]
        errors.append(np.abs(frame @ frame.T - np.eye(3)).max())
        errors.append(abs(np.linalg.det(frame) - 1))
        errors.append(np.abs(frame[2] - normal).max())

    search()
    bounded.at_most(
        errors,
        1e-9,
        case="any direction",
        quantity="departure of frames from rotations",
        source="eps over the 1e-6 at which a hint counts as lost",
    )


def test_quaternions_and_angles_of_any_rotation(bounded):
    errors = [0.0]

    @SEARCH
    @given(TURNS, ANGLES, TURNS)
    def search(alpha, beta, gamma):
        rotation = from_euler(alpha, beta, gamma)
        quaternion = quaternion_from_matrix(rotation)
        assert quaternion[0] >= 0
        errors.append(np.abs(matrix_from_quaternion(quaternion) - rotation).max())
        errors.append(abs(float(rotation_angle(from_euler(0, beta, 0))) - beta))

    search()
    bounded.at_most(
        errors,
        64 * np.finfo(float).eps,
        case="any direction",
        quantity="rotation to quaternion and back; its angle",
        source="64 roundings of entries that are at most pi",
    )


def test_interpolation_reproduces_constants_in_any_direction(bounded):
    errors = [0.0]

    @SEARCH
    @given(st.integers(1, 40), COMPONENTS, COMPONENTS, COMPONENTS)
    def search(side, x, y, z):
        grid = HemisphereGrid(side)
        nodes, weights = grid.taps(unit(x, y, z)[None])
        assert (weights >= 0).all()
        assert ((nodes >= 0) & (nodes < grid.n_nodes)).all()
        errors.append(abs(float(weights.astype(np.float64).sum()) - 1))

    search()
    bounded.at_most(
        errors,
        8 * np.finfo(np.float32).eps,
        case="any direction",
        quantity="sum of the weights of a grid's nodes less 1",
        source="four products in float32",
        dtype=np.float32,
    )
