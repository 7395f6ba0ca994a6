"""The demo: a simulated dome of a vase, processed and compared."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from reflfield.api.reconstruction import Result, reconstruct
from reflfield.errors import ReflfieldError
from reflfield.field.clustered_pca import CompressionOptions
from reflfield.field.sample_fit import SampleFitOptions
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.pipeline_options import (
    AlignmentOptions,
    ComparisonOptions,
    CompletionOptions,
    PipelineOptions,
    TextureOptions,
)
from reflfield.util.child_processes import tied
from reflfield.util.progress import report

SCENE = "demo_vase"
HELD_OUT = HoldOut(views=2, lights=2)
# The demo has to end within three minutes on two cores, compilation included: texels a little
# coarser than usual, bases shaped by half as many, frames of the harmonic search, the fit
# that trials would take with a third of its steps, and a second field for the comparison.
TRAINING_TEXELS = 4096
OPTIONS = PipelineOptions(
    texture=TextureOptions(texels_per_pixel=1.1),
    completion=CompletionOptions(training_texels=TRAINING_TEXELS),
    alignment=AlignmentOptions(refine=False),
    compression=CompressionOptions(
        fit="samples",
        training_texels=TRAINING_TEXELS,
        samples=SampleFitOptions(rounds=2, iterations=8, frame_spread_deg=0.0),
    ),
    comparison=ComparisonOptions(without_alignment=True),
)


# The smallest alignment and the smallest fit to samples that call all that the demo's do.
COMPILE = """
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from reflfield.alignment import align
from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.coefficients import solve_coefficients
from reflfield.field.sample_fit import SampleFitOptions, fit_basis
from reflfield.observations.texel_samples import TexelSamples, transformed_samples
from reflfield.sphere.hemisphere import HemisphereGrid

directions = HemisphereGrid(7).directions
align(np.ones((2, 49, 49), np.float32), directions, directions, 4, refine=False)
few = np.tile(directions[:5].astype(np.float32), (2, 1, 1))
seen, pairs = np.ones((2, 5), bool), np.ones((5, 5), bool)
texels = TexelSamples(np.ones((2, 5, 5, 3), np.float32), few, few, seen, seen, pairs)
frames = np.tile(np.eye(3, dtype=np.float32), (2, 1, 1))
model = ClusteredModel(
    np.zeros(2, np.int32),
    np.zeros((2, 1), np.float32),
    np.ones((1, 9, 9, 6), np.float32),
    np.ones((1, 1, 1)),
)
samples = transformed_samples(texels, frames, (3, 3), "cube_root")
fit_basis(lambda some: samples, model, np.arange(2), 1000, SampleFitOptions(rounds=1))
with ThreadPoolExecutor(1) as pool:
    solve_coefficients(samples, model.cluster, model, pool, bounded=True)
"""


def run_demo(out: Path, workers: int) -> Result:
    """Simulate the shipped scene into `out`/capture and process it into `out`.

    Parameters
    ----------
    out : Path
    workers : int
        Threads.

    Returns
    -------
    Result

    Raises
    ------
    ReflfieldError
        If the simulation fails; its own message is passed on.
    """
    with compiling_ahead():
        capture = out / "capture"
        if not (capture / "capture.json").is_file():
            simulate(capture, workers)
        return reconstruct(
            capture,
            out,
            hold_out=HELD_OUT,
            options=OPTIONS,
            resources=Resources(workers=workers),
        )


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """Compile what alignment and fit need in a process of its own, beside the first stages.

    Numba keeps it on disk, where the run finds it: a third of the compilation on a fresh
    machine. Compiled before, it takes two seconds; if it fails, the run compiles for itself.
    """
    process = subprocess.Popen(
        tied([sys.executable, "-c", COMPILE]),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        process.kill()
        process.wait()


def simulate(capture: Path, workers: int) -> None:
    """Run the simulator as a process of its own: the two share nothing but files."""
    capture.parent.mkdir(parents=True, exist_ok=True)
    report("simulating the dome", 0, 1)
    command = [simulator(), "render", SCENE, "-o", str(capture), "--workers", str(workers)]
    done = subprocess.run(tied(command), capture_output=True, text=True, check=False)
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
