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
from reflfield.field.clustered_pca import HALF_VECTOR, CompressionOptions
from reflfield.field.half_vector import HalfVectorOptions
from reflfield.fitting.compilation import compile_kernels
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.pipeline_options import PipelineOptions, TextureOptions
from reflfield.util.child_processes import tied
from reflfield.util.progress import report

SCENE = "demo_vase"
HELD_OUT = HoldOut(views=2, lights=2)
# The demo has to end within three minutes on two cores, compilation included: texels a little
# coarser than usual. At 1.1 unseen views are 1.6 dB worse, at the usual 1.6 .3 dB better.
OPTIONS = PipelineOptions(
    texture=TextureOptions(texels_per_pixel=1.35),
    # Three materials; to find that by views left out would take a tenth of the time.
    compression=CompressionOptions(model=HALF_VECTOR, half_vector=HalfVectorOptions(n_lobes=3)),
)
# Run beside the first stages.
COMPILE = f"from {compile_kernels.__module__} import compile_kernels; compile_kernels()"


def run_demo(out: Path, resources: Resources) -> Result:
    """Simulate the shipped scene into `out`/capture and process it into `out`.

    Parameters
    ----------
    out : Path
    resources : Resources
        Of the run; the simulator gets as many workers.

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
            simulate(capture, resources.workers, SCENE)
        return reconstruct(
            capture,
            out,
            hold_out=HELD_OUT,
            options=OPTIONS,
            resources=resources,
        )


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """Compile what the fit needs in a process of its own, beside the first stages.

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


def simulate(capture: Path, workers: int, scene: str = "demo_vase") -> None:
    """Run the simulator as a process of its own: the two share nothing but files.

    `scene` is the name of a shipped one, or the path of a file.
    """
    capture.parent.mkdir(parents=True, exist_ok=True)
    report("simulating the dome", 0, 1)
    command = [simulator(), "render", scene, "-o", str(capture), "--workers", str(workers)]
    done = subprocess.run(tied(command), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ReflfieldError(
            f"capture-sim: expected status 0, received {done.returncode}: {done.stderr.strip()}"
        )
    report("simulating the dome", 1, 1)


def simulator() -> str:
    """Path of the command ``capture-sim``, installed beside this one."""
    beside = Path(sys.executable).with_name("capture-sim")
    path = str(beside) if beside.is_file() else shutil.which("capture-sim")
    if path is None:
        raise ReflfieldError(
            "capture-sim: expected beside reflfield, found none; install the distribution"
        )
    return path
