"""Clustered local PCA on what the half-vector model leaves: what images gain by it.

    python tests/benchmarks/bench_residual.py                     # facets, woven satin, Spot
    python tests/benchmarks/bench_residual.py woven_bob --clusters 4 --components 4

The paper's model beside ours: of every sample the difference of cube roots to the half-vector
field is fitted by clusters with a few functions of view and light each, in the field's frames,
by the same code that makes clustered fields; images show the cube of the sum. Objects are those
that lobes shared by all texels could fail on: brushed in another direction in each triangle,
so that a pixel mixes them, and measured woven satin; and Spot (test data, REFLFIELD_DATA).
A share of the residual is added, as of a model that is shrunk: what helps the photographs
that it was fitted to may harm others.

Writes results/residual.json.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from benchmarks.bench_captures import DATA  # noqa: E402
from benchmarks.bench_models import NEEDED, simulated  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

from reflfield.capture.readers import open_capture  # noqa: E402
from reflfield.field.clustered_pca import CompressionOptions  # noqa: E402
from reflfield.field.evaluation import evaluate  # noqa: E402
from reflfield.field.file import open_field  # noqa: E402
from reflfield.metrics.image_metrics import measure_image  # noqa: E402
from reflfield.observations.store import open_samples  # noqa: E402
from reflfield.options import HoldOut  # noqa: E402
from reflfield.pipeline import comparison, results  # noqa: E402
from reflfield.pipeline.alignment import AlignedFrames  # noqa: E402
from reflfield.pipeline.cache import StageFolder, plain  # noqa: E402
from reflfield.pipeline.compression import write_compressed  # noqa: E402
from reflfield.pipeline.pipeline_options import PipelineOptions  # noqa: E402
from reflfield.pipeline.quantisation_search import FieldMaker  # noqa: E402
from reflfield.pipeline.resampling import resampled  # noqa: E402
from reflfield.pipeline.stages import run  # noqa: E402
from reflfield.render.renderer import Renderer  # noqa: E402

MEASURED = ("reflfield.pipeline.stages",)
SPOT = "mitsuba_spot"
OBJECTS = ("brushed_facets", "woven_bob", SPOT)
SHARES, KEYS = (0.0, 0.5, 1.0), ("psnr_ldr", "ssim")
# Stages that the residual's fit reads, and those on the surface from normals that it takes for
# those on the hull.
KEPT = ("silhouettes", "hull", "hollows", "left_out_views", "atlas")
ON_SURFACE = {"visibility": "surface_visibility", "observations": "surface_observations"}


def residual_context(context, folder, compression):
    """Context of a run in a folder, whose hull is the surface of another's field."""
    stages = folder / "stages"
    stages.mkdir(parents=True)
    root = context.stages.root
    for name in KEPT:
        if (root / name).exists():
            shutil.copytree(root / name, stages / name)
    for name, source in ON_SURFACE.items():
        shutil.copytree(root / source, stages / name)
    shutil.copy(root / "surface" / "atlas.npz", stages / "atlas" / "atlas.npz")
    indirect = replace(context.options.indirect, enabled=False)
    return replace(
        context,
        out=folder,
        options=replace(context.options, compression=compression, indirect=indirect),
        asked=None,
        stages=StageFolder(stages),
        on_surface=False,
    )


def subtract_field(context, field):
    """Put the cubes of differences of cube roots in the place of the samples."""
    reader = results.base_reader(context)
    store, pairs = open_samples(reader.store.location, mode="r+"), reader.store.observed.pairs
    for block in reader.blocks_of(np.arange(reader.n_texels)):
        measured = reader.measured(block)
        values = measured.samples.astype(np.float32)
        t, p = np.nonzero(measured.seen)
        views, lights = measured.views[t, pairs.view[p]], measured.lights[t, pairs.light[p]]
        shown = evaluate(field, block[t], views, lights) / np.float32(reader.store.unit)
        left = np.where(np.isnan(values), np.float32(np.nan), np.float32(0.0))
        left[t, p] = (np.cbrt(values[t, p]) - np.cbrt(shown)) ** 3
        store[int(block[0]) : int(block[-1]) + 1] = left.astype(np.float16)


def fitted_residual(context, field, folder, options):
    """Clustered field of what a field leaves of its samples, in its frames."""
    compression = CompressionOptions(
        model="clustered", n_clusters=options.clusters, n_components=options.components
    )
    context = residual_context(context, folder, compression)
    subtract_field(context, field)
    base = results.texels(context).local_from_world.astype(np.float64)
    local_from_base = field.local_from_world.astype(np.float64) @ np.swapaxes(base, 1, 2)
    # None of the frames is free to turn.
    frames = AlignedFrames(local_from_base, np.zeros(0, np.intp))
    stage = context.stages.root / "compression"
    stage.mkdir()
    maker = FieldMaker(context, compression, plain(context.options))
    texels = resampled(context, frames, compression, context.blocks(stage))
    write_compressed(texels, maker, stage)
    return stage / "field.rfld"


def images_with(field, residual, share, options, pairs, exposure):
    """Mean LDR PSNR and SSIM of a field with a share of a residual."""

    def both(shown, texels, views, lights):
        values = evaluate(shown, texels, views, lights)
        if share and shown is field:
            left = evaluate(residual, texels, views, lights)
            values = np.maximum(np.cbrt(values) + np.float32(share) * np.cbrt(left), 0) ** 3
        return values

    renderer, measured = Renderer(field, options), []
    with patch("reflfield.render.renderer.evaluate", both):
        for i, photograph in enumerate(pairs.capture.photographs):
            camera = pairs.capture.cameras[photograph.camera]
            image = renderer.render(camera, pairs.capture.lights[photograph.light]).image
            measured.append(measure_image(replace(pairs.read(i), relit=image), exposure))
    return [
        float(np.mean([getattr(m, name) for m in measured])) for name in ("psnr_ldr", "ssim")
    ]


def measure(table, name, capture, folder, options):
    """Make a field and its residual, and add a row for each share."""
    start = time.perf_counter()
    context = run(
        open_capture(capture),
        folder / "out",
        PipelineOptions(),
        hold_out=HoldOut(views=2, lights=2),
    ).refined
    field, spent = open_field(results.field_file(context)), time.perf_counter() - start
    start = time.perf_counter()
    path = fitted_residual(context, field, folder / "residual", options)
    residual, more = open_field(path), time.perf_counter() - start
    for one in (field, residual):
        one.decode()
    relighting, pairs = context.options.relighting, comparison.relit_pairs(context)
    for share in SHARES:
        row = {"object": name, "share of the residual": share}
        for kind, of_kind in pairs.items():
            exposure = comparison.comparison_of(context, kind).exposure
            psnr, ssim = images_with(field, residual, share, relighting, of_kind, exposure)
            words = "held out" if kind == "heldout" else "unseen"
            row |= {f"{words}, dB": round(psnr, 2), f"{words}, SSIM": round(ssim, 4)}
        size = results.field_file(context).stat().st_size + bool(share) * path.stat().st_size
        row |= {
            "field, kB": round(size / 1000, 1),
            "wall time, s": round(spent + bool(share) * more, 1),
        }
        table.add(row)
        print(row, flush=True)


def capture_of(name, folder):
    """Simulate an object, or find it in the test data."""
    return DATA / SPOT if name == SPOT else simulated(name, folder / "simulated")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("objects", nargs="*", help=f"of {', '.join(OBJECTS)}; default all")
    parser.add_argument("--clusters", type=int, default=8)
    parser.add_argument("--components", type=int, default=8)
    options = parser.parse_args()
    names = options.objects or OBJECTS
    if unknown := set(names) - set(OBJECTS):
        parser.error(f"expected objects of {', '.join(OBJECTS)}, received {sorted(unknown)}")
    table = Results("residual", "Clustered local PCA on the residual", MEASURED)
    table.table(f"{options.clusters} clusters of {options.components} functions")
    for name in names:
        needed = [DATA / path for path in NEEDED.get(name, ())]
        if not all(path.exists() for path in [*needed, *([DATA / SPOT] * (name == SPOT))]):
            print(f"{name}: skipped, its test data are not here (REFLFIELD_DATA)")
            continue
        with tempfile.TemporaryDirectory() as scratch:
            measure(table, name, capture_of(name, Path(scratch)), Path(scratch), options)
    table.write()


if __name__ == "__main__":
    main()
