"""The sweep: what is run, within which time, what is picked, and that it goes on."""

import json

import pytest

from reflfield.errors import InputError
from reflfield.options import Resources
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.tradeoff.cost_fit import fit_costs
from reflfield.tradeoff.measured_ladder import measured_ladder
from reflfield.tradeoff.sweep_results import Measured, better_half, front_of, gain, paths, picks
from reflfield.tradeoff.swept_options import (
    SWEPT,
    Configuration,
    nested,
    one_at_a_time,
    same,
    value_of,
)
from reflfield.tradeoff.tradeoff_report import write_tradeoff


@pytest.fixture
def point_sets(rng):
    """Sets of (cost, quality) with ties, of one point and more."""
    return [rng.integers(1, 9, (n, 2)).tolist() for n in range(1, 13) for _ in range(20)]


def test_no_point_beats_the_front_and_it_beats_all_others(point_sets):
    for points in point_sets:
        front = front_of(points)
        for i, (cost, quality) in enumerate(points):
            assert any(points[j][0] <= cost and points[j][1] >= quality for j in front)
            cheaper = any(c < cost and q >= quality for c, q in points)
            assert not (i in front and cheaper)


def test_half_is_kept_and_the_best_and_the_cheapest_with_it(point_sets):
    for points in point_sets:
        kept = [points[i] for i in better_half(points)]
        assert len(kept) == -(-len(points) // 2)
        assert max(quality for _, quality in points) in [quality for _, quality in kept]
        if len(kept) > 1:
            assert min(points[i] for i in front_of(points)) in kept


def test_changes_are_all_values_but_the_default_once():
    options = PipelineOptions()
    changes = [(option.name, value) for option, value in one_at_a_time(options, SWEPT)]
    assert len(set(changes)) == len(changes)
    expected = sum(
        not same(value, value_of(options, option.name))
        for option in SWEPT
        for value in option.values
    )
    assert len(changes) == expected


@pytest.mark.parametrize("option", [o for o in SWEPT if "." in o.name], ids=lambda o: o.name)
def test_every_value_can_be_set(option):
    for value in option.values:
        options = Configuration().having(option.name, value).applied_to(PipelineOptions())
        assert same(value_of(options, option.name), value)


def test_settings_come_back_as_they_were():
    settings = {"hull.resolution": 96, "alignment.refine": False, "compression.fit": "grid"}
    assert nested(settings)["alignment"] == {"refine": False}
    assert nested(settings)["compression"] == {"fit": "grid"}


def test_a_sweep_runs_what_it_has_announced(fake_runs, make_sweep):
    fake, lines = fake_runs(), []
    sweep = make_sweep()
    result = sweep.run(lines.append)
    said = next(line for line in lines if line.startswith("one at once"))
    assert said.split()[3] == str(len(sweep.alone))
    alone = [m for m in result.measured if m.stage_of_sweep == "alone"]
    assert len(alone) == len(sweep.alone)
    assert {"halving", "together"} <= {m.stage_of_sweep for m in result.measured}
    assert not result.left
    assert any(job.reported is not None for job in fake.jobs)


def test_the_best_path_is_followed_and_picked(fake_runs, make_sweep):
    fake_runs()
    result = make_sweep().run()
    chosen = picks(result)
    best = dict(chosen["best"].configuration.settings)
    # Both options that the formula of the error has, at their finest.
    assert best["texture.texels_per_pixel"] == 2.2
    assert best["compression.half_vector.image_steps"] == 4
    assert chosen["fast"].cpu_seconds <= chosen["balanced"].cpu_seconds
    assert chosen["balanced"].cpu_seconds <= chosen["best"].cpu_seconds
    assert chosen["fast"].psnr >= chosen["best"].psnr - 3
    assert all("reported" in measured.outcome for measured in chosen.values())


def test_an_interrupted_sweep_goes_on(fake_runs, make_sweep):
    fake = fake_runs()
    first = make_sweep().run()
    n = len(fake.jobs)
    again = make_sweep().run()
    assert len(fake.jobs) == n
    assert [m.configuration for m in again.measured] == [
        m.configuration for m in first.measured
    ]
    assert [m.repeats for m in again.measured] == [m.repeats for m in first.measured]


def test_what_was_run_otherwise_is_run_again(fake_runs, make_sweep):
    fake = fake_runs()
    make_sweep().run()
    n = len(fake.jobs)
    make_sweep(resources=Resources(workers=2)).run()
    assert len(fake.jobs) == 2 * n


def test_a_budget_leaves_out_what_would_not_end_in_time(fake_runs, make_sweep):
    fake_runs()
    result = make_sweep(budget=1e-3).run()
    assert len(result.measured) == 1
    assert len(result.left) >= len(make_sweep().alone)


def test_a_configuration_that_cannot_be_used_stops_nothing(fake_runs, make_sweep):
    fake_runs(refused="texture")
    result = make_sweep().run()
    failed = [m for m in result.measured if m.failed]
    assert len(failed) == 4
    assert all(m.measures for m in picks(result).values())


def test_repeats_show_the_scatter_of_the_times(fake_runs, make_sweep):
    fake_runs()
    result = make_sweep().run()
    assert len(result.default.repeats) == 2
    assert len(picks(result)["best"].repeats) == 2


def run_with(cpu, psnr, changed=None):
    """A run that has taken so much and is so good."""
    stage = {"name": "surface", "cpu_seconds": cpu, "seconds": cpu, "reused": False}
    outcome = {"stages": [stage], "chosen on": {"psnr": [psnr]}}
    return Measured(Configuration(), outcome, changed)


def test_paths_begin_with_what_pays_most():
    alone = [
        run_with(5.0, 29.0, ("hull.resolution", 96)),  # half of the time for 1 dB
        run_with(5.0, 27.0, ("alignment.iterations", 1)),  # half for 3 dB
        run_with(2.5, 29.5, ("completion.rank", 6)),  # a quarter for half a dB
        run_with(20.0, 31.0, ("compression.rank", 32)),  # twice for 1 dB
        run_with(20.0, 33.0, ("compression.n_clusters", 16)),  # twice for 3 dB
        run_with(20.0, 29.0, ("completion.passes", 8)),  # twice for nothing
    ]
    combined = [[name for name, _ in c.settings] for c in paths(run_with(10.0, 30.0), alone)]
    assert combined == [
        ["completion.rank", "hull.resolution"],
        ["alignment.iterations", "completion.rank", "hull.resolution"],
        ["compression.n_clusters", "compression.rank"],
    ]


def test_a_gain_has_the_error_of_images_that_are_the_same(fake_runs, make_sweep):
    fake_runs()
    result = make_sweep().run()
    gained, error = gain(picks(result)["best"], result.default)
    assert gained == pytest.approx(picks(result)["best"].psnr - result.default.psnr)
    # Two images whose gains are equal: a decibel over the root of two.
    assert error == pytest.approx(1 / 2**0.5)


def test_report_document_and_costs_are_written(fake_runs, make_sweep):
    fake_runs()
    sweep = make_sweep(stages_swept=("texture", "lights", "views"))
    result = sweep.run()
    fit = fit_costs(result, sweep.share, sweep.costs, sweep.slowness)
    page = write_tradeoff(sweep.out, result, fit).read_text()
    for title in ("Pareto front", "Options, one at a time", "Is it worth more lights?"):
        assert title in page
    document = json.loads((sweep.out / "tradeoff.json").read_text())
    assert document["configurations"][0]["name"] == "default"
    assert len(document["configurations"]) == len(result.measured)
    ladder, costs = measured_ladder(sweep.out)
    assert list(ladder.values())[-1] == dict(picks(result)["best"].configuration.settings)
    assert costs.units == fit.costs.units
    # The fit is to these runs: it is no worse on them than what it came from.
    summary = fit.summary()
    assert summary["after, median factor"] <= summary["before, median factor"]


def test_another_document_is_no_sweep(tmp_path):
    (tmp_path / "tradeoff.json").write_text('{"configurations": [{"views": 1}]}')
    with pytest.raises(InputError, match=r"tradeoff\.json: expected the document"):
        measured_ladder(tmp_path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"stages_swept": ("hulls",)}, "stages: expected some of"),
        ({"budget": -1.0}, "budget: expected a time above 0"),
    ],
)
def test_bad_arguments_are_refused(make_sweep, words, message):
    with pytest.raises(InputError, match=message):
        make_sweep(**words)
