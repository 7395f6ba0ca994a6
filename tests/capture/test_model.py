"""Captures: index, subset, digest, and the summary."""

import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.capture import Capture
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.inspect import describe, largest_gap, object_centre
from reflfield.capture.lights import Light
from reflfield.capture.orientation import estimated_up
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"


@pytest.fixture
def frozen():
    return open_capture(FROZEN)


@pytest.fixture
def copied(tmp_path):
    return Path(shutil.copytree(FROZEN, tmp_path / "elsewhere"))


class TestSubset:
    def test_keeps_photographs_of_what_stays(self, frozen):
        part = frozen.subset(views=[1], lights=[2, 0])
        assert [c.id for c in part.cameras] == ["v001"]
        assert [light.id for light in part.lights] == ["l002", "l000"]
        assert part.photograph_index.tolist() == [[1, 0]]
        assert [part.photographs[i].name for i in part.photograph_index[0]] == [
            "v001_l002",
            "v001_l000",
        ]
        assert part.silhouettes == frozen.silhouettes[1:]
        blue = part.read_photograph(part.photograph_index[0, 0])[0, 0, 2]
        assert blue == (1 + 2 * 2) / 4

    def test_of_everything_is_the_same(self, frozen):
        assert frozen.subset().digest() == frozen.digest()
        every = frozen.subset(np.ones(2, bool), np.arange(3))
        assert every.digest() == frozen.digest()

    @pytest.mark.parametrize("views", [[2], [-1], [0, 5]])
    def test_out_of_range(self, frozen, views):
        with pytest.raises(CaptureError, match=r"views.*0 \.\. 1"):
            frozen.subset(views=views)


class TestDigest:
    def test_does_not_depend_on_folder_or_time(self, frozen, copied):
        (copied / "photographs/v000_l000.exr").touch()
        assert open_capture(copied).digest() == frozen.digest()

    @pytest.mark.parametrize(
        ("part", "file"),
        [("photographs", "photographs/v001_l001.exr"), ("silhouettes", "silhouettes/v001.png")],
    )
    def test_content_of_files_enters_its_own_part_only(self, frozen, copied, part, file):
        if part == "photographs":
            write_exr(copied / file, np.ones((6, 8, 3), np.float32))
        else:
            write_png(copied / file, np.full((6, 8), 255, np.uint8))
        changed = open_capture(copied)
        for name in ("cameras", "lights", "silhouettes", "photographs"):
            same = changed.digest((name,)) == frozen.digest((name,))
            assert same == (name != part)

    def test_calibration_enters(self, frozen):
        moved = replace(frozen.cameras[0], fl_x=16.000001)
        other = replace(frozen, cameras=(moved, frozen.cameras[1]))
        assert other.digest(("cameras",)) != frozen.digest(("cameras",))
        brighter = replace(frozen.lights[0], intensity=np.array([9, 9, 18.001]))
        other = replace(frozen, lights=(brighter, *frozen.lights[1:]))
        assert other.digest(("lights",)) != frozen.digest(("lights",))
        assert other.digest(("cameras",)) == frozen.digest(("cameras",))

    def test_made_silhouettes_depend_on_the_photographs(self, frozen, copied):
        bare = replace(open_capture(copied), silhouettes=(None, None))
        before = bare.digest(("silhouettes",))
        write_exr(copied / "photographs/v001_l001.exr", np.ones((6, 8, 3), np.float32))
        assert bare.digest(("silhouettes",)) != before

    def test_order_of_parts_does_not_matter(self, frozen):
        assert frozen.digest(("lights", "cameras")) == frozen.digest(("cameras", "lights"))
        with pytest.raises(CaptureError, match="parts"):
            frozen.digest(("camera",))

    def test_missing_file_is_named(self, frozen, copied):
        capture = open_capture(copied)
        (copied / "photographs/v000_l000.exr").unlink()
        with pytest.raises(CaptureError, match=r"v000_l000\.exr"):
            capture.digest()

    def test_speed(self, shared_data):
        capture = open_capture(shared_data("mitsuba_spot"))
        begin = time.perf_counter()
        assert len(capture.digest()) == 64
        # 32 MB in 1024 files: .05 s on one core; the bound leaves room for a busy machine
        assert time.perf_counter() - begin < 2


class TestModel:
    def test_indices_are_checked(self, frozen):
        stray = Photograph("x", 2, 0, (Exposure(Path("x.exr")),))
        with pytest.raises(CaptureError, match=r"photograph 'x'.*camera < 2"):
            replace(frozen, photographs=(stray,))

    def test_base_geometry_is_checked(self, frozen):
        with pytest.raises(CaptureError, match=r"base_geometry.*'sphere'"):
            replace(frozen, base_geometry="sphere")

    def test_a_single_exposure_is_divided_by_its_time(self, frozen):
        photograph = frozen.photographs[0]
        longer = replace(photograph, exposures=(Exposure(photograph.path, 4.0),))
        np.testing.assert_allclose(longer.read() * 4, photograph.read())

    def test_photograph_read_again_is_checked_for_size(self, frozen):
        other = replace(frozen.cameras[0], width=9)
        capture = replace(frozen, cameras=(other, frozen.cameras[1]))
        with pytest.raises(CaptureError, match=r"image size.*9 x 6"):
            capture.read_photograph(0)


def ring(axis_up, n=8, height=0.5, roll=0.0):
    cameras = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, n, endpoint=False)):
        pose = looking_at([2 * np.cos(angle), 2 * np.sin(angle), height], [0, 0, 0], axis_up)
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        cameras.append(Camera(f"c{i}", "opencv", 4, 4, 4.0, 4.0, 2.0, 2.0, turn @ pose))
    return cameras


class TestUp:
    def test_from_upright_cameras(self):
        assert estimated_up(ring([0, 0, 1])).tolist() == [0, 0, 1]

    @pytest.mark.parametrize("roll", [np.pi / 2, -np.pi / 2])
    def test_from_cameras_that_lie_on_their_side(self, roll):
        assert estimated_up(ring([0, 0, 1], roll=roll)).tolist() == [0, 0, 1]
        # seen from below, up is the other way: towards where the cameras are
        assert estimated_up(ring([0, 0, 1], height=-0.5, roll=roll)).tolist() == [0, 0, -1]

    def test_tilted_world_is_not_snapped(self, rounding):
        tilted = np.array([0.0, 1.0, 1.0]) / np.sqrt(2)
        camera = Camera(
            "c", "opencv", 4, 4, 4.0, 4.0, 2.0, 2.0, looking_at([1, 0, 0], [0, 0, 0], tilted)
        )
        np.testing.assert_allclose(
            estimated_up([camera]), tilted, rtol=0, atol=rounding(np.float64)
        )


class TestSummary:
    def test_counts(self, frozen, rounding):
        summary = describe(frozen)
        assert (summary.n_views, summary.n_lights, summary.n_photographs) == (2, 3, 6)
        assert summary.n_missing_pairs == 0
        assert summary.image_sizes == {(8, 6): 2}
        assert summary.light_kinds == {"point": 1, "directional": 1, "spot": 1}
        assert summary.values[0] == 0
        assert summary.values[2] == 1.25
        assert summary.silhouettes_given == 2
        covered = (4 * 128 / 255 + 12) / 48
        assert summary.silhouette_coverage == pytest.approx((covered, covered))
        np.testing.assert_allclose(summary.object_centre, 0, atol=rounding(np.float64))
        # poses of 12 decimals
        assert summary.camera_distances == pytest.approx((2, 8**0.5), abs=1e-12)
        assert summary.light_distances == pytest.approx(
            (1, 3), abs=rounding(np.float64, scale=3)
        )

    def test_text(self, frozen):
        text = "\n".join(describe(frozen).lines())
        assert "photographs   6, 0 pairs missing" in text
        assert "1 point, 1 directional, 1 spot" in text
        assert "8 x 6 (2)" in text

    def test_missing_pairs_and_negative_values(self, tmp_path):
        write_exr(tmp_path / "a.exr", np.full((4, 4, 3), -1, np.float32))
        camera = ring([0, 0, 1], n=1)[0]
        capture = Capture(
            name="x",
            root=tmp_path,
            cameras=(camera,),
            lights=(Light("a", "unknown"), Light("b", "directional")),
            photographs=(Photograph("a", 0, 0, (Exposure(tmp_path / "a.exr"),)),),
        )
        summary = describe(capture)
        assert summary.n_missing_pairs == 1
        assert summary.n_negative == 48
        assert summary.silhouette_coverage is None
        assert summary.camera_spread is None

    def test_sets_in_the_shared_data(self, shared_data, rounding):
        spot = describe(open_capture(shared_data("mitsuba_spot")), sample=3)
        assert spot.camera_distances == pytest.approx((0.65, 0.65), abs=rounding(np.float32))
        assert spot.light_distances == pytest.approx((0.75, 0.75), abs=rounding(np.float32))
        # 32 directions over a hemisphere: no gap beyond two mean spacings of about 25 degrees
        assert spot.camera_spread < np.radians(50)
        rti = describe(open_capture(shared_data("rti_loewenkopf")), sample=3)
        assert rti.light_spread < np.radians(45)

    def test_object_centre_of_a_ring(self, rounding):
        cameras = tuple(ring([0, 0, 1]))
        capture = Capture("x", Path(), cameras, (Light("a", "unknown"),), ())
        np.testing.assert_allclose(object_centre(capture), 0, atol=rounding(np.float64))

    def test_gap_between_the_axes(self):
        axes = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1.0]])
        gap = largest_gap(axes, axes[4])
        # the cube's diagonal; probes are about 3 degrees apart
        assert np.degrees(gap) == pytest.approx(np.degrees(np.arccos(1 / 3**0.5)), abs=3)

    def test_gap_shrinks_with_more_directions(self, rng):
        directions = rng.normal(size=(400, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        up = np.array([0.0, 0.0, 1.0])
        gaps = [largest_gap(directions[:n], up) for n in (10, 50, 400)]
        assert gaps[0] > gaps[1] > gaps[2]


class TestOrientation:
    def photograph(self, folder, name, orientation):
        picture = Image.new("RGB", (8, 6), (90, 90, 90))
        exif = picture.getexif()
        if orientation is not None:
            exif[274] = orientation
        picture.save(folder / name, exif=exif)

    @pytest.mark.parametrize("orientations", [(1, 6, 1), (None, 3, None), (8, 8, 6)])
    def test_mixture_of_one_camera_is_refused(self, tmp_path, orientations):
        for i, orientation in enumerate(orientations):
            self.photograph(tmp_path, f"{i}.jpg", orientation)
        (tmp_path / "x.lp").write_text("3\n0.jpg 0 0 1\n1.jpg 0 1 1\n2.jpg 1 0 1\n")
        with pytest.raises(CaptureError, match=r"\.jpg: expected Exif orientation"):
            open_capture(tmp_path)

    @pytest.mark.parametrize("orientation", [1, 3, 6])
    def test_one_orientation_stays_as_stored(self, tmp_path, orientation):
        for i in range(2):
            self.photograph(tmp_path, f"{i}.jpg", orientation)
        (tmp_path / "x.lp").write_text("2\n0.jpg 0 0 1\n1.jpg 0 1 1\n")
        capture = open_capture(tmp_path)
        assert capture.read_photograph(0).shape == (6, 8, 3)
