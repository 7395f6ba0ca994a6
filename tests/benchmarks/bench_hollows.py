"""Hollows that no silhouette shows: bowls of several materials, filled and carved.

    python tests/benchmarks/bench_hollows.py                        # all
    python tests/benchmarks/bench_hollows.py clay --out NEWDIR      # some; the runs stay

Each bowl is simulated with the light between its sides, and without. A field is made of each on
the visual hull and on what carving leaves, and compared with views and lights that are not in
the capture: what the hollow costs, and what light between parts of the object costs beside it.
The surfaces are compared with the true one.

Writes results/hollows.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from benchmarks.bench_captures import MEASURED, ran  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

from reflfield.geometry.mesh import read_ply  # noqa: E402
from reflfield.metrics.hull_distance import hull_distance  # noqa: E402

SCENE = HERE / "scenes" / "gold_bowl.toml"
MATERIALS = {"clay": "matte_clay", "glaze": "glazed_ceramic", "gold": "gold"}
# Pixels along a side of the photographs: fewer than the scene's, as twelve fields are made.
SIDE = 80


def simulated(material, reflects, folder):
    """Simulate a bowl; the folder of the capture."""
    folder.mkdir(parents=True)
    text = SCENE.read_text().replace('preset = "gold"', f'preset = "{MATERIALS[material]}"')
    text = text.replace("width = 112", f"width = {SIDE}").replace(
        "height = 112", f"height = {SIDE}"
    )
    if not reflects:
        text = text.replace(', "interreflection"', "")
    (folder / "bowl.toml").write_text(text)
    words = ("render", folder / "bowl.toml", "-o", folder / "capture")
    ran("capture_sim", words, folder / "simulator.txt")
    return folder / "capture"


def off_truth(mesh, capture):
    """Mean distance of a mesh to the true surface, millimetres."""
    surface, true = read_ply(mesh), read_ply(capture / "truth" / "mesh.ply")
    pair = (surface.vertices, surface.faces), (true.vertices, true.faces)
    return 1e3 * float(np.abs(hull_distance(*pair).signed).mean())


def add_field(results, names, capture, out, carves):
    """Make one field and add its row."""
    settings = (
        "--set",
        f"hull.hollows={str(carves).lower()}",
        "--set",
        "compression.fit=samples",
    )
    words = ("run", capture, "-o", out, "--hold-out", "views=2,lights=2", *settings)
    spent = ran("reflfield", words, out.with_suffix(".txt"))
    unseen = json.loads((out / "stages/comparison/field/truth.json").read_text())["mean"]
    carved = out / "stages" / "hollows" / "carved.ply"
    results.add(
        {
            **names,
            "hollows": "carved" if carved.is_file() else ("kept" if carves else "filled"),
            "surface off, mm": round(
                off_truth(carved if carved.is_file() else out / "hull.ply", capture), 3
            ),
            "unseen, dB": round(unseen["psnr_ldr"], 2),
            "unseen, SSIM": round(unseen["ssim"], 4),
            "CPU time, s": round(spent.cpu, 1),
            "peak memory, GB": round(spent.peak_bytes / 2**30, 2),
        }
    )
    print(results.tables[-1]["rows"][-1], flush=True)


def main():
    """Measure the materials that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(MATERIALS))
    parser.add_argument("--out", type=Path, help="new folder in which the runs stay")
    options = parser.parse_args()
    if unknown := set(options.names) - set(MATERIALS):
        parser.error(f"NAME: expected {', '.join(MATERIALS)}, received {', '.join(unknown)}")
    results = Results("hollows", "Hollows: bowls filled and carved", MEASURED)
    results.table("Surface, images of unseen views and lights, time and memory")
    with ExitStack() as stack:
        root = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for material in options.names or MATERIALS:
            for reflects in (True, False):
                names = {
                    "bowl": material,
                    "light between its sides": "yes" if reflects else "no",
                }
                folder = root / f"{material}_{'with' if reflects else 'without'}"
                capture = simulated(material, reflects, folder)
                for carves in (False, True):
                    out = folder / ("carved" if carves else "filled")
                    add_field(results, names, capture, out, carves)
    print(results.write())


if __name__ == "__main__":
    main()
