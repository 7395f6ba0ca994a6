"""A tiny simulated capture of a product of views and lights; planned contexts of it."""

import json

import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.capture.readers import open_capture
from reflfield.field.clustered_pca import CompressionOptions
from reflfield.options import Resources
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.tradeoff import sweep as sweep_module
from reflfield.tradeoff.measured_run import OUTCOME
from reflfield.tradeoff.sweep import Sweep
from reflfield.tradeoff.swept_options import value_of
from tests.tiny_dome import ball_scene

SCENE = ball_scene("tiny_product", n_lights=(6, 4))


@pytest.fixture(scope="session")
def product_folder(made_once):
    """Folder of a capture of 10 views under 10 lights. Read only."""

    def fill(folder):
        write_capture(parse_scene(SCENE), folder)

    return made_once("tiny_product", fill)[0]


@pytest.fixture
def product(product_folder):
    """The capture of 10 views under 10 lights."""
    return open_capture(product_folder)


class FakeRuns:
    """Stands for the processes of a sweep: times and errors by known formulas.

    Parameters
    ----------
    refused : str
        Name of an option whose other values than the default cannot be used.
    """

    def __init__(self, refused=""):
        self.jobs, self.refused = [], refused

    def __call__(self, job):
        """Write the outcome that a run would have left."""
        self.jobs.append(job)
        job.out.mkdir(parents=True, exist_ok=True)
        outcome = self.outcome(job)
        (job.out / OUTCOME).write_text(json.dumps(outcome))
        return outcome

    def outcome(self, job):
        """The finer the texels, the more steps and lobes, the better and the slower."""
        density = value_of(job.options, "texture.texels_per_pixel")
        steps = value_of(job.options, "compression.half_vector.image_steps")
        lobes = value_of(job.options, "compression.half_vector.n_lobes")
        lobes = 3 if lobes == "auto" else lobes
        if self.refused == "texture" and density != 1.6:
            return {"key": job.key, "failed": "texels: cannot be used", "command seconds": 1.0}
        n = sum(not photograph.is_test for photograph in job.capture.photographs)
        psnr = 30 + 2 * density + steps + lobes - 100 / n
        seconds = {"observations": n / 100, "surface": 4 * density**2 + 4 * steps + lobes}
        stage = {"peak_bytes": 1 << 28, "size_bytes": 1000, "reused": False}
        records = [
            {"name": name, "key": name, "seconds": s, "cpu_seconds": s, **stage}
            for name, s in seconds.items()
        ]
        mean = {"psnr_ldr": psnr, "ssim": 0.9}
        images = {"mean": mean, "psnr": [psnr - 0.1, psnr + 0.1]}
        outcome = {
            "key": job.key,
            "stages": records,
            "field bytes": int(1000 * density**2),
            "chosen on": images,
            "unseen": {},
            "truth": {},
            "command seconds": sum(seconds.values()),
        }
        return {**outcome, "reported": images} if job.reported is not None else outcome


@pytest.fixture
def fake_runs(monkeypatch):
    """Function that puts known outcomes in the place of processes."""

    def install(**words):
        fake = FakeRuns(**words)
        monkeypatch.setattr(sweep_module, "run_in_process", fake)
        monkeypatch.setattr(sweep_module, "machine_seconds", dict)
        return fake

    return install


@pytest.fixture
def make_sweep(product, tmp_path):
    """Function that makes a sweep of the tiny capture."""

    def make(**words):
        asked = {"resources": Resources(workers=1), "stages_swept": ("texture", "compression")}
        options = PipelineOptions(compression=CompressionOptions(model="half_vector"))
        return Sweep(product, tmp_path / "sweep", options, **{**asked, **words})

    return make
