"""Measured materials: the tensor file reader, the warp, the values."""

import math
import struct

import numpy as np
import pytest

from capture_sim.errors import SceneError
from capture_sim.materials import make_material, read_rgl
from capture_sim.materials.rgl import sector_count
from capture_sim.materials.tensor_file import TYPES, read_tensor_file
from capture_sim.materials.warp import BilinearTable, Slices, Warp

CODES = {np.dtype(name): code for code, name in TYPES.items()}


def tensor_file(fields, magic=b"tensor_file\0", version=(1, 0), n_fields=None):
    """Bytes of a tensor file; `fields` maps names to arrays."""
    header_size = 18 + sum(13 + len(name) + 8 * a.ndim for name, a in fields.items())
    header = magic + struct.pack(
        "<BBI", *version, len(fields) if n_fields is None else n_fields
    )
    body = b""
    for name, array in fields.items():
        header += struct.pack("<H", len(name)) + name.encode()
        header += struct.pack("<HBQ", array.ndim, CODES[array.dtype], header_size + len(body))
        header += struct.pack(f"<{array.ndim}Q", *array.shape)
        body += array.tobytes()
    return header + body


def small_material(rng, n_phi=1, azimuths=2 * np.pi):
    """A made-up but well-formed material; anisotropic if n_phi > 2."""
    f4 = np.float32
    sigma = np.tile(0.5 + rng.random(6), (5, 1))  # of a direction's inclination alone
    if n_phi > 2:
        sigma = 0.5 + rng.random((5, 6))
    phi = np.linspace(-np.pi, azimuths - np.pi, n_phi) if n_phi > 1 else np.zeros(1)
    fields = {
        "description": np.frombuffer(b"made up", np.uint8),
        "phi_i": phi.astype(f4),
        "theta_i": np.linspace(0, np.pi / 2, 4).astype(f4),
        "sigma": sigma.astype(f4),
        "ndf": (0.5 + rng.random((5, 6))).astype(f4),
        "vndf": (0.1 + rng.random((n_phi, 4, 8, 9))).astype(f4),
        "luminance": (0.1 + rng.random((n_phi, 4, 4, 4))).astype(f4),
        "rgb": (0.1 + rng.random((n_phi, 4, 3, 4, 4))).astype(f4),
        "jacobian": np.ones(1, np.uint8),
    }
    if n_phi == 1:
        # Isotropic materials are mirror symmetric; the other reader relies on that, as it
        # leaves its number of sectors unset for them.
        for name in ("ndf", "vndf", "rgb"):
            fields[name] = ((fields[name] + np.flip(fields[name], axis=-2)) / 2).astype(f4)
    return fields


@pytest.fixture
def saved(tmp_path):
    def save(content):
        path = tmp_path / "material_rgb.bsdf"
        path.write_bytes(content)
        return path

    return save


def upper_directions(rng, n):
    directions = rng.normal(size=(n, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


# ------------------------------------------------------------------------- container


def test_reader_returns_what_was_written(rng, saved):
    fields = small_material(rng)
    for name, array in read_tensor_file(saved(tensor_file(fields))).items():
        np.testing.assert_array_equal(array, fields[name])
        assert array.dtype == fields[name].dtype


def test_every_truncation_is_refused(rng, saved):
    content = tensor_file({"a": np.arange(6, dtype=np.float32).reshape(2, 3)})
    for length in range(len(content)):
        with pytest.raises(SceneError, match=r"truncated|a tensor file"):
            read_tensor_file(saved(content[:length]))


def test_wrong_magic_and_versions_are_refused(saved):
    field = {"a": np.zeros(2, np.float32)}
    with pytest.raises(SceneError, match="a tensor file"):
        read_tensor_file(saved(tensor_file(field, magic=b"tensor_fiLe\0")))
    with pytest.raises(SceneError, match="version"):
        read_tensor_file(saved(tensor_file(field, version=(2, 0))))
    with pytest.raises(SceneError, match="no such file"):
        read_tensor_file(saved(b"").with_name("absent.bsdf"))


@pytest.mark.parametrize("shape", [(2**60,), (2**32, 2**32), (2**63, 2), (7,)])
def test_absurd_sizes_are_refused_before_allocation(shape, saved):
    good = tensor_file({"a": np.zeros((6,), np.float32)})
    at = good.index(struct.pack("<Q", 6), 18)
    rank = struct.pack("<HBQ", len(shape), 10, at + 8 * len(shape))
    content = good[: at - 11] + rank + struct.pack(f"<{len(shape)}Q", *shape) + good[at + 8 :]
    assert math.prod(shape) > 6
    with pytest.raises(SceneError, match="data within"):
        read_tensor_file(saved(content))


def test_other_absurdities_are_refused(saved):
    field = {"a": np.zeros(2, np.float32)}
    with pytest.raises(SceneError, match="fields"):
        read_tensor_file(saved(tensor_file(field, n_fields=2**32 - 1)))
    content = bytearray(tensor_file(field))
    content[18 + 2 + 1 + 2] = 99  # type code
    with pytest.raises(SceneError, match="known type"):
        read_tensor_file(saved(bytes(content)))


# ------------------------------------------------------------------------ the tables


def spoil(fields, name, change):
    fields = {key: array.copy() for key, array in fields.items()}
    if change is None:
        del fields[name]
    else:
        fields[name] = change(fields[name])
    return fields


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("rgb", None, "no \\['rgb'\\]"),
        ("rgb", lambda a: a[:, :, :2], "'rgb'"),
        ("vndf", lambda a: a[:, :3], "'vndf'"),
        ("vndf", lambda a: -a, "'vndf'"),
        ("vndf", lambda a: 0 * a, "'vndf'"),
        ("sigma", lambda a: a[:1], "'sigma'"),
        ("ndf", lambda a: a * np.float32("nan"), "finite"),
        ("theta_i", lambda a: a[::-1], "increasing"),
        ("jacobian", lambda a: a[:0], "'jacobian'"),
    ],
)
def test_tables_that_do_not_fit_are_refused(name, change, message, rng, saved):
    content = tensor_file(spoil(small_material(rng), name, change))
    with pytest.raises(SceneError, match=message):
        read_rgl(saved(content))


def test_sector_that_does_not_divide_the_circle_is_refused(rng, saved):
    content = tensor_file(small_material(rng, n_phi=5, azimuths=2 * np.pi / 3))
    with pytest.raises(SceneError, match="phi_i"):
        read_rgl(saved(content))


# -------------------------------------------------------------------------- the warp


def test_warp_inversion_is_the_distribution_function(rng):
    """Against direct integration of the bilinear density on a fine grid."""
    values = 0.1 + rng.random((1, 5, 7))
    warp, at = Warp.of(values), Slices.between([np.zeros(1)], [np.zeros(1)])
    x0, y0 = 0.37, 0.83
    table, n = BilinearTable(values), 400
    centres = (np.arange(n) + 0.5) / n
    many = Slices.between([np.zeros(1)], [np.zeros(n * n)])

    def integral(x_scale, y_scale):
        x, y = np.meshgrid(centres * x_scale, centres * y_scale)
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        return table.evaluate(points, many).mean() * x_scale * y_scale

    row = np.stack([centres, np.full(n, y0)], axis=1)
    part = np.stack([centres * x0, np.full(n, y0)], axis=1)
    line = Slices.between([np.zeros(1)], [np.zeros(n)])
    x = table.evaluate(part, line).mean() * x0 / table.evaluate(row, line).mean()
    y = integral(1.0, y0) / integral(1.0, 1.0)
    ours = warp.invert(np.array([[x0, y0]]), at)[0]
    np.testing.assert_allclose(ours, [x, y], atol=1e-4)  # midpoint rule, 400 steps


def test_warp_is_monotone_and_onto(rng, rounding):
    warp = Warp.of(0.01 + rng.random((1, 6, 6)) ** 4)
    t = np.linspace(0.0, 1.0, 101)
    at = Slices.between([np.zeros(1)], [np.zeros(101)])
    across = warp.invert(np.stack([t, np.full(101, 0.4)], axis=1), at)[:, 0]
    up = warp.invert(np.stack([np.full(101, 0.4), t], axis=1), at)[:, 1]
    for samples in (across, up):
        assert samples[0] == pytest.approx(0.0, abs=rounding(np.float64))
        assert samples[-1] == pytest.approx(1.0, abs=rounding(np.float64))
        assert (np.diff(samples) > 0.0).all()


# ------------------------------------------------------------------------ the values


def mitsuba_values(path, views, lights):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    bsdf = mi.load_dict({"type": "measured", "filename": str(path)})
    context, point, values = mi.BSDFContext(), mi.SurfaceInteraction3f(), []
    for view, light in zip(views, lights, strict=True):
        point.wi = mi.Vector3f(*view)
        values.append(np.array(bsdf.eval(context, point, mi.Vector3f(*light))).ravel())
    return np.array(values)


FILES = ["cc_ibiza_sunset", "cc_iris_purple_gem", "colodur_napoli_4f", "paper_white"]


@pytest.mark.reference
@pytest.mark.parametrize("name", FILES)
def test_measured_files_match_mitsuba(name, rng, shared_data, rounding):
    path = shared_data("rgl_bsdf") / f"{name}_rgb.bsdf"
    views, lights = upper_directions(rng, 300), upper_directions(rng, 300)
    material = make_material({"type": "rgl", "file": str(path)})
    ours = material.evaluate(views, lights, np.zeros((300, 2))) * lights[:, 2:]
    theirs = np.maximum(mitsuba_values(path, views, lights), 0.0)  # ours has no negative values
    # Their single precision through the inversion of two cumulative sums over 128 nodes.
    np.testing.assert_allclose(ours, theirs, rtol=2e-3, atol=1e-5)
    assert np.median(np.abs(ours - theirs) / (theirs + 1e-3)) < rounding(np.float32)


@pytest.mark.reference
@pytest.mark.parametrize(
    ("n_phi", "azimuths"), [(9, 2 * np.pi), (5, np.pi), (4, np.pi / 2), (1, 0.0)]
)
def test_every_layout_matches_mitsuba(n_phi, azimuths, rng, saved, rounding):
    path = saved(tensor_file(small_material(rng, n_phi, azimuths)))
    views, lights = upper_directions(rng, 200), upper_directions(rng, 200)
    material = read_rgl(path)
    ours = material.evaluate(views, lights, np.zeros((200, 2))) * lights[:, 2:]
    # Well conditioned tables: single precision of a hundred independent roundings.
    theirs = mitsuba_values(path, views, lights)
    np.testing.assert_allclose(ours, theirs, rounding(np.float32, operations=10))
    assert material.isotropic == (n_phi <= 2)


@pytest.mark.reference
def test_paper_is_nearly_reciprocal_and_absorbs(rng, shared_data):
    material = read_rgl(shared_data("rgl_bsdf") / "paper_white_rgb.bsdf")
    views, lights = upper_directions(rng, 4000), upper_directions(rng, 4000)
    uv = np.zeros((4000, 2))
    forth, back = material.evaluate(views, lights, uv), material.evaluate(lights, views, uv)
    # Measurement noise is a few percent; the cosine on the wrong side would be 28 percent.
    seen = forth + back > 0.0
    assert np.median(np.abs(forth - back)[seen] / (forth + back)[seen]) < 0.03
    view = np.tile([0.0, 0.0, 1.0], (4000, 1))
    albedo = 2 * np.pi * (material.evaluate(view, lights, uv) * lights[:, 2:]).mean(axis=0)
    assert (albedo > 0.5).all()  # white paper
    assert (albedo < 1.1).all()  # calibration of the measurement, and 4000 samples


def test_isotropic_material_does_not_see_azimuth(rng, rounding, saved):
    material = read_rgl(saved(tensor_file(small_material(rng))))
    views, lights = upper_directions(rng, 50), upper_directions(rng, 50)
    angle = 0.7
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    uv = np.zeros((50, 2))
    turned = material.evaluate(views @ turn.T, lights @ turn.T, uv)
    # Interpolation is continuous, so that rounding of the azimuth is all there is.
    np.testing.assert_allclose(
        turned, material.evaluate(views, lights, uv), rtol=rounding(float, 1000, condition=10)
    )


@pytest.mark.stability
def test_grazing_and_polar_directions_stay_finite(rng, saved):
    material = read_rgl(saved(tensor_file(small_material(rng, 5, np.pi))))
    heights = np.array([1.0, 1.0 - 1e-16, 0.5, 1e-8, 1e-300])
    z_view, z_light = (a.ravel() for a in np.meshgrid(heights, heights))
    views = np.stack([np.sqrt(1 - z_view**2), 0 * z_view, z_view], axis=1)
    lights = np.stack([-np.sqrt(1 - z_light**2), 0 * z_light, z_light], axis=1)
    values = material.evaluate(views, lights, np.zeros((25, 2)))
    assert np.isfinite(values).all()
    assert (values * lights[:, 2:] < 100.0).all()


def test_sector_counts():
    assert [sector_count(np.array([-np.pi, -np.pi + 2 * np.pi / n])) for n in (1, 2, 4)] == [
        1,
        2,
        4,
    ]
