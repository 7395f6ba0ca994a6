"""The command line's part in reading captures: links, notes, and what cannot be printed."""

import json
import shutil
from pathlib import Path

import pytest

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"


@pytest.fixture
def linked(tmp_path):
    """A capture one of whose photographs is a link out of its folder."""
    folder = tmp_path / "linked"
    shutil.copytree(FROZEN, folder)
    photograph = folder / "photographs" / "v000_l001.exr"
    photograph.rename(tmp_path / "blob")
    photograph.symlink_to(tmp_path / "blob")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ("inspect", "CAPTURE"),
        ("run", "CAPTURE", "-o", "OUT"),
    ],
)
def test_links_out_of_the_folder_need_leave(reflfield, linked, tmp_path, words):
    words = [{"CAPTURE": linked, "OUT": tmp_path / "out"}.get(word, word) for word in words]
    outcome = reflfield(*words)
    assert outcome.status == 2
    assert "v000_l001.exr' is reached through a symbolic link" in outcome.err
    assert "--follow-links" in outcome.err
    assert len(outcome.err.splitlines()) == 1


def test_followed_links(reflfield, linked):
    outcome = reflfield("inspect", linked, "--follow-links")
    assert outcome.status == 0
    assert "photographs   6, 0 pairs missing" in outcome.out


@pytest.mark.parametrize(
    "command",
    ["run", "plan", "tradeoff", "inspect", "compare", "relight", "convert", "check", "masks",
     "calibrate"],
)  # fmt: skip
def test_every_command_that_opens_captures_follows_links(reflfield, command):
    assert "--follow-links" in reflfield(command, "--help").out


def test_notes_and_names_are_one_printable_line_each(reflfield, tmp_path):
    folder = tmp_path / "a\nb\x1b[2J"
    shutil.copytree(FROZEN, folder)
    document = json.loads((folder / "capture.json").read_text())
    del document["name"]
    (folder / "capture.json").write_text(json.dumps(document | {"mood": "bad"}))
    outcome = reflfield("inspect", folder)
    assert outcome.status == 0
    [note] = outcome.err.splitlines()
    assert note.startswith("reflfield: note: ")
    assert note.endswith(r"a\nb\x1b[2J/capture.json: not used: 'mood'")
    assert outcome.out.splitlines()[0].startswith(r"capture       a\nb\x1b[2J (native")
    assert all(line.isprintable() for line in outcome.out.splitlines())


def test_convert(reflfield, tmp_path):
    outcome = reflfield("convert", FROZEN, "-o", tmp_path / "out")
    assert outcome.status == 0
    assert outcome.out.startswith("6 photographs, 9 files in ")
    assert reflfield("inspect", tmp_path / "out").status == 0
    outcome = reflfield("convert", FROZEN, "-o", tmp_path / "other", "--to", "transforms")
    assert outcome.status == 2
    assert "received one of kind 'directional'; write it with --to native" in outcome.err
    assert not (tmp_path / "other").exists()
    outcome = reflfield("convert", FROZEN, "-o", tmp_path / "out")
    assert outcome.err.startswith("reflfield: error: --out: expected a new or empty folder")
