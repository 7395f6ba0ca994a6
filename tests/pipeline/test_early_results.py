"""What is finished is in the output folder before what comes after it can fail."""

import json
import re
import shutil

import pytest

from reflfield.errors import InputError
from reflfield.field.file import open_field

BARE = (
    "--set", "comparison.without_alignment=false",
    "--set", "comparison.rate_distortion=false",
)  # fmt: skip


@pytest.mark.parametrize(
    ("function", "failure", "left"),
    [
        (
            "reflfield.pipeline.comparison.compare_with_photographs",
            InputError("frame 'v005_l003': no"),
            {"field.rfld", "hull.ply", "atlas.glb", "normals.exr", "tangents.exr"},
        ),
        (
            "reflfield.pipeline.report.report_content",
            OSError(122, "Disk quota exceeded"),
            {"field.rfld", "hull.ply", "atlas.glb", "normals.exr", "tangents.exr",
             "metrics.json", "object.html"},
        ),
    ],
)  # fmt: skip
def test_the_field_is_there_whatever_fails_later(
    run_tiny, run_copy, monkeypatch, function, failure, left
):
    for path in run_copy.iterdir():
        if path.name != "stages":
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def fails(*_, **__):
        raise failure

    monkeypatch.setattr(function, fails)
    outcome = run_tiny(run_copy, *BARE, "--from", "comparison")
    assert outcome.status == 2
    (said,) = [s for s in outcome.err.splitlines() if not s.endswith(" left")]
    assert str(failure.args[-1]) in said
    assert said.endswith(f"; the field is finished: {run_copy / 'field.rfld'}")
    assert {p.name for p in run_copy.iterdir()} == left | {"stages"}
    assert open_field(run_copy / "field.rfld").n_texels > 500


def test_one_photograph_is_a_result(run_tiny, capture_copy, described, tmp_path):
    """Of all cameras' silhouettes and what that photograph shows."""
    only = [{"camera": "v005", "light": "l001", "file": "photographs/v005_l001.exr"}]
    described(capture_copy, lambda document: document.update(photographs=only))
    out = tmp_path / "out"
    outcome = run_tiny(out, *BARE, "--hold-out", "", capture=capture_copy)
    assert outcome.status == 0, outcome.err
    assert "9 cameras without a photograph" in outcome.out
    field = open_field(out / "field.rfld")
    assert field.metadata["lights"] == 1
    assert field.n_texels > 500
    assert (out / "report" / "index.html").is_file()


def test_a_camera_without_photographs_is_said_and_worked_around(
    run_tiny, capture_copy, described, tmp_path
):
    def without_v002(document):
        document["photographs"] = [
            {"camera": c["id"], "light": li["id"], "file": f"photographs/{name}.exr"}
            for c in document["cameras"]
            for li in document["lights"]
            if (name := f"{c['id']}_{li['id']}") and c["id"] != "v002" and li["id"] != "l004"
        ]

    described(capture_copy, without_v002)
    out = tmp_path / "out"
    outcome = run_tiny(out, *BARE, capture=capture_copy)
    assert outcome.status == 0, outcome.err
    assert "1 camera without a photograph, of which only the silhouette is used: 'v002'" in (
        outcome.out
    )
    assert "1 light without a photograph, left out: 'l004'" in outcome.out
    # Nine cameras and five lights have photographs; one of each is held out.
    assert (
        "held out: 1 photograph of 1 held-out view under 1 held-out light is compared; "
        "12 others of those are used for neither; 32 of 45 make the field"
    ) in outcome.out
    assert open_field(out / "field.rfld").metadata["views"] == 9
    assert len(json.loads((out / "metrics.json").read_text())["images"]) == 1
    page = (out / "report" / "index.html").read_text()
    assert "of which only the silhouette is used" in page
    # All nine cameras' silhouettes are set against the hull, the one without pictures too.
    assert len(re.findall(r"<span>v\d+ · IoU", page)) == 9
