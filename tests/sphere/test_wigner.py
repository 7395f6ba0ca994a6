import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.errors import ShapeError
from reflfield.sphere.harmonics import real_harmonics
from reflfield.sphere.wigner import (
    block_offsets,
    degree_tables,
    fill_wigner_d,
    rotation_blocks,
)

# Near beta = 0 and pi the two solutions of the recursion grow alike and rounding grows
# with the square of the degree; there the matrix is made as a product of two others.
DEGENERATE_SINE = 0.1
# Rotations at which Euler angles are not unique, and general ones.
SPECIAL = [np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1]), np.diag([-1.0, 1, -1])]


def wigner_d(degree, beta):
    """Matrix d^j_mn(beta) by rows m and columns n, in numpy: the reference of the kernel."""
    if abs(np.sin(beta)) < DEGENERATE_SINE:
        return _ascend(degree, beta + 1.0) @ _ascend(degree, 1.0).T
    return _ascend(degree, beta)


def _ascend(degree, beta):
    """The recursion from degree 0 upwards."""
    older = np.zeros((1, 1))
    newer = np.ones((1, 1))
    edge = np.ones(1)
    for j in range(1, degree + 1):
        edge = _edge_row(edge, j, beta)
        older, newer = newer, _next_degree(older, newer, edge, j, beta)
    return newer


def _edge_row(edge, j, beta):
    """Row d^j_{j,n} from row d^{j-1}_{j-1,n}."""
    orders = np.arange(-j + 1, j)
    row = np.zeros(2 * j + 1)
    growth = np.sqrt(2.0 * j * (2.0 * j - 1.0) / ((j + orders) * (j - orders)))
    row[1:-1] = edge * growth * (-0.5 * np.sin(beta))
    row[0] = np.sin(0.5 * beta) ** (2 * j)
    row[-1] = np.cos(0.5 * beta) ** (2 * j)
    return row


def _next_degree(older, newer, edge, j, beta):
    """Matrix of degree j from those of degrees j - 2 and j - 1 and its last row."""
    matrix = np.zeros((2 * j + 1, 2 * j + 1))
    orders = np.arange(-j, j + 1)
    sign = np.where((orders - j) % 2, -1.0, 1.0)
    matrix[-1] = edge
    matrix[:, -1] = sign * edge
    matrix[:, 0] = edge[::-1]
    matrix[0] = (sign * edge)[::-1]
    i = j - 1
    inner = orders[1:-1].astype(np.float64)
    now, last = j**2 - inner**2, np.maximum(i**2 - inner**2, 0.0)
    centre = i * j * np.cos(beta) - np.outer(inner, inner)
    total = (2 * i + 1) * centre * newer
    if i > 0:
        total[1:-1, 1:-1] -= j * np.sqrt(np.outer(last, last))[1:-1, 1:-1] * older
        matrix[1:-1, 1:-1] = total / (i * np.sqrt(np.outer(now, now)))
    else:
        matrix[1, 1] = np.cos(beta)
    return matrix


@pytest.mark.stability
@pytest.mark.parametrize("beta", [1e-8, 0.3, np.pi / 2, 3.0, np.pi])
def test_degree_256_is_orthogonal(beta, bounded):
    d = wigner_d(256, beta)
    bounded.at_most(
        np.abs(d @ d.T - np.eye(513)),
        1e-12,
        case="Wigner d of degree 256",
        quantity="largest entry of d d^T - 1, of the form that the kernel is compared with",
        source="demanded by the design",
    )


@pytest.mark.stability
@pytest.mark.parametrize("beta", [0.0, 1e-8, 1e-3, 0.3, np.pi / 2, 3.0, np.pi - 1e-3, np.pi])
def test_kernel_is_orthogonal_at_its_highest_degree(beta, bounded):
    tables = degree_tables(64, "float64")
    d = np.zeros(tables.recursion.shape[1])
    turn = (np.cos(beta), np.sin(beta))
    fill_wigner_d(turn, tables.row_start, tables.recursion, tables.edge, d)
    rows = d[tables.row_start[63] : tables.row_start[64]].reshape(64, -1)
    centre = rows.shape[1] // 2
    kept = rows[:, centre - 63 : centre + 64]
    bounded.at_most(
        np.abs(kept @ kept.T - np.eye(64)),
        1e-12,
        case="Wigner d of degree 256",
        quantity="largest entry of d d^T - 1, of the kernel at its highest degree, 63",
        source="demanded by the design",
    )


@pytest.mark.stability
def test_loss_of_orthogonality_grows_at_most_linearly_with_the_degree():
    degrees = np.array([8, 16, 32, 64, 128])
    errors = []
    for degree in degrees:
        d = wigner_d(int(degree), 1.1)
        errors.append(np.abs(d @ d.T - np.eye(2 * degree + 1)).max())
    slope = np.polyfit(np.log(degrees), np.log(errors), 1)[0]
    assert slope < 1.5  # one step of the recursion per degree, plus scatter


def test_kernel_and_matrix_form_agree(rounding):
    tables = degree_tables(15, "float64")
    d = np.zeros(tables.recursion.shape[1])
    for beta in (0.0, 0.7, np.pi):
        fill_wigner_d(
            (np.cos(beta), np.sin(beta)), tables.row_start, tables.recursion, tables.edge, d
        )
        for j in range(15):
            rows = d[tables.row_start[j] : tables.row_start[j + 1]].reshape(j + 1, -1)
            centre = rows.shape[1] // 2
            kept = rows[:, centre - j : centre + j + 1]
            np.testing.assert_allclose(
                kept, wigner_d(j, beta)[j:], atol=rounding(np.float64, 20)
            )


def test_single_precision_stays_within_its_rounding(rounding):
    turns = Rotation.random(20, random_state=1).as_matrix()
    double, single = rotation_blocks(turns, 31), rotation_blocks(turns, 31, "float32")
    assert np.abs(double - single).max() < rounding(np.float32, operations=31)


def test_turned_function_is_the_function_at_turned_directions(rng, rounding):
    turns = np.concatenate([SPECIAL, Rotation.random(6, random_state=2).as_matrix()])
    points = rng.standard_normal((30, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    coefficients = rng.standard_normal((len(turns), 144))
    offsets = block_offsets(12)
    for r, blocks, before in zip(turns, rotation_blocks(turns, 12), coefficients, strict=True):
        after = np.concatenate(
            [
                blocks[offsets[j] : offsets[j + 1]].reshape(2 * j + 1, 2 * j + 1)
                @ before[j * j : (j + 1) ** 2]
                for j in range(12)
            ]
        )
        np.testing.assert_allclose(
            real_harmonics(points, 12) @ after,
            real_harmonics(points @ r, 12) @ before,
            atol=rounding(np.float64, 144, scale=4),
        )


def test_product_of_rotations_is_product_of_matrices(rounding):
    first, second = Rotation.random(2, random_state=3).as_matrix()
    a, b, c = (rotation_blocks(r[None], 9)[0] for r in (first, second, first @ second))
    offsets = block_offsets(9)
    for j in range(9):
        part, shape = slice(offsets[j], offsets[j + 1]), (2 * j + 1, 2 * j + 1)
        product = a[part].reshape(shape) @ b[part].reshape(shape)
        np.testing.assert_allclose(product, c[part].reshape(shape), atol=rounding(float, 30))


def test_rotation_about_z_mixes_only_equal_orders(rounding):
    block = rotation_blocks(Rotation.from_rotvec([[0, 0, 0.4]]).as_matrix(), 3)[
        0, 10:35
    ].reshape(5, 5)
    m = np.abs(np.arange(-2, 3))
    assert np.abs(block[m[:, None] != m[None, :]]).max() == 0.0
    assert block[4, 4] == pytest.approx(np.cos(0.8), abs=rounding(float))


def test_wrong_shapes_are_refused():
    with pytest.raises(ShapeError, match="rotations"):
        rotation_blocks(np.eye(3), 3)
