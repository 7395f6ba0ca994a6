"""What the benchmark of whole captures reads of a finished run, and the README's rows of it."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import bench_captures, make_results, measuring


@pytest.fixture
def measured(finished):
    """Results of the tiny run, as if the benchmark had started it."""
    benchmark = bench_captures.CAPTURES["tiny"]
    results = measuring.Results("capture_tiny", "Capture: tiny", ["reflfield.cli"])
    bench_captures.images_table(results, benchmark, finished.folder)
    spent = bench_captures.Spent(wall=9.0, cpu=12.0, peak_bytes=1 << 20)
    words = ("run", Path("somewhere/capture"), "-o", Path("somewhere/out"))
    bench_captures.run_tables(results, benchmark, finished.folder, spent, words)
    return results.to_dict()


def test_images_size_time_and_memory_are_read(measured, finished):
    tables = {table["title"]: table["rows"] for table in measured["tables"]}
    metrics = json.loads((finished.folder / "metrics.json").read_text())["mean"]
    held_out, unseen = [row for row in tables["Images"] if row["field"] == "aligned"]
    assert held_out["images"] == "held out: 1 view x 1 light"
    # Three decimals are kept.
    assert held_out["PSNR, dB"] == pytest.approx(metrics["psnr_ldr"], abs=5e-4)
    assert unseen["number"] == 2
    (run,) = tables["Run"]
    assert run["command"] == "reflfield run capture -o out"
    size = (finished.folder / "field.rfld").stat().st_size / 1000
    assert run["field, kB"] == pytest.approx(size, abs=0.05)  # one decimal is kept
    assert (run["wall time, s"], run["CPU time, s"]) == (9.0, 12.0)
    # Of the run itself, which took more than the megabyte above.
    assert run["peak memory, GB"] > 0.1
    assert {"hull", "alignment", "report"} <= {row["stage"] for row in tables["Stages"]}


def test_rows_of_the_readme_follow(measured):
    measured["machine"] |= {"cores": 2, "load": 2.5}
    first, second = make_results.short_rows(measured)
    assert first["capture"] == "tiny"
    assert first["time"] == "9 s"
    images = next(table["rows"] for table in measured["tables"] if table["title"] == "Images")
    other = next(row for row in images if row["field"] == "without alignment")
    assert first["not aligned"] == f"{other['PSNR, dB']:.1f}"
    assert second["capture"] == ""
    assert second["images"] == "unseen views and lights"


@pytest.mark.parametrize("load", [4.5, None])
def test_wall_time_of_a_busy_machine_is_not_shown(measured, load):
    measured["machine"] |= {"cores": 2, "load": load}
    if load is None:
        del measured["machine"]["load"]
    assert make_results.short_rows(measured)[0]["time"] == "-"
