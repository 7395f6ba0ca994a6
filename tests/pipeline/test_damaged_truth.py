"""A simulated capture whose truth is damaged is compared without what of it is."""

import json
import re
import shutil

import numpy as np
import pytest

BARE = (
    "--set", "comparison.without_alignment=false",
    "--set", "comparison.rate_distortion=false",
)  # fmt: skip


def cut_off(path):
    path.write_bytes(path.read_bytes()[:-300])


def not_json(path):
    path.write_text("{")


def of_other_lights(path):
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["samples"] = arrays["samples"][:, :, :-1]
    for name in ("lights", "light_visible"):
        arrays[name] = arrays[name][:, :-1]
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    "damaged",
    [
        {"truth.json": (not_json, "expected JSON")},
        {
            "heldout/h001.exr": (cut_off, "h001.exr"),
            "mesh.ply": (cut_off, "expected a mesh"),
            "views/v003.npz": (cut_off, "damaged, truncated"),
            "abrdf.npz": (of_other_lights, "10 views and 6 lights, received 10 and 5"),
        },
    ],
    ids=["description", "files"],
)
def test_it_is_named_and_the_run_goes_on(run_tiny, run_copy, tiny_capture, tmp_path, damaged):
    capture = shutil.copytree(tiny_capture, tmp_path / "capture")
    for name, (damage, _) in damaged.items():
        damage(capture / "truth" / name)
    before = json.loads((run_copy / "metrics.json").read_text())
    outcome = run_tiny(run_copy, *BARE, capture=capture)
    assert outcome.status == 0, outcome.err
    said = [s for s in outcome.out.splitlines() if s.startswith("truth: not compared: ")]
    assert len(said) == len(damaged)
    page = (run_copy / "report" / "index.html").read_text()
    for line, (name, (_, words)) in zip(said, damaged.items(), strict=True):
        assert f"{capture / 'truth' / name}" in line
        assert re.search(words, line)
        assert words in page
    # What is compared with photographs is as it was.
    assert json.loads((run_copy / "metrics.json").read_text()) == before
