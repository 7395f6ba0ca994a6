"""Laws that every material obeys: furnace, reciprocity, energy, no negative light."""

import numpy as np
import pytest

from capture_sim.effects.directions import draw_directions
from capture_sim.materials import make_material, material_presets, read_rgl

MEASURED = ("paper_white", "satin_rosaline", "cc_ibiza_sunset", "cc_iris_purple_gem",
            "colodur_napoli_4f")  # fmt: skip
VIEWS = np.array([[np.sin(t), 0.0, np.cos(t)] for t in (0.0, 0.5, 1.0, 1.3)])
N = 20_000


def furnace(material, view, rng):
    """Light reflected to a viewer in a furnace of radiance 1, and its standard error."""
    uv = np.tile(rng.random((1, 2)), (N, 1))
    views = np.tile(view, (N, 1))
    lights, density = draw_directions(views, material.lobe(uv), rng.random((N, 3)))
    values = material.evaluate(views, lights, uv)
    samples = values * (np.maximum(lights[:, 2], 0.0) / density)[:, None]
    return samples.mean(axis=0), samples.std(axis=0) / np.sqrt(N)


def random_pairs(rng, n=2000):
    directions = rng.normal(size=(2, n, 3))
    directions[..., 2] = np.abs(directions[..., 2]) + 1e-3
    return (
        *(directions / np.linalg.norm(directions, axis=2, keepdims=True)),
        rng.random((n, 2)),
    )


@pytest.mark.parametrize("name", material_presets())
def test_no_preset_reflects_more_than_arrives(name, rng):
    material = make_material({"preset": name})
    for view in VIEWS:
        for _ in range(4):  # places
            albedo, error = furnace(material, view, rng)
            assert (albedo <= 1.0 + 4.0 * error).all()
            assert albedo.max() > 0.01
            assert (error < 0.05).all()  # or the bound says nothing


@pytest.mark.parametrize("name", material_presets())
def test_presets_are_reciprocal_and_positive(name, rng, rounding):
    material = make_material({"preset": name})
    views, lights, uv = random_pairs(rng)
    forth, back = material.evaluate(views, lights, uv), material.evaluate(lights, views, uv)
    assert (forth >= 0.0).all()
    # Sharp lobes magnify the rounding of half vectors by about 4 / alpha, here 0.1.
    np.testing.assert_allclose(forth, back, rtol=rounding(float, 64, condition=40))


@pytest.mark.parametrize("name", MEASURED)
def test_measured_materials_conserve_energy(name, rng, shared_data):
    material = read_rgl(shared_data("rgl_bsdf") / f"{name}_rgb.bsdf")
    for view in VIEWS[:3]:
        albedo, error = furnace(material, view, rng)
        assert (error < 0.05).all()
        # The gonioreflectometer is calibrated to some per cent.
        assert (albedo <= 1.05 + 4.0 * error).all()
    views, lights, uv = random_pairs(rng)
    assert (material.evaluate(views, lights, uv) >= 0.0).all()


@pytest.mark.parametrize("name", MEASURED)
def test_measured_materials_are_nearly_reciprocal(name, rng, shared_data):
    """What was measured is not exactly reciprocal: noise, and a finite source and detector."""
    material = read_rgl(shared_data("rgl_bsdf") / f"{name}_rgb.bsdf")
    views, lights, uv = random_pairs(rng)
    steep = (views[:, 2] > 0.4) & (lights[:, 2] > 0.4)
    forth = material.evaluate(views, lights, uv)[steep]
    back = material.evaluate(lights, views, uv)[steep]
    asymmetry = np.abs(forth - back).mean() / forth.mean()
    assert asymmetry < 0.2
