"""Analytic and spatially varying materials."""

import cv2
import numpy as np
import pytest

from capture_sim.errors import SceneError
from capture_sim.materials import frames_from, make_material, material_presets
from capture_sim.materials.analytic import phong_density

UV = np.zeros((1, 2))

ANALYTIC = {
    "lambert": {"type": "lambert", "albedo": [0.9, 0.5, 0.1]},
    "ashikhmin_shirley": {
        "type": "ashikhmin_shirley",
        "specular": [0.2, 0.5, 0.9],
        "diffuse": [1.0, 0.5, 0.2],
        "exponent_u": 10.0,
        "exponent_v": 400.0,
    },
    "ggx": {
        "type": "ggx",
        "specular": 0.04,
        "diffuse": [1.0, 0.3, 0.1],
        "alpha_x": 0.1,
        "alpha_y": 0.5,
    },
    "metal": {"type": "ggx", "metal": "copper", "alpha_x": 0.5, "alpha_y": 0.2},
    "separable": {"type": "ggx", "specular": 1.0, "diffuse": 0.0, "correlated": False},
}


def upper_directions(rng, n):
    directions = rng.normal(size=(n, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def hemisphere_quadrature(n_height, n_azimuth):
    """Gauss-Legendre in the cosine, equal steps in azimuth: directions and solid angles."""
    nodes, weights = np.polynomial.legendre.leggauss(n_height)
    z = 0.5 * (nodes + 1.0)
    phi = 2.0 * np.pi * (np.arange(n_azimuth) + 0.5) / n_azimuth
    z, phi = np.repeat(z, n_azimuth), np.tile(phi, n_height)
    radius = np.sqrt(1.0 - z**2)
    solid_angles = np.repeat(0.5 * weights, n_azimuth) * 2.0 * np.pi / n_azimuth
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1), solid_angles


def reflected(material, view, directions, solid_angles):
    """Directional albedo: integral of the BRDF times the cosine over all lights."""
    views = np.tile(view, (len(directions), 1))
    values = material.evaluate(views, directions, np.zeros((len(directions), 2)))
    return (values * (directions[:, 2:] * solid_angles[:, None])).sum(axis=0)


@pytest.mark.parametrize("name", ANALYTIC)
def test_reciprocal_and_not_negative(name, rng, rounding):
    material = make_material(ANALYTIC[name])
    views, lights = upper_directions(rng, 500), upper_directions(rng, 500)
    uv = rng.random((500, 2))
    forth, back = material.evaluate(views, lights, uv), material.evaluate(lights, views, uv)
    assert (forth >= 0.0).all()
    assert forth.shape == (500, 3)
    np.testing.assert_allclose(forth, back, rtol=rounding(float, operations=64))


COMPILED = {
    **ANALYTIC,
    "sharp": {"type": "ggx", "specular": 0.5, "diffuse": 0.1, "alpha": 1e-3},
    **{name: {"preset": name} for name in ("satin", "painted_vase", "greek_key")},
}


@pytest.mark.parametrize("name", COMPILED)
def test_compiled_values_are_those_of_the_formulas(name, rng, rounding):
    material = make_material(COMPILED[name])
    n, n_lights = 200, 17
    views, uv = upper_directions(rng, n), rng.random((n, 2))
    lights = upper_directions(rng, n * n_lights).reshape(n, n_lights, 3)
    # Half of the lights near the mirror direction, where lobes are steepest.
    mirrored = views[:, None] * [-1, -1, 1] + 0.05 * rng.normal(size=(n, n_lights, 3))
    lights[:, ::2] = mirrored[:, ::2]
    lights[..., 2] = np.abs(lights[..., 2])
    lights /= np.linalg.norm(lights, axis=-1, keepdims=True)
    expected = material.evaluate(
        np.repeat(views, n_lights, axis=0),
        lights.reshape(-1, 3),
        np.repeat(uv, n_lights, axis=0),
    ).reshape(n, n_lights, 3)
    lit = rng.random((n, n_lights)) < 0.8
    precision = material.precision
    by_light = np.ascontiguousarray(np.moveaxis(lights, 1, 2), dtype=precision)
    values = material.evaluate_lights(views.astype(precision), by_light, lit, uv)
    assert values.dtype == precision
    error = np.where(lit[..., None], np.moveaxis(values, 1, 2) - expected, 0.0)
    assert np.linalg.norm(error) < 1e-5 * np.linalg.norm(expected)
    # Rounded half vectors move a lobe of width alpha by 4 eps / alpha; the sharpest in
    # float32 has alpha 0.024, and grazing pairs lose another digit.
    condition = 40 / 0.024 if precision is np.float32 else 40 / 1e-3
    bound = rounding(precision, condition=condition) * (expected + 1e-3)
    assert (np.abs(error) <= bound).all()


@pytest.mark.stability
@pytest.mark.parametrize("name", COMPILED)
def test_compiled_values_are_finite_at_the_horizon(name):
    material = make_material(COMPILED[name])
    grazing = np.array([[1.0, 0.0, 1e-7], [0.0, 1.0, 1e-12], [0.0, 0.0, 1.0]])
    lights = np.stack([grazing * [-1, -1, 1], grazing, grazing[::-1]], axis=2)
    precision = material.precision
    values = material.evaluate_lights(
        grazing.astype(precision), lights.astype(precision), np.ones((3, 3), bool), UV[[0] * 3]
    )
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()


@pytest.mark.parametrize("name", ANALYTIC)
@pytest.mark.parametrize("inclination", [0.0, 0.6, 1.2, 1.5])
def test_white_furnace(name, inclination):
    material = make_material(ANALYTIC[name])
    directions, solid_angles = hemisphere_quadrature(160, 240)
    for azimuth in (0.0, 0.7, np.pi / 2):
        sine = np.sin(inclination)
        view = [sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(inclination)]
        albedo = reflected(material, view, directions, solid_angles)
        # 1e-3: error of the quadrature on the narrowest lobe here (alpha 0.1).
        assert albedo.max() <= 1.0 + 1e-3
        assert albedo.min() > 0.01


def test_ggx_density_holds_all_microfacets():
    # The projected area of the microfacets is that of the surface: integral D cos = 1.
    from capture_sim.materials.analytic import ggx_density

    directions, solid_angles = hemisphere_quadrature(200, 200)
    alphas = np.tile([0.3, 0.6], (len(directions), 1))
    total = (ggx_density(directions, alphas)[:, 0] * directions[:, 2] * solid_angles).sum()
    assert total == pytest.approx(1.0, abs=1e-6)  # converged quadrature of a smooth lobe


def test_phong_density_integrates_to_one_without_cosine():
    directions, solid_angles = hemisphere_quadrature(200, 200)
    ones = np.ones((len(directions), 1))
    total = (phong_density(directions, 5.0 * ones, 30.0 * ones)[:, 0] * solid_angles).sum()
    assert total == pytest.approx(1.0, abs=1e-6)  # as above


def test_highlight_is_wider_along_the_tangent_with_larger_alpha_x():
    material = make_material(ANALYTIC["metal"])
    view = np.array([[0.0, 0.0, 1.0]])
    along, across = np.array([[0.6, 0.0, 0.8]]), np.array([[0.0, 0.6, 0.8]])
    wide, narrow = (material.evaluate(view, light, UV)[0, 0] for light in (along, across))
    assert wide > 2.0 * narrow


def test_ashikhmin_shirley_by_the_paper(rng, rounding):
    """Equations 4, 5 and 8 of the paper, written out for one pair at a time."""
    table = ANALYTIC["ashikhmin_shirley"]
    material = make_material(table)
    rs, rd = np.array(table["specular"]), np.array(table["diffuse"])
    nu, nv = table["exponent_u"], table["exponent_v"]
    for k1, k2 in zip(upper_directions(rng, 50), upper_directions(rng, 50), strict=True):
        h = (k1 + k2) / np.linalg.norm(k1 + k2)
        exponent = (nu * h[0] ** 2 + nv * h[1] ** 2) / (1.0 - h[2] ** 2)
        fresnel = rs + (1.0 - rs) * (1.0 - h @ k1) ** 5
        specular = np.sqrt((nu + 1) * (nv + 1)) / (8 * np.pi) * h[2] ** exponent * fresnel
        specular /= (h @ k1) * max(k1[2], k2[2])
        diffuse = 28 * rd / (23 * np.pi) * (1 - rs)
        diffuse = diffuse * (1 - (1 - k1[2] / 2) ** 5) * (1 - (1 - k2[2] / 2) ** 5)
        ours = material.evaluate(k1[None], k2[None], UV)[0]
        # The plain power loses about `exponent` roundings.
        np.testing.assert_allclose(ours, specular + diffuse, rtol=rounding(float, 500))


def mitsuba_values(definition, views, lights):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    bsdf, context, point = mi.load_dict(definition), mi.BSDFContext(), mi.SurfaceInteraction3f()
    values = []
    for view, light in zip(views, lights, strict=True):
        point.wi = mi.Vector3f(*view)
        values.append(np.array(bsdf.eval(context, point, mi.Vector3f(*light))).ravel())
    return np.array(values)


@pytest.mark.reference
@pytest.mark.parametrize("alphas", [(0.3, 0.3), (0.05, 0.4), (0.8, 0.1)])
def test_conductor_matches_mitsuba(alphas, rng, rounding):
    eta, kappa = [0.2, 0.92, 1.1], [3.9, 2.45, 2.14]
    material = make_material(
        {
            "type": "ggx",
            "eta": eta,
            "kappa": kappa,
            "alpha_x": alphas[0],
            "alpha_y": alphas[1],
            "correlated": False,
        }
    )
    views, lights = upper_directions(rng, 200), upper_directions(rng, 200)
    spectrum = {"eta": {"type": "rgb", "value": eta}, "k": {"type": "rgb", "value": kappa}}
    theirs = mitsuba_values(
        {
            "type": "roughconductor",
            "distribution": "ggx",
            "alpha_u": alphas[0],
            "alpha_v": alphas[1],
            **spectrum,
        },
        views,
        lights,
    )
    ours = material.evaluate(views, lights, np.zeros((200, 2))) * lights[:, 2:]
    # Their single precision; half vectors of narrow lobes are conditioned by 1 / alpha^2.
    tolerance = rounding(np.float32, operations=4, condition=1 / min(alphas))
    np.testing.assert_allclose(ours, theirs, rtol=tolerance)


@pytest.mark.reference
def test_lambert_matches_mitsuba(rng, rounding):
    albedo = [0.9, 0.5, 0.1]
    views, lights = upper_directions(rng, 50), upper_directions(rng, 50)
    theirs = mitsuba_values(
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}, views, lights
    )
    material = make_material({"type": "lambert", "albedo": albedo})
    ours = material.evaluate(views, lights, np.zeros((50, 2))) * lights[:, 2:]
    np.testing.assert_allclose(ours, theirs, rtol=rounding(np.float32))


def test_correlated_masking_hides_less_than_separable(rng):
    tables = [{"type": "ggx", "alpha": 0.6, "correlated": c} for c in (True, False)]
    views, lights = upper_directions(rng, 200), upper_directions(rng, 200)
    correlated, separable = (
        make_material(t).evaluate(views, lights, np.zeros((200, 2))) for t in tables
    )
    assert (correlated >= separable).all()
    assert (correlated > separable * 1.01).any()


@pytest.mark.parametrize("name", ANALYTIC)
def test_dark_below_the_horizon(name):
    material = make_material(ANALYTIC[name])
    up, down = np.array([[0.0, 0.0, 1.0]]), np.array([[0.6, 0.0, -0.8]])
    level = np.array([[1.0, 0.0, 0.0]])
    for view, light in ((up, down), (down, up), (down, down), (up, level), (level, up)):
        assert (material.evaluate(view, light, UV) == 0.0).all()


EXTREMES = [
    {"type": "ggx", "alpha": 1e-4, "diffuse": 0.0},
    {"type": "ggx", "alpha": 1.0},
    {"type": "ggx", "alpha_x": 1e-4, "alpha_y": 1.0, "metal": "silver"},
    {"type": "ashikhmin_shirley", "exponent_u": 0.0, "exponent_v": 0.0},
    {"type": "ashikhmin_shirley", "exponent_u": 1e5, "exponent_v": 1e5},
    {"type": "ashikhmin_shirley", "exponent_u": 0.0, "exponent_v": 1e5},
]


@pytest.mark.stability
@pytest.mark.parametrize("table", EXTREMES)
def test_extremes_stay_finite(table):
    material = make_material(table)
    heights = np.array([1.0, 0.5, 1e-3, 1e-8, 1e-15, 1e-300])
    z_view, z_light = (a.ravel() for a in np.meshgrid(heights, heights))
    views = np.stack([np.sqrt(1 - z_view**2), 0 * z_view, z_view], axis=1)
    for turn in (0.0, 1.0, np.pi):  # retro-reflection, aside, exact mirror
        sine = np.sqrt(1 - z_light**2)
        lights = np.stack([sine * np.cos(turn), sine * np.sin(turn), z_light], axis=1)
        values = material.evaluate(views, lights, np.zeros((len(views), 2)))
        assert np.isfinite(values).all()
        assert (values >= 0.0).all()
        # Both cosines keep the value below half the peak of the lobe, here 1 / (pi alpha^2);
        # one alone does not (grazing mirrors of these models are singular).
        assert (values * lights[:, 2:] * views[:, 2:] < 0.5e8 / np.pi + 1.0).all()


@pytest.mark.stability
def test_mirror_peak_of_the_smoothest_ggx(rounding):
    # At the mirror direction D = 1 / (pi alpha^2), masking about 1, F = 1.
    material = make_material(
        {"type": "ggx", "alpha": 1e-4, "specular": 1.0, "diffuse": 0.0, "correlated": True}
    )
    view, light = np.array([[0.6, 0.0, 0.8]]), np.array([[-0.6, 0.0, 0.8]])
    peak = 1.0 / (np.pi * 1e-8) / (4 * 0.8 * 0.8)
    # Masking differs from 1 by alpha^2; the half vector's error is amplified by 1 / alpha.
    tolerance = 1e-8 + rounding(float, condition=1e4)
    assert material.evaluate(view, light, UV)[0, 0] == pytest.approx(peak, rel=tolerance)


@pytest.mark.stability
def test_phong_density_near_the_pole_is_smooth():
    # Across the switch from the limit to log1p the exponent's relative error stays tiny:
    # log density = -n sin^2 / 2 (1 + sin^2 / 2 + ...).
    sines = np.logspace(-12, -2, 200)
    halves = np.stack([sines, 0 * sines, np.sqrt(1 - sines**2)], axis=1)
    n = np.full((200, 1), 1e5)
    values = phong_density(halves, n, n)[:, 0] * 2 * np.pi / (1e5 + 1)
    expected = np.exp(1e5 * 0.5 * np.log1p(-(sines**2)))
    np.testing.assert_allclose(values, expected, rtol=1e-10)  # exponent up to 5, eps 1e-16


# ------------------------------------------------------------------ spatially varying


def test_frames_are_rotations(rng, rounding):
    table = {
        "type": "textured",
        "base": {"type": "lambert"},
        "tangent_angle": {"type": "noise", "values": [-2.0, 2.0]},
        "height": {"type": "noise", "seed": 3},
        "height_scale": 0.5,
    }
    frames = make_material(table).frame_change(rng.random((300, 2)))
    identity = np.einsum("nij,nkj->nik", frames, frames)
    tolerance = rounding(float, 16)
    np.testing.assert_allclose(
        identity, np.broadcast_to(np.eye(3), (300, 3, 3)), atol=tolerance
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=tolerance)
    assert (frames[:, 2, 2] < 0.999).any()  # the bumps do tilt


def test_bump_tilts_against_the_slope():
    # Height rises along u like 0.5 - 0.5 cos(2 pi u): slope 1/2 2 pi at u = 1/4.
    table = {
        "type": "textured",
        "base": {"type": "lambert"},
        "height": {"type": "stripes", "columns": 1, "softness": 1.0, "values": [1.0, 0.0]},
        "height_scale": 1 / np.pi,
    }
    normal = make_material(table).frame_change(np.array([[0.25, 0.0]]))[0, 2]
    # 1e-6: second-order error of the finite difference.
    np.testing.assert_allclose(normal, np.array([-1.0, 0.0, 1.0]) / np.sqrt(2.0), atol=1e-6)


def test_normal_map_is_read_in_the_surface_frame(tmp_path):

    encoded = np.round(255 * (0.5 + 0.5 * np.array([0.6, 0.0, 0.8]))).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "n.png"), np.tile(encoded[::-1], (2, 2, 1)))
    table = {
        "type": "textured",
        "base": {"type": "lambert"},
        "normal_map": {"type": "image", "file": "n.png"},
    }
    frame = make_material(table, tmp_path).frame_change(np.array([[0.3, 0.4]]))[0]
    np.testing.assert_allclose(frame[2], [0.6, 0.0, 0.8], atol=0.01)  # 8-bit steps
    assert frame[0] @ [1.0, 0.0, 0.0] > 0.7  # tangent stays near dP/du


def test_turned_frame_turns_the_highlight(rng, rounding):
    base = ANALYTIC["metal"]
    turned = make_material({"type": "textured", "base": base, "tangent_angle": 0.4})
    frame = turned.frame_change(UV)[0]
    view, light = upper_directions(rng, 1), upper_directions(rng, 1)
    seen = turned.evaluate(view @ frame.T, light @ frame.T, UV)
    swapped = {**base, "alpha_x": base["alpha_y"], "alpha_y": base["alpha_x"]}
    quarter = make_material(
        {"type": "textured", "base": swapped, "tangent_angle": 0.4 + np.pi / 2}
    )
    frame = quarter.frame_change(UV)[0]
    same = quarter.evaluate(view @ frame.T, light @ frame.T, UV)
    np.testing.assert_allclose(seen, same, rtol=rounding(float, 64))


def test_mixed_takes_each_material_at_its_label():
    table = {
        "type": "mixed",
        "labels": {"type": "bands", "edges": [[0.5, 1.0]]},
        "materials": [
            {"type": "lambert", "albedo": 0.25},
            {"type": "textured", "base": {"type": "lambert", "albedo": 0.75}, "tint": 0.5},
        ],
    }
    material = make_material(table)
    uv, up = np.array([[0.1, 0.2], [0.1, 0.7]]), np.array([[0.0, 0.0, 1.0]] * 2)
    assert material.label(uv).tolist() == [0, 1]
    values = material.evaluate(up, up, uv) * np.pi
    np.testing.assert_allclose(values[:, 0], [0.25, 0.375])
    assert material.uses_uv


@pytest.mark.parametrize("name", material_presets())
def test_presets_are_sound(name, rng):
    material = make_material({"preset": name})
    views, lights = upper_directions(rng, 100), upper_directions(rng, 100)
    values = material.evaluate(views, lights, rng.random((100, 2)))
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()
    assert values.max() > 0.0


def test_preset_takes_overrides():
    material = make_material({"preset": "grey_card", "albedo": 0.5})
    assert material.albedo.value == (0.5,)


def test_frames_from_keeps_the_normal(rng):
    normals, tangents = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    frames = frames_from(normals, tangents)
    cosine = np.sum(frames[:, 2] * normals, axis=1) / np.linalg.norm(normals, axis=1)
    np.testing.assert_allclose(cosine, 1.0)
    assert (np.sum(frames[:, 0] * tangents, axis=1) > 0.0).all()


BAD_TABLES = [
    ({}, "type"),
    ({"type": "velvet"}, "type: expected one of"),
    ({"preset": "unobtainium"}, "preset: expected one of"),
    ({"type": "lambert", "colour": 1}, "'colour'"),
    ({"type": "lambert", "albedo": 1.1}, r"albedo: expected values in \[0, 1\], received 1.1"),
    ({"type": "lambert", "albedo": [0.1, -0.1, 0.5]}, "received -0.1"),
    ({"type": "lambert", "albedo": [0.1, 0.5]}, "a list of 3 numbers"),
    ({"type": "lambert", "albedo": float("nan")}, "albedo"),
    ({"type": "lambert", "albedo": True}, "albedo"),
    ({"type": "lambert", "albedo": {"type": "plaid"}}, "albedo.type"),
    ({"type": "lambert", "albedo": {"type": "checker", "values": [0, 2]}}, "received 2"),
    ({"type": "lambert", "albedo": {"type": "checker", "columns": 0}}, "columns"),
    ({"type": "lambert", "albedo": {"type": "image", "file": "no.png"}}, "an existing file"),
    ({"type": "ggx", "alpha": 0.0}, "alpha: expected"),
    ({"type": "ggx", "alpha_x": 0.1, "alpha_y": 2.0}, "alpha_y"),
    ({"type": "ggx", "metal": "mithril"}, "metal"),
    ({"type": "ggx", "eta": 1.5}, "kappa"),
    ({"type": "ashikhmin_shirley", "exponent_u": -1.0}, "exponent_u"),
    ({"type": "textured"}, "base"),
    ({"type": "mixed", "materials": []}, "materials"),
    ({"type": "mixed", "materials": [{"type": "lambert"}], "labels": 1}, "labels"),
    ({"type": "rgl", "file": "no.bsdf"}, "an existing file"),
]


@pytest.mark.parametrize(("table", "message"), BAD_TABLES)
def test_bad_tables_say_what_is_wrong(table, message):
    with pytest.raises(SceneError, match=message):
        make_material(table)


def test_nesting_ends():
    table = {"type": "lambert"}
    for _ in range(12):
        table = {"type": "textured", "base": table}
    with pytest.raises(SceneError, match="levels"):
        make_material(table)
