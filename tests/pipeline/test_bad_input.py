"""Bad input ends with one message that says what is wrong, status 2, and nothing half-made."""

import errno
import io
import json
import os
import re
import shutil
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from reflfield.capture.image_files import read_image
from reflfield.capture.image_writing import write_exr
from reflfield.pipeline import observations


@pytest.fixture
def refused(tmp_path):
    """Function that demands one message with all words, status 2, and no unfinished file."""

    def check(outcome, *words, out=None):
        assert outcome.status == 2, outcome
        lines = [line for line in outcome.err.splitlines() if not line.endswith(" left")]
        assert len(lines) == 1, outcome.err
        assert lines[0].startswith("reflfield: error: ")
        for word in words:
            assert re.search(word, lines[0]), (word, lines[0])
        assert outcome.out == ""
        unfinished = [p for p in tmp_path.rglob("*") if "partial" in p.name or "tmp" in p.name]
        for path in unfinished:
            # Whole blocks of the stage may be kept for the next run, and nothing else.
            assert {entry.name for entry in path.iterdir()} <= {"key", "blocks", "samples"}
        if out is not None:
            assert not out.exists()

    return check


def edit_exr(path, change):
    image = read_image(path)
    change(image)
    write_exr(path, image)


class TestPhotographs:
    def test_missing(self, capture_copy, run_tiny, refused, tmp_path):
        (capture_copy / "photographs" / "v002_l002.exr").unlink()
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "v002_l002.exr", "missing", "1 of 60", "copy", out=tmp_path / "out")

    def test_truncated(self, capture_copy, run_tiny, refused, tmp_path):
        path = capture_copy / "photographs" / "v002_l002.exr"
        path.write_bytes(path.read_bytes()[:-500])
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "v002_l002.exr", "damaged|truncated|incomplete|cannot be read")

    def test_header_only(self, capture_copy, run_tiny, refused, tmp_path):
        path = capture_copy / "photographs" / "v002_l002.exr"
        path.write_bytes(path.read_bytes()[:20])
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "v002_l002.exr", out=tmp_path / "out")

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_not_finite(self, capture_copy, run_tiny, refused, tmp_path, value):
        def spoil(image):
            image[16, 15, 1] = value

        edit_exr(capture_copy / "photographs" / "v002_l002.exr", spoil)
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "v002_l002.exr", "finite|NaN")
        stages = tmp_path / "out" / "stages"
        assert not (stages / "observations").exists()
        assert not (tmp_path / "out" / "field.rfld").exists()

    def test_of_another_size(self, capture_copy, run_tiny, refused, tmp_path):
        write_exr(
            capture_copy / "photographs" / "v002_l002.exr", np.zeros((16, 32, 3), np.float16)
        )
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "v002_l002.exr", "32 x 32", "32 x 16", out=tmp_path / "out")

    def test_repeated_pair(self, capture_copy, described, run_tiny, refused, tmp_path):
        pair = {"camera": "v000", "light": "l000", "file": "photographs/v000_l000.exr"}
        described(capture_copy, lambda d: d.update(photographs=[pair, pair]))
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "duplicate", "v000", "l000", out=tmp_path / "out")


class TestDescription:
    def test_absent(self, run_tiny, refused, tmp_path):
        outcome = run_tiny(tmp_path / "out", capture=tmp_path / "nowhere")
        refused(outcome, "nowhere", "does not exist", out=tmp_path / "out")

    def test_empty_folder(self, run_tiny, refused, tmp_path):
        (tmp_path / "empty").mkdir()
        outcome = run_tiny(tmp_path / "out", capture=tmp_path / "empty")
        refused(outcome, "empty", "capture.json", out=tmp_path / "out")

    def test_zip(self, run_tiny, refused, tmp_path):
        with zipfile.ZipFile(tmp_path / "capture.zip", "w") as archive:
            archive.writestr("capture.json", "{}")
        outcome = run_tiny(tmp_path / "out", capture=tmp_path / "capture.zip")
        refused(outcome, "capture.zip", "zip|binary", "unpack", out=tmp_path / "out")

    def test_newer_version(self, capture_copy, described, run_tiny, refused, tmp_path):
        described(capture_copy, lambda d: d.update(version=2))
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "capture.json", "version 2", "update", out=tmp_path / "out")

    @pytest.mark.parametrize("scale", [0.0, 2.0], ids=["singular", "scaled"])
    def test_matrix_that_is_no_pose(
        self, capture_copy, described, run_tiny, refused, tmp_path, scale
    ):
        def spoil(document):
            pose = np.array(document["cameras"][1]["camera_from_world"])
            pose[:3, :3] *= scale
            document["cameras"][1]["camera_from_world"] = pose.tolist()

        described(capture_copy, spoil)
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "v001", "camera_from_world|rotation", out=tmp_path / "out")

    @pytest.mark.parametrize("what", ["cameras", "lights"])
    def test_duplicate_ids(self, capture_copy, described, run_tiny, refused, tmp_path, what):
        def spoil(document):
            document[what][1]["id"] = document[what][0]["id"]

        described(capture_copy, spoil)
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "capture.json", what, "twice", out=tmp_path / "out")

    @pytest.mark.parametrize("path", ["../outside.png", "/etc/hostname"])
    def test_path_that_leaves(self, capture_copy, described, run_tiny, refused, tmp_path, path):
        described(capture_copy, lambda d: d["cameras"][0].update(silhouette=path))
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, re.escape(path), "leaves the folder", out=tmp_path / "out")

    def test_light_inside_the_object(
        self, capture_copy, described, run_tiny, refused, tmp_path
    ):
        described(capture_copy, lambda d: d["lights"][1].update(position=[0.01, 0, 0]))
        outcome = run_tiny(tmp_path / "out", "--hold-out", "", capture=capture_copy)
        # What is cheap to check comes first, and finds that the light shows nothing.
        note, _, error = outcome.err.partition("\n")
        assert "note" in note
        assert "dead light l001" in note
        refused(replace(outcome, err=error), "l001", "inside")
        assert not (tmp_path / "out" / "stages" / "hull").exists()


class TestSilhouettes:
    def test_empty(self, capture_copy, run_tiny, refused, tmp_path):
        Image.new("L", (32, 32)).save(capture_copy / "silhouettes" / "v001.png")
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "v001.png", "empty")

    def test_all_inconsistent(self, capture_copy, run_tiny, refused, tmp_path):
        for i, path in enumerate(sorted((capture_copy / "silhouettes").iterdir())):
            coverage = np.zeros((32, 32), np.uint8)
            corner = 2 if i % 2 else 22
            coverage[corner : corner + 8, corner : corner + 8] = 255
            Image.fromarray(coverage).save(path)
        outcome = run_tiny(tmp_path / "out", capture=capture_copy)
        refused(outcome, "silhouettes", "contradict", "camera")


def text_field(folder, finished):
    path = folder / "notes.rfld"
    path.write_text("not a field")
    return path


def empty_zip(folder, finished):
    path = folder / "notes.rfld"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("notes.txt", "not a field")
    return path


def truncated_field(folder, finished):
    path = folder / "notes.rfld"
    path.write_bytes((finished.folder / "field.rfld").read_bytes()[:-2000])
    return path


def newer_field(folder, finished):
    """The field with the version in its header raised."""
    path = folder / "notes.rfld"
    with (
        zipfile.ZipFile(finished.folder / "field.rfld") as source,
        zipfile.ZipFile(path, "w") as target,
    ):
        for info in source.infolist():
            content = source.read(info)
            if info.filename.endswith(".json"):
                header = json.loads(content)
                header["version"] += 1
                content = json.dumps(header).encode()
            target.writestr(info, content)
    return path


def no_field(folder, finished):
    return folder / "notes.rfld"


class TestFields:
    @pytest.mark.parametrize(
        ("make", "word"),
        [
            (text_field, "field"),
            (empty_zip, "field"),
            (truncated_field, "damaged|truncated|field"),
            (newer_field, "newer|version"),
            (no_field, "no such file"),
        ],
    )
    @pytest.mark.parametrize("command", ["inspect", "relight", "compare"])
    def test_not_usable(
        self, reflfield, refused, tmp_path, finished, tiny_capture, make, word, command
    ):
        path, out = make(tmp_path, finished), tmp_path / "out"
        words = {
            "inspect": (),
            "relight": ("--orbit", "2", "--light", "1,0,1", "-o", out),
            "compare": (tiny_capture, "-o", out),
        }[command]
        refused(reflfield(command, path, *words), "notes.rfld", word, out=out)

    def test_a_folder(self, reflfield, refused, tmp_path):
        (tmp_path / "field.rfld").mkdir()
        refused(reflfield("inspect", tmp_path / "field.rfld"), "field.rfld")


class TestOptions:
    @pytest.mark.parametrize(
        ("setting", "words"),
        [
            ("hull.resolutoin=9", ("hull.resolutoin", "did you mean 'resolution'")),
            ("hul.resolution=9", ("'hul'", "did you mean 'hull'")),
            ("hull=9", ("'hull'", "a table", "9")),
            ("hull.resolution=fine", ("hull.resolution", "whole number", "'fine'")),
            ("hull.resolution=9.5", ("hull.resolution", "whole number", "9.5")),
            ("hull.resolution=true", ("hull.resolution", "whole number", "True")),
            ("hull.resolution=2", ("hull.resolution", "8 .. 512", "2")),
            ("hull.blur=nan", ("hull.blur", "finite", "nan")),
            ("hull.bounds=[1, 2]", ("hull.bounds", "list", r"\[1, 2\]")),
            ("alignment.enabled=1", ("alignment.enabled", "true or false", "1")),
            ("alignment.iterations=0", ("alignment.iterations", "1 to 1000", "0")),
            ("alignment.band_limit=0", ("alignment.band_limit", "1 to 64", "0")),
            ("completion.method=magic", ("completion.method", "'map' or 'brand'", "'magic'")),
            ("completion.rank=1000000000", ("completion.rank", "at most 1024")),
            ("compression.rank=1000000000", ("compression.rank", "at most 1024")),
            (
                "compression.samples.grid_refinement=1e300",
                ("grid_refinement", "at most 16", "1e"),
            ),
            ("compression.samples.rounds=0", ("compression.samples.rounds", "at least 1")),
            ("compression.training_texels=0", ("compression.training_texels", "at least 1")),
            ("texture.largest=0", ("texture.largest", "0")),
            ("resampling.view_side=-3", ("resampling.view_side", "-3")),
            ("seed=-1", ("seed", "-1")),
            ("seed", ("--set", "stage.option=value", "'seed'")),
            ("=3", ("--set", "stage.option=value")),
        ],
    )
    def test_set(self, run_tiny, refused, tmp_path, setting, words):
        outcome = run_tiny(tmp_path / "out", "--set", setting)
        refused(outcome, *words, out=tmp_path / "out")

    @pytest.mark.parametrize(
        ("text", "word"),
        [
            ("[hull\n", "TOML"),
            ("[hull]\nresolution = 'x'\n", "whole number"),
            ("\xff\xfe", "TOML"),
            ("[" * 5000, "TOML"),
        ],
    )
    def test_config(self, reflfield, refused, tmp_path, tiny_capture, text, word):
        path, out = tmp_path / "bad.toml", tmp_path / "out"
        path.write_bytes(text.encode("latin-1"))
        outcome = reflfield("run", tiny_capture, "-o", out, "--config", path)
        refused(outcome, word, out=out)

    def test_config_absent(self, reflfield, refused, tmp_path, tiny_capture):
        words = ("run", tiny_capture, "-o", tmp_path / "out", "--config", tmp_path / "no.toml")
        refused(reflfield(*words), "no.toml", "cannot be read", out=tmp_path / "out")

    @pytest.mark.parametrize(
        ("words", "expected"),
        [
            (("--hold-out", "views=10"), ("--hold-out", "fewer than the 10 views", "10")),
            (("--hold-out", "lights=6"), ("--hold-out", "fewer than the 6 lights", "6")),
            (("--hold-out", "views=all"), ("--hold-out", "views=K,lights=K", "views=all")),
            (("--hold-out", "views=1,views=2"), ("--hold-out", "views=K,lights=K")),
            (("--hold-out", "frames=1"), ("--hold-out", "frames=1")),
            (("--hold-out", "photographs=60"), ("fewer than the 60 photographs", "60")),
            (("--hold-out", "test"), ("--hold-out test", "test split", "photographs=K")),
            (("--psnr", "0"), ("--psnr", "above 0", "0")),
            (("--psnr", "-3"), ("--psnr", "above 0", "-3")),
            (("--psnr", "nan"), ("--psnr", "above 0", "nan")),
            (("--psnr", "inf"), ("--psnr", "above 0", "inf")),
            (("--size", "0"), ("--size", "more than no bytes", "'0'")),
            (("--size", "-2MB"), ("--size", "more than no bytes", "'-2MB'")),
            (("--size", "nan"), ("--size", "'nan'")),
            (("--max-memory", "lots"), ("--max-memory", "4GB", "'lots'")),
            (("--max-memory", "-4GB"), ("--max-memory", "at least")),
            (("--max-memory", "100MB"), ("--max-memory", "at least", "0.1 GB")),
            (("--workers", "-1"), ("--workers", "1 to 1024, or 0", "-1")),
            (("--workers", "100000"), ("--workers", "1 to 1024, or 0", "100000")),
            (("--from", "hulls"), ("--from", "silhouettes, hull", "'hulls'")),
            (("--until", "hulls"), ("--until", "silhouettes, hull", "'hulls'")),
            (("--from", "report", "--until", "hull"), ("--from", "--until", "report", "hull")),
            (("--format", "metashapes"), ("format", "native", "'metashapes'")),
        ],
    )
    def test_arguments(self, run_tiny, refused, tmp_path, words, expected):
        out = tmp_path / "out"
        refused(run_tiny(out, *words), *expected, out=out)

    def test_folder_that_cannot_be_made(self, run_tiny, refused, tmp_path):
        (tmp_path / "file").write_text("in the way")
        refused(run_tiny(tmp_path / "file" / "out"), "file", "[Nn]ot a directory")


class TestRelightArguments:
    @pytest.mark.parametrize(
        ("words", "expected"),
        [
            ((), ("--capture", "--orbit")),
            (("--orbit", "3"), ("--environment", "--light")),
            (("--orbit", "3", "--light", "up"), ("--light", "X,Y,Z", "'up'")),
            (("--orbit", "3", "--light", "0,0,0"), ("--light", "zero")),
            (("--orbit", "3", "--light", "nan,0,1"), ("--light", "finite")),
            (("--orbit", "0", "--light", "1,0,1"), ("--orbit", "1 to 3600", "0")),
            (("--orbit", "3", "--light", "1,0,1", "--size", "0"), ("size", "1 to 16383", "0")),
            (
                ("--orbit", "3", "--light", "1,0,1", "--rays-per-pixel", "3"),
                ("--rays-per-pixel", "square", "3"),
            ),
            (("--orbit", "3", "--environment", "no.exr"), ("no.exr",)),
            (("--capture", "nowhere"), ("nowhere", "does not exist")),
            (("--capture", "nowhere", "--light", "1,0,1"), ("--light", "--orbit")),
        ],
    )
    def test_refused(self, reflfield, refused, finished, tmp_path, words, expected):
        out = tmp_path / "out"
        field = finished.folder / "field.rfld"
        refused(reflfield("relight", field, "-o", out, *words), *expected, out=out)

    def test_convention(self, reflfield, refused, finished, tmp_path):
        write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3), np.float32))
        words = ("--orbit", "2", "--environment", tmp_path / "sky.exr", "--convention", "z-up")
        field, out = finished.folder / "field.rfld", tmp_path / "out"
        outcome = reflfield("relight", field, "-o", out, *words)
        refused(outcome, "openexr", "z-up", out=out)


def test_compare_refuses_frames_without_photographs(
    reflfield, refused, finished, tiny_capture, tmp_path
):
    empty = shutil.copytree(tiny_capture, tmp_path / "empty")
    shutil.rmtree(empty / "photographs")
    out = tmp_path / "out"
    outcome = reflfield("compare", finished.folder / "field.rfld", empty, "-o", out)
    refused(outcome, "missing", out=out)


def test_numbers_beyond_double_are_refused(capture_copy, run_tiny, refused, tmp_path):
    path = capture_copy / "capture.json"
    text = io.StringIO(path.read_text()).read().replace('"cx": 16.0', '"cx": 1e999', 1)
    path.write_text(text)
    outcome = run_tiny(tmp_path / "out", capture=capture_copy)
    refused(outcome, "capture.json", "1e999", "finite", out=tmp_path / "out")


def test_a_full_disk_of_a_store_is_not_taken_for_that_of_the_results(
    run_tiny, tmp_path, monkeypatch
):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(observations, "project_photographs", full)
    words = ("--store", tmp_path / "store", "--until", "observations")
    outcome = run_tiny(tmp_path / "out", *words)
    assert outcome.status == 2
    assert re.search(r"error: .*/store/.*: No space left on device", outcome.err)
