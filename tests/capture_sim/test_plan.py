"""Plans: the right counts, and costs that scale with the work."""

import re

import pytest

from capture_sim.effects.effect_registry import NAMES
from capture_sim.plan import plan
from capture_sim.scene import parse_scene
from capture_sim.write import write_capture


def scene(thing, **more):
    return parse_scene(
        {
            "name": "trial",
            "object": {"preset": thing},
            "material": {"preset": "grey_card"},
            "cameras": {"preset": "fibonacci", "n": 4, "width": 24, "height": 24},
            "lights": {"preset": "fibonacci", "n": 3},
            "truth": {"points": 10},
            **more,
        }
    )


def test_counts_and_decisions():
    decided = plan(scene("sphere"))
    assert (decided.work.n_views, decided.work.n_lights) == (4, 3)
    assert decided.work.n_photographs == 12
    assert decided.work.n_pixels == 4 * 24 * 24
    assert 0 < decided.work.n_lit < decided.work.n_points * 3
    on = {effect.name for effect in decided.effects if effect.simulated}
    assert on == {"antialiasing", "near_lights"}
    assert [effect.name for effect in decided.effects] == list(NAMES)
    assert all((effect.bound > 1e-3) is effect.simulated for effect in decided.effects)
    assert all(effect.reason for effect in decided.effects)


def test_shadow_rays_are_counted():
    decided = plan(scene("vase"))
    costs = {effect.name: effect.cost.rays for effect in decided.effects}
    assert costs["shadows"] == decided.work.n_lit
    assert decided.rays == sum(costs[n] for n in ("shadows", "antialiasing", "interreflection"))


def test_size_is_near_that_of_the_capture(tmp_path):
    small = scene("vase")
    folder = write_capture(small, tmp_path / "capture")
    written = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    # Three of four views were measured; json, silhouettes and headers are not counted.
    assert plan(small).bytes == pytest.approx(written, rel=0.1)


def test_lines_state_effects_and_reasons():
    text = " ".join("\n".join(plan(scene("vase")).lines()).split())
    assert "12 (4 views, 3 lights)" in text
    assert re.search(r"on shadows <= \d+ % \S+ rays the object is not convex", text)
    assert re.search(r"on interreflection <= .* leave a standard error of", text)


def test_effects_that_are_asked_for_without_parameters_take_the_usual_ones():
    asked = scene("sphere", effects=["vignetting", "light_variation"])
    lines = {effect.name: effect for effect in plan(asked).effects}
    assert lines["vignetting"].simulated
    assert lines["vignetting"].bound > 0.01
    assert "of the light is lost" in lines["vignetting"].reason
    assert not lines["defocus"].simulated
