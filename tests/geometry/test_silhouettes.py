import numpy as np
import pytest
from scipy import ndimage

from reflfield.errors import GeometryError, InputError
from reflfield.geometry.silhouette_distance import (
    SignedDistance,
    _coarse_distance,
    signed_distance,
)

SIZE, SUPERSAMPLING = 96, 16
centres = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), axis=-1)


def coverage_of(distance):
    """Anti-aliased picture of the region where `distance(x, y)` is positive."""
    fine = (np.arange(SIZE * SUPERSAMPLING) + 0.5) / SUPERSAMPLING
    x, y = np.meshgrid(fine, fine)
    blocks = (distance(x, y) > 0).reshape(SIZE, SUPERSAMPLING, SIZE, SUPERSAMPLING)
    return blocks.mean(axis=(1, 3))


@pytest.mark.parametrize("angle", [0.0, 0.2, 0.7, np.pi / 4, 1.3, 2.5])
def test_straight_edges_are_exact_to_the_supersampling(angle):
    def edge(x, y):
        return (x - 48.3) * np.cos(angle) + (y - 47.1) * np.sin(angle)

    truth = edge(centres[..., 0], centres[..., 1])
    inner = (np.abs(truth) < 4.0) & (np.abs(centres - 48.0) < 38.0).all(axis=-1)
    error = np.abs(signed_distance(coverage_of(edge)).values - truth)[inner]
    # A coverage of 16 x 16 samples places an edge to 1/32 pixel.
    assert error.max() < 1.5 / SUPERSAMPLING
    assert error.mean() < 0.5 / SUPERSAMPLING


def test_discs_are_known_to_a_few_hundredths_of_a_pixel():
    def disc(x, y):
        return 30.3 - np.hypot(x - 48.1, y - 47.7)

    truth = disc(centres[..., 0], centres[..., 1])
    error = np.abs(signed_distance(coverage_of(disc)).values - truth)
    assert error[np.abs(truth) < 3.5].mean() < 0.02  # measured .011
    assert error.max() < 0.75  # far away the nearest pixel border is good enough


@pytest.mark.stability
def test_a_line_one_pixel_wide_stays_inside_and_thin():
    silhouette = np.zeros((20, 20))
    silhouette[10, 3:17] = 1.0
    column = signed_distance(silhouette).values[8:13, 10]
    np.testing.assert_array_equal(column, [-1.5, -0.5, 0.5, -0.5, -1.5])


@pytest.mark.stability
def test_a_single_pixel_has_an_outline():
    silhouette = np.zeros((9, 9))
    silhouette[4, 4] = 1.0
    values = signed_distance(silhouette).values
    assert values[4, 4] > 0
    assert (np.delete(values.ravel(), 40) < 0).all()


def test_outside_the_frame_is_empty_unless_the_object_leaves_it():
    silhouette = np.zeros((20, 20))
    silhouette[5:15, 5:15] = 1.0
    whole = signed_distance(silhouette)
    assert not whole.leaves_image
    assert whole.at(np.array([[-5.0, 10.0]]))[0] < -9.0
    silhouette[5:15, :15] = 1.0
    cropped = signed_distance(silhouette)
    assert cropped.leaves_image
    assert cropped.at(np.array([[-5.0, 10.0], [30.0, 10.0]])).min() > 0.0
    assert cropped.at(np.array([[17.5, 2.5]]))[0] < 0.0


def by_scipy(distance, pixels):
    """`SignedDistance.at`, by SciPy's interpolation."""
    height, width = distance.values.shape
    limit = np.array([width, height], float)
    nearest = np.clip(pixels, 0, limit)
    beyond = np.hypot(*(pixels - nearest).T)
    inside = ndimage.map_coordinates(
        distance.values.astype(float), (nearest - 0.5).T[::-1], order=1, mode="nearest"
    )
    if not distance.leaves_image:
        return inside - beyond
    to_border = np.minimum(nearest, limit - nearest).min(axis=1)
    return np.where(beyond > 0, beyond, np.maximum(inside, -to_border))


@pytest.mark.parametrize("leaves_image", [False, True])
@pytest.mark.parametrize("shape", [(20, 31), (1, 31), (20, 1), (2, 2), (1, 1)])
def test_distances_anywhere_are_those_of_scipy(rng, shape, leaves_image):
    rim = np.zeros((int(leaves_image), 2))
    values = rng.normal(size=shape).astype(np.float32)
    distance = SignedDistance(values, np.zeros((0, 2)), rim)
    pixels = rng.uniform(-8, 8 + max(shape), (4000, 2))
    on_grid = np.round(2 * pixels) / 2  # centres, corners and borders
    for places in (pixels, on_grid):
        np.testing.assert_allclose(
            distance.at(places), by_scipy(distance, places), rtol=0, atol=1e-13
        )  # a dozen roundings of numbers below 60


@pytest.mark.stability
def test_distances_of_extreme_places_are_bounded_or_missing():
    distance = SignedDistance(np.ones((3, 4), np.float32), np.zeros((0, 2)), np.zeros((0, 2)))
    far = distance.at(np.array([[1e300, 0.0], [-np.inf, 1.0], [0.0, -1e12]]))
    assert (far <= 1 - 1e12).all()
    assert np.isnan(distance.at(np.array([[np.nan, 0.0], [1.0, np.nan]]))).all()
    assert distance.at(np.zeros((0, 2))).shape == (0,)


@pytest.mark.parametrize(("value", "seen"), [(0.0, "no pixel"), (1.0, "every pixel")])
def test_silhouettes_without_outline_are_refused_by_name(value, seen):
    with pytest.raises(GeometryError, match=f"view 'v7'.*{seen}"):
        signed_distance(np.full((4, 5), value), "silhouette of view 'v7'")


@pytest.mark.parametrize("value", [np.nan, -0.1, 1.1])
def test_what_is_no_coverage_is_refused(value):
    silhouette = np.zeros((4, 4))
    silhouette[1, 1] = value
    with pytest.raises(InputError, match=r"coverage in \[0, 1\]"):
        signed_distance(silhouette)


def test_distances_do_not_depend_on_where_arrays_lie():
    """OpenCV's differ in the last bit with the alignment of its arrays."""
    rows, columns = np.mgrid[:67, :131]
    covered = (rows - 30) ** 2 + (columns - 50) ** 2 < 400
    expected = _coarse_distance(covered)
    for offset in range(1, 17):
        room = np.zeros(covered.size + 64, np.bool_)
        moved = room[offset : offset + covered.size].reshape(covered.shape)
        moved[:] = covered
        np.testing.assert_array_equal(_coarse_distance(moved), expected)
    # Correctly rounded square roots of whole numbers.
    inside = expected[covered].astype(np.float64) + 0.5
    squares = np.rint(inside**2)
    np.testing.assert_array_equal(
        expected[covered], np.sqrt(squares.astype(np.float32)) - np.float32(0.5)
    )


def test_far_distances_are_those_to_an_eighth_of_a_pixel():
    covered = np.zeros((3, 3000), np.bool_)
    covered[:, :10] = True
    far = _coarse_distance(covered)[1]
    np.testing.assert_array_equal(far[1000:], 9.5 - np.arange(1000, 3000))
