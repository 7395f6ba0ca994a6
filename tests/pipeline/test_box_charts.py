"""An atlas that is not of the charts asked for is said on the way, in record and report."""

import json
import re


def test_box_charts_are_said_everywhere(run_copy, run_tiny, monkeypatch):
    monkeypatch.setattr("reflfield.geometry.uv_atlas.MOST_FACES", 100)
    quick = ("--set", "comparison.without_alignment=false",
             "--set", "comparison.rate_distortion=false")  # fmt: skip
    outcome = run_tiny(run_copy, "--from", "atlas", *quick)
    assert outcome.status == 0, outcome.err
    said = "the atlas is made of box charts"
    assert said in outcome.err
    assert "not asked to unwrap more than 100 triangles" in outcome.err
    page = (run_copy / "report" / "index.html").read_text()
    assert said in page[: page.index("<section")]
    assert re.search(r"charts made by.{0,40}boxes", page)
    counts = json.loads((run_copy / "stages" / "atlas" / "stage.json").read_text())["counts"]
    assert counts["charts made by"] == "boxes"
    # Nor is it forgotten where the stage is reused.
    assert said in run_tiny(run_copy, *quick).err
