"""The example scripts run as their own text says, and so does that of the package."""

import doctest
import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import reflfield as package

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def example(monkeypatch, capsys):
    """Function that runs a script in this process; what it printed."""

    def run(name, *words):
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_every_example_uses_the_public_api_alone():
    scripts = sorted(EXAMPLES.glob("*.py"))
    assert len(scripts) == 3
    for script in scripts:
        internal = re.findall(
            r"(?:from|import) (?:reflfield|capture_sim)\.\S+", script.read_text()
        )
        assert internal == [], script.name
        assert "import reflfield as rf" in script.read_text(), script.name


def test_process_and_relight(tiny_capture, tiny_options, example, tmp_path):
    words = ("--config", tiny_options, "--size", 64)
    out = example("process_and_relight.py", tiny_capture, tmp_path, *words)
    picture = np.asarray(Image.open(out.strip().splitlines()[-1]))
    assert picture.shape == (64, 64, 3)
    # The ball stands in the middle, lit; the corners are empty.
    assert picture[28:36, 28:36].mean() > 20
    assert not picture[:4, :4].any()


def test_photograph_and_relit(tiny_capture, finished, example, tmp_path):
    path = tmp_path / "both.png"
    example("photograph_and_relit.py", tiny_capture, finished.folder, path, "--size", 64)
    both = np.asarray(Image.open(path))
    assert both.shape == (64, 136, 3)
    assert (both[:, 64:72] == 255).all()
    photograph, relit = both[:, :64].astype(float), both[:, 72:].astype(float)
    # A coarse field of a ball: nearer to its photograph than black is.
    assert np.abs(photograph - relit).mean() < 0.5 * photograph.mean()


def test_align_samples(example):
    out = example("align_samples.py", "--texels", 60)
    error, unaligned = map(float, re.findall(r"\d+\.\d+", out))
    # Of tilts of 15 degrees at most, one part in ten.
    assert error < 0.1 * unaligned


@pytest.mark.slow
def test_the_example_of_the_package_runs_whole(tiny_capture, tmp_path, monkeypatch):
    """The lines that doctest skips, too, with the capture that they name."""
    shutil.copytree(tiny_capture, tmp_path / "capture")
    monkeypatch.chdir(tmp_path)
    text = package.__doc__.replace("# doctest: +SKIP", "").replace("\n27.2\n", "\n1...\n")
    example = doctest.DocTestParser().get_doctest(text, {}, "reflfield", None, None)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    assert runner.run(example).failed == 0
    assert (tmp_path / "out" / "field.rfld").is_file()
