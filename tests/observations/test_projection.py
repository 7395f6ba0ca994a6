"""Photographs into texture space: half-pixel centres, irradiance, what stays zero."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.capture import Capture
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.lights import Light, facing_irradiance
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.errors import InputError, ShapeError
from reflfield.metrics.held_out_photographs import mean_sample
from reflfield.observations import store
from reflfield.observations.bilinear_sampling import sample_bilinear
from reflfield.observations.image_projection import (
    HALF_MAX,
    USUAL_SAMPLE,
    Projection,
    directions_of,
    look_into,
    project_chunk,
    project_photographs,
    shines,
)
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.store import ObservationStore, Observed
from reflfield.util.blocks import Blocks, Scheduler

from .rigs import dome

WIDTH, HEIGHT = 8, 6


def camera(name, height=2.0):
    """Looks down on the plane z = 0 from above; one pixel is one metre."""
    pose = looking_at([0, 0, height], [0, 0, 0], [0, 1, 0])
    return Camera(name, "orthographic", WIDTH, HEIGHT, 1.0, 1.0, 4.0, 3.0, pose)


def lamp(name, height=1.0, intensity=(1.0, 1.0, 1.0), **changes):
    return Light(name, "point", position=[0, 0, height], intensity=intensity, **changes)


@pytest.fixture
def capture_of(tmp_path):
    """Return a function from images (n_views, n_lights, h, w, 3) to a capture of them."""

    def make(images, lights, missing=()):
        photographs = []
        for i, j in np.ndindex(images.shape[:2]):
            if (i, j) not in missing:
                path = tmp_path / f"v{i}_l{j}.exr"
                write_exr(path, images[i, j].astype(np.float32))
                photographs.append(Photograph(path.stem, i, j, (Exposure(path),)))
        cameras = tuple(camera(f"v{i}") for i in range(len(images)))
        return Capture("plane", tmp_path, cameras, tuple(lights), tuple(photographs))

    return make


@pytest.fixture
def project(tmp_path):
    """Return a function that projects and reads everything back."""

    def run(capture, positions, visible=None):
        positions = np.asarray(positions, float)
        if visible is None:
            visible = np.ones((len(positions), capture.n_views), bool)
        folder = tmp_path / f"run{len(list(tmp_path.glob('run*')))}"
        projection = Projection(capture, positions, visible, folder / "store")
        project_photographs(projection, Blocks(Scheduler(), folder / "blocks"))
        lights = np.ones((len(positions), capture.n_lights), bool)
        observed = Observed(visible, lights, PhotographedPairs.of(capture))
        stored = ObservationStore(folder / "store", observed)
        samples = stored.read(slice(None)).astype(np.float64) * stored.unit
        return observed.pairs.as_product(samples, np.nan)

    return run


class TestBilinear:
    def test_pixel_centres_return_pixels(self, rng):
        images = rng.random((2, 3, 4, 3)).astype(np.float32)
        y, x = np.mgrid[:3, :4]
        centres = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
        got = sample_bilinear(images, centres)
        assert np.array_equal(got, np.moveaxis(images.reshape(2, 12, 3), 0, 1))

    def test_quarter_of_the_way(self):
        image = np.array([[[[0.0] * 3, [4.0] * 3], [[8.0] * 3, [100.0] * 3]]], np.float32)
        # x at 1/4, y at 1/2: 0.5 * (3/4 * 0 + 1/4 * 4) + 0.5 * (3/4 * 8 + 1/4 * 100)
        assert sample_bilinear(image, np.array([[0.75, 1.0]]))[0, 0, 0] == 16.0

    def test_plane_is_reproduced(self, rng, rounding):
        y, x = np.mgrid[:20, :30] + 0.5
        image = np.stack([x, y, 2 * x - 3 * y + 1], axis=-1)[None].astype(np.float32)
        at = rng.uniform([0.5, 0.5], [29.5, 19.5], size=(500, 2))
        got = sample_bilinear(image, at)[:, 0]
        expected = np.stack([at[:, 0], at[:, 1], 2 * at[:, 0] - 3 * at[:, 1] + 1], axis=1)
        assert np.abs(got - expected).max() < rounding(np.float32, 4, scale=60)

    @pytest.mark.parametrize("pixel", [(-5.0, -7.0), (0.0, 0.5), (-np.inf, 0.1), (-1e300, 0)])
    def test_beyond_the_image_is_the_rim(self, pixel, rng):
        images = rng.random((1, 3, 4, 3)).astype(np.float32)
        assert np.array_equal(sample_bilinear(images, np.array([pixel]))[0, 0], images[0, 0, 0])
        far = np.array([[40.0, 1e9]])
        assert np.array_equal(sample_bilinear(images, far)[0, 0], images[0, 2, 3])

    @pytest.mark.parametrize("shape", [(1, 1), (1, 3), (3, 1)])
    def test_images_a_pixel_wide(self, shape, rng):
        images = rng.random((1, *shape, 3)).astype(np.float32)
        got = sample_bilinear(images, np.array([[0.5, 0.5], [9.0, 9.0]]))
        assert np.array_equal(got[:, 0], images[0, [0, -1], [0, -1]])

    def test_no_pixels(self):
        assert sample_bilinear(np.ones((2, 3, 3, 3), np.float32), np.zeros((0, 2))).size == 0

    def test_bad_input(self):
        images = np.ones((1, 2, 2, 3), np.float32)
        with pytest.raises(InputError, match=r"pixels: .*NaN in row 1"):
            sample_bilinear(images, np.array([[0.0, 0.0], [0.0, np.nan]]))
        with pytest.raises(ShapeError, match="images"):
            sample_bilinear(images[0], np.zeros((1, 2)))
        with pytest.raises(ShapeError, match="pixels"):
            sample_bilinear(images, np.zeros((1, 3)))


class TestIrradiance:
    def test_near_point_light(self):
        near = lamp("l0", height=2.0, intensity=[8, 4, 0])
        # Distances 2 and sqrt(8): a quarter and an eighth of the intensity.
        got = facing_irradiance((near,), np.array([[0, 0, 0.0], [2, 0, 0]]))
        assert np.allclose(got[:, 0], [[2, 1, 0], [1, 0.5, 0]], rtol=1e-6)  # float32

    def test_unknown_light_counts_as_one(self):
        assert (facing_irradiance((Light("l", "unknown"),), np.zeros((2, 3))) == 1).all()


class TestProjection:
    def test_ramp_under_a_near_light(self, capture_of, project):
        ramp = np.broadcast_to(np.arange(WIDTH)[:, None], (1, 1, HEIGHT, WIDTH, 3))
        capture = capture_of(ramp, [lamp("l0", height=1.0, intensity=[1, 2, 4])])
        # The axis hits x = 4 px, halfway between the pixels 3 and 4.
        got = project(capture, [[0, 0, 0], [1, 0, 0], [-0.5, 0, 0]])[:, 0, 0]
        squared_distance = np.array([1, 2, 1.25])[:, None]
        expected = np.array([3.5, 4.5, 3.0])[:, None] * squared_distance / [1, 2, 4]
        assert np.allclose(got, expected, rtol=2**-11)  # half floats: 11 bits

    def test_image_rows_run_down(self, capture_of, project):
        rows = np.broadcast_to(np.arange(HEIGHT)[:, None, None], (1, 1, HEIGHT, WIDTH, 3))
        capture = capture_of(rows, [Light("l0", "directional")])
        assert project(capture, [[0, 1, 0]])[0, 0, 0, 0] == 1.5

    def test_views_and_lights_keep_their_places(self, capture_of, project, monkeypatch):
        monkeypatch.setattr(store, "VIEWS_PER_CHUNK", 2)
        number = np.arange(15).reshape(5, 3)[:, :, None, None, None]
        images = np.broadcast_to(number, (5, 3, HEIGHT, WIDTH, 3))
        lights = [Light(f"l{j}", "directional") for j in range(3)]
        got = project(capture_of(images, lights), [[0, 0, 0], [1, 1, 0]])
        assert np.array_equal(got[1, ..., 0], number[..., 0, 0, 0])

    def test_lights_of_a_large_view_are_written_a_few_at_a_time(
        self, capture_of, project, monkeypatch, rng
    ):
        lights = [lamp(f"l{i}") for i in range(7)]
        capture = capture_of(rng.uniform(0.1, 1.0, (2, 7, HEIGHT, WIDTH, 3)), lights)
        points = np.c_[rng.uniform(-2, 2, (9, 2)), np.zeros(9)]
        whole = project(capture, points)
        # Two parts of a view: four and three of its lights.
        monkeypatch.setattr(store, "MOST_VIEW_BYTES", 9 * 4 * store.SAMPLE_BYTES)
        assert store.chunk_shape(9, PhotographedPairs.of(capture)) == (9, 8)
        monkeypatch.setattr(store, "VIEWS_PER_CHUNK", 1)
        assert store.chunk_shape(9, PhotographedPairs.of(capture)) == (9, 4)
        np.testing.assert_array_equal(project(capture, points), whole)

    def test_more_lights_than_are_read_together(self, capture_of, project):
        number = np.arange(70)[None, :, None, None, None]
        images = np.broadcast_to(number, (1, 70, HEIGHT, WIDTH, 3))
        lights = [Light(f"l{j}", "directional") for j in range(70)]
        assert np.array_equal(project(capture_of(images, lights), [[0, 0, 0]])[0, 0, :, 0],
                              np.arange(70))  # fmt: skip

    def test_unseen_stay_zero_and_of_what_was_not_photographed_there_is_nothing(
        self, capture_of, project
    ):
        images = np.ones((2, 2, HEIGHT, WIDTH, 3))
        lights = [Light(f"l{j}", "directional") for j in range(2)]
        visible = np.array([[True, True], [False, True], [False, False]])
        got = project(capture_of(images, lights, {(1, 0)}), np.zeros((3, 3)), visible)
        expected = np.repeat(visible[:, :, None], 2, axis=2).astype(float)
        expected[:, 1, 0] = np.nan
        assert np.array_equal(got[..., 0], expected, equal_nan=True)

    def test_view_without_photographs(self, capture_of, project):
        images = np.ones((2, 1, HEIGHT, WIDTH, 3))
        capture = capture_of(images, [Light("l0", "directional")], {(0, 0)})
        got = project(capture, np.zeros((1, 3)))[0, :, 0, 0]
        assert np.array_equal(got, [np.nan, 1], equal_nan=True)

    def test_light_without_blue_measures_none_and_a_spot_that_misses_gives_none(
        self, capture_of, project
    ):
        beam = {"direction": [1, 0, 0], "cone_angle": 0.1, "falloff_angle": 0.1}
        spot = Light("l1", "spot", position=[0, 0, 1], **beam)
        capture = capture_of(
            np.ones((1, 2, HEIGHT, WIDTH, 3)), [lamp("l0", 1, [1, 1, 0]), spot]
        )
        got = project(capture, [[0, 0, 0]])[0, 0]
        assert np.array_equal(got, [[1, 1, np.nan], [0, 0, 0]], equal_nan=True)

    def test_order_of_texels(self, capture_of, project, rng):
        images = rng.random((2, 2, HEIGHT, WIDTH, 3))
        capture = capture_of(images, [lamp("l0"), lamp("l1", 3.0)])
        positions = rng.uniform(-2, 2, size=(40, 3)) * [1, 1, 0]
        order = rng.permutation(40)
        assert np.array_equal(project(capture, positions)[order],
                              project(capture, positions[order]))  # fmt: skip

    @pytest.mark.stability
    @pytest.mark.parametrize("scale", [2.0**-14, 1.0, 2.0**14])
    def test_scale_of_light_and_image_cancels(self, capture_of, project, rng, scale):
        """Any common unit drops out: radiance over irradiance."""
        images = rng.uniform(0.5, 1, (1, 1, HEIGHT, WIDTH, 3)).astype(np.float32)
        positions = rng.uniform(-2, 2, size=(20, 3)) * [1, 1, 0]
        one = project(capture_of(images, [lamp("l0")]), positions)
        scaled = project(capture_of(images * scale, [lamp("l0", 1, [scale] * 3)]), positions)
        assert np.array_equal(scaled, one)

    @pytest.mark.stability
    @pytest.mark.parametrize("exponent", [-120, -37, -13, -1, 0, 4, 14, 41, 110])
    def test_samples_scale_with_the_capture(self, capture_of, project, rng, exponent):
        """Exact for powers of two within floats: halves hold samples over their unit."""
        images = rng.uniform(2e-3, 1, (1, 1, HEIGHT, WIDTH, 3)).astype(np.float32)
        sun = [Light("l0", "directional")]
        positions = rng.uniform(-2, 2, size=(20, 3))
        one = project(capture_of(images, sun), positions)
        scaled = project(capture_of(images * 2.0**exponent, sun), positions)
        assert np.array_equal(scaled, one * 2.0**exponent)

    @pytest.mark.stability
    @pytest.mark.parametrize("scale", [1e-12, 1e-3, 1e7, 1e12])
    def test_no_sample_clips_or_underflows(self, capture_of, project, rng, scale):
        """Of five decades around the usual sample: a highlight, and a shade."""
        images = 10.0 ** rng.uniform(-4, 2, (1, 1, HEIGHT, WIDTH, 3))
        sun = [Light("l0", "directional", intensity=[scale] * 3)]
        y, x = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1)
        centres = np.stack([x + 0.5 - WIDTH / 2, HEIGHT / 2 - y - 0.5, 0 * x], axis=1)
        got = project(capture_of(images, sun), centres)[:, 0, 0]
        # The unit is within a factor of 8 of the median over `USUAL_SAMPLE`.
        least = 2.0**-25 * 8 * np.median(images) / USUAL_SAMPLE
        # Halves round to eleven bits, and float32 once before; below 2^-14 to 2^-25.
        np.testing.assert_allclose(
            got * scale, images[0, 0].reshape(-1, 3), rtol=2**-10.9, atol=least
        )

    @pytest.mark.stability
    def test_peaks_beyond_the_range_of_halves_are_held_there(self, capture_of, project):
        images = np.full((1, 1, HEIGHT, WIDTH, 3), 2.0**-5)
        images[..., 0, 0, :] = 1e9
        corner = [0.5 - WIDTH / 2, HEIGHT / 2 - 0.5, 0]
        capture = capture_of(images, [Light("l0", "directional")])
        got = project(capture, [corner, [0, 0, 0], [1, 0, 0]])
        assert got[:, 0, 0, 0].tolist() == [HALF_MAX, 2.0**-5, 2.0**-5]

    def test_shapes(self, capture_of, tmp_path):
        capture = capture_of(np.ones((1, 1, HEIGHT, WIDTH, 3)), [lamp("l0")])
        with pytest.raises(ShapeError, match="positions"):
            Projection(capture, np.zeros((2, 2)), np.ones((2, 1), bool), tmp_path)
        with pytest.raises(ShapeError, match="visible"):
            Projection(capture, np.zeros((2, 3)), np.ones((2, 3), bool), tmp_path)


class TestClipping:
    """Photographs of eight bits, one exposure, as a camera writes them."""

    @pytest.fixture
    def measure(self, tmp_path):
        """Return a function from codes (h, w, 3) to samples at pixel centres, and counts."""

        def run(codes, offset=0.0):
            write_png(tmp_path / "p.png", codes.astype(np.uint8))
            photograph = Photograph("p", 0, 0, (Exposure(tmp_path / "p.png"),))
            sun = Light("l0", "directional")
            capture = Capture("clipped", tmp_path, (camera("v0"),), (sun,), (photograph,))
            y, x = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1)
            positions = np.stack([x + 0.5 + offset - WIDTH / 2, HEIGHT / 2 - y - 0.5, 0 * x], 1)
            visible = np.ones((len(positions), 1), bool)
            projection = Projection(capture, positions, visible, tmp_path / "store")
            projected = project_photographs(projection, Blocks(Scheduler(), tmp_path / "b"))
            observed = Observed(visible, np.ones_like(visible), PhotographedPairs.product(1, 1))
            stored = ObservationStore(tmp_path / "store", observed)
            values = stored.read(slice(None)).astype(np.float64) * stored.unit
            return values.reshape(HEIGHT, WIDTH, 3), projected, stored

        return run

    def test_saturated_values_are_not_measured(self, measure):
        codes = np.full((HEIGHT, WIDTH, 3), 100)
        codes[2, 3] = [255, 200, 255]
        values, projected, stored = measure(codes)
        expected = np.zeros(values.shape, bool)
        expected[2, 3] = [True, False, True]
        assert np.array_equal(np.isnan(values), expected)
        assert projected.count("saturated") == 2
        assert projected.count("measured") == values.size - 2
        assert stored.gaps == 2 / values.size
        assert projected.measured.all()  # the green of that pixel

    def test_beside_a_saturated_pixel_nothing_is_measured(self, measure):
        codes = np.full((HEIGHT, WIDTH, 3), 100)
        codes[2, 3] = 255
        values, projected, _ = measure(codes, offset=0.25)
        # A quarter of the way from pixel 3 to 4, and three quarters from 2 to 3.
        assert np.argwhere(np.isnan(values[..., 0])).tolist() == [[2, 2], [2, 3]]
        assert projected.count("saturated") == 6

    def test_code_zero_is_the_bounded_measurement_that_it_is(self, measure):
        codes = np.full((HEIGHT, WIDTH, 3), 100)
        codes[1, 1], codes[4, 4] = 1, 0
        values, projected, stored = measure(codes)
        half = 2.0**-25  # what halves round to, of the unit
        least = 1 / 255 / 12.92
        np.testing.assert_allclose(values[1, 1], least, rtol=0, atol=half)
        # Of numbers spread evenly below half a code the mean cube root is three quarters of
        # the largest.
        np.testing.assert_allclose(values[4, 4], 0.75**3 * least / 2, rtol=0, atol=half)
        assert projected.count("black") == 3
        assert stored.gaps == 0

    def test_texel_of_which_nothing_was_measured_is_told(self, measure):
        codes = np.full((HEIGHT, WIDTH, 3), 100)
        codes[5, 6] = 255
        _, projected, _ = measure(codes)
        assert np.flatnonzero(~projected.measured[:, 0]).tolist() == [5 * WIDTH + 6]


class TestDirections:
    def test_are_unit_and_lead_to_camera_and_light(self, rng, rounding):
        capture = dome(4, 3)
        points = rng.normal(size=(10, 3)) * 0.3
        views, lights = directions_of(capture, points)
        assert views.shape == (10, 4, 3)
        assert lights.shape == (10, 3, 3)
        for directions, ends in (
            (views, [c.centre for c in capture.cameras]),
            (lights, [light.position for light in capture.lights]),
        ):
            towards = np.stack(ends)[None] - points[:, None]
            cross = np.cross(directions, towards)
            assert np.abs(cross).max() < rounding(np.float32, scale=3)
            assert (np.sum(directions * towards, axis=2) > 0).all()
            assert np.abs(np.linalg.norm(directions, axis=2) - 1).max() < rounding(np.float32)

    def test_unknown_light_is_overhead(self):
        capture = dome(2, 1, lights=(Light("l0", "unknown"),))
        assert directions_of(capture, np.zeros((2, 3)))[1].tolist() == [[[0, 0, 1]]] * 2

    def test_pairs(self):
        pairs = PhotographedPairs.of(dome(2, 3, missing={(1, 2)}))
        assert pairs.table.tolist() == [[True, True, True], [True, True, False]]


def test_camera_that_images_nothing_is_named(capture_of, tmp_path):
    capture = capture_of(np.ones((1, 1, HEIGHT, WIDTH, 3)), [lamp("l0")])
    perspective = replace(capture.cameras[0], kind="opencv")
    behind = replace(capture, cameras=(perspective,))
    projection = Projection(
        behind, np.array([[0, 0, 5.0]]), np.ones((1, 1), bool), tmp_path / "s"
    )
    store.create_samples(projection.location, 1, projection.pairs)
    with pytest.raises(InputError, match="pixels"):
        project_chunk(projection, range(1))


def test_the_photographs_looked_into_show_every_light(capture_of, tmp_path):
    """Every fourth of 10 x 6 photographs in their order would show four of the lights."""
    capture = capture_of(np.ones((10, 6, HEIGHT, WIDTH, 3)), [lamp(f"l{i}") for i in range(6)])
    points = np.zeros((1, 3))
    seen = np.ones((1, 10), np.bool_)
    look = look_into(Projection(capture, points, seen, tmp_path / "none"))
    shown = [capture.photographs[i] for i in look.photograph]
    assert {p.light for p in shown} == set(range(6))
    assert len({p.camera for p in shown}) >= 6


def test_means_of_samples_leave_out_what_was_not_measured(rng):
    values = rng.random((5, 7, 3)).astype(np.float16)
    observed = rng.random((5, 7)) < 0.6
    observed[0] = False
    for gaps in (False, True):
        if gaps:
            values[rng.random(values.shape) < 0.3] = np.nan
        means = mean_sample(values, observed)
        for i in range(5):
            for c in range(3):
                counted = values[i, observed[i], c].astype(float)
                counted = counted[~np.isnan(counted)]
                expected = counted.mean() if len(counted) else np.nan
                # Sums of seven single-precision numbers below 1.
                np.testing.assert_allclose(means[i, c], expected, rtol=1e-6)
    assert np.isnan(means[0]).all()


def test_colours_that_lights_have_are_those_of_their_irradiance():
    spot = Light(
        "spot", "spot", position=np.array([0.0, 0, 1]), direction=np.array([0.0, 0, -1]),
        intensity=np.array([1.0, 0, 1]), cone_angle=0.5, falloff_angle=0.1,
    )  # fmt: skip
    lights = (
        Light("off", "point", position=np.array([0.0, 1, 1]), intensity=np.zeros(3)),
        Light("red", "directional", intensity=np.array([1.0, 0, 0])),
        spot,
        Light("unknown", "unknown"),
    )
    points = np.random.default_rng(1).uniform(-1, 1, (40, 3)) * [1, 1, 0.2]
    found = shines(lights, points)
    np.testing.assert_array_equal(found, facing_irradiance(lights, points) > 0)
    assert 0 < found[:, 2, 0].sum() < 40
