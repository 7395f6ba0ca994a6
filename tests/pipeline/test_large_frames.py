"""A whole run of large photographs keeps below the ceiling that it says would suffice."""

import json
import re
import shutil

import pytest

from tests.large_captures import enlarged_capture

SIDE = 1400


@pytest.fixture(scope="module")
def large_capture(tiny_capture, tmp_path_factory):
    """Four views and two lights of the tiny capture, every pixel many times as large."""
    folder = tmp_path_factory.mktemp("large") / "capture"
    enlarged_capture(tiny_capture, folder, SIDE)
    yield folder
    shutil.rmtree(folder)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["clustered", "half_vector"])
def test_large_frames_keep_below_the_ceiling_that_is_asked_for(
    large_capture, tiny_options, subprocess_run, tmp_path, model
):
    def run(ceiling):
        return subprocess_run(
            *("-m", "reflfield", "run", large_capture, "-o", tmp_path / "out"),
            *("--config", tiny_options, "--hold-out", "photographs=1"),
            *("--max-memory", ceiling, "--set", "comparison.without_alignment=false"),
            *("--set", f"compression.model={model}"),
            *("--set", "comparison.rate_distortion=false"),
        )

    refused = run("1GB")
    assert refused.status == 2
    asked = re.search(r"--max-memory: expected at least (\d+\.\d) GB", refused.err)
    assert asked, refused.err
    assert run(f"{asked[1]}GB").status == 0
    timings = json.loads((tmp_path / "out" / "timings.json").read_text())
    ceiling = float(asked[1]) * 2**30
    assert timings["max_memory"] == pytest.approx(ceiling, abs=1)  # whole bytes
    # The libraries alone take 400 MB, so that the watch has seen something.
    assert 400e6 < timings["peak_bytes"] <= ceiling
