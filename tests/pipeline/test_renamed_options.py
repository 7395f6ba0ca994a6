"""Options and stages of earlier versions are accepted, with one line."""

import logging
from dataclasses import replace

import pytest

from reflfield.options import REMOVED_OPTIONS, RENAMED_OPTIONS, with_tables
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.stages import RENAMED, STAGES


def value_of(options, name):
    for part in name.split("."):
        options = getattr(options, part)
    return options


@pytest.mark.parametrize("old", RENAMED_OPTIONS)
def test_an_old_name_sets_the_new_option(old, caplog):
    new = RENAMED_OPTIONS[old]
    usual = value_of(PipelineOptions(), new)
    changed = 0.75 if usual == "auto" else 2 * usual
    tables = changed
    for part in reversed(old.split(".")):
        tables = {part: tables}
    with caplog.at_level(logging.WARNING, logger="reflfield"):
        options = with_tables(PipelineOptions(), tables)
    assert value_of(options, new) == changed
    assert [record.getMessage().count(new) for record in caplog.records] == [1]


@pytest.mark.parametrize("gone", REMOVED_OPTIONS)
def test_an_option_that_is_gone_is_ignored_with_one_line(gone, caplog):
    """As the options that a run of an earlier version has written down list it."""
    stage, name = gone.split(".")
    with caplog.at_level(logging.WARNING, logger="reflfield"):
        options = with_tables(PipelineOptions(), {stage: {name: 1.0}, "seed": 3})
    assert options == replace(PipelineOptions(), seed=3)
    (record,) = caplog.records
    assert f"{gone!r} is gone: {REMOVED_OPTIONS[gone]}" in record.getMessage()


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_name_of_a_stage_stops_there(old, run_copy, run_tiny):
    outcome = run_tiny(run_copy, "--until", old)
    assert outcome.status == 0, outcome.err
    assert f"stage '{old}' is deprecated, use '{RENAMED[old]}'" in outcome.err
    assert RENAMED[old] in STAGES


def test_an_unknown_stage_is_refused_with_those_there_are(run_copy, run_tiny):
    outcome = run_tiny(run_copy, "--until", "choises")
    assert outcome.status == 2
    assert "--until" in outcome.err
    assert "model_selection" in outcome.err


def test_folders_of_an_older_version_are_left_alone(run_copy, run_tiny):
    """A run into them computes what it needs and takes nothing from names it does not know."""
    stages = run_copy / "stages"
    (stages / "held_out_silhouettes").rename(stages / "frame_silhouettes")
    kept = sorted(p.name for p in (stages / "frame_silhouettes").iterdir())
    outcome = run_tiny(run_copy)
    assert outcome.status == 0, outcome.err
    assert (stages / "held_out_silhouettes" / "stage.json").is_file()
    assert sorted(p.name for p in (stages / "frame_silhouettes").iterdir()) == kept
