"""The demo: a simulated dome of a vase, processed and compared."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from reflfield.capture.readers import open_capture
from reflfield.config import HoldOut, Resources
from reflfield.errors import ReflfieldError
from reflfield.field.compression import CompressionOptions
from reflfield.field.fit import SampleFitOptions
from reflfield.pipeline import run
from reflfield.progress import report
from reflfield.steps.job import Job
from reflfield.steps.options import (
    AlignmentOptions,
    ComparisonOptions,
    PipelineOptions,
    TextureOptions,
)

SCENE = "demo_vase"
HELD_OUT = HoldOut(views=2, lights=2)
# The demo has to end within three minutes on two cores, compilation included: texels a little
# coarser than usual, frames of the harmonic search, the fit that trials would take, and a
# second field for the comparison.
OPTIONS = PipelineOptions(
    texture=TextureOptions(texels_per_pixel=1.1),
    alignment=AlignmentOptions(refine=False),
    compression=CompressionOptions(
        fit="samples", samples=SampleFitOptions(frame_spread_deg=0.0)
    ),
    comparison=ComparisonOptions(without_alignment=True),
)


def run_demo(out: Path, workers: int) -> Job:
    """Simulate the shipped scene into `out`/capture and process it into `out`.

    Parameters
    ----------
    out : Path
    workers : int
        Threads.

    Returns
    -------
    Job

    Raises
    ------
    ReflfieldError
        If the simulation fails; its own message is passed on.
    """
    capture = out / "capture"
    if not (capture / "capture.json").is_file():
        simulate(capture, workers)
    return run(
        open_capture(capture),
        out,
        OPTIONS,
        hold_out=HELD_OUT,
        resources=Resources(workers=workers),
    )


def simulate(capture: Path, workers: int) -> None:
    """Run the simulator as a process of its own: the two share nothing but files."""
    capture.parent.mkdir(parents=True, exist_ok=True)
    report("simulating the dome", 0, 1)
    command = [simulator(), "render", SCENE, "-o", str(capture), "--workers", str(workers)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ReflfieldError(
            f"capture-sim: expected status 0, received {done.returncode}: {done.stderr.strip()}"
        )
    report("simulating the dome", 1, 1)


def simulator() -> str:
    """Path of the command ``capture-sim``, installed beside this one."""
    beside = Path(sys.executable).with_name("capture-sim")
    found = str(beside) if beside.is_file() else shutil.which("capture-sim")
    if found is None:
        raise ReflfieldError(
            "capture-sim: expected beside reflfield, found none; install the distribution"
        )
    return found
