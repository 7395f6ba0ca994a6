"""Every photograph, sample and texel of a run is accounted for, in equal counts."""

import json
import tomllib

import numpy as np
import pytest

from reflfield.capture.readers import open_capture
from reflfield.field.file import open_field
from reflfield.options import HoldOut, with_tables
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.sample_bookkeeping import accounts_of
from reflfield.pipeline.stages import run


@pytest.fixture
def finished_job(run_copy, tiny_capture, tiny_options):
    """The finished run, opened again: nothing is computed."""
    options = with_tables(PipelineOptions(), tomllib.loads(tiny_options.read_text()))
    capture = open_capture(tiny_capture)
    job = run(capture, run_copy, options, hold_out=HoldOut(views=1, lights=1))
    assert all(record.reused for record in job.stages.records)
    return job


def test_all_accounts_add_up(finished_job):
    accounts = {(a.stage, a.things): a for a in accounts_of(finished_job)}
    assert [account.missing for account in accounts.values()] == [0] * 7
    photographs = accounts["observations", "photographs"]
    assert photographs.total == 60
    # One of ten views and one of six lights: 9 x 5 projected, the pair compared, 5 + 9 apart.
    assert list(photographs.parts.values()) == [45, 1, 14]
    values = accounts["observations", "values"]
    assert values.total == values.parts["measured"] == 3 * 5 * finished_job.view_seen.sum()
    samples = accounts["compression", "samples"]
    assert samples.total == 45 * len(finished_job.texels)
    assert accounts["comparison", "photographs"].total == 3


def test_samples_fitted_are_those_with_weight_in_the_fit(finished_job):
    field = open_field(finished_job.stages.root / "compression" / "field.rfld")
    reader = finished_job.base_reader.rotated(field.local_from_world)
    transformed = reader.transformed(finished_job.seen_texels)
    weights = (
        transformed.view_weights[:, :, None]
        * transformed.light_weights[:, None]
        * transformed.pairs
    )
    account = next(
        a
        for a in accounts_of(finished_job)
        if (a.stage, a.things) == ("compression", "samples")
    )
    # The file holds quantised frames: a few samples at the horizon change sides.
    assert account.parts["fitted"] == pytest.approx(np.count_nonzero(weights), rel=1e-3)


@pytest.mark.parametrize(
    ("stage", "count"),
    [("observations", "photographs"), ("observations", "values measured"),
     ("completion", "texels completed"),
     ("alignment", "texels aligned"), ("compression", "texels fitted"),
     ("completion", "samples observed")],
)  # fmt: skip
def test_a_stage_that_loses_one_is_found_out(finished_job, stage, count):
    record = next(r for r in finished_job.stages.records if r.name == stage)
    record.counts[count] -= 1
    assert sum(account.missing for account in accounts_of(finished_job)) == 1


def test_a_frame_that_was_not_measured_is_found_out(finished_job):
    path = finished_job.stages.root / "comparison" / "field" / "truth.json"
    metrics = json.loads(path.read_text())
    metrics["frames"].pop()
    path.write_text(json.dumps(metrics))
    assert sum(account.missing for account in accounts_of(finished_job)) == 1
