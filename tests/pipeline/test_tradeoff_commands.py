"""The commands `plan` and `tradeoff`, and `run` with a preset or a budget."""

import json

import pytest

from reflfield.capture.readers import open_capture
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.tradeoff.measured_run import Job, run_in_process
from reflfield.tradeoff.photograph_groups import photograph_groups

HELD_OUT = ("--hold-out", "views=1,lights=1")


def test_plan_says_time_memory_and_disk_and_writes_nothing(reflfield, tiny_capture, tmp_path):
    before = sorted(tiny_capture.rglob("*"))
    done = reflfield("plan", tiny_capture, *HELD_OUT, "--workers", 1)
    assert done.status == 0, done.err
    words = [line.split()[0] for line in done.out.splitlines()]
    assert words[:7] == [
        *("capture", "photographs", "work", "time", "memory", "disk", "stage"),
    ]
    assert {"hull", "observations", "compression", "report"} <= set(words[7:])
    assert sorted(tiny_capture.rglob("*")) == before


def test_a_preview_is_planned_to_take_less(reflfield, tiny_capture):
    def seconds(preset):
        done = reflfield("plan", tiny_capture, *HELD_OUT, "--preset", preset, "--workers", 1)
        hull = next(line for line in done.out.splitlines() if line.startswith("  hull"))
        return float(hull.split()[1])

    assert seconds("preview") < seconds("standard")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("run", "--preset", "fast"), "--preset: expected one of preview, standard, best"),
        (("run", "--budget", "soon"), "--budget: expected a time above 0"),
        (("run", "--budget", "10ms"), "--budget: expected a time above 0"),
        (("run", "--budget", "0.01s"), "--budget: expected at least"),
        (("run", "--tradeoff", "x"), "--tradeoff: expected with a budget"),
        (("run", "--budget", "1h", "--tradeoff", "absent"), "tradeoff.json: cannot be read"),
        (("tradeoff", "--stages", "hulls"), "--stages: expected some of"),
        (("tradeoff", "--budget", "-1"), "--budget: expected a time above 0"),
        (("tradeoff", "--hold-out", "views=10"), "--hold-out: expected fewer than"),
    ],
)
def test_bad_words_end_with_one_line_and_leave_nothing(
    reflfield, tiny_capture, tmp_path, words, message
):
    command, *rest = words
    held = () if "--hold-out" in rest else HELD_OUT
    done = reflfield(command, tiny_capture, "-o", tmp_path / "out", *held, *rest)
    assert done.status == 2
    assert message in done.err
    assert not (tmp_path / "out").exists()


def test_a_budget_chooses_a_preset_and_says_so(reflfield, tiny_capture, tmp_path):
    words = ("--budget", "2h", "--until", "silhouettes", "--workers", 1)
    done = reflfield("run", tiny_capture, "-o", tmp_path / "out", *HELD_OUT, *words)
    assert done.status == 0, done.err
    assert "budget of 2 h 00 min: best, expected to take" in done.err


def test_a_configuration_that_is_refused_says_why(tiny_capture, tmp_path):
    """A hull cannot be made within bounds that hold nothing of the object."""
    groups = photograph_groups(open_capture(tiny_capture), HoldOut(views=1, lights=1))
    options = PipelineOptions()
    hull = type(options.hull)(resolution=16, bounds=((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)))
    options = type(options)(hull=hull)
    job = Job("key", groups.trained, tmp_path / "run", options, Resources(workers=1))
    outcome = run_in_process(job)
    assert outcome["failed"]
    assert "stages" not in outcome
    assert json.loads((tmp_path / "run" / "outcome.json").read_text()) == outcome


@pytest.mark.slow
def test_a_sweep_reuses_stages_reports_and_goes_on(
    reflfield, tiny_capture, tiny_options, tmp_path
):
    out = tmp_path / "sweep"
    words = ("--config", tiny_options, *HELD_OUT, "--stages", "relighting", "--workers", 1)
    done = reflfield("tradeoff", tiny_capture, "-o", out, *words)
    assert done.status == 0, done.err
    document = json.loads((out / "tradeoff.json").read_text())
    names = [entry["name"] for entry in document["configurations"]]
    assert names == [
        "default",
        "relighting.samples_per_pixel=4",
        "relighting.samples_per_pixel=16",
    ]
    assert "Pareto front" in (out / "index.html").read_text()
    assert document["configurations"][0]["reported"]["mean"]["psnr_ldr"] > 5
    # Only what shows the field was computed again.
    outcomes = [json.loads(path.read_text()) for path in out.glob("runs/*/outcome.json")]
    again = [{s["name"] for s in o["stages"] if not s["reused"]} for o in outcomes]
    assert sorted(map(len, again))[:2] == [1, 1]
    assert reflfield("tradeoff", tiny_capture, "-o", out, *words).status == 0
    run = tmp_path / "run"
    chosen = ("--budget", "1h", "--tradeoff", out, "--until", "silhouettes", *HELD_OUT)
    assert reflfield("run", tiny_capture, "-o", run, *chosen).status == 0
