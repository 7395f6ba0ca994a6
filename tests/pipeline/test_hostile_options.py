"""Options of any value or size, and files of any kind where options and stages are read."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest

from reflfield.capture.image_writing import write_exr
from reflfield.errors import InputError
from reflfield.options import parse_settings, read_toml, with_tables
from reflfield.pipeline.cache import RECORD, StageFolder
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.util.checksums import checksums, first_damaged
from reflfield.util.folders import LOCK, only_run
from tests.pipeline.test_fuzz_commands import OPTIONS

DIGITS = "9" * 5000


class TestNumbersWithoutEnd:
    @pytest.mark.parametrize("name", ["hull.blur", "hull.resolution", "seed", "hull.bounds"])
    @pytest.mark.parametrize("value", [DIGITS, "0x" + "f" * 6000, "[" + DIGITS + "]", "1e999"])
    def test_one_short_message_of_a_setting(self, name, value):
        with pytest.raises(InputError) as error:
            with_tables(PipelineOptions(), parse_settings([f"{name}={value}"]))
        assert name in str(error.value)
        assert "expected" in str(error.value)
        assert len(str(error.value)) < 400

    @pytest.mark.parametrize(
        "text", [f"seed = {DIGITS}", "a." * 50_000 + "b = 1", "[" + "a." * 50_000 + "b]"]
    )
    def test_in_a_file(self, tmp_path, text):
        (tmp_path / "o.toml").write_text(text)
        with pytest.raises(InputError, match=r"o\.toml: .* received a line of"):
            read_toml(tmp_path / "o.toml")

    def test_in_a_file_and_short(self, tmp_path):
        (tmp_path / "o.toml").write_text("hull.resolution = 0x" + "f" * 4000)
        with pytest.raises(InputError, match=r"hull\.resolution.*one of 16000 bits"):
            with_tables(PipelineOptions(), read_toml(tmp_path / "o.toml"))

    def test_largest_whole_number_is_read(self):
        set_ = parse_settings([f"seed={2**63 - 1}"])
        assert with_tables(PipelineOptions(), set_).seed == 2**63 - 1
        with pytest.raises(InputError, match=r"seed.*whole number, received one of 64 bits"):
            with_tables(PipelineOptions(), parse_settings([f"seed={2**63}"]))

    def test_name_of_many_parts(self):
        with pytest.raises(InputError, match="a name of 5000 parts"):
            parse_settings([".".join(["a"] * 5000) + "=1"])


@pytest.mark.parametrize(
    "setting",
    [
        "hull.blur=1e300",
        "hull.blur=1e9",
        "hull.smoothing=1000000000",
        "hull.tolerance=-1",
        "hull.minimum_component=1e300",
        "atlas.padding=1000000000",
        "atlas.resolution=1000000000",
        "atlas.time_limit_s=1e300",
        "texture.largest=1000000000",
        "visibility.ray_offset=1e300",
        "visibility.edge_slope=1e300",
        "resampling.smoothness=1e300",
        "alignment.band_limit=1000000000",
        "alignment.iterations=1000000000",
        "alignment.n_clusters=1000000000",
        "alignment.spread_deg=1e300",
        "compression.relative_step=1e-8",
        "compression.relative_step=1e300",
        "compression.samples.smoothness=1e300",
        "compression.samples.frame_spread_deg=1e300",
        "indirect.n_components=1000000000",
        "indirect.training_texels=1000000000",
    ],
)
def test_option_beyond_its_range_is_refused(setting):
    name = re.escape(setting.partition("=")[0])
    with pytest.raises(InputError, match=rf"option {name}: expected .*, received"):
        with_tables(PipelineOptions(), parse_settings([setting]))


@pytest.mark.parametrize("name", OPTIONS)
def test_every_number_has_a_range(name):
    """Of text, lists and choices a number is refused as such."""
    beyond = 2**63 if name == "seed" else 10**17
    for value in (beyond, -beyond, float(beyond)):
        with pytest.raises(InputError, match=rf"option '?{re.escape(name)}'?: expected"):
            with_tables(PipelineOptions(), parse_settings([f"{name}={value}"]))


class TestNoRegularFiles:
    """A pipe would be waited for without end, a device read without end."""

    def test_options(self, tmp_path):
        os.mkfifo(tmp_path / "o.toml")
        with pytest.raises(InputError, match=r"o\.toml: .* received a named pipe"):
            read_toml(tmp_path / "o.toml")

    @pytest.mark.timeout(60)
    @pytest.mark.parametrize(
        ("flag", "name"),
        [("--on", "a.obj"), ("--on", "a.glb"), ("--environment", "a.exr"),
         ("--capture", "capture.json")],
    )  # fmt: skip
    def test_files_of_a_command(self, reflfield, finished, tmp_path, flag, name):
        os.mkfifo(tmp_path / name)
        lit = ("--orbit", "1", "--light", "0,0,1") if flag == "--on" else ()
        turned = ("--orbit", "1") if flag == "--environment" else ()
        words = ("relight", finished.folder / "field.rfld", "-o", tmp_path / "out")
        outcome = reflfield(*words, *lit, *turned, flag, tmp_path / name)
        assert outcome.status == 2
        assert f"{name}: expected a file, received a named pipe" in outcome.err

    @pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda p: p.symlink_to(p.name)])
    @pytest.mark.parametrize("name", [RECORD, "result"])
    def test_file_of_a_stage_is_damaged_and_the_stage_computed_again(
        self, tmp_path, make, name, caplog
    ):
        def compute(folder):
            (folder / "result").write_text("right")
            return {}

        damaged = StageFolder(tmp_path).run("hull", compute) / name
        damaged.unlink()
        make(damaged)
        again = StageFolder(tmp_path)
        assert (again.run("hull", compute) / "result").read_text() == "right"
        assert not again.record("hull").reused
        assert "damaged" in caplog.text
        once_more = StageFolder(tmp_path)
        once_more.run("hull", compute)
        assert once_more.record("hull").reused

    def test_lock(self, tmp_path):
        os.mkfifo(tmp_path / LOCK)
        with pytest.raises(InputError, match="expected the lock of a run"), only_run(tmp_path):
            pass

    def test_lock_that_leads_to_a_file_leaves_it_alone(self, tmp_path):
        (tmp_path / "precious").write_text("x")
        (tmp_path / LOCK).symlink_to("precious")
        with pytest.raises(InputError, match="expected the lock of a run"), only_run(tmp_path):
            pass
        assert (tmp_path / "precious").read_text() == "x"


def test_dark_photographs_are_said_to_be_dark(capture_copy, run_tiny, tmp_path):
    for path in (capture_copy / "photographs").iterdir():
        write_exr(path, np.zeros((32, 32, 3), np.float16))
    outcome = run_tiny(tmp_path / "out", capture=capture_copy)
    assert outcome.status == 2
    assert "photographs: everything is dark" in outcome.err
    assert "expose longer" in outcome.err


def test_inspect_keeps_to_the_memory_allowed(finished, reflfield):
    field = finished.folder / "field.rfld"
    outcome = reflfield("inspect", field, "--max-memory", "50KB")
    assert outcome.status == 2
    assert "expected arrays of at most 51200 bytes" in outcome.err
    assert "--max-memory" in outcome.err


@pytest.mark.parametrize("name", ["", " ", "/", "//", "/usr/.."])
def test_folder_for_results_is_neither_nameless_nor_the_root(
    reflfield, tiny_capture, name, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for words in (("run", tiny_capture), ("demo",), ("relight", "f.rfld", "--orbit", 1)):
        outcome = reflfield(*words, "-o", name)
        assert outcome.status == 2
        assert "expected a folder for results, received" in outcome.err
    assert not list(tmp_path.iterdir())


def test_output_that_is_full_is_named(tiny_capture):
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = subprocess.run(
            [sys.executable, "-m", "reflfield", "inspect", str(tiny_capture)],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=100,
        )  # fmt: skip
    assert done.returncode == 2
    assert "reflfield: error: standard output: No space left on device" in done.stderr
    assert "Traceback" not in done.stderr


def test_chunk_of_samples_that_is_a_pipe_is_damaged(tmp_path):
    (tmp_path / "samples" / "c").mkdir(parents=True)
    chunk = tmp_path / "samples" / "c" / "0"
    chunk.write_bytes(b"12345678")
    recorded = checksums(tmp_path, stores=("samples",))
    assert first_damaged(tmp_path, recorded) is None
    for make in (os.mkfifo, lambda p: p.symlink_to("nowhere")):
        chunk.unlink()
        make(chunk)
        assert first_damaged(tmp_path, recorded) == "samples/c/0"
