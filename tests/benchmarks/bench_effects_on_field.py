"""What each effect of the simulator does to the pipeline: one at a time on one scene.

    python tests/benchmarks/bench_effects_on_field.py OUT
    python tests/benchmarks/bench_effects_on_field.py OUT --effects defocus,bayer

Simulates the scene without errors and once with each effect, makes a field of each
capture, and compares it with true photographs of unseen views under unseen lights, with
the true surface, and with its true frames. Results stay in OUT/NAME/result.json: a second
call with other effects adds to them. Writes OUT/effects.md and OUT/effects.png.

How far the measures scatter by themselves is shown by captures that differ in nothing that
can be seen: lenses bent, and calibrated as bent, by less than a thousandth of a pixel.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from benchmarks.measuring import Results

import reflfield as rf
from capture_sim.effects import (
    dropped_photographs,
    environment,
    lens_distortion,
    light_extent,
)
from capture_sim.effects.effect_registry import EFFECTS
from capture_sim.model import Scene
from capture_sim.scene import load_scene
from capture_sim.write import write_capture

NOTHING = "none"
# What every capture has: these make the image, they do not spoil it.
ALWAYS = ("antialiasing", "near_lights", "shadows")
# Radial distortions that move no point by more than a thousandth of a pixel.
HARMLESS = {"harmless_1": 1e-6, "harmless_2": -1e-6, "harmless_3": 1e-5}
# Fewer samples than usual: the errors of a pipeline are larger than those of sampling.
PARAMETERS = (
    environment.Options(samples=32),
    light_extent.Options(samples=5),
    dropped_photographs.Options(fraction=0.1),
)
# A coarse field, fitted in few rounds: twenty of them are made.
OPTIONS = (
    "texture.texels_per_pixel=0.6",
    "alignment.iterations=2",
    "compression.samples.rounds=2",
    "compression.samples.iterations=6",
)
# What a run says of its field, by the names of its counts, and how tables call it.
COLUMNS = {
    "truth PSNR, dB": "PSNR, dB",
    "hull to the truth, mm": "hull error, mm",
    "normals to the truth, degrees": "normals, degrees",
    "tangents to the truth, degrees": "tangents, degrees",
}


def with_effect(scene: Scene, name: str) -> Scene:
    """The scene with one effect on, besides those that every capture has."""
    parameters = PARAMETERS
    if name in HARMLESS:
        parameters = (*PARAMETERS, lens_distortion.Options(k1=HARMLESS[name], k2=0.0))
        name = lens_distortion.NAME
    choice = replace(scene.effects, simulate=(*ALWAYS, name), parameters=parameters, forced={})
    return replace(scene, effects=choice)


def measure(scene: Scene, name: str, out: Path, options: rf.PipelineOptions, workers: int):
    """Simulate, process and score one effect, unless that has been done."""
    folder = out / name
    if (folder / "result.json").is_file():
        return
    spoilt = with_effect(scene, name)
    capture = write_capture(spoilt, folder / "capture", workers=workers, overwrite=True)
    resources = rf.Resources(workers=workers)
    result = rf.reconstruct(capture, folder / "run", options=options, resources=resources)
    counts = {key: value for stage in result.stages for key, value in stage.counts.items()}
    scores = {key: counts[key] for key in COLUMNS}
    scores |= {
        "CPU time, s": round(sum(stage.cpu_seconds for stage in result.stages), 1),
        "peak memory, GB": round(max(stage.peak_bytes for stage in result.stages) / 2**30, 2),
    }
    (folder / "result.json").write_text(json.dumps(scores, indent=1) + "\n")
    for part in ("capture", "run"):
        shutil.rmtree(folder / part)


def table(results: dict[str, dict]) -> str:
    """Markdown: one line an effect, what differs from none in brackets."""
    lines = ["| effect | " + " | ".join(COLUMNS.values()) + " |", "|---" * 5 + "|"]
    for name, result in results.items():
        cells = [f"{result[key]:.2f}" for key in COLUMNS]
        if name != NOTHING and NOTHING in results:
            changes = [result[key] - results[NOTHING][key] for key in COLUMNS]
            cells = [f"{c} ({d:+.2f})" for c, d in zip(cells, changes, strict=True)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def written(scene: str, scores: dict[str, dict]) -> Path:
    """Write the table as results; their path."""
    results = Results(
        "effects_on_field",
        "What each effect does to the field",
        ["reflfield.pipeline.stages", "capture_sim.write"],
    )
    results.table(f"Scene {scene}, a coarse field, unseen views and lights")
    for name, score in scores.items():
        results.add({"effect": name} | {COLUMNS.get(key, key): score[key] for key in score})
    return results.write()


def plot(results: dict[str, dict], path: Path) -> None:
    """Bars of every measure; line: the capture without errors; band: those like it."""
    names = [name for name in results if name not in (NOTHING, *HARMLESS)]
    alike = [results[name] for name in (NOTHING, *HARMLESS) if name in results]
    figure, axes = plt.subplots(1, 4, figsize=(13, 0.32 * len(names) + 1.2), sharey=True)
    for axis, (key, title) in zip(axes, COLUMNS.items(), strict=True):
        axis.barh(names, [results[name][key] for name in names], color="tab:blue")
        if alike:
            values = [result[key] for result in alike]
            axis.axvspan(min(values), max(values), color="tab:orange", alpha=0.4)
        if NOTHING in results:
            axis.axvline(results[NOTHING][key], color="black", linewidth=1)
        if title.startswith("PSNR"):
            values = [result[key] for result in results.values()]
            axis.set_xlim(min(values) - 1, max(values) + 0.5)
        axis.set_title(title)
    axes[0].invert_yaxis()
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Parse, measure, tell."""
    names = [effect.NAME for effect in EFFECTS if effect.NAME not in ALWAYS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--scene", default="demo_vase", help="name or TOML file")
    parser.add_argument("--effects", default=",".join(names), help="names with commas")
    parser.add_argument("--config", type=Path, help="options of the pipeline in TOML")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()

    options = rf.read_options(arguments.config, () if arguments.config else OPTIONS)
    scene = load_scene(arguments.scene)
    for name in [NOTHING, *HARMLESS, *arguments.effects.split(",")]:
        measure(scene, name, arguments.out, options, arguments.workers)
    order = [NOTHING, *HARMLESS, *names]
    files = {name: arguments.out / name / "result.json" for name in order}
    results = {n: json.loads(path.read_text()) for n, path in files.items() if path.is_file()}
    (arguments.out / "effects.md").write_text(table(results))
    plot(results, arguments.out / "effects.png")
    print(table(results))
    print(written(arguments.scene, results))
    print(arguments.out / "effects.png")


if __name__ == "__main__":
    main()
