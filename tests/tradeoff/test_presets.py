"""Presets, and the best of them within a time."""

from dataclasses import replace

import pytest

from reflfield.api.reconstruction import read_options
from reflfield.errors import InputError
from reflfield.options import HoldOut, Resources, parse_seconds, with_tables
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.tradeoff import presets
from reflfield.tradeoff.presets import (
    LADDER,
    ONE_VIEW_BEST,
    PRESETS,
    choose_within,
    preset_settings,
)
from reflfield.tradeoff.swept_options import OF_SEARCHED_FRAMES, SWEPT
from reflfield.tradeoff.work_counts import counts_of, planned_context

HELD_OUT = HoldOut(views=1, lights=1)


@pytest.fixture
def choose(product, monkeypatch):
    """Function that chooses for the tiny capture, on a machine like the reference."""
    monkeypatch.setattr(presets, "machine_seconds", dict)

    def chosen(budget, ladder=LADDER):
        return choose_within(
            *(budget, product, PipelineOptions(), ladder),
            hold_out=HELD_OUT,
            resources=Resources(workers=1),
        )

    return chosen


def test_presets_are_of_options_that_are_swept():
    swept = {option.name for option in SWEPT}
    assert set(PRESETS) <= set(LADDER)
    assert all(set(settings) <= swept for settings in LADDER.values())
    assert read_options(preset="standard") == PipelineOptions()


def test_settings_override_a_preset():
    assert read_options(preset="preview").hull.resolution != 192
    options = read_options(settings=["hull.resolution=100"], preset="preview")
    assert options.hull.resolution == 100
    assert options.texture == read_options(preset="preview").texture


def test_an_unknown_preset_is_refused():
    with pytest.raises(InputError, match="preset: expected one of preview, standard, best"):
        preset_settings("fast")


def test_the_best_that_ends_in_time_is_chosen(choose):
    ladder = list(LADDER)
    times = {name: choose(1e9, {name: LADDER[name]}).plan.seconds for name in ladder}
    assert list(times.values()) == sorted(times.values())
    assert choose(1e9).name == ladder[-1]
    for slower, faster in zip(ladder[1:], ladder, strict=False):
        assert choose(0.5 * (times[slower] + times[faster])).name == faster


def test_a_time_that_suffices_for_nothing_is_refused(choose):
    with pytest.raises(InputError, match="budget: expected at least"):
        choose(1e-3)


@pytest.mark.parametrize("text", ["", "5 minutes", "-3s", "0s", "nan", "1e3s"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(InputError, match="budget: expected a time above 0"):
        parse_seconds(text)


def test_a_preview_by_clusters_is_fitted_once(product):
    """Ten views under one light tell too little for the half-vector model."""
    one_light = replace(
        product, photographs=tuple(p for p in product.photographs if not p.light)
    )
    assert preset_settings("preview", one_light)["compression.fit"] == "grid"
    assert preset_settings("best", one_light) == preset_settings("best")


def test_a_preview_of_one_view_has_few_nodes(product):
    of_first = tuple(p for p in product.photographs if p.camera == 0)
    one_view = replace(product, photographs=of_first, base_geometry="plane").subset([0])
    settings = preset_settings("preview", one_view)
    assert settings["compression.fit"] == "grid"
    # Ten lights have a grid of five nodes along a side, of which none is taken away.
    assert "resampling.light_side" not in settings
    best = preset_settings("best", one_view)
    assert best == {**preset_settings("best"), **ONE_VIEW_BEST}
    context = planned_context(one_view, PipelineOptions())
    assert context.options.compression.step == 0.25
    assert planned_context(product, PipelineOptions()).options.compression.step == 0.5


def test_searches_for_frames_are_swept_where_frames_are_searched_for(product):
    of_first = tuple(p for p in product.photographs if p.camera == 0)
    one_view = replace(product, photographs=of_first, base_geometry="plane").subset([0])
    clusters = with_tables(PipelineOptions(), {"compression": {"model": "clustered"}})
    swept = {}
    for name, capture in (("one view", one_view), ("dome", product)):
        counts = counts_of(planned_context(capture, clusters), 0.5)
        swept[name] = {option.name for option in SWEPT if option.matters(counts)}
    searches = {name for name in swept["dome"] if name.startswith(("completion", "alignment"))}
    assert searches == {*OF_SEARCHED_FRAMES, "alignment.enabled"}
    assert searches & swept["one view"] == {"alignment.enabled"}


def test_a_preview_of_a_dome_asks_for_no_clusters(product):
    settings = preset_settings("preview", product)
    assert "compression.fit" not in settings
    assert settings == preset_settings("preview")
