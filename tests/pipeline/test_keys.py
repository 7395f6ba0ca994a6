"""What each stage depends on: every input and every option, and no resource."""

import json
import os
import shutil
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from reflfield.capture.readers import open_capture
from reflfield.options import HoldOut, Resources, with_tables
from reflfield.pipeline import stage, stages
from reflfield.pipeline.cache import StageFolder, StageRecord, stage_key
from reflfield.pipeline.context import Context
from reflfield.pipeline.hold_out import split_of
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.render.renderer import RenderOptions
from reflfield.util.file_digests import FileDigests

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"
# All stages but the model selection: no option is "auto" here.
OPTIONS = with_tables(
    PipelineOptions(),
    {
        "resampling": {"visibility": "factored"},
        "compression": {
            "fit": "samples",
            "n_clusters": 8,
            "n_components": 6,
            "relative_step": 0.5,
        },
        "comparison": {"without_alignment": True, "rate_distortion": True},
    },
)
FIELD = ("indirect", "completion", "alignment", "resampling", "compression")
# What depends on the images of the fields.
IMAGES = ("comparison", "error_analysis", "rate_distortion", "web_page", "report")
LATER = ("maps", "without_alignment", *IMAGES)
REFLECTANCE = ("observations", *FIELD, *LATER)
AFTER_HULL = ("atlas", "visibility", "held_out_silhouettes", *REFLECTANCE)


class Keys(StageFolder):
    """Folder in which nothing is computed; stages have keys all the same."""

    def run(self, name, compute, *, options=None, inputs=None, after=None, code="", **_):
        key = stage_key(name, options, {**(inputs or {}), **(after or {})}, code)
        self.records.append(StageRecord(name, key, 0.0, 0, 0))


@pytest.fixture(scope="module")
def capture_folder(tmp_path_factory):
    """A small capture with a truth. Read only."""
    folder = tmp_path_factory.mktemp("keys") / "capture"
    shutil.copytree(FROZEN, folder)
    (folder / "truth").mkdir()
    (folder / "truth" / "truth.json").write_text('{"version": 1}')
    (folder / "truth" / "mesh.ply").write_bytes(b"ply")
    return folder


def keys(folder, options=OPTIONS, hold_out=None, **resources):
    """Key of every stage that would run."""
    out = folder.parent / "out"
    context = Context(
        open_capture(folder),
        out,
        options,
        hold_out or HoldOut(views=1, lights=1),
        Resources(**resources),
        Keys(out / "stages"),
    )
    for each in stages.ORDER:
        if each.wanted(context):
            each.run(context)
    return {record.name: record.key for record in context.stages.records}


@pytest.fixture(scope="module")
def usual(capture_folder):
    usual_keys = keys(capture_folder)
    assert set(usual_keys) == {"silhouettes", "hull", *AFTER_HULL}
    return usual_keys


def changed(usual, others):
    return {name for name in usual if usual[name] != others.get(name)}


# --- inputs -------------------------------------------------------------------------------


def described(edit):
    """Change of the description."""

    def change(folder):
        path = folder / "capture.json"
        document = json.loads(path.read_text())
        edit(document)
        path.write_text(json.dumps(document))

    return change


def bits(name):
    """Change of the last bytes of a file, whose length stays."""

    def change(folder):
        path = folder / name
        path.write_bytes(path.read_bytes()[:-4] + b"last")

    return change


def another_silhouette(folder):
    path = folder / "silhouettes" / "v000.png"
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), np.roll(image, 1, axis=0))


def same_but_newer(folder):
    for path in folder.rglob("*"):
        if path.is_file():
            os.utime(path, ns=(10**18, 10**18))


def photograph(part):
    """File of a photograph that makes the field, or that it is compared with."""
    split = split_of(capture := open_capture(FROZEN), HoldOut(views=1, lights=1))
    return Path("photographs") / getattr(split, part)(capture).photographs[0].path.name


INPUTS = {
    "a camera's focal length": (
        described(lambda d: d["cameras"][0].update(fl_x=d["cameras"][0]["fl_x"] * 1.01)),
        {"silhouettes", "hull", *AFTER_HULL},
    ),
    "a light's position": (
        described(lambda d: d["lights"][0].update(position=[1, 2, 3])),
        {"hull", *AFTER_HULL},
    ),
    "a light's intensity": (
        described(lambda d: d["lights"][0].update(intensity=[3, 2, 1])),
        {"hull", *AFTER_HULL},
    ),
    "a silhouette": (another_silhouette, {"silhouettes", "hull", *AFTER_HULL}),
    "a photograph": (bits(photograph("training")), {*REFLECTANCE}),
    "a held-out photograph": (
        bits(photograph("compared_capture")),
        {*IMAGES},
    ),
    "the capture's name": (
        described(lambda d: d.update(name="another")),
        {"compression", *LATER},
    ),
    "the true surface": (bits("truth/mesh.ply"), {"report"}),
    "times of files alone": (same_but_newer, set()),
}


@pytest.mark.parametrize(("change", "expected"), INPUTS.values(), ids=INPUTS)
def test_inputs(capture_folder, usual, tmp_path, change, expected):
    folder = shutil.copytree(capture_folder, tmp_path / "capture")
    assert changed(usual, keys(folder)) == set()  # another place is no change
    change(folder)
    assert changed(usual, keys(folder)) == expected


def test_what_is_held_out(capture_folder, usual):
    without = keys(capture_folder, hold_out=HoldOut(lights=1))
    assert {"observations", *FIELD, *LATER} <= changed(usual, without)


# --- options ------------------------------------------------------------------------------

# What is computed again with an option of a table, or with one of them.
AFTER_COMPRESSION = {"compression", *LATER}
TABLES = {
    "hull": {"hull", *AFTER_HULL},
    "texture": {"atlas", "visibility", *REFLECTANCE},
    "atlas": {"atlas", "visibility", *REFLECTANCE},
    "visibility": {"visibility", *REFLECTANCE},
    "resampling": {*FIELD, *LATER},
    "indirect": {"indirect", *AFTER_COMPRESSION},
    "completion": {*FIELD, *LATER} - {"indirect"},
    "alignment": {"alignment", "resampling", *AFTER_COMPRESSION},
    "compression": AFTER_COMPRESSION,
    "compression.rank": {"resampling", *AFTER_COMPRESSION},
    "compression.training_texels": {"resampling", *AFTER_COMPRESSION},
    "relighting": {*IMAGES},
    "relighting.workers": set(),
    "relighting.block_pixels": set(),
    # A field to compare with more or less; the report lists what was asked for.
    "comparison.without_alignment": {
        *("without_alignment", *IMAGES),
    },
    "comparison.rate_distortion": {"rate_distortion", "report"},
    "seed": {*FIELD, *LATER},
}


def options_of(options, prefix=""):
    """Dotted names of all options."""
    for entry in fields(options):
        value = getattr(options, entry.name)
        if is_dataclass(value):
            yield from options_of(value, f"{prefix}{entry.name}.")
        else:
            yield f"{prefix}{entry.name}"


def altered(options, name):
    """Options of which one is another, whatever it is: no range is checked."""
    first, _, rest = name.partition(".")
    copy = replace(options)
    value = getattr(options, first)
    if rest:
        new = altered(value, rest)
    elif isinstance(value, bool):
        new = not value
    elif isinstance(value, (int, float)):
        new = value + 1
    else:
        new = f"{value} altered"
    object.__setattr__(copy, first, new)
    return copy


@pytest.mark.parametrize("name", list(options_of(PipelineOptions())))
def test_options(capture_folder, usual, name):
    # What shadows are kept for is tested with the model selection.
    if name in ("resampling.visibility", "indirect.enabled", "alignment.enabled"):
        return
    expected = TABLES.get(name, TABLES.get(name.partition(".")[0]))
    assert changed(usual, keys(capture_folder, altered(OPTIONS, name))) == expected


def test_resources(capture_folder, usual, tmp_path):
    few = keys(
        capture_folder,
        workers=1,
        max_memory=1 << 31,
        scheduler="tcp://nowhere:1",
        store=str(tmp_path / "store"),
    )
    assert few == usual


def test_candidate_runs_depend_on_no_resource():
    selection = stages.MODEL_SELECTION
    resources = RenderOptions(workers=3, block_pixels=64)
    assert selection.options(replace(OPTIONS, relighting=resources)) == selection.options(
        OPTIONS
    )
    finer = RenderOptions(samples_per_pixel=64)
    assert selection.options(replace(OPTIONS, relighting=finer)) != selection.options(OPTIONS)


def test_code(capture_folder, usual, monkeypatch):
    """A stage of code that changed, and those after it, are computed again."""
    digests = stage.code_digest
    monkeypatch.setattr(
        stage,
        "code_digest",
        lambda module: digests(module) + "changed" * (module == "reflfield.pipeline.report"),
    )
    assert changed(usual, keys(capture_folder)) == {"report"}


# --- files --------------------------------------------------------------------------------


def test_photographs_are_hashed_once_and_not_again_by_the_next_run(
    capture_folder, tmp_path, context_of
):
    folder = shutil.copytree(capture_folder, tmp_path / "capture")
    same_but_newer(folder)
    index = tmp_path / "files.json"
    before = FileDigests(index)
    context = replace(context_of(open_capture(folder), tmp_path, OPTIONS), digests=before)
    photographs = sorted((folder / "photographs").iterdir())
    for _ in range(2):
        first = context.digest_of(context.capture, "photographs", "lights")
    assert sorted(before.hashed) == photographs
    # Their inodes are as new as this test: the index leaves out what may change unseen.
    assert not json.loads(index.read_text())["files"]
    settle(before)
    after = FileDigests(index)
    assert (
        replace(context, digests=after).digest_of(context.capture, "photographs", "lights")
        == first
    )
    assert after.hashed == []
    # One that has changed is hashed, and no other.
    bits(f"photographs/{photographs[2].name}")(folder)
    again = FileDigests(index)
    assert replace(context, digests=again).digest_of(context.capture, "photographs") != first
    assert again.hashed == [photographs[2]]


def settle(digests):
    """Make an index as if its files had been hashed long after they were written."""
    for entry in digests._known.values():
        entry["at"] += 10**10
    digests._new = True
    digests.save()


def test_a_damaged_index_counts_as_none(capture_folder, tmp_path):
    index, photographs = tmp_path / "files.json", capture_folder / "photographs"
    path = sorted(photographs.iterdir())[0]
    digests = FileDigests(index)
    expected = digests.digest(path)
    settle(digests)
    text = index.read_text()
    wrong = text.replace(expected.hex()[:8], "00000000")
    for damaged in ("", "{", "[1]", text[:-9], wrong):
        index.write_text(damaged)
        again = FileDigests(index)
        assert again.digest(path) == expected
        assert again.hashed == [path]
