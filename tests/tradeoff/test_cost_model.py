"""The model of costs: counts that are foreseen, unit costs that are fitted, plans."""

import json
from dataclasses import replace

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.pipeline_options import PipelineOptions, TextureOptions
from reflfield.tradeoff.machine_speed import slowness
from reflfield.tradeoff.run_plan import plan_of, wanted_stages, with_planned_selection
from reflfield.tradeoff.stage_costs import (
    CPU,
    StageMeasured,
    UnitCosts,
    fitted,
    read_costs,
    shipped_costs,
    work_of,
)
from reflfield.tradeoff.work_counts import counts_of, planned_context, texture_of

HELD_OUT = HoldOut(views=1, lights=1)


@pytest.fixture
def context(product):
    return planned_context(product, PipelineOptions(), HELD_OUT, Resources(workers=1))


@pytest.fixture
def counts(context):
    return counts_of(context)


def test_counts_are_those_of_the_photographs_that_make_the_field(counts):
    assert (counts.n_views, counts.n_lights, counts.n_photographs) == (9, 9, 81)
    assert counts.photograph_pixels == 81 * 32 * 32
    assert counts.compared_pixels == 32 * 32
    assert counts.n_samples == counts.n_texels * 81


def test_the_outline_of_a_ball_tells_its_texels(context):
    """A ball of r pixels has 4 pi r^2, a texture 64 texels wide at least."""
    fine = PipelineOptions(texture=TextureOptions(texels_per_pixel=8.0))
    radius = 10.0
    side, n = texture_of(replace(context, options=fine), np.pi * radius**2)
    area = 4 * np.pi * (8 * radius) ** 2
    # HULL_EXCESS says that hulls have a tenth more; charts leave 0.53 to 0.62 of it unused.
    assert 0.8 * area < n < 1.2 * area
    assert n < side**2
    assert texture_of(context, 4.0)[0] == 64


def test_texels_are_about_those_of_a_run(finished_ball, context):
    texels, options = finished_ball
    _, n = texture_of(replace(context, options=options), 0.25 * 32 * 32)
    assert texels / 1.5 < n < 1.5 * texels


@pytest.fixture
def finished_ball():
    """Texels of the ball that `tests/pipeline` runs, in a texture of 64 x 64: 0.24 of it."""
    options = PipelineOptions()
    return 980, replace(options, atlas=replace(options.atlas, resolution=64))


def planted(counts, context):
    """Stages with costs that known unit costs give, of runs of several sizes."""
    units = {"tables, rounds": 0.2, "image steps, pixels": 1.5, "coefficients, samples": 0.7}
    options = with_planned_selection(context, replace_model(counts)).options
    for factor in (1, 4, 16, 64):
        some = replace_model(
            counts, n_samples=factor * 2e6, covered_values=factor**0.5 * 1e6, n_texels=2e4
        )
        work = work_of("surface", some, options)
        cost = sum(units.get(name, 0.0) * amount for name, amount in work.items())
        yield StageMeasured("surface", some, options, cost, cost * 1e8, cost * 1e6)


def replace_model(counts, **changes):
    return replace(counts, model="half_vector", **changes)


def test_planted_costs_are_recovered(counts, context):
    rows = list(planted(counts, context))
    costs = fitted(rows, None, {"model": 1.0})
    for row in rows:
        predicted = costs.cost(CPU, "surface", row.counts, row.options)
        # A linear system of numbers between 1 and 100 that has an exact solution.
        assert predicted == pytest.approx(row.cpu, rel=1e-4)


def test_what_no_run_shows_stays_as_it_was(counts, context, rounding):
    prior = UnitCosts(
        {CPU: {"hull": 3.0, "tables, rounds": 9.0}, "memory": {}, "disk": {}}, {"model": 1.0}
    )
    costs = fitted(planted(counts, context), prior, prior.machine_seconds)
    assert costs.units[CPU]["hull"] == pytest.approx(3.0, abs=rounding(np.float64, scale=3))
    assert costs.units[CPU].get("tables, rounds", 0.0) < 9.0


def test_costs_that_are_read_are_those_that_were_written(tmp_path):
    costs = shipped_costs()
    (tmp_path / "costs.json").write_text(json.dumps(costs.document()))
    read = read_costs(tmp_path / "costs.json")
    assert read.units == costs.units
    assert read.machine_seconds == costs.machine_seconds


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b'{"format": "reflfield-unit-costs", "version": 1, "units": 3}',
        b'{"format": "reflfield-unit-costs", "version": 1, "machine seconds": {"model": 1},'
        b' "units": {"cpu": {"hull": -1}, "memory": {}, "disk": {}}}',
        b'{"format": "another", "version": 1, "machine seconds": {}, "units": {}}',
    ],
)
def test_costs_of_another_kind_are_refused(tmp_path, content):
    (tmp_path / "costs.json").write_bytes(content)
    with pytest.raises(InputError, match=r"costs\.json: expected unit costs"):
        read_costs(tmp_path / "costs.json")


def test_a_plan_names_the_stages_of_the_run(context, counts):
    plan = plan_of(context, counts, shipped_costs(), 1.0)
    names = [stage.name for stage in plan.stages if stage.name != "model_selection"]
    assert names == wanted_stages(with_planned_selection(context, counts))
    assert plan.cpu_seconds > sum(stage.cpu_seconds for stage in plan.stages)
    assert plan.memory == max(stage.memory for stage in plan.stages)
    assert any("texels" in line for line in plan.lines())


def test_a_plan_on_a_slower_machine_takes_longer(context, counts):
    here, slower = (plan_of(context, counts, shipped_costs(), s) for s in (1.0, 2.0))
    assert slower.cpu_seconds == pytest.approx(2 * here.cpu_seconds)
    assert slower.memory == here.memory


def test_workers_shorten_the_time_but_not_the_work(context, counts):
    one, four = (
        plan_of(replace(context, resources=Resources(workers=n)), counts, shipped_costs(), 1.0)
        for n in (1, 4)
    )
    assert four.seconds < one.seconds
    assert four.cpu_seconds == pytest.approx(one.cpu_seconds)


def test_slowness_is_one_here_and_its_inverse_there():
    here, there = {"model": 0.3, "numbers": 0.2}, {"model": 0.1, "numbers": 0.4}
    assert slowness(here, here) == pytest.approx(1.0)
    assert slowness(here, there) * slowness(there, here) == pytest.approx(1.0)
