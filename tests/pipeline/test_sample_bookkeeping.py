"""Every photograph, sample and texel of a run is accounted for, in equal counts."""

import json
import tomllib

import numpy as np
import pytest

from reflfield.capture.readers import open_capture
from reflfield.field.file import open_field
from reflfield.options import HoldOut, with_tables
from reflfield.pipeline import results
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.sample_bookkeeping import sample_counts
from reflfield.pipeline.stages import run


@pytest.fixture
def finished_context(run_copy, tiny_capture, tiny_options):
    """The finished run, opened again: nothing is computed."""
    options = with_tables(PipelineOptions(), tomllib.loads(tiny_options.read_text()))
    capture = open_capture(tiny_capture)
    context = run(capture, run_copy, options, hold_out=HoldOut(views=1, lights=1))
    assert all(record.reused for record in context.stages.records)
    return context


def test_all_counts_add_up(finished_context):
    counts = {(a.stage, a.things): a for a in sample_counts(finished_context)}
    assert [count.missing for count in counts.values()] == [0] * 7
    photographs = counts["observations", "photographs"]
    assert photographs.total == 60
    # One of ten views and one of six lights: 9 x 5 projected, the pair compared, 5 + 9 apart.
    assert list(photographs.parts.values()) == [45, 1, 14, 0]
    values = counts["observations", "values"]
    assert (
        values.total
        == values.parts["measured"]
        == 3 * 5 * results.view_visible(finished_context).sum()
    )
    samples = counts["compression", "samples"]
    assert samples.total == 45 * len(results.texels(finished_context))
    assert counts["comparison", "photographs"].total == 3


def test_samples_fitted_are_those_with_weight_in_the_fit(finished_context):
    field = open_field(finished_context.stages.root / "compression" / "field.rfld")
    reader = results.base_reader(finished_context).rotated(field.local_from_world)
    transformed = reader.transformed(results.measured_texels(finished_context))
    weights = (
        transformed.view_weights[:, :, None]
        * transformed.light_weights[:, None]
        * transformed.pairs
    )
    count = next(
        a
        for a in sample_counts(finished_context)
        if (a.stage, a.things) == ("compression", "samples")
    )
    # The file holds frames quantised to a degree: of the samples that near the horizon, one in
    # a hundred, some change sides; 14 of 6,710 when this was written.
    assert count.parts["fitted"] == pytest.approx(np.count_nonzero(weights), rel=5e-3)


@pytest.mark.parametrize(
    ("stage", "count"),
    [("observations", "photographs"), ("observations", "values measured"),
     ("completion", "texels completed"),
     ("alignment", "texels aligned"), ("compression", "texels fitted"),
     ("completion", "samples observed")],
)  # fmt: skip
def test_a_stage_that_loses_one_is_found_out(finished_context, stage, count):
    record = next(r for r in finished_context.stages.records if r.name == stage)
    record.counts[count] -= 1
    assert sum(one.missing for one in sample_counts(finished_context)) == 1


def test_a_frame_that_was_not_measured_is_found_out(finished_context):
    path = finished_context.stages.root / "comparison" / "field" / "truth.json"
    metrics = json.loads(path.read_text())
    metrics["images"].pop()
    path.write_text(json.dumps(metrics))
    assert sum(one.missing for one in sample_counts(finished_context)) == 1
