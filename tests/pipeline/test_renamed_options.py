"""Options that were renamed are accepted by their old names, with one line of warning."""

import logging

import pytest

from reflfield.options import RENAMED_OPTIONS, with_tables
from reflfield.pipeline.pipeline_options import PipelineOptions


def value_of(options, name):
    for part in name.split("."):
        options = getattr(options, part)
    return options


@pytest.mark.parametrize("old", RENAMED_OPTIONS)
def test_an_old_name_sets_the_new_option(old, caplog):
    new = RENAMED_OPTIONS[old]
    changed = 2 * value_of(PipelineOptions(), new)
    tables = changed
    for part in reversed(old.split(".")):
        tables = {part: tables}
    with caplog.at_level(logging.WARNING, logger="reflfield"):
        options = with_tables(PipelineOptions(), tables)
    assert value_of(options, new) == changed
    assert [record.getMessage().count(new) for record in caplog.records] == [1]
