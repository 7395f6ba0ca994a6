"""Light between parts of the object: furnace, stated error, bound, and nothing when off."""

from dataclasses import replace

import numpy as np
import pytest

from capture_sim.arrival import LightArrays
from capture_sim.dome import fibonacci
from capture_sim.effects import directions, interreflection, simulated
from capture_sim.materials import make_material
from capture_sim.model import Blocks, EffectOptions
from capture_sim.rays import RayTracer, towards_camera
from capture_sim.render import shade
from capture_sim.scene import parse_scene
from capture_sim.shading import direct_light
from capture_sim.stopwatch import Stopwatch
from capture_sim.view_samples import sample_view


def bowl(material, *, paths=16, bounces=8, lights=None):
    scene = parse_scene(
        {
            "object": {"preset": "bowl", "around": 48, "along": 40},
            "material": material,
            "cameras": {
                "preset": "list",
                "directions": [[0.3, -0.5, 1]],
                "width": 12,
                "height": 12,
                "target": [0, 0, 0.03],
                "extent": 0.13,
            },
            "lights": lights or {"preset": "fibonacci", "n": 5},
            "image": {"samples_per_side": 1, "edge_samples_per_side": 1},
        }
    )
    options = interreflection.Options(paths=paths, bounces=bounces)
    names = ("shadows", "near_lights", "interreflection")
    return replace(scene, effects=EffectOptions(simulate=names, parameters=(options,)))


def estimated(scene):
    """Direct and indirect radiance of the view's points, and the variance; (n, 3, n_lights)."""
    tracer = RayTracer(scene.mesh)
    view = sample_view(scene, tracer, scene.cameras[0])
    views = towards_camera(view.camera, view.points.position)
    lights = LightArrays.of(scene, scene.lights)
    values, strength = direct_light(scene, tracer, view.points, views, lights)
    shining = strength[:, None] * lights.colour.T
    direct = np.where(shining > 0.0, values * shining, 0.0)
    return direct, *interreflection.estimate(scene, tracer, view.points, views, lights)


def test_white_object_vanishes_in_a_furnace():
    """With albedo 1 in light from all around every point has the radiance of the light."""
    scene = bowl({"type": "lambert", "albedo": 1.0}, paths=64, bounces=200)
    directions = fibonacci(600, np.pi)
    furnace = tuple(
        {"id": str(i), "type": "directional", "direction": d, "irradiance": [share] * 3}
        for i, d in enumerate(directions.tolist())
        for share in [4.0 * np.pi / len(directions)]
    )
    direct, indirect, variance = estimated(replace(scene, lights=furnace))
    whole = (direct + indirect).sum(axis=2)[:, 0]
    assert direct.sum(axis=2).min() < 0.75  # the hollow sees little of the furnace itself
    # The variance of the sum over lights, which share paths, is bounded by that of the whole:
    # each path brings between 0 and 1. 64 paths: standard deviations up to 1 / 16.
    assert np.abs(whole - 1.0).max() < 5.0 / 16.0
    # Mean over the picture: n points, independent; 600 directions resolve 1 per cent.
    assert abs(whole.mean() - 1.0) < 4.0 / (16.0 * np.sqrt(len(whole))) + 0.01
    assert (variance >= 0.0).all()


@pytest.mark.parametrize("material", ["grey_card", "gold"])
def test_stated_variance_is_that_of_repeated_estimates(material):
    scene = bowl({"preset": material}, paths=8)
    runs = []
    for run in range(24):
        # Another sequence of paths: points moved by a hair draw other numbers.
        shift = 1e-12 * (run + 1)
        moved = replace(scene, mesh=replace(scene.mesh, vertices=scene.mesh.vertices + shift))
        runs.append(estimated(moved)[1:])
    estimates, variances = (np.stack(part) for part in zip(*runs, strict=True))
    scatter = estimates.astype(float).var(axis=0, ddof=1).sum()
    stated = variances.astype(float).mean(axis=0).sum()
    # 24 runs of some hundred points and lights: 20 %; stratified paths scatter less than
    # independent ones, which the stated variance takes them for.
    assert 0.3 * stated < scatter < 1.2 * stated


def test_numbers_depend_on_no_order_of_work():
    scene = bowl({"preset": "glazed_ceramic"}, paths=4)
    tracer = RayTracer(scene.mesh)
    view = sample_view(scene, tracer, scene.cameras[0])
    whole = shade(scene, tracer, view, scene.lights)
    again = shade(replace(scene, blocks=Blocks(block=1 << 15)), tracer, view, scene.lights)
    np.testing.assert_array_equal(again, whole)
    alone = shade(scene, tracer, view, scene.lights[2:3])[0]
    np.testing.assert_array_equal(alone, whole[2])


def test_brighter_than_without_and_free_when_off(monkeypatch):
    scene = bowl({"type": "lambert", "albedo": 0.6})
    tracer = RayTracer(scene.mesh)
    view = sample_view(scene, tracer, scene.cameras[0])
    whole = shade(scene, tracer, view, scene.lights)
    direct_only = EffectOptions(simulate=("shadows", "near_lights"))
    off = replace(scene, effects=direct_only, costs=Stopwatch())
    monkeypatch.setattr(interreflection, "estimate", None)  # not even called
    monkeypatch.setattr(interreflection, "_traced_paths", None)
    direct = shade(off, tracer, view, scene.lights)
    assert (whole >= direct).all()
    assert whole.sum() > 1.1 * direct.sum()
    assert off.costs.seconds("interreflection") == 0.0


def test_bound_holds_and_follows_the_albedo():
    scene = bowl({"type": "lambert", "albedo": 0.5}, paths=64)
    direct, indirect, _ = estimated(scene)
    factor = interreflection.largest_form_factor(scene.mesh)
    assert 0.4 < factor < 0.8  # the bottom of a bowl three quarters deep
    gain = 0.5 * factor
    bound = interreflection.needed(scene).bound
    assert bound == pytest.approx(gain / (1.0 - gain), rel=0.02)  # headroom 1 here
    assert (indirect.max(axis=0) <= bound * direct.max(axis=0)).all()
    black = replace(scene, material=make_material({"type": "lambert", "albedo": 0.0}))
    assert interreflection.needed(black).bound == 0.0


def test_a_convex_object_throws_no_light_on_itself():
    scene = parse_scene(
        {
            "object": {"preset": "sphere"},
            "material": {"preset": "gold"},
            "cameras": {"preset": "rti"},
            "lights": {"preset": "rti"},
        }
    )
    assert interreflection.needed(scene).bound == 0.0
    assert not simulated(scene, interreflection)


@pytest.mark.parametrize("alphas", [(0.0, 0.0), (0.2, 0.2), (0.1, 0.5)])
def test_density_of_directions_integrates_to_one(alphas, rng):
    view = np.array([0.6, 0.1, np.sqrt(1 - 0.37)])
    n = 200_000
    lobes = np.tile(alphas, (n, 1))
    views = np.tile(view, (n, 1))
    outgoing, density = interreflection.draw_directions(views, lobes, rng.random((n, 3)))
    # The mean of g / density over the drawn directions is the integral of g.
    above = outgoing[:, 2] > 0.0
    for g, exact in ((outgoing[:, 2] / np.pi, 1.0), (outgoing[:, 2] ** 3 / np.pi, 0.5)):
        ratio = np.where(above, g / density, 0.0)
        error = ratio.std() / np.sqrt(n)
        assert abs(ratio.mean() - exact) < 4.0 * error + 1e-12
    # And the other way: a uniform grid of directions integrates the density itself.
    assert np.allclose(np.linalg.norm(outgoing, axis=1), 1.0)


@pytest.mark.parametrize("n_paths", range(1, 10))
def test_any_number_of_paths_is_unbiased(n_paths, rng):
    """Paths draw from two densities; the mean of g / density is the integral of g."""
    n_points = 20_000
    keys = rng.random((n_points, 6)).repeat(n_paths, axis=0).view(np.uint64)
    numbers = np.zeros((len(keys), 4))
    directions.fill_numbers(keys, np.arange(len(keys)), n_paths, 0, numbers)
    views = np.tile([0.6, 0.1, np.sqrt(1 - 0.37)], (len(keys), 1))
    outgoing, density = interreflection.draw_directions(
        views, np.full((len(keys), 2), 0.2), numbers
    )
    cosine = np.maximum(outgoing[:, 2], 0.0)
    for power, exact in ((1, 1.0), (3, 0.5), (9, 0.2)):  # 2 / (power + 1)
        means = (cosine**power / np.pi / density).reshape(n_points, n_paths).mean(axis=1)
        error = means.std(ddof=1) / np.sqrt(n_points)
        assert error < 0.02 * exact  # a path too many of one kind is off by 3 % and more
        # 27 comparisons: 4.5 standard errors are exceeded in one of 5,000 runs of them all.
        assert abs(means.mean() - exact) < 4.5 * error, power


def test_an_odd_number_of_paths_gives_the_converged_picture():
    """Mirror-like metal, of which too many mirrored paths lose a sixth."""
    converged = estimated(bowl({"preset": "gold"}, paths=512, bounces=2))[1]
    runs = []
    for run in range(24):
        scene = bowl({"preset": "gold"}, paths=3, bounces=2)
        shift = 1e-12 * (run + 1)  # draws other numbers
        moved = replace(scene, mesh=replace(scene.mesh, vertices=scene.mesh.vertices + shift))
        runs.append(estimated(moved)[1].mean(dtype=float))
    error = np.std(runs, ddof=1) / np.sqrt(len(runs))
    assert error < 0.04 * converged.mean()
    assert abs(np.mean(runs) - converged.mean(dtype=float)) < 4.0 * error


@pytest.mark.stability
def test_grazing_points_and_black_material_stay_finite():
    lights = {"preset": "rings", "elevations_deg": [0.5], "counts": [4]}
    scene = bowl({"type": "ggx", "metal": "silver", "alpha": 0.01}, paths=4, lights=lights)
    direct, indirect, variance = estimated(scene)
    for part in (direct, indirect, variance):
        assert np.isfinite(part).all()
        assert (part >= 0.0).all()
