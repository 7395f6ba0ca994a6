import numpy as np
import pytest

from reflfield.export import microfacet_fit
from reflfield.export.microfacet_fit import direction_pairs, fit_microfacets
from reflfield.export.microfacets import MicrofacetMaterial
from tests.synthetic_fields import baked_field, lambert, square_surface

UP, ACROSS = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def material(n=1, **changes):
    """Grey dielectric with a round highlight, facing up."""
    parts = {
        "base_colour": np.full((n, 3), 0.5), "metallic": np.zeros(n),
        "roughness": np.full(n, 0.5), "strength": np.zeros(n),
        "dielectric_f0": np.full((n, 3), 0.04), "dielectric_f90": np.ones(n),
        "normals": np.tile(UP, (n, 1)), "stretch": np.tile(ACROSS, (n, 1)),
    }  # fmt: skip
    wrong = {name: np.broadcast_to(value, parts[name].shape) for name, value in changes.items()}
    return MicrofacetMaterial(**(parts | {n: v.astype(float) for n, v in wrong.items()}))


def at(one, views, lights):
    return one.evaluate(np.zeros(len(views), int), views, lights)


def khronos(v, l, base, metallic, roughness, strength):  # noqa: E741
    """The extension's own sample code, line by line, with t = x, b = y, n = z."""

    def dot(a, b):
        return (a * b).sum(axis=-1)

    t, b, n = np.eye(3)
    h = (v + l) / np.linalg.norm(v + l, axis=1, keepdims=True)
    alpha = roughness * roughness
    at, ab = alpha + (1 - alpha) * strength * strength, alpha
    f = np.stack([ab * dot(t, h), at * dot(b, h), at * ab * dot(n, h)], axis=1)
    w2 = at * ab / dot(f, f)
    distribution = at * ab * w2 * w2 / np.pi
    ggx_v = dot(n, l) * np.linalg.norm([at * dot(t, v), ab * dot(b, v), dot(n, v)], axis=0)
    ggx_l = dot(n, v) * np.linalg.norm([at * dot(t, l), ab * dot(b, l), dot(n, l)], axis=0)
    gloss = distribution * np.clip(0.5 / (ggx_v + ggx_l), 0, 1)
    schlick = (1 - np.abs(dot(v, h))) ** 5
    fresnel = 0.04 + 0.96 * schlick
    dielectric = base / np.pi * (1 - fresnel) + gloss * fresnel
    metal = gloss * (base + (1 - base) * schlick)
    return dot(n, l) * ((1 - metallic) * dielectric + metallic * metal)


@pytest.mark.reference
@pytest.mark.parametrize("strength", [0.0, 0.7])
def test_reflectance_is_that_of_the_specification(strength, rounding):
    views, lights = direction_pairs(200, near_normal=True)
    one = material(metallic=0.3, roughness=0.4, strength=strength)
    wanted = khronos(views, lights, 0.5, 0.3, 0.4, strength)
    shown = at(one, views, lights)
    limit = rounding(float, operations=50, scale=wanted.max())
    np.testing.assert_allclose(shown, np.repeat(wanted[:, None], 3, axis=1), atol=limit)


def test_no_material_reflects_more_than_arrives():
    """White furnace, of light spread by the cosine: means of 4096 samples of a smooth lobe."""
    _, lights = direction_pairs(4096, near_normal=False)
    for tilt in (0.0, 0.6, 1.2):
        view = np.tile([np.sin(tilt), 0.0, np.cos(tilt)], (len(lights), 1))
        white = material(base_colour=1.0, metallic=1.0, roughness=0.7, strength=0.5)
        reflected = np.pi * (at(white, view, lights) / lights[:, 2:]).mean()
        assert 0.5 < reflected < 1.0


def test_metal_looks_the_same_with_view_and_light_exchanged(rounding):
    views, lights = direction_pairs(100, near_normal=True)
    metal = material(metallic=1.0, roughness=0.5, strength=0.4)
    one = at(metal, views, lights) / lights[:, 2:]
    other = at(metal, lights, views) / views[:, 2:]
    np.testing.assert_allclose(one, other, atol=rounding(float, operations=50, scale=one.max()))


def planted(n, rng):
    """Materials of every kind: tilted, stretched in any direction, coloured."""
    slopes = rng.uniform(-0.3, 0.3, (n, 2))
    normals = np.column_stack([slopes, np.ones(n)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    stretch = np.column_stack([rng.normal(size=(n, 2)), np.zeros(n)])
    stretch -= (stretch * normals).sum(axis=1, keepdims=True) * normals
    stretch /= np.linalg.norm(stretch, axis=1, keepdims=True)
    f0 = rng.uniform(0.05, 0.4, (n, 3))
    return material(
        n, base_colour=rng.uniform(0.1, 0.8, (n, 3)), roughness=rng.uniform(0.3, 0.6, n),
        strength=rng.uniform(0.3, 0.5, n), dielectric_f0=f0, normals=normals, stretch=stretch,
    )  # fmt: skip


@pytest.mark.reference
def test_the_fit_recovers_a_planted_material(monkeypatch, rng):
    field = baked_field(square_surface(6), lambert(0.5), view_side=5, light_side=5)
    truth = planted(field.n_texels, rng)

    def evaluate(_, texels, views, lights):
        return truth.evaluate(texels, views.astype(float), lights.astype(float))

    monkeypatch.setattr(microfacet_fit, "evaluate", evaluate)
    fit = fit_microfacets(field, np.tile(UP, (field.n_texels, 1)))
    across = truth.roughness**2
    along = across + (1 - across) * truth.strength**2
    # Cauchy's weights and the priors leave thousandths; one texel may stay in a side valley.
    for shown, wanted in (
        (fit.diffuse, truth.base_colour), (fit.f0, truth.dielectric_f0),
        (fit.alphas, np.stack([along, across], axis=1)), (fit.normals, truth.normals),
    ):  # fmt: skip
        off = np.abs(shown - wanted).max(axis=1)
        assert np.sort(off)[-2] < 0.02, np.sort(off)[-5:]
    turned = np.abs((fit.stretch * truth.stretch).sum(axis=1))
    assert np.sort(turned)[1] > np.cos(np.radians(3.0))


@pytest.mark.stability
def test_a_black_texel_and_a_shadowed_sample_are_survived(monkeypatch, rng):
    """One sample of twenty is black; the highlight and colour are those of the others."""
    field = baked_field(square_surface(4), lambert(0.5), view_side=5, light_side=5)
    truth = material(16, roughness=0.4)

    def evaluate(_, texels, views, lights):
        samples = truth.evaluate(texels, views.astype(float), lights.astype(float))
        samples[rng.random(len(samples)) < 0.05] = 0.0
        samples[np.asarray(texels) == 3] = 0.0
        return samples

    monkeypatch.setattr(microfacet_fit, "evaluate", evaluate)
    fit = fit_microfacets(field, np.tile(UP, (16, 1)))
    lit = np.arange(16) != 3
    assert np.abs(fit.diffuse[lit] - 0.5).max() < 0.05
    assert not fit.diffuse[3].any()
    assert np.isfinite(fit.normals).all()
