"""Output folder: what stands there was made from each other; what does not is set apart."""

import dataclasses
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from reflfield.capture.readers import open_capture
from reflfield.errors import InputError
from reflfield.pipeline import stages
from reflfield.pipeline.cache import plain
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.publishing import RESULTS

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"
SELECTED = PipelineOptions(
    resampling=replace(PipelineOptions().resampling, visibility="kept"),
    compression=replace(PipelineOptions().compression, fit="samples"),
)
OTHER_ALIGNMENT = replace(SELECTED, alignment=replace(SELECTED.alignment, enabled=False))
OTHER_HULL = replace(SELECTED, hull=replace(SELECTED.hull, resolution=99))
FIELD = {"field.rfld", "hull.ply"}
LATER = {
    "object.html",
    "atlas.glb",
    "normals.exr",
    "tangents.exr",
    "metrics.json",
    "report/index.html",
}
RECORDS = {"timings.json", "options.toml"}


def small(stage):
    """Stage that writes, in no time, its options and the keys of those before it."""

    def compute(context, folder):
        records = [context.stages.record(earlier.name) for earlier in stage.after]
        before = {record.name: record.key for record in records if record is not None}
        text = json.dumps([stage.name, plain(stage.options(context.options)), before])
        for name in ("value", *RESULTS.get(stage.name, {})):
            (folder / name).write_text(text)
        return {}

    return dataclasses.replace(stage, compute=compute)


@pytest.fixture
def capture(tmp_path):
    return open_capture(shutil.copytree(FROZEN, tmp_path / "capture"))


@pytest.fixture
def run(monkeypatch, capture, tmp_path):
    """Function that runs the pipeline with small stages into a folder."""
    order = tuple(small(stage) for stage in stages.ORDER)
    monkeypatch.setattr(stages, "ORDER", order)

    def pipeline_run(options=SELECTED, **named):
        return stages.run(capture, tmp_path / "out", options, **named)

    return pipeline_run


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def results(out):
    """Files of the output folder, those that are set apart included."""
    skipped = ("stages", "candidates")
    return {
        path.relative_to(out).as_posix(): path.read_text()
        for path in out.rglob("*")
        if path.is_file() and path.relative_to(out).parts[0] not in skipped
    }


def test_a_whole_run_publishes_all_and_nothing_is_outdated(run, out):
    run()
    assert set(results(out)) == FIELD | LATER | RECORDS


def test_unchanged_results_are_left_alone(run, out):
    run()
    before = {name: (out / name).stat().st_mtime_ns for name in FIELD | LATER}
    context = run()
    assert all(record.reused for record in context.stages.records)
    assert {name: (out / name).stat().st_mtime_ns for name in FIELD | LATER} == before


@pytest.mark.parametrize(
    ("options", "until", "new", "outdated"),
    [
        (OTHER_ALIGNMENT, "compression", {"field.rfld"}, LATER),
        (OTHER_ALIGNMENT, "alignment", set(), LATER | {"field.rfld"}),
        (OTHER_HULL, "hull", {"hull.ply"}, LATER | {"field.rfld"}),
        (OTHER_HULL, "compression", FIELD, LATER),
        (SELECTED, "hull", set(), set()),
        (SELECTED, "compression", set(), set()),
        # Another option, but not of what was run: field and report are of each other.
        (OTHER_ALIGNMENT, "hull", set(), set()),
    ],
)
def test_what_does_not_follow_is_set_apart(run, out, caplog, options, until, new, outdated):
    run()
    before = results(out)
    run(options, until=until)
    after = results(out)
    assert set(after) == (FIELD | LATER | RECORDS) - outdated | {
        f"outdated/{name}" for name in outdated
    }
    for name in outdated:
        assert after[f"outdated/{name}"] == before[name]
    kept = (FIELD | LATER) - outdated
    assert {name for name in kept if after[name] != before[name]} == new
    assert ("outdated: made from other stages than now" in caplog.text) == bool(outdated)
    assert f"Of a run up to the stage '{until}'" in after["options.toml"]
    # A whole run leaves nothing outdated.
    caplog.clear()
    run(options)
    assert set(results(out)) == FIELD | LATER | RECORDS
    assert "outdated" not in caplog.text


def test_a_failure_after_the_field_leaves_no_earlier_report_beside_it(run, out, monkeypatch):
    run()
    before = results(out)

    def fails(context, folder):
        raise InputError("frames: damaged")

    order = tuple(
        replace(stage, compute=fails) if stage.name == "comparison" else stage
        for stage in stages.ORDER
    )
    monkeypatch.setattr(stages, "ORDER", order)
    with pytest.raises(InputError, match="frames: damaged"):
        run(OTHER_ALIGNMENT)
    after = results(out)
    assert after["field.rfld"] != before["field.rfld"]
    assert after["hull.ply"] == before["hull.ply"]
    assert not {"metrics.json", "report/index.html"} & set(after)
    assert after["outdated/metrics.json"] == before["metrics.json"]


def test_an_earlier_field_stays_until_there_is_another(run, out, monkeypatch):
    run()
    before = results(out)

    def fails(context, folder):
        raise InputError("memory: full")

    order = tuple(
        replace(stage, compute=fails) if stage.name == "compression" else stage
        for stage in stages.ORDER
    )
    monkeypatch.setattr(stages, "ORDER", order)
    with pytest.raises(InputError, match="memory: full"):
        run(OTHER_HULL)
    assert results(out) == before


@pytest.mark.parametrize("damage", ["one bit", "empty", "gone"])
@pytest.mark.parametrize("name", ["compression/field.rfld", "hull/hull.ply"])
def test_a_damaged_stage_file_never_replaces_the_result(run, out, caplog, name, damage):
    run()
    before = results(out)
    path = out / "stages" / name
    if damage == "gone":
        path.unlink()
    else:
        text = bytearray(path.read_bytes())
        text[len(text) // 2] ^= 16
        path.write_bytes(text if damage == "one bit" else b"")
    context = run()
    computed = [record.name for record in context.stages.records if not record.reused]
    assert computed == [name.split("/")[0]]
    assert f"{name}: damaged or gone; the stage" in caplog.text
    assert {n: t for n, t in results(out).items() if n not in RECORDS} == {
        n: t for n, t in before.items() if n not in RECORDS
    }


def test_damaged_after_it_was_verified_it_is_not_published(run, out, monkeypatch):
    run()
    (out / "field.rfld").unlink()
    copy = shutil.copyfile

    def damaging(source, target):
        copy(source, target)
        Path(target).write_bytes(b"\0" + Path(target).read_bytes()[1:])

    monkeypatch.setattr(shutil, "copyfile", damaging)
    with pytest.raises(InputError, match=r"field\.rfld: expected the file that the stage"):
        run()
    assert not (out / "field.rfld").exists()
    assert not list(out.glob(".*"))


def test_a_damaged_result_is_replaced_by_the_intact_one(run, out):
    run()
    before = results(out)
    (out / "field.rfld").write_text("damaged")
    run()
    assert results(out)["field.rfld"] == before["field.rfld"]
