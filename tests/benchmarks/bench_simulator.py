"""Time, memory and error of the simulator on a full dome, and how the time splits.

    python tests/benchmarks/bench_simulator.py                       # bonn151, 256 px, samples
    python tests/benchmarks/bench_simulator.py --rig ubo81 --whole   # writes the capture

Every stage is timed on a few views by one thread and scaled to the dome, in seconds of the
processor, which another program does not change. The plain sums over pairs, which the tests
hold the renderer to, are timed on the same points in the same run; so are rays for every
pair instead of visibility traced once per light. With ``--whole`` the capture is written by
two workers and timed as a whole; ``--off 20`` compares effects that are off with none.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from benchmarks.measuring import Results, peak, reset_peak, spent

from capture_sim.effects.effect_registry import decided
from capture_sim.files import write_exr
from capture_sim.memory import parse_bytes
from capture_sim.model import EffectOptions, TruthOptions
from capture_sim.photograph import photographs, set_up
from capture_sim.rays import RayTracer, towards_camera
from capture_sim.render import (
    arriving_light,
    lit_pairs,
    reflectance_of_pairs,
    render_view,
    shade,
    traced_lights,
)
from capture_sim.scene import load_scene, parse_scene
from capture_sim.view_samples import sample_view
from capture_sim.write import write_capture

DIRECT = EffectOptions(simulate=("antialiasing", "near_lights", "shadows"))
N_PLAIN_LIGHTS = 4
MEASURED = ("capture_sim.write",)


def dome(rig, thing, material, side):
    """A scene in which every direction of the rig is a camera and a lamp."""
    target = [0.0, 0.0, 0.1 if thing in ("vase", "amphora") else 0.0]
    ring = {"preset": rig, "target": target, "distance": 1.0}
    scene = parse_scene(
        {
            "object": {"preset": thing},
            "material": {"preset": material},
            "cameras": {**ring, "extent": 0.25, "width": side, "height": side},
            "lights": ring,
        }
    )
    return replace(scene, effects=DIRECT, truth=TruthOptions(per_view=False, points=0))


def seconds(work):
    """Processor seconds, all threads together, and the answer."""
    start = time.process_time()
    answer = work()
    return time.process_time() - start, answer


def plain(scene, tracer, view, lights):
    """Photographs as sums over pairs of point and light, one formula at a time."""
    arriving = arriving_light(scene, lights, view.points.position)
    views = towards_camera(view.camera, view.points.position)
    lit, cosine = lit_pairs(scene, tracer, view.points, arriving)
    values = reflectance_of_pairs(
        scene.material, view.points, views, arriving.directions, lit, cosine
    )
    shining = view.weight[:, None, None] * values * arriving.irradiance
    flat = np.stack(
        [
            np.bincount(view.pixel, column, minlength=view.coverage.size)
            for column in shining.reshape(len(view.points), -1).T
        ]
    )
    shape = (len(lights), 3, *view.coverage.shape)
    return np.moveaxis(flat.reshape(shape), 1, 3)


def written(folder, images):
    for index, image in enumerate(images):
        write_exr(folder / f"{index}.exr", image)


def measured(scene, n_views, folder):
    """Rows (stage, seconds for the dome), the plain sums' seconds, and errors."""
    tracer = RayTracer(scene.mesh, n_threads=1)
    trace, traced = seconds(lambda: traced_lights(scene, tracer))
    chosen = np.linspace(0, len(scene.cameras) - 1, n_views).astype(int)
    warm = sample_view(scene, tracer, scene.cameras[0])
    shade(scene, tracer, warm, scene.lights, traced)
    few = scene.lights[:: max(1, len(scene.lights) // N_PLAIN_LIGHTS)][:N_PLAIN_LIGHTS]
    totals, errors, n_points = np.zeros(5), [], 0
    for index in chosen:
        sampling, view = seconds(lambda i=index: sample_view(scene, tracer, scene.cameras[i]))
        shading, images = seconds(
            lambda v=view: [image for _, image in render_view(scene, tracer, v, traced)]
        )
        every_ray, exact = seconds(lambda v=view: shade(scene, tracer, v, scene.lights))
        slow, summed = seconds(lambda v=view: plain(scene, tracer, v, few))
        writing, _ = seconds(lambda i=images: written(folder, i))
        images, n_points = np.stack(images), n_points + len(view.points)
        fast = shade(scene, tracer, view, few)
        errors.append(
            (
                np.linalg.norm(images - exact) / np.linalg.norm(exact),
                (images != exact).any(axis=-1).sum() / (exact > 0).any(axis=-1).sum(),
                np.linalg.norm(fast - summed) / np.linalg.norm(summed),
            )
        )
        slow *= len(scene.lights) / len(few)
        totals += [sampling, shading, writing, every_ray, slow]
    return trace, totals * len(scene.cameras) / n_views, np.mean(errors, axis=0), n_points


def report(scene, n_views, results):
    reset_peak()
    with tempfile.TemporaryDirectory() as folder:
        trace, totals, errors, n_points = measured(scene, n_views, Path(folder))
    memory = peak() / 2**30
    sampling, shading, writing, every_ray, slow = totals
    whole = trace + sampling + shading + writing
    n_photographs = len(scene.cameras) * len(scene.lights)
    print(f"{n_photographs} photographs, {n_points / n_views:.0f} points a view")
    results.table(f"{n_photographs} photographs, CPU time of one thread, memory of all")
    for name, value in (
        ("visibility of the lights, once", trace),
        ("rays of the pixels, once a view", sampling),
        ("shading", shading),
        ("writing", writing),
        ("together", whole),
    ):
        share = f"{100 * value / whole:4.0f} %"
        print(f"  {name:34}{value:8.1f} s {share} {1e3 * value / n_photographs:8.2f} ms each")
        each = 1e3 * value / n_photographs
        results.add({"stage": name, "s": value, "ms each": each, "peak memory, GB": memory})
    print(f"  {'shading, a ray for every pair':34}{every_ray:8.1f} s")
    print(f"  {'shading, plain sums over pairs':34}{slow:8.1f} s, {slow / shading:.1f} times")
    print(
        f"  error against a ray for every pair: relative L2 {errors[0]:.1e}, "
        f"lit pixels changed {errors[1]:.1e}"
    )
    print(f"  error against plain sums: relative L2 {errors[2]:.1e}")
    results.table("Other ways of shading, and by how much ours differs from them")
    for how, value, error, changed in (
        ("a ray for every pair", every_ray, errors[0], errors[1]),
        ("plain sums over pairs", slow, errors[2], None),
    ):
        cells = {"shading": how, "s": value, "times as long": value / shading}
        differs = {"relative L2": error, "share of lit pixels": changed}
        results.add(cells | differs | {"peak memory, GB": memory})
    assert errors[2] < 1e-5, "the compiled BRDFs have lost digits"
    assert errors[1] < 1e-3, "visibility at nodes is no longer next to exact"


def off_is_free(n_runs, results):
    """Time with every effect described and off, over that of shading and nothing else."""
    scene = load_scene("vase")
    nothing = replace(scene.effects, simulate="none")
    off = decided(replace(scene, effects=nothing))
    bare = replace(scene, effects=EffectOptions(simulate="none", active=frozenset()))
    tracer, lights = RayTracer(scene.mesh), np.arange(len(scene.lights))

    def described():
        real = set_up(off).real
        return [image for _, image in photographs(real, tracer, 0, lights)]

    def shaded():
        view = sample_view(bare, tracer, bare.cameras[0])
        return [image for _, image in render_view(bare, tracer, view)]

    assert np.array_equal(described(), shaded()), "an effect that is off left a trace"
    times = np.array([[seconds(described)[0], seconds(shaded)[0]] for _ in range(n_runs)])
    ratio = np.divide(*np.median(times, axis=0))
    results.table("Every effect described and off, over bare shading")
    results.add({"runs": n_runs, "time over that of bare shading": ratio})
    print(f"every effect described and off: {ratio:.2f} times the time of bare shading, "
          f"medians of {n_runs} alternating runs; photographs equal bit by bit")  # fmt: skip


def write_whole(scene, workers, max_memory, results):
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        path = Path(folder) / "capture"
        _, cost = spent(
            lambda: write_capture(scene, path, workers=workers, max_memory=max_memory)
        )
        files = [f for f in Path(folder).rglob("*") if f.is_file()]
        size = sum(file.stat().st_size for file in files)
    n = len(scene.cameras) * len(scene.lights)
    results.table(f"The whole capture, {workers} workers")
    allowed = {"allowed, GB": max_memory / 2**30}
    results.add({"photographs": n, "capture, GB": size / 1e9} | cost | allowed)
    results.say()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", default="bonn151")
    parser.add_argument("--object", default="vase")
    parser.add_argument("--material", default="painted_vase")
    parser.add_argument("--side", type=int, default=256, help="pixels")
    parser.add_argument("--views", type=int, default=4, help="that are timed")
    parser.add_argument("--whole", action="store_true", help="write the whole capture too")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--max-memory", default="4GB", help="ceiling of the whole capture")
    parser.add_argument("--off", type=int, metavar="RUNS", help="only: what is off is free")
    options = parser.parse_args()
    if options.off:
        results = Results("simulator_off", "Simulator: what is off is free", MEASURED)
        off_is_free(options.off, results)
        print(results.write())
        return
    title = f"Simulator: {options.object} in {options.rig}, {options.side} pixels"
    results = Results(f"simulator_{options.rig}", title, MEASURED)
    scene = dome(options.rig, options.object, options.material, options.side)
    report(scene, options.views, results)
    if options.whole:
        write_whole(scene, options.workers, parse_bytes(options.max_memory), results)
    print(results.write())


if __name__ == "__main__":
    main()
