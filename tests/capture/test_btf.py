"""BTF samples: images named by their directions, and Bonn's containers, written by hand."""

import struct

import numpy as np
import pytest

from reflfield.capture.btf import Btf, read_btf
from reflfield.capture.cameras import Camera
from reflfield.capture.conversion import convert_btf, convert_capture
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.readers import open_capture
from reflfield.capture.rectified_samples import directions_of_angles, rectified_camera
from reflfield.errors import CaptureError, InputError

WIDTH, HEIGHT = 3, 2
LARGEST = 9  # radiance
HALF = 1.001 / 2048  # halves have 11 bits; single precision rounds before them
SIZE = struct.pack("<II", WIDTH, HEIGHT)
VIEWS = np.radians([[0, 0], [40, 0], [40, 120], [40, 240], [70, 30]])
LIGHTS = np.radians([[10, 0], [60, 90], [60, 210], [60, 330]])


# --- images named by their directions -----------------------------------------------------


def test_rectified_cameras_see_the_plane_as_it_is(rng, rounding):
    exact = rounding(np.float64)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (20, 2)) * [1, 0.5], np.zeros(20)])
    for angles in [[0, 0], [10, 30], [75, 200], [85, -90], [60, 0]]:
        direction = directions_of_angles(np.radians([angles]))[0]
        camera = rectified_camera(direction, (100, 50), "test")
        pixels, _ = camera.project(points)
        slant = 1 / direction[2]
        expected = points[:, :2] * [100, -100] + [50, 25]
        np.testing.assert_allclose(
            pixels, expected, rtol=0, atol=rounding(np.float64, 4, slant, 100)
        )
        np.testing.assert_allclose(camera.view_directions(points), [direction] * 20, atol=exact)
        origins, rays = camera.rays(pixels)
        np.testing.assert_allclose(rays, [-direction] * 20, atol=exact)
        reached = origins - origins[:, 2:] / rays[:, 2:] * rays
        np.testing.assert_allclose(reached, points, rtol=0, atol=rounding(np.float64, 4, slant))


def test_skew_is_for_orthographic_cameras():
    with pytest.raises(CaptureError, match="skew: expected 0"):
        Camera("v", "opencv", 1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4), skew=1.0)


NAMINGS = [
    "{n:05d} tl{tl:03d} pl{pl:03d} tv{tv:03d} pv{pv:03d}.png",  # UBO2003
    "tv{tv:03d}_pv{pv:03d}/tl{tl:03d}_pl{pl:03d}_tv{tv:03d}_pv{pv:03d}.png",  # UTIA
    "tv{tv}.0_pv{pv}.0_tl{tl}.0_pl{pl}.0.png",  # SPECTRAL
]


@pytest.mark.parametrize("naming", NAMINGS)
def test_names(tmp_path, naming, rounding):
    views, lights = [(60, 90), (0, 0)], [(0, 0), (45, 180)]
    angles = [(*light, *view) for view in views for light in lights]
    for n, (tl, pl, tv, pv) in enumerate(angles):
        path = tmp_path / naming.format(n=n, tl=tl, pl=pl, tv=tv, pv=pv)
        path.parent.mkdir(exist_ok=True)
        write_png(path, np.full((4, 8, 3), 50 + n, np.uint8))
    capture, exact = open_capture(tmp_path), rounding(np.float64)
    assert (capture.format, capture.base_geometry) == ("btf-images", "plane")
    assert (capture.n_views, capture.n_lights) == (2, 2)
    assert (capture.photograph_index >= 0).all()
    np.testing.assert_allclose(capture.cameras[0].forward, [0, 0, -1], rtol=0, atol=exact)
    np.testing.assert_allclose(
        capture.cameras[1].forward, [0, -np.sqrt(0.75), -0.5], rtol=0, atol=exact
    )
    far = next(light for light in capture.lights if light.direction[2] < 0.9)
    np.testing.assert_allclose(
        far.direction, [-np.sqrt(0.5), 0, np.sqrt(0.5)], rtol=0, atol=exact
    )
    convert_capture(capture, tmp_path / "native")
    again = open_capture(tmp_path / "native")
    for ours, theirs in zip(again.cameras, capture.cameras, strict=True):
        np.testing.assert_array_equal(ours.matrix, theirs.matrix)
    with pytest.raises(InputError, match="received an orthographic one"):
        convert_capture(capture, tmp_path / "colmap", "colmap")


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (["tl000 pl000 tv095 pv000.png"], "0 to 90 degrees"),
        (["tl000 pl000 tv090 pv000.png"], "above the sample"),
        (["tl000 pl000 tv000 pv000.png", "tl000_pl000_tv000_pv000.png"], "duplicate"),
        (["tv000_pv000/tl000_pl000_tv000_pv000.exr"], "PNG files of a UTIA sample"),
        (["tl000 pl000 tv000.png"], "received none of them"),
    ],
)  # fmt: skip
def test_names_that_are_refused(tmp_path, names, reason):
    for name in names:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        if path.suffix == ".exr":
            write_exr(path, np.ones((4, 8, 3), np.float32))
        else:
            write_png(path, np.full((4, 8, 3), 50, np.uint8))
    with pytest.raises(CaptureError, match=reason):
        open_capture(tmp_path)


# --- containers ---------------------------------------------------------------------------


def sampling():
    content = struct.pack("<I", len(VIEWS))
    for view in VIEWS:
        content += view.astype("<f4").tobytes() + struct.pack("<I", len(LIGHTS))
        content += LIGHTS.astype("<f4").tobytes()
    return content + SIZE


def header(cosine=1, version=4, scale=(1, 1, 1), channels=3):
    content = b"s".ljust(80) + b"c".ljust(80) + b"l".ljust(80) + struct.pack("<f3f", 10, *scale)
    if version > 1:
        content += struct.pack("<I", cosine)
    if version > 2:
        content += struct.pack("<I", 5) + b"<xml>"
    if version > 3:
        content += struct.pack("<I", channels) + b"".join(
            struct.pack("<I", 1) + name.encode() for name in "RGBXYZ"[:channels]
        )
    return struct.pack("<II", len(content) + 8, version) + content


def factors(table, size=4):
    """A factorisation of a matrix, singular values included in v."""
    u, s, v = np.linalg.svd(table, full_matrices=False)
    dtype = f"<f{size}"
    content = struct.pack("<BIII", size, len(s), *table.shape)
    return content + b"".join(a.astype(dtype).tobytes() for a in (s, u, (v.T * s)))


def rotations_bytes(rotations):
    return struct.pack("<I", len(rotations)) + rotations.astype("<f4").tobytes()


@pytest.fixture
def table(rng):
    """Radiance by texel, view, light and channel; some far above 1."""
    shape = (WIDTH * HEIGHT, len(VIEWS), len(LIGHTS), 3)
    return rng.uniform(0.05, LARGEST, shape)


def matrix(table):
    """Rows channel fastest, then light, then view."""
    return table.reshape(len(table), -1).T


def containers(table, rotations=None):
    """Content of each kind of container of one table."""
    n_rows = matrix(table)
    common = header() + sampling()
    turned = rotations_bytes(np.zeros((0, 3, 3)) if rotations is None else rotations)
    yuv_from_rgb = np.linalg.solve(
        np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]]), np.eye(3)
    )
    y, u, v = np.moveaxis(table @ yuv_from_rgb.T, -1, 0)
    channels = [a.reshape(len(table), -1).T for a in (np.log(y + 1e-5), u / y, v / y)]
    decorrelated = struct.pack("<Ii", 20, 11) + np.zeros(12, "<f4").tobytes()
    halves = table.reshape(len(table), -1).astype("<f2")
    chunks = b"".join(
        struct.pack("<I", part.nbytes) + part.tobytes() for part in (halves[:4], halves[4:])
    )
    mask = b"\1" * len(table)
    return {
        "FMF": b"!FMF06FC" + common + struct.pack("<I", 6) + factors(n_rows),
        "FMF double": b"!FMF06FCR" + common + turned + struct.pack("<I", 6)
        + factors(n_rows, 8),
        "FMF12": b"!FMF12FCER" + common + turned + struct.pack("<BI2I", 2, 1, 2, 1) + b"\0" * 4
        + struct.pack("<I", 6) + factors(np.log(n_rows + 1e-5)),
        "DFMF": b"!DFMF08FCR" + common + turned + decorrelated
        + b"".join(factors(channel) for channel in channels),
        "BDI": b"!BDIF06R2!" + common + struct.pack("<IB", 1, 2) + mask + turned + chunks,
    }  # fmt: skip


KINDS = ["FMF", "FMF double", "FMF12", "DFMF", "BDI"]


@pytest.mark.parametrize("kind", KINDS)
def test_containers(tmp_path, table, kind, rounding):
    path = tmp_path / "a.btf"
    path.write_bytes(containers(table)[kind])
    btf = read_btf(path)
    stored = rounding(np.float32, scale=VIEWS.max(), safety=1)  # angles in radians
    np.testing.assert_allclose(btf.views, directions_of_angles(VIEWS), rtol=0, atol=stored)
    rtol, atol = HALF if kind == "BDI" else 0, rounding(np.float32, scale=LARGEST)
    for view in range(len(VIEWS)):
        for light in range(len(LIGHTS)):
            expected = table[:, view, light].reshape(HEIGHT, WIDTH, 3)
            image = btf.image(view, light)
            np.testing.assert_allclose(image, expected, rtol, atol)


def test_values_without_the_cosine(tmp_path, table, rounding):
    content = b"!FMF06FC" + header(cosine=0) + sampling() + struct.pack("<I", 6)
    (tmp_path / "a.btf").write_bytes(content + factors(matrix(table)))
    image = read_btf(tmp_path / "a.btf").image(0, 1)
    tolerance = rounding(np.float32, scale=LARGEST / 2)
    np.testing.assert_allclose(image.reshape(-1, 3), table[:, 0, 1] * 0.5, 0, tolerance)


@pytest.mark.parametrize("kind", ["FMF double", "DFMF", "BDI"])
def test_rotations_about_the_normal(tmp_path, table, kind, rounding):
    """A sampling that a turn by 120 degrees maps onto itself, and the turn of each texel."""
    c, s = np.cos(np.radians(120)), np.sin(np.radians(120))
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])  # azimuths fall by 120 degrees
    rotations = np.array([turn if i % 2 else np.eye(3) for i in range(WIDTH * HEIGHT)])
    (tmp_path / "a.btf").write_bytes(containers(table, rotations)[kind])
    btf = read_btf(tmp_path / "a.btf")
    image = btf.image(2, 2).reshape(-1, 3)  # view at 120, light at 210 degrees
    rtol, atol = HALF if kind == "BDI" else 0, rounding(np.float32, scale=LARGEST)
    np.testing.assert_allclose(image[::2], table[::2, 2, 2], rtol, atol)
    np.testing.assert_allclose(image[1::2], table[1::2, 1, 1], rtol, atol)


def test_directions_below_a_turned_texel_are_black():
    tilt = np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]])  # its normal is x
    views, lights = directions_of_angles(VIEWS), directions_of_angles(LIGHTS)
    plain = np.ones((1, 3 * len(views) * len(lights)), np.float32)
    btf = Btf(1, 1, views, lights, True, ((None, plain),), lambda stored: stored, tilt[None])
    assert btf.image(1, 3).tolist() == [[[1, 1, 1]]]  # view and light on the side of +x
    assert btf.image(2, 3).tolist() == [[[0, 0, 0]]]


def test_a_container_becomes_a_capture(tmp_path, table, rounding):
    (tmp_path / "a.btf").write_bytes(containers(table)["DFMF"])
    with pytest.raises(CaptureError, match=r"BTF container; write it as one first"):
        open_capture(tmp_path / "a.btf")
    assert convert_btf(tmp_path / "a.btf", tmp_path / "out") == 20
    capture = open_capture(tmp_path / "out")
    assert (capture.n_views, capture.n_lights, capture.base_geometry) == (5, 4, "plane")
    image = capture.read_photograph(int(capture.photograph_index[1, 2]))
    atol = rounding(np.float32, scale=LARGEST)  # beside the halves of the file
    np.testing.assert_allclose(image.reshape(-1, 3), table[:, 1, 2], HALF, atol)
    with pytest.raises(InputError, match="new or empty folder"):
        convert_btf(tmp_path / "a.btf", tmp_path / "out")


def test_means(tmp_path, rng):
    """Four directions; the value is exp(3 mean), grey."""
    directions = directions_of_angles(VIEWS[:4])
    folder = tmp_path / "means"
    folder.mkdir()
    np.vstack([directions.T, [0, 1, 2, 3]]).tofile(folder / "xyz_loc.bin")
    means = rng.uniform(-1, 1, (2, 4, 4))
    means.tofile(folder / "felt_mean_std.bin")
    assert convert_btf(folder, tmp_path / "out") == 16
    capture = open_capture(tmp_path / "out")
    assert len({photograph.path for photograph in capture.photographs}) == 4
    for view in range(4):
        for light in range(4):
            image = capture.read_photograph(int(capture.photograph_index[view, light]))
            np.testing.assert_allclose(image, np.exp(3 * means[0, view, light]), rtol=HALF)
    means[:1].tofile(folder / "felt_mean_std.bin")
    with pytest.raises(CaptureError, match="of 4 x 4 directions"):
        convert_btf(folder, tmp_path / "other")


@pytest.mark.slow
def test_felt(shared_data, tmp_path):
    """The mean of a felt on the directions of the Bonn dome."""
    assert convert_btf(shared_data("ubo2014_felt05"), tmp_path / "out") == 151 * 151
    capture = open_capture(tmp_path / "out")
    assert (capture.n_views, capture.n_lights) == (151, 151)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda b: b[:-3], "truncated"),
        (lambda b: b[:300], "truncated|damaged"),
        (lambda b: b[:20], "truncated"),
        (lambda b: b"", "begins with"),
        (lambda b: b"!PVF06FC" + b[8:], "begins with '!PVF06FC"),
        (lambda b: b + b"\0", "1 more bytes"),
        (lambda b: b.replace(SIZE, struct.pack("<II", 2**31, 9)), "texels"),
        (lambda b: b.replace(SIZE, struct.pack("<II", 3, 3)), "60 x 9"),
        (lambda b: b[:12] + struct.pack("<I", 2**32 - 1) + b[16:], "version 1 to 4"),
        (lambda b: b"!FMF06FC" + header(scale=(1, 2, 1)) + b[8 + len(header()):], "one scale"),
        (lambda b: b"!FMF06FC" + header(channels=5) + b[8 + len(header()):], "three channels"),
        (lambda b: b.replace(np.float32(VIEWS[1, 0]).tobytes(), np.float32(np.nan).tobytes()),
         "finite"),
        (lambda b: b[:-4] + struct.pack("<f", np.inf), "finite values"),
    ],
)  # fmt: skip
def test_damaged_containers(tmp_path, table, change, reason):
    content = containers(table)["FMF"]
    changed = change(content)
    assert changed != content
    (tmp_path / "a.btf").write_bytes(changed)
    with pytest.raises(CaptureError, match=reason):
        read_btf(tmp_path / "a.btf")


@pytest.mark.parametrize(
    ("kind", "old", "new", "reason"),
    [
        ("DFMF", struct.pack("<Ii", 20, 11), struct.pack("<Ii", 20, 5), "model.*received 5"),
        ("BDI", struct.pack("<IB", 1, 2) + b"\1", struct.pack("<IB", 1, 1) + b"\1", "ion 1"),
        ("BDI", b"\1" * 6, b"\1" * 5 + b"\0", "missing texels"),
        ("FMF12", struct.pack("<BI", 2, 1), struct.pack("<BI", 2, 7), "reduction 0 or 1"),
        ("FMF double", struct.pack("<II", 0, 6), struct.pack("<II", 2**31, 6), "rotations"),
    ],
)  # fmt: skip
def test_what_containers_may_not_hold(tmp_path, table, kind, old, new, reason):
    content = containers(table)[kind]
    assert old in content
    (tmp_path / "a.btf").write_bytes(content.replace(old, new, 1))
    with pytest.raises(CaptureError, match=reason):
        read_btf(tmp_path / "a.btf")
