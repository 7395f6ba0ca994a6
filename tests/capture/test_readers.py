"""Readers: each format, told apart by content, and everything that can be wrong with it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from reflfield.capture import documents
from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.native import schema
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"


@pytest.fixture
def native(tmp_path):
    """A writable copy of the frozen capture: its folder, and its description to edit."""
    folder = tmp_path / "frozen"
    shutil.copytree(FROZEN, folder)
    return folder


def edited(folder, change):
    """The folder after `change(document)` was applied to its description."""
    path = folder / "capture.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return folder


class TestNativeContract:
    """The frozen version 1 capture reads today as on the day it was written."""

    def test_counts_and_kinds(self):
        capture = open_capture(FROZEN)
        assert (capture.name, capture.format, capture.base_geometry) == (
            "frozen",
            "native",
            "hull",
        )
        assert [c.id for c in capture.cameras] == ["v000", "v001"]
        assert [light.kind for light in capture.lights] == ["point", "directional", "spot"]
        assert capture.photograph_index.tolist() == [[0, 1, 2], [3, 4, 5]]
        assert [p.name for p in capture.photographs][:2] == ["v000_l000", "v000_l001"]
        assert capture.up.tolist() == [0, 0, 1]

    def test_pixels(self):
        # R = x / 8, G = y / 8, B = (view + 2 light) / 4
        capture = open_capture(FROZEN)
        y, x = np.mgrid[:6, :8]
        for index, photograph in enumerate(capture.photographs):
            blue = (photograph.camera + 2 * photograph.light) / 4
            expected = np.stack([x / 8, y / 8, np.full((6, 8), blue)], axis=-1)
            np.testing.assert_array_equal(capture.read_photograph(index), expected)

    def test_silhouette(self):
        coverage = open_capture(FROZEN).read_silhouette(0)
        assert coverage[1, 2] == pytest.approx(128 / 255)
        assert coverage[2, 2] == 1
        assert coverage[0, 0] == 0

    def test_cameras(self):
        first, second = open_capture(FROZEN).cameras
        # two metres before the origin, looking along +y: x right, z up
        pixels, depth = first.project([[0, 0, 0], [0.5, 0, 0.25]])
        np.testing.assert_array_equal(pixels, [[4, 3], [8, 1]])
        np.testing.assert_array_equal(depth, [2, 2])
        # the poses have 12 decimals
        np.testing.assert_allclose(second.centre, [0, -2, 2], rtol=0, atol=2e-12)
        assert second.distortion == (-0.1, 0, 0.001, 0, 0, 0, 0, 0)

    def test_lights(self):
        point, far, spot = open_capture(FROZEN).lights
        np.testing.assert_allclose(point.irradiance([[0, 0, 0]]), [[1, 1, 2]])
        np.testing.assert_allclose(far.directions([[0, 0, 0]]), [[0, -(0.5**0.5), 0.5**0.5]])
        np.testing.assert_allclose(far.irradiance([[0, 0, 0]]), [[1, 2, 3]])
        np.testing.assert_allclose(spot.irradiance([[0, 0, 0], [0, -2, 0]]), [[4] * 3, [0] * 3])

    def test_description_file_and_forced_format_mean_the_same(self):
        for capture in (
            open_capture(FROZEN / "capture.json"),
            open_capture(FROZEN, "native"),
            open_capture(str(FROZEN)),
        ):
            assert len(capture.photographs) == 6


class TestNative:
    def test_photographs_as_a_list(self, native):
        def change(document):
            document["photographs"] = [
                {"camera": "v001", "light": "l002", "file": "photographs/v001_l002.exr"},
                {"camera": "v000", "light": "l000", "file": "photographs/v000_l000.exr"},
            ]

        capture = open_capture(edited(native, change))
        assert capture.photograph_index.tolist() == [[1, -1, -1], [-1, -1, 0]]

    def test_bracketed_exposures_are_merged(self, native):
        radiance = np.linspace(0.05, 3, 6 * 8 * 3).reshape(6, 8, 3)
        seconds = [0.1, 0.4, 1.6]
        for i, t in enumerate(seconds):
            encoded = np.round(encode_srgb(np.clip(radiance * t, 0, 1)) * 65535)
            write_png(native / f"shot{i}.png", encoded.astype(np.uint16))
        entry = {
            "camera": "v000",
            "light": "l000",
            "exposures": [
                {"file": f"shot{i}.png", "seconds": t} for i, t in enumerate(seconds)
            ],
        }
        capture = open_capture(edited(native, lambda d: d.update(photographs=[entry])))
        # 16-bit steps in the darkest values used
        np.testing.assert_allclose(capture.read_photograph(0), radiance, rtol=2e-3)

    def test_optional_fields(self, native):
        def change(document):
            document.update(
                up=[0, 1, 0],
                base_geometry="plane",
                photographs=[
                    {"camera": "v000", "light": "sky", "file": "photographs/v000_l000.exr"}
                ],
            )
            document["cameras"][0]["model"] = "orthographic"
            del document["cameras"][0]["silhouette"]
            document["lights"] = [{"id": "sky", "type": "environment", "file": "sky.exr"}]

        write_exr(native / "sky.exr", np.ones((2, 4, 3), np.float32))
        capture = open_capture(edited(native, change))
        assert capture.up.tolist() == [0, 1, 0]
        assert capture.cameras[0].kind == "orthographic"
        assert capture.lights[0].file == native / "sky.exr"
        np.testing.assert_array_equal(capture.read_silhouette(0), np.ones((6, 8)))

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            (lambda d: d.update(version=2), "newer version 2; update"),
            (lambda d: d.update(version=0), "version: 1 was expected"),
            (lambda d: d.pop("cameras"), "'cameras' is a required"),
            (lambda d: d.update(cameras=[]), "cameras"),
            (lambda d: d["cameras"][0].update(fl_x="wide"), r"cameras\[0\]\.fl_x"),
            (lambda d: d["cameras"][0].update(focal=1), r"cameras\[0\].*'focal'"),
            (
                lambda d: d["cameras"][1].update(id="v000"),
                r"capture\.json: cameras: .*'v000' twice",
            ),
            (lambda d: d["cameras"][1].update(id="../x"), r"cameras\[1\]\.id"),
            (
                lambda d: d["lights"][1].update(id="l000"),
                r"capture\.json: lights: .*'l000' twice",
            ),
            (lambda d: d["lights"][0].pop("position"), r"lights\[0\].*position"),
            (lambda d: d["lights"][0].update(intensity=[1, 1, -1]), r"lights\[0\]\.intensity"),
            (
                lambda d: d["cameras"][0].update(camera_from_world=np.zeros((4, 4)).tolist()),
                "camera 'v000'.*last row",
            ),
            (
                lambda d: d["cameras"][0].update(
                    camera_from_world=np.diag([1.0, 1, 0, 1]).tolist()
                ),
                "camera 'v000'.*singular",
            ),
            (lambda d: d["cameras"][0].update(fl_x=0), "camera 'v000'.*singular.*fl_x"),
            (lambda d: d["photographs"].update(pattern="x_{camera}.exr"), "pattern"),
            (
                lambda d: d["photographs"].update(pattern="../{camera}_{light}.exr"),
                "leaves the folder",
            ),
            (
                lambda d: d["photographs"].update(pattern="/tmp/{camera}_{light}.exr"),
                "leaves the folder",
            ),
            (lambda d: d["cameras"][0].update(silhouette="../s.png"), "leaves the folder"),
            (
                lambda d: d.update(
                    photographs=[{"camera": "v9", "light": "l000", "file": "a"}]
                ),
                "id of a camera.*'v9'",
            ),
            (
                lambda d: d.update(
                    photographs=[{"camera": "v000", "light": "l9", "file": "a"}]
                ),
                "id of a light.*'l9'",
            ),
            (
                lambda d: d.update(photographs=[{"camera": "v000", "light": "l000"}]),
                "photographs",
            ),
            (
                lambda d: d.update(
                    photographs=[
                        {
                            "camera": "v000",
                            "light": "l000",
                            "file": "photographs/v000_l000.exr",
                        },
                        {
                            "camera": "v000",
                            "light": "l000",
                            "file": "photographs/v000_l001.exr",
                        },
                    ]
                ),
                "duplicate photograph of camera 'v000' under light 'l000'",
            ),
        ],
    )
    def test_bad_descriptions(self, native, change, reason):
        with pytest.raises(CaptureError, match=reason):
            open_capture(edited(native, change))

    @pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
    def test_numbers_that_are_not_finite(self, native, number):
        path = native / "capture.json"
        path.write_text(path.read_text().replace('"fl_x": 16.0', f'"fl_x": {number}', 1))
        with pytest.raises(CaptureError, match=r"capture\.json.*not finite"):
            open_capture(native)

    def test_missing_photographs_are_counted_at_opening(self, native):
        (native / "photographs/v000_l002.exr").unlink()
        (native / "photographs/v001_l001.exr").unlink()
        with pytest.raises(CaptureError, match=r"v000_l002\.exr.*missing \(2 of 6"):
            open_capture(native)
        assert len(open_capture(native, require_photographs=False).photographs) == 6

    def test_image_of_another_size(self, native):
        write_exr(native / "photographs/v001_l000.exr", np.zeros((6, 9, 3), np.float32))
        with pytest.raises(CaptureError, match=r"v001_l000.*image size.*8 x 6.*'v001'.*9 x 6"):
            open_capture(native)

    def test_truncated_photograph(self, native):
        path = native / "photographs/v001_l000.exr"
        path.write_bytes(path.read_bytes()[:-20])
        with pytest.raises(CaptureError, match=r"v001_l000\.exr.*truncated"):
            open_capture(native).read_photograph(3)

    def test_empty_silhouette(self, native):
        write_png(native / "silhouettes/v001.png", np.zeros((6, 8), np.uint8))
        with pytest.raises(CaptureError, match=r"v001\.png.*empty silhouette.*'v001'"):
            open_capture(native).read_silhouette(1)

    def test_silhouette_of_another_size(self, native):
        write_png(native / "silhouettes/v001.png", np.full((5, 8), 255, np.uint8))
        with pytest.raises(CaptureError, match=r"v001\.png.*image size"):
            open_capture(native)
        (native / "silhouettes/v001.png").unlink()
        with pytest.raises(CaptureError, match=r"v001\.png.*cannot be read"):
            open_capture(native)

    def test_link_that_leaves_the_folder(self, native, tmp_path):
        outside = tmp_path / "outside.exr"
        (native / "photographs/v000_l000.exr").rename(outside)
        (native / "photographs/v000_l000.exr").symlink_to(outside)
        with pytest.raises(
            CaptureError,
            match=r"v000_l000\.exr' is reached through a symbolic .*follow_links",
        ):
            open_capture(native)
        capture = open_capture(native, follow_links=True)
        assert capture.read_photograph(0)[0, 1].tolist() == [0.125, 0, 0]

    def test_schema_is_what_it_says(self):
        assert schema()["properties"]["version"] == {"const": 1}


class TestMiddlebury:
    LINE = "a.png 100 0 3.5 0 100 2.5 0 0 1 1 0 0 0 1 0 0 0 1 0 0 2"

    def write(self, folder, *lines, count=None):
        folder.mkdir(exist_ok=True)
        write_png(folder / "a.png", np.full((6, 8, 3), 128, np.uint8))
        text = "\n".join([str(len(lines) if count is None else count), *lines, ""])
        (folder / "a_par.txt").write_text(text)
        return folder

    def test_by_hand(self, tmp_path):
        capture = open_capture(self.write(tmp_path / "c", self.LINE))
        pixels, depth = capture.cameras[0].project([[0.02, 0.0, 0.0]])
        # whole-number pixel centres: (4.5, 2.5) there is (5, 3) here
        np.testing.assert_allclose(pixels, [[5.0, 3.0]], atol=1e-13)
        assert depth.tolist() == [2]
        assert [light.kind for light in capture.lights] == ["unknown"]
        assert capture.cameras[0].id == "a"

    @pytest.mark.parametrize(
        ("lines", "count", "reason"),
        [
            ([LINE], 2, "number of images"),
            ([LINE, "b.png 1 2 3"], None, "21 finite numbers"),
            ([LINE.replace("3.5", "nan")], None, "21 finite numbers"),
            ([LINE.replace("100 0 3.5", "0 0 0")], None, "'a.png'.*singular"),
            ([LINE.replace("100 0 3.5", "100 9 3.5")], None, "skew"),
            (
                [LINE.replace("1 0 0 0 1 0 0 0 1 0", "1 0 0 0 1 0 0 0 0 0")],
                None,
                "singular|row",
            ),
            ([LINE.replace("a.png", "../a.png")], None, "leaves the folder"),
            ([LINE.replace("a.png", "gone.png")], None, r"gone\.png"),
        ],
    )
    def test_bad_lines(self, tmp_path, lines, count, reason):
        with pytest.raises(CaptureError, match=reason):
            open_capture(self.write(tmp_path / "c", *lines, count=count), "middlebury")

    def test_dino(self, shared_data):
        capture = open_capture(shared_data("middlebury_sparse_rings") / "dinoSparseRing")
        assert (capture.format, capture.n_views, capture.n_lights) == ("middlebury", 16, 1)
        # the README's bounding box projects into the images; the ring's axis is +y
        low, high = np.array(
            [(-0.061897, -0.018874, -0.057845), (0.010897, 0.068227, 0.015495)]
        )
        middle = (low + high) / 2
        for camera in capture.cameras:
            pixels, depth = camera.project(middle[None])
            assert camera.contains(pixels).all()
            assert 0.5 < depth[0] < 0.8
        assert capture.up.tolist() == [0, 1, 0]


class TestLp:
    def write(self, folder, *lines, count=None):
        folder.mkdir(exist_ok=True)
        text = "\n".join([str(len(lines) if count is None else count), *lines, ""])
        (folder / "dome.lp").write_text(text)
        for name in ("a.png", "b c.png"):
            write_png(folder / name, np.full((4, 8, 3), 128, np.uint8))
        return folder

    def test_by_hand(self, tmp_path):
        folder = self.write(tmp_path / "c", "a.png 0 0 2", "b c.png 3 0 4")
        capture = open_capture(folder)
        assert (capture.format, capture.base_geometry) == ("lp", "plane")
        assert [p.name for p in capture.photographs] == ["a", "b c"]
        directions = [light.directions([[0, 0, 0]])[0].tolist() for light in capture.lights]
        assert directions == [[0, 0, 1], [0.6, 0, 0.8]]
        assert capture.lights[1].irradiance([[0, 0, 0]]).tolist() == [[1, 1, 1]]
        # 8 pixels are 1 m; x right, y up, z towards the camera
        camera = capture.cameras[0]
        pixels, depth = camera.project([[0, 0, 0], [0.5, 0.25, 0.1]])
        np.testing.assert_array_equal(pixels, [[4, 2], [8, 0]])
        assert depth[1] < depth[0]
        np.testing.assert_allclose(camera.view_directions([[0, 0, 0]]), [[0, 0, 1]])
        np.testing.assert_array_equal(capture.read_silhouette(0), np.ones((4, 8)))

    def test_file_beside_when_its_folder_got_lost(self, tmp_path):
        capture = open_capture(self.write(tmp_path / "c", "jpeg-exports/a.png 0 0 1"))
        assert capture.photographs[0].path.name == "a.png"
        assert capture.read_photograph(0).shape == (4, 8, 3)

    @pytest.mark.parametrize(
        ("lines", "count", "reason"),
        [
            (["a.png 0 0 1"], 2, "number of photographs"),
            (["a.png 0 0 1"], "x", "number of photographs"),
            (["a.png 0 0 0"], None, "light direction of 'a.png'"),
            (["a.png 0 0 nan"], None, "three finite numbers.*'a.png 0 0 nan'"),
            (["a.png 0 0 1_0"], None, "three finite numbers"),
            (["a.png 0 0 1e308"], None, "at most 1e.12"),
            (["a.png 0 0"], None, "three finite numbers"),
            (["../gone.png 0 0 1"], None, "leaves the folder"),
            (["gone.png 0 0 1"], None, r"gone\.png"),
            (["a.png 0 0 1", "gone.png 0 0 1"], None, r"gone\.png.*missing \(1 of 2"),
        ],
    )
    def test_bad_lines(self, tmp_path, lines, count, reason):
        with pytest.raises(CaptureError, match=reason):
            open_capture(self.write(tmp_path / "c", *lines, count=count), "lp")

    def test_more_than_a_thousand_lights(self, tmp_path):
        folder = self.write(tmp_path / "c", *[f"a.png {i} 1 1" for i in range(1200)])
        capture = open_capture(folder, require_photographs=False)
        assert capture.n_lights == 1200
        assert capture.photographs[1].name == "a_1"

    def test_loewenkopf(self, shared_data):
        capture = open_capture(shared_data("rti_loewenkopf"))
        assert (capture.n_views, capture.n_lights) == (1, 240)
        assert (np.stack([light.direction for light in capture.lights])[:, 2] > 0).all()
        # light from the left and light from the right show different sides
        azimuth = np.array([light.direction[0] for light in capture.lights])
        left, right = (capture.read_photograph(int(f(azimuth))) for f in (np.argmin, np.argmax))
        assert np.corrcoef(left.ravel(), right.ravel())[0, 1] < 0.8


class TestDetection:
    def test_description_by_content_not_by_name(self, tmp_path, native):
        path = native / "other.json"
        (native / "capture.json").rename(path)
        assert open_capture(path).format == "native"

    def test_suffixes_in_capital_letters(self, tmp_path):
        write_png(tmp_path / "a.png", np.full((4, 4, 3), 99, np.uint8))
        (tmp_path / "LIGHTS.LP").write_text("1\na.png 0 0 1\n")
        assert open_capture(tmp_path).format == "lp"

    def test_two_descriptions_ask_for_one(self, native):
        frame = {"file_path": "photographs/v000_l000.exr", "pl_pos": [0, 0, 1]}
        pose = {"transform_matrix": np.eye(4).tolist(), "fl_x": 10.0}
        (native / "transforms.json").write_text(json.dumps({"frames": [frame | pose]}))
        with pytest.raises(
            CaptureError, match=r"expected one of.*capture\.json, transforms\.json"
        ):
            open_capture(native)
        assert open_capture(native, "native").format == "native"
        assert open_capture(native, "transforms").format == "transforms"

    def test_folder_without_description(self, tmp_path):
        with pytest.raises(CaptureError, match=r"none of them"):
            open_capture(tmp_path)

    def test_nothing_there(self, tmp_path):
        with pytest.raises(CaptureError, match="does not exist"):
            open_capture(tmp_path / "gone")

    def test_unknown_format(self, tmp_path):
        with pytest.raises(CaptureError, match=r"format.*'tables'"):
            open_capture(tmp_path, "tables")

    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (b"PK\x03\x04\xff\xfe", "zip archive; unpack"),
            (b"\x89RFLD\xff\xfe\x00", "binary"),
            (b"hello", "capture description"),
            (b"", "capture description"),
            (b"{}", "capture description"),
            (b'{"frames": [', "expected JSON"),
            (b"[" * 100000, "capture description"),
            (b'{"a":' * 100000, "expected JSON"),
        ],
    )
    def test_other_files(self, tmp_path, content, reason):
        path = tmp_path / "thing.json"
        path.write_bytes(content)
        with pytest.raises(CaptureError, match=rf"thing\.json.*{reason}"):
            open_capture(path)

    @pytest.mark.parametrize(("name", "kind"), [("a.EXR", "photograph"), ("f.rfld", "field")])
    def test_photographs_and_fields_are_no_captures(self, tmp_path, name, kind):
        (tmp_path / name).write_bytes(b"\x76\x2f\x31\x01")
        with pytest.raises(CaptureError, match=rf"expected a capture, received a {kind}"):
            open_capture(tmp_path / name)

    def test_array_named_as_capture(self, tmp_path):
        (tmp_path / "capture.json").write_text("[1, 2]")
        with pytest.raises(CaptureError, match="JSON object, received list"):
            open_capture(tmp_path)

    def test_oversized_description(self, native, monkeypatch):
        monkeypatch.setattr(documents, "MAX_DOCUMENT_BYTES", 100)
        with pytest.raises(CaptureError, match=r"capture\.json.*at most"):
            open_capture(native)

    def test_byte_order_mark(self, native):
        path = native / "capture.json"
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
        assert open_capture(native).n_views == 2

    def test_path_with_a_nul(self, native):
        change = {"pattern": "a\0{camera}{light}"}
        with pytest.raises(CaptureError, match="not a usable path"):
            open_capture(edited(native, lambda d: d.update(photographs=change)))


@pytest.mark.parametrize(
    ("n_images", "reason"), [(2, "own folder"), (4, r"4 images alone.*`reflfield lights`")]
)
def test_photographs_alone_are_told_where_their_lights_may_come_from(
    tmp_path, n_images, reason
):
    for number in range(n_images):
        Image.new("RGB", (4, 3)).save(tmp_path / f"{number}.png")
    with pytest.raises(CaptureError, match=reason):
        open_capture(tmp_path)
