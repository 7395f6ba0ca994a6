"""Metashape's XML, Kintsugi 3D's view sets, LLFF's poses: small files, and real ones."""

import json

import numpy as np
import pytest

from reflfield.capture.image_files import ImageReading
from reflfield.capture.image_writing import write_png
from reflfield.capture.inspect import describe
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError
from tests.capture.calibrations import assert_same_cameras, quaternion, ring, write_photographs

NAMES = [f"shot {i}.png" for i in range(5)]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def words(array):
    return " ".join(repr(float(number)) for number in np.ravel(array))


def turned(angle=0.3):
    """A rotation that is no symmetry of the ring."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ np.array(
        [[1.0, 0, 0], [0, c, -s], [0, s, c]]
    )


# --- Metashape ----------------------------------------------------------------------------

CALIBRATION = (
    "<f>31</f><cx>0.5</cx><cy>-0.5</cy><b1>-1</b1><k1>-0.1</k1><p1>0.003</p1><p2>0.004</p2>"
)


def similarity(rotation, translation, scale):
    return (
        f'<transform><rotation locked="false">{words(rotation)}</rotation>'
        f"<translation>{words(translation)}</translation><scale>{scale}</scale></transform>"
    )


def metashape(cameras, *, calibration=CALIBRATION, kind="frame", component="", chunk="",
              labels=NAMES, extra="", sensor=""):  # fmt: skip
    """XML of cameras whose poses are written as they are."""
    entries = "".join(
        f'<camera id="{i}" sensor_id="0" component_id="0" label="{label}"><transform>'
        f"{words(np.linalg.solve(camera.camera_from_world, np.eye(4)))}</transform>"
        f"<rotation_covariance>1 0 0 0 1 0 0 0 1</rotation_covariance></camera>"
        for i, (camera, label) in enumerate(zip(cameras, labels, strict=True))
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">'
        '<chunk label="c" enabled="true"><sensors next_id="1"><sensor id="0" label="lens" '
        f'type="{kind}"><resolution width="16" height="12"/>{sensor}'
        f'<calibration type="{kind}" class="adjusted"><resolution width="16" height="12"/>'
        f"{calibration}</calibration></sensor></sensors>"
        f'<components active_id="0"><component id="0" label="1">{component}</component>'
        f'</components><cameras next_id="9">{extra}{entries}</cameras>{chunk}</chunk>'
        "</document>"
    )


@pytest.fixture
def project(tmp_path):
    """Photographs, and a function that writes an XML beside them and opens it."""
    write_photographs(tmp_path / "images", NAMES)

    def opened(text):
        (tmp_path / "cameras.xml").write_text(text)
        return open_capture(tmp_path)

    return opened


def lens(**more):
    return {"fl_x": 30.0, "fl_y": 31.0, "cx": 8.5, "cy": 5.5, **more}


def test_metashape(project):
    capture = project(metashape(ring()))
    # Metashape's p1 multiplies r^2 + 2 x^2, which is OpenCV's p2
    expected = ring(**lens(distortion=(-0.1, 0, 0.004, 0.003)))
    assert_same_cameras(capture.cameras, expected)
    assert [p.path.name for p in capture.photographs] == NAMES
    assert "sensors: 'lens' (opencv)" in "\n".join(describe(capture).lines())


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "utf-8-sig"])
def test_metashape_in_another_encoding(project, tmp_path, encoding):
    whole = project(metashape(ring()))
    (tmp_path / "cameras.xml").write_bytes(metashape(ring()).encode(encoding))
    assert_same_cameras(open_capture(tmp_path).cameras, whole.cameras)


@pytest.mark.parametrize("where", ["component", "chunk", "both"])
def test_metashape_scale_and_rotation_of_the_world(project, where, rounding):
    rotation, translation, scale = turned(), np.array([3.0, -2.0, 1.0]), 2.5
    text = similarity(rotation, translation, scale)
    chunk, component = (text if where in (w, "both") else "" for w in ("chunk", "component"))
    capture = project(metashape(ring(), chunk=chunk, component=component))
    for camera, before in zip(capture.cameras, ring(), strict=True):
        centre = scale * rotation @ before.centre + translation
        np.testing.assert_allclose(camera.centre, centre, 0, rounding(np.float64, scale=7))
        forward = rotation @ before.forward
        np.testing.assert_allclose(camera.forward, forward, 0, rounding(np.float64))


def test_metashape_fisheye(project):
    text = "<f>31</f><k1>0.1</k1><k2>0.02</k2><k3>0.003</k3><k4>0.0004</k4>"
    camera = project(metashape(ring(), calibration=text, kind="fisheye")).cameras[0]
    assert (camera.kind, camera.cx, camera.cy) == ("opencv_fisheye", 8, 6)
    assert camera.distortion == (0.1, 0.02, 0, 0, 0.003, 0.0004, 0, 0)


def test_metashape_labels_without_suffix_groups_and_cameras_that_do_not_count(project):
    more = ('<camera id="7" label="not aligned" sensor_id="0"/>'
            '<camera id="8" label="off" sensor_id="5" enabled="false"><transform>1'
            "</transform></camera>")  # fmt: skip
    text = metashape(ring(), labels=[name[:-4] for name in NAMES], extra=more)
    text = text.replace('<camera id="0"', '<group id="0"><camera id="0"', 1)
    text = text.replace('</camera><camera id="1"', '</camera></group><camera id="1"', 1)
    capture = project(text)
    assert len(capture.photographs) == 5
    assert any("1 cameras are not aligned" in note for note in capture.notes)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: t.replace("<cx>", "<b2>0.5</b2><cx>"), "b2: expected 0.*undistort"),
        (lambda t: t.replace("<cx>", "<k4>0.5</k4><cx>"), "k4: expected 0"),
        (lambda t: t.replace("<cx>", "<p3>0.5</p3><cx>"), "p3: expected 0"),
        (lambda t: t.replace("<cx>", "<corrections>1</corrections><cx>"), "'corrections'"),
        (lambda t: t.replace("<f>31</f>", ""), "focal length f"),
        (lambda t: t.replace("<f>31</f>", "<f>nan</f>"), "'f' = 'nan'"),
        (lambda t: t.replace("<f>31</f>", "<f>-31</f>"), r"sensor|fl_y > 0"),
        (lambda t: t.replace('type="frame" class', 'type="spherical" class'), "'spherical'"),
        (lambda t: t.replace("adjusted", "initial").replace(
            "</sensor>", "<calibration/></sensor>"),
         "one adjusted calibration, received 2"),
        (lambda t: t.replace('sensor_id="0"', 'sensor_id="4"'), "sensor '4'"),
        (lambda t: t.replace('label="shot 2.png"', 'master_id="1" label="shot 2.png"'), "rig"),
        (lambda t: t.replace('label="shot 2.png"', 'label=""'), "a label"),
        (lambda t: t.replace('label="shot 2.png"', 'label="../a.png"'), "leaves it"),
        (lambda t: t.replace("<transform>", "<transform>2 ", 1), "16 numbers"),
        (lambda t: t.replace("</chunk>", similarity(2 * np.eye(3), [0, 0, 0], 1) + "</chunk>"),
         "rotation: expected a rotation, received scale"),
        (lambda t: t.replace("</chunk>", similarity(np.eye(3), [0, 0, 0], 0) + "</chunk>"),
         "scale: expected more than 0"),
        (lambda t: t.replace("<cameras ", "<cameras><camera/></cameras><x ").replace(
            "</cameras></chunk>", "</x></chunk>"), "aligned cameras, received none"),
        (lambda t: t.replace("<cx>", "<rolling_shutter>1</rolling_shutter><cx>"), "rolling"),
        (lambda t: t.replace('<sensor id="0" label="lens" type="frame">',
            '<sensor id="0" type="frame"><rolling_shutter>true</rolling_shutter>'), "at rest"),
        (lambda t: t.replace("</document>", "<chunk/></document>"), "one enabled chunk"),
        (lambda t: t[:-30], "expected XML"),
        (lambda t: t.replace("<doc", '<!DOCTYPE x [<!ENTITY a "b">]><doc'), "entities"),
    ],
)  # fmt: skip
def test_metashape_refuses(project, change, reason):
    text = metashape(ring())
    changed = change(text)
    assert changed != text
    with pytest.raises(CaptureError, match=reason) as caught:
        project(changed)
    assert "cameras.xml" in str(caught.value)


def test_other_xml_is_no_capture(project):
    with pytest.raises(CaptureError, match="received none of them"):
        project("<html></html>")


def test_rodin(shared_data):
    capture = open_capture(shared_data("mia_rodin_metashape"))
    assert len(capture.photographs) == 45
    assert any("45 of 397 photographs are there" in note for note in capture.notes)
    assert any("2 cameras are not aligned" in note for note in capture.notes)
    # both lenses, at an eighth of their size
    focal = {round(camera.fl_x, 1) for camera in capture.cameras}
    assert focal <= {round(f / 8, 1) for f in (5998.259326, 12665.259988)}


# --- Kintsugi 3D --------------------------------------------------------------------------


def view_set(cameras, names=NAMES, *, projection="D 1 2 1.3333333333 37.5 16 9 9 9 9 9",
             light="l 0.1 0.2 0.3 4 5 6", extra=""):  # fmt: skip
    """Text of a view set; poses of odd views as quaternions."""
    lines = ["# a view set", "m mesh.obj", "i previews", projection, light, *extra.split("|")]
    for i, camera in enumerate(cameras):
        pose = FLIP @ camera.camera_from_world
        if i % 2:
            w, *xyz = quaternion(pose[:3, :3])
            lines.append(f"p {words([*camera.centre, *xyz, w])}")
        else:
            lines.append(f"P {words(pose)}")
    lines += [f"v {i} 0 0 {name}\t# of the object" for i, name in enumerate(names)]
    return "\n".join(lines) + "\n"


@pytest.fixture
def flashes(tmp_path):
    """Photographs, and a function that writes a view set beside them and opens it."""
    write_photographs(tmp_path / "previews", NAMES)

    def opened(text):
        (tmp_path / "a.vset").write_text(text)
        return open_capture(tmp_path)

    return opened


@pytest.mark.parametrize(
    ("projection", "focal"),
    [
        ("D 1 2 1.3333333333 37.5 16 9 9 9 9 9", 37.5),
        ("d 1 2 1.3333333333 75", 37.5),
        ("f 1 2 1.3333333333 30", 6 / np.tan(np.radians(15))),
        ("s 8 6 1.3333333333 37.5 16 0 0 0 0 0 0 0 0", 37.5),
    ],
)
def test_view_set(flashes, projection, focal, rounding):
    capture = flashes(view_set(ring(), projection=projection))
    expected = ring(fl_x=focal, fl_y=focal, cx=8.0, cy=6.0)
    assert_same_cameras(capture.cameras, expected, tolerance=1e-7)
    for photograph in capture.photographs:
        camera, light = capture.cameras[photograph.camera], capture.lights[photograph.light]
        np.testing.assert_allclose(light.intensity, [4, 5, 6])
        in_camera = FLIP[:3, :3] @ (camera.rotation @ (light.position - camera.centre))
        tolerance = rounding(np.float64, scale=np.abs(camera.centre).max())
        np.testing.assert_allclose(in_camera, [0.1, 0.2, 0.3], 0, tolerance)


def test_view_set_encoding(flashes):
    capture = flashes(view_set(ring(), extra="e 0.25 62|e 0.5 200"))
    # between the pairs' (0, 0) and (62, .25), monotone
    assert capture.read_photograph(2)[0, 0, 0] == pytest.approx(0.25, abs=1e-6)
    capture = flashes(view_set(ring()))
    assert capture.photographs[0].exposures[0].reading == ImageReading()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: t.replace("v 3 0 0", "v 9 0 0"), "index of a pose below 5, received 9"),
        (lambda t: t.replace("v 3 0 0", "v 3 7 0"), "index of a projection below 1"),
        (lambda t: t.replace("v 3 0 0", "v 3 0 5"), "index of a light below 1"),
        (lambda t: t.replace("v 3 0 0", "v 3 0"), "POSE PROJECTION LIGHT FILE"),
        (lambda t: t.replace("v 3 0 0", "v -3 0 0"), "POSE PROJECTION LIGHT FILE"),
        (lambda t: t.split("\nv")[0], "expected views"),
        (lambda t: t.replace("37.5", "nan"), "5 numbers after 'D'"),
        (lambda t: t.replace("37.5", "0"), "above 0"),
        (lambda t: t.replace("37.5", "1e300"), "at most 1e"),
        (lambda t: t.replace("1.3333333333", "1"), "1 times as wide as high"),
        (lambda t: t.replace("D 1 2", "s 8 6").replace("9 9 9 9 9", "0 0 0 0 0 1 0 0"),
         "without distortion"),
        (lambda t: t.replace("l 0.1 0.2 0.3 4", "l 0.1 0.2 0.3 -4"), "light: intensity"),
        (lambda t: t.replace("\nP ", "\nP 3 ", 1), "a rotation and a translation"),
        (lambda t: t.replace("shot 2.png", "../../shot 2.png"), "leaves it"),
        (lambda t: t.replace("i previews", "i ../../elsewhere"), "photographs in a folder"),
        (lambda t: t.replace("i previews", f"i {'p' * 300}"), "not a usable path"),
        (lambda t: t + "e 0.5 200\n", "2 to 65536 pairs"),
        (lambda t: t + "e 0.5 200\ne 0.6 100\n", "increase"),
    ],
)  # fmt: skip
def test_view_set_refuses(flashes, change, reason):
    text = view_set(ring())
    changed = change(text)
    assert changed != text
    with pytest.raises(CaptureError, match=reason) as caught:
        flashes(changed)
    assert "a.vset" in str(caught.value)


def test_view_set_notes_lines_that_it_does_not_know(flashes):
    capture = flashes(view_set(ring(), extra="k 3 mask.png|q 1"))
    assert any("lines not used: 'k', 'q'" in note for note in capture.notes)


def test_guanyu_is_as_its_transforms(shared_data, rounding):
    folder = shared_data("mia_guanyu_flash")
    ours = open_capture(folder / "guan-yu-replicability.vset")
    theirs = open_capture(folder / "transforms.json")
    by_name = {photograph.name: photograph for photograph in theirs.photographs}
    assert len(ours.photographs) == len(by_name) == 240
    for photograph in ours.photographs:
        other = by_name[photograph.name]
        # both went through single precision: positions of 13 units, six digits
        camera = ours.cameras[photograph.camera], theirs.cameras[other.camera]
        assert_same_cameras([camera[0]], [camera[1]], tolerance=2e-4)
        light = ours.lights[photograph.light], theirs.lights[other.light]
        tolerance = rounding(np.float64, scale=7)  # the same digits by two ways
        np.testing.assert_allclose(light[0].position, light[1].position, 0, tolerance)
        np.testing.assert_array_equal(light[0].intensity, light[1].intensity)
    assert len(ours.photographs[0].exposures[0].reading.encoding.pairs) == 6


def test_a_capture_of_our_own_counts_before_other_programs_files(shared_data):
    capture = open_capture(shared_data("mia_guanyu_flash"))
    assert capture.format == "transforms"
    assert any("guan-yu-replicability.vset beside it" in note for note in capture.notes)


# --- LLFF ---------------------------------------------------------------------------------


def poses_bounds(cameras, size=(12, 16), focal=30.0):
    rows = []
    for camera in cameras:
        right, down, forward = camera.rotation
        matrix = np.stack([down, right, -forward, camera.centre, (*size, focal)], axis=1)
        rows.append([*matrix.ravel(), 1.0, 3.0])
    return np.array(rows)


@pytest.fixture
def llff(tmp_path):
    """Photographs, and a function that writes an array beside them and opens it."""
    write_photographs(tmp_path / "images", NAMES)

    def opened(array):
        np.save(tmp_path / "poses_bounds.npy", array)
        return open_capture(tmp_path)

    return opened


def test_llff(llff, tmp_path):
    capture = llff(poses_bounds(ring()))
    expected = ring(fl_x=30.0, fl_y=30.0, cx=8.0, cy=6.0)
    assert_same_cameras(capture.cameras, expected)
    assert capture.silhouettes == (None,) * 5
    mask = np.full((12, 16), 255, np.uint8)
    (tmp_path / "masks").mkdir()
    for name in NAMES:
        write_png(tmp_path / "masks" / name, mask)
    capture = llff(poses_bounds(ring(), (120, 160), 300.0))
    assert_same_cameras(capture.cameras, expected)
    assert all(path.parent.name == "masks" for path in capture.silhouettes)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda a: a[:4], "4 rows for 5 photographs"),
        (lambda a: a[:, :14], r"n x 17, received float64 \(5, 14\)"),
        (lambda a: a.astype(int), "array of floats"),
        (lambda a: np.where(a == 30, np.nan, a), "finite numbers"),
        (lambda a: np.where(a == 30, -30, a), "fl_x and fl_y > 0"),
        (lambda a: np.where(a == 16, 0, a), "height and width of 1"),
        (lambda a: np.where(a == 16, 20, a), "turned"),
        (lambda a: 2 * a, "axes down, right and back"),
        (lambda a: np.array([{"a": 1}], dtype=object), "pickled objects"),
    ],
)
def test_llff_refuses(llff, change, reason):
    with pytest.raises(CaptureError, match=reason):
        llff(change(poses_bounds(ring())))


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00\xff\xff{'a'"])
def test_llff_damaged_files(llff, tmp_path, content):
    llff(poses_bounds(ring()))
    (tmp_path / "poses_bounds.npy").write_bytes(content)
    with pytest.raises(CaptureError, match="damaged, truncated or different"):
        open_capture(tmp_path)
    header = json.dumps({"descr": "<f8", "fortran_order": False, "shape": [2**50, 17]})
    header = header.replace("false", "False").replace("[", "(").replace("]", ")").ljust(118)
    (tmp_path / "poses_bounds.npy").write_bytes(
        b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    )
    with pytest.raises(CaptureError, match="damaged, truncated or different"):
        open_capture(tmp_path)


def test_ethiopian_head(shared_data):
    capture = open_capture(shared_data("ethiopian_head_masks"))
    assert len(capture.cameras) == sum(path is not None for path in capture.silhouettes) == 66
    # half of the last digit that is given here
    assert capture.cameras[0].fl_x == pytest.approx(7543.6 * 0.2, abs=0.05 * 0.2)
