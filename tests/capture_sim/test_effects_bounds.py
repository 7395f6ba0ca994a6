"""No effect changes a photograph by more than it said it could."""

import numpy as np
import pytest

from capture_sim.brightness import measured, photograph_scale, relative_change
from capture_sim.contributions import contributions, some_pairs
from capture_sim.effects import light_extent, simulated
from capture_sim.effects.effect_registry import EFFECTS
from capture_sim.rays import RayTracer
from capture_sim.scene import parse_scene

# Parameters below what photographs notice, and as large as those of a careless rig.
SMALL = {
    "lens_distortion": {"k1": -1e-4, "k2": 0.0},
    "pose_error": {"rotation_deg": 1e-3, "translation": 1e-5},
    "misregistration": {"pixels": 0.01},
    "falloff_profile": {"exponent": 0.05},
    "light_position_error": {"position": 1e-4},
    "light_variation": {"intensity": 1e-3, "colour": 1e-3},
    "light_extent": {"radius": 1e-3, "samples": 4},
    "environment": {"radiance": 1e-4, "samples": 16},
    "vignetting": {"coefficients": [-0.01]},
    "defocus": {"f_number": 32.0},
    "quantisation": {"bits": 14},
    "black_level": {"drift": 1e-5},
    "saturation": {"radiance": 100.0},
}
LARGE = {
    **{name: {} for name in SMALL},
    "light_extent": {"samples": 4},
    "environment": {"samples": 16},
    "saturation": {"radiance": 0.5},
    "bayer": {},
    "sensor_noise": {},
    "exposure_brackets": {},
}


def scene(thing, material, **effects):
    return parse_scene(
        {
            "object": {"preset": thing},
            "material": {"preset": material},
            "cameras": {
                "preset": "rings",
                "elevations_deg": [20, 60],
                "counts": [1, 2],
                "width": 24,
                "height": 24,
                "distance": 0.8,
                "extent": 0.25,
            },
            "lights": {
                "preset": "rings",
                "elevations_deg": [10, 50],
                "counts": [2, 1],
                "distance": 0.6,
            },
            "effects": effects,
        }
    )


@pytest.mark.parametrize(
    ("thing", "material", "parameters"),
    [
        ("sphere", "satin", SMALL),
        ("sphere", "satin", LARGE),
        pytest.param("relief", "greek_key", LARGE, marks=pytest.mark.slow),
        pytest.param("vase", "gold", LARGE, marks=pytest.mark.slow),
    ],
    ids=["small", "ball", "relief", "vase"],
)
def test_changes_stay_below_their_bounds(thing, material, parameters):
    described = scene(thing, material, **parameters)
    tracer = RayTracer(described.mesh)
    known = measured(described, tracer)
    bounds = {effect.NAME: effect.needed(known).bound for effect in EFFECTS}
    shares = contributions(known, tracer, some_pairs(known, 3))
    assert {one.name for one in shares} >= {"antialiasing", "near_lights", "pose_error"}
    broken = {one.name: (one.change, bounds[one.name]) for one in shares}
    broken = {name: pair for name, pair in broken.items() if pair[0] > pair[1]}
    assert broken == {}


def test_what_auto_leaves_out_is_below_the_tolerance():
    """Parameters far below the tolerance: `auto` leaves them out, `all` changes little."""
    tiny = {
        "falloff_profile": {"exponent": 1e-4},
        "light_variation": {"intensity": 1e-6, "colour": 1e-6},
        "environment": {"radiance": 1e-7, "samples": 16},
        "vignetting": {"coefficients": [-1e-5], "cos4": False},
        "quantisation": {"bits": 24, "full_scale": 100.0},
    }
    described = scene("sphere", "satin", **tiny)
    tracer = RayTracer(described.mesh)
    auto = measured(described, tracer)
    assert auto.effects.active.isdisjoint(tiny)
    forced = measured(
        scene("sphere", "satin", simulate=[*auto.effects.active, *tiny], **tiny), tracer
    )
    shares = contributions(forced, tracer, some_pairs(forced, 3))
    changes = {one.name: one.change for one in shares if one.name in tiny}
    assert set(changes) == set(tiny)
    assert max(changes.values()) <= auto.effects.tolerance
    assert max(changes.values()) > 0.0


def test_differences_are_what_the_effect_added():
    described = scene("sphere", "satin", environment={"samples": 16}, vignetting={})
    tracer = RayTracer(described.mesh)
    shares = {
        one.name: one
        for one in contributions(measured(described, tracer), tracer, [(0, 0), (2, 2)])
    }
    assert set(shares["environment"].differences) == {(0, 0), (2, 2)}
    assert shares["environment"].differences[2, 2].min() >= 0.0
    assert shares["vignetting"].differences[2, 2].max() <= 0.0


def test_the_sensors_own_noise_is_a_tolerance():
    """Lamps with a small area would be simulated, but not where noise hides them."""
    area = {"light_extent": {"radius": 1e-3}}
    clean = scene("sphere", "satin", **area)
    noise = {"sensor_noise": {"electrons_per_radiance": 1e3, "read_noise": 500.0}}
    noisy = scene("sphere", "satin", **area, **noise)
    tracer = RayTracer(clean.mesh)
    assert simulated(measured(clean, tracer), light_extent)
    assert not simulated(measured(noisy, tracer), light_extent)


def test_scale_and_change_of_photographs():
    image = np.zeros((20, 20, 3))
    assert photograph_scale(image) == 0.0
    assert relative_change(image, image) == 0.0
    assert relative_change(image, image + 1.0) == np.inf
    image[:10] = 4.0
    other = image.copy()
    other[0, 0, 0] += 1.0
    assert relative_change(image, other) == 0.25
