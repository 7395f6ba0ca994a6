"""The command line: names of shipped scenes, messages, exit status."""

import re
import sys

import pytest

from capture_sim import cli

TINY = """
[object]
preset = "sphere"
[material]
preset = "grey_card"
[cameras]
preset = "rti"
width = 8
height = 8
[lights]
preset = "rti"
n = 2
[truth]
points = 0
"""


@pytest.fixture
def run(monkeypatch, capsys):
    """Return a function from arguments to (exit status, stdout, stderr)."""

    def command(*arguments):
        monkeypatch.setattr(sys, "argv", ["capture-sim", *map(str, arguments)])
        with pytest.raises(SystemExit) as ending:
            cli.main()
        return (ending.value.code or 0, *capsys.readouterr())

    return command


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


def test_render_writes_a_capture(run, tiny, tmp_path):
    status, out, _ = run("render", tiny, "-o", tmp_path / "out", "--workers", 1)
    assert status == 0
    assert str(tmp_path / "out") in out.replace("\n", "")
    assert (tmp_path / "out" / "capture.json").is_file()


def test_render_twice_needs_overwrite(run, tiny, tmp_path):
    run("render", tiny, "-o", tmp_path / "out")
    status, _, err = run("render", tiny, "-o", tmp_path / "out")
    assert status == 2
    assert "pass --overwrite" in err
    assert run("render", tiny, "-o", tmp_path / "out", "--overwrite")[0] == 0


def test_plan_accepts_the_name_of_a_shipped_scene(run):
    status, out, _ = run("plan", "demo_vase")
    assert status == 0
    assert "840 (28 views, 30 lights)" in out
    assert re.search(r"off +interreflection .* of a point.s horizon", out)


def test_presets_lists_everything(run):
    status, out, _ = run("presets")
    assert status == 0
    for name in ("demo_vase", "amphora", "painted_vase", "bonn151"):
        assert name in out


@pytest.mark.parametrize("command", ["plan", "render"])
def test_mistakes_end_with_one_message_and_status_2(run, tmp_path, command):
    scene = tmp_path / "bad.toml"
    scene.write_text(TINY + "gloss = 3\n")
    extra = ["-o", tmp_path / "out"] if command == "render" else []
    status, out, err = run(command, scene, *extra)
    assert status == 2
    assert "bad.toml: truth: expected keys per_view, points, received 'gloss'" in err
    assert "Traceback" not in err + out
    assert not (tmp_path / "out").exists()


def test_unknown_scene_lists_the_known(run):
    status, _, err = run("plan", "no_such_scene")
    assert status == 2
    assert "demo_vase" in err


def test_places_that_cannot_be_written_end_with_status_2(run, tiny):
    status, _, err = run("render", tiny, "-o", tiny / "inside_a_file")
    assert status == 2
    assert "tiny.toml" in err
    assert "Traceback" not in err


def test_effects_are_chosen_on_the_command_line(run, tiny, tmp_path):
    status, out, _ = run("plan", tiny, "--effects", "vignetting,bayer")
    assert status == 0
    on = {line.split()[1] for line in out.splitlines() if line.startswith("  on ")}
    assert on == {"vignetting", "bayer"}
    folder = tmp_path / "out"
    _, out, _ = run(
        *("render", tiny, "-o", folder, "--effects", "vignetting", "--contributions", 1)
    )
    shown = next(line for line in out.splitlines() if "vignetting" in line)
    assert shown.split()[0] == "on"
    assert shown.count("%") == 3  # bound, contribution, reason
    names = {path.name for path in (folder / "truth" / "contributions").iterdir()}
    assert "vignetting" in names
    assert "bayer" not in names


def test_unknown_effects_on_the_command_line_are_named(run, tiny):
    status, _, err = run("plan", tiny, "--effects", "glow")
    assert status == 2
    assert "--effects: expected names among" in err
