"""Where captures go: one process at a time, nobody else's files, resumed rightly."""

import errno
import filecmp
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import capture_sim.destination
from capture_sim import cli, files
from capture_sim.errors import SceneError
from capture_sim.scene import parse_scene
from capture_sim.write import write_capture

SCENE = """
[object]
preset = "sphere"
around = 16
[material]
preset = "grey_card"
[cameras]
preset = "fibonacci"
n = 3
width = 16
height = 16
[lights]
preset = "fibonacci"
n = 3
[truth]
points = 0
"""


def scene(**changed):
    return parse_scene(
        {
            "object": {"preset": "sphere", "around": 16},
            "material": {"preset": "grey_card"},
            "cameras": {"preset": "fibonacci", "n": 2, "width": 8, "height": 8},
            "lights": {"preset": "fibonacci", "n": 2},
            "truth": {"points": 0},
            **changed,
        }
    )


def tree(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if not p.is_dir())


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_capture(scene(), tmp_path_factory.mktemp("captures") / "whole")


def assert_same(one, other):
    names = [name for name in tree(one) if name != "truth/effects.json"]
    assert tree(other) == tree(one)
    assert filecmp.cmpfiles(one, other, names, shallow=False)[1:] == ([], [])


def test_two_at_a_time_do_not_mix(tmp_path, monkeypatch):
    """The second is refused at once, the first goes on undisturbed."""
    second = []

    def during(*arguments):
        if not second:
            with pytest.raises(SceneError, match=r"out: expected a folder for this command"):
                write_capture(scene(material={"preset": "gold"}), tmp_path / "out")
            second.append(tree(tmp_path))
        return whole(*arguments)

    whole = capture_sim.write.write_exr
    monkeypatch.setattr(capture_sim.write, "write_exr", during)
    write_capture(scene(), tmp_path / "out")
    assert second
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert_same(write_capture(scene(), tmp_path / "alone"), tmp_path / "out")


@pytest.fixture
def started():
    """Function that starts the command in a process of its own."""
    running = []

    def start(*words, **more):
        command = [sys.executable, "-m", "capture_sim", *map(str, words)]
        running.append(subprocess.Popen(command, text=True, **more))
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.communicate()


def test_two_processes_do_not_mix(tmp_path, started):
    (tmp_path / "a.toml").write_text(SCENE.replace("n = 3", "n = 8"))
    (tmp_path / "b.toml").write_text(SCENE)
    out = tmp_path / "out"
    first = started("render", tmp_path / "a.toml", "-o", out, stdout=subprocess.DEVNULL)
    hidden = capture_sim.destination.work_folder(out)
    end = time.monotonic() + 60
    while not (hidden / "scene.sha256").exists():
        assert time.monotonic() < end
        assert first.poll() is None
        time.sleep(0.01)
    first.send_signal(signal.SIGSTOP)
    second = started("render", tmp_path / "b.toml", "-o", out, stderr=subprocess.PIPE)
    _, error = second.communicate(timeout=60)
    assert second.returncode == 2
    assert error.count("\n") == 1
    assert "another capture-sim working on it" in error
    first.send_signal(signal.SIGCONT)
    first.wait(timeout=100)
    assert first.returncode == 0
    assert len(list((out / "photographs").iterdir())) == 64


@pytest.mark.parametrize("there", [True, False])
def test_files_are_on_the_disk_before_they_have_their_names(tmp_path, order_of_writes, there):
    """In an empty folder each is renamed, a new folder with all."""
    out = tmp_path / "out"
    if there:
        out.mkdir()
    write_capture(scene(), out)
    for name in tree(out):
        done = order_of_writes(out / name, named=None if there else out)
        assert done == (["flushed", "named", "named"] if there else ["flushed", "named"]), name


def test_an_empty_folder_keeps_its_identity(tmp_path, capture):
    """It may be where the user stands, or a file system of its own."""
    (tmp_path / "out").mkdir()
    before = (tmp_path / "out").stat().st_ino
    write_capture(scene(), tmp_path / "out")
    assert (tmp_path / "out").stat().st_ino == before
    assert_same(capture, tmp_path / "out")


def test_the_current_folder_may_be_the_target(tmp_path, capture, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    write_capture(scene(), Path())
    assert_same(capture, tmp_path / "here")
    with pytest.raises(SceneError, match="pass --overwrite"):
        write_capture(scene(), Path())
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


FOREIGN = {
    "no capture of ours": {"capture.json": "x", "mine.txt": "precious"},
    "photographs with a description": {"capture.json": "{}", "photographs/a.exr": "mine"},
    "a list that is none": {"capture.json": "{}", "files.json": "[1]"},
    "a list of another program": {
        "capture.json": "{}",
        "files.json": '{"generator": "x", "files": {"capture.json": 2}}',
    },
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_folders_of_others_are_never_overwritten(tmp_path, kind):
    for name, text in FOREIGN[kind].items():
        (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / name).write_text(text)
    with pytest.raises(SceneError, match=r"out: expected an empty folder or an earlier"):
        write_capture(scene(), tmp_path / "out", overwrite=True)
    assert {n: (tmp_path / "out" / n).read_text() for n in FOREIGN[kind]} == FOREIGN[kind]
    assert tree(tmp_path / "out") == sorted(FOREIGN[kind])


@pytest.mark.parametrize(
    "change",
    [
        lambda out: (out / "notes.txt").write_text("mine"),
        lambda out: (out / "photographs" / "v000_l009.exr").write_text("mine"),
        lambda out: (out / "photographs" / "v000_l000.exr").write_text("retouched"),
        lambda out: (out / "link").symlink_to(out.parent),
        lambda out: os.mkfifo(out / "truth" / "pipe"),
    ],
)
def test_what_was_added_to_a_capture_or_changed_is_in_the_way(tmp_path, change):
    out = write_capture(scene(), tmp_path / "out")
    change(out)
    before = tree(out)
    with pytest.raises(SceneError, match=r"received '\S+', which it did not write or which"):
        write_capture(scene(), out, overwrite=True)
    assert tree(out) == before


def test_lists_reach_nothing_outside(tmp_path):
    out = write_capture(scene(), tmp_path / "out")
    (tmp_path / "precious").write_text("x")
    text = (out / "files.json").read_text()
    (out / "files.json").write_text(text.replace('"files": {', '"files": {"../precious": 1,'))
    write_capture(scene(), out, overwrite=True)
    assert (tmp_path / "precious").exists()


def test_what_is_put_in_the_way_meanwhile_is_kept(tmp_path, monkeypatch):
    def late(*arguments, **named):
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "mine.txt").write_text("precious")
        return whole(*arguments, **named)

    whole = capture_sim.write.write_truth
    monkeypatch.setattr(capture_sim.write, "write_truth", late)
    with pytest.raises(SceneError, match=r"received 'mine\.txt'"):
        write_capture(scene(), tmp_path / "out")
    assert tree(tmp_path / "out") == ["mine.txt"]


@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize("moves", [0, 3, 7, 8, 9])
def test_a_kill_while_files_go_to_their_places_is_made_good(
    tmp_path, capture, monkeypatch, moves, earlier
):
    """Never a capture.json beside files of another capture; the next call finishes."""
    out = tmp_path / "out"
    out.mkdir()
    if earlier:
        write_capture(scene(heldout={"photographs": 1}, material={"preset": "gold"}), out)
    done, replace = [], type(out).replace

    def killed(path, target):
        if not path.name.startswith(".") and path.parent != target.parent:
            if len(done) == moves:
                raise KeyboardInterrupt
            done.append(target)
        return replace(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(type(out), "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            write_capture(scene(), out, overwrite=earlier)
    assert not (out / "capture.json").exists()
    monkeypatch.setattr(capture_sim.write, "measured", None)  # nothing is rendered again
    write_capture(scene(), out, overwrite=earlier)
    assert_same(capture, out)
    assert not (out / "truth" / "heldout").exists()


def test_a_kill_before_the_rename_renders_nothing_again(tmp_path, capture, monkeypatch):
    def killed(*_):
        raise OSError("kill")

    with monkeypatch.context() as patch:
        patch.setattr(type(tmp_path), "rename", killed)
        with pytest.raises(OSError, match="kill"):
            write_capture(scene(), tmp_path / "out")
    monkeypatch.setattr(capture_sim.write, "_write_photograph", None)
    write_capture(scene(), tmp_path / "out")
    assert_same(capture, tmp_path / "out")


def test_a_killed_process_is_resumed(tmp_path, started):
    (tmp_path / "a.toml").write_text(SCENE.replace("n = 3", "n = 16"))
    out = tmp_path / "out"
    words = ("render", tmp_path / "a.toml", "-o", out, "--workers", "1")
    first = started(*words, stdout=subprocess.DEVNULL)
    photographs = tmp_path / ".out.incomplete" / "photographs"
    end = time.monotonic() + 60
    while not (photographs.is_dir() and len(list(photographs.iterdir())) > 5):
        assert time.monotonic() < end
        assert first.poll() is None
        time.sleep(0.005)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert not out.exists()
    kept = {p.name: p.stat().st_mtime_ns for p in photographs.glob("[!.]*")}
    assert started(*words, stdout=subprocess.DEVNULL).wait(timeout=100) == 0
    again = {p.name: p.stat().st_mtime_ns for p in (out / "photographs").iterdir()}
    assert len(again) == 256
    assert {name: again[name] for name in kept} == kept


def test_ctrl_c_ends_with_status_130_and_one_line(tmp_path, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    (tmp_path / "a.toml").write_text(SCENE)
    monkeypatch.setattr(cli, "write_capture", interrupted)
    words = ["capture-sim", "render", str(tmp_path / "a.toml"), "-o", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ending:
        cli.main()
    assert ending.value.code == 130
    assert capsys.readouterr().err.splitlines()[-1].startswith("capture-sim: interrupted;")


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="libraries are seen in /proc")
@pytest.mark.parametrize("seconds", [0.5, 1.5])
def test_ctrl_c_in_the_first_seconds_is_one_line(tmp_path, seconds, started):
    """While libraries are imported, too: from the time when the first of them is there."""
    (tmp_path / "a.toml").write_text(SCENE.replace("n = 3", "n = 60"))
    words = ("render", "a.toml", "-o", "out")
    process = started(*words, stderr=subprocess.PIPE, cwd=tmp_path)
    end = time.monotonic() + 60
    while "numpy" not in Path(f"/proc/{process.pid}/maps").read_text():
        assert time.monotonic() < end
        time.sleep(0.01)
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    assert error.startswith("capture-sim: interrupted")
    assert error.count("\n") == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small file system")
def test_a_full_disk_is_one_message_with_the_name_of_the_file(tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=40k", "tmpfs", small], check=False
    )
    if mounted.returncode:
        pytest.skip("file systems cannot be mounted here")
    try:
        noise = np.random.default_rng(0).random((200, 200, 3)).astype(np.float32)
        for write, name in ((files.write_exr, "a.exr"), (files.write_json, "a.json")):
            values = noise if name == "a.exr" else {"a": noise.tolist()}
            with pytest.raises(OSError, match=rf"No space left .*: '.*/{name}'") as caught:
                files.write_whole(small / name, write, values)
            assert caught.value.errno == errno.ENOSPC
            assert list(small.iterdir()) == []
        with pytest.raises(OSError, match=r"No space left on device: '.*\.(exr|png|npz)'"):
            write_capture(scene(cameras={"preset": "fibonacci", "n": 9}), small / "out")
    finally:
        subprocess.run(["umount", small], check=True)
