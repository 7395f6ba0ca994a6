"""Models of a field on objects of several kinds: what "auto" takes against each by itself.

    python tests/benchmarks/bench_models.py                       # all but the vases
    python tests/benchmarks/bench_models.py gold_bowl --models auto clustered
    python tests/benchmarks/bench_models.py dense_vase --models auto

Objects that a model may fail on: concave with interreflection, matt under few lights, brushed
in another direction in each triangle (a pixel mixes them), textured satin, measured paint and
measured woven satin. By name only, with results of their own: the vase of the demo under
12 x 12 photographs, and under 57 x 60 and 64 x 64, which take long.
Scenes are in `scenes/`; `painted_bob` and `woven_bob` need mesh and material of the test data
(REFLFIELD_DATA). Every field is made by ``reflfield run`` with default options but for the
model, and compared with held-out photographs and with those of views and lights that are not in
the capture. Beside it is the lumigraph over all photographs: the nearest one, carried over
the surface.

Writes results/models.json, of a vase results/models_VASE.json.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from benchmarks.bench_captures import DATA, MEASURED, ROOT, ran  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

SCENES = HERE / "scenes"
KINDS = (
    "gold_bowl",
    "clay_vase",
    "brushed_facets",
    "satin_sphere",
    "painted_bob",
    "woven_bob",
)
BY_NAME_ONLY = ("sparse_vase", "dense_vase", "square_vase")
MODELS = ("auto", "half_vector", "clustered")
# Files of the test data that a scene needs beside it.
NEEDED = {
    "painted_bob": ("meshes/bob/bob_tri.obj", "rgl_bsdf/cc_ibiza_sunset_rgb.bsdf"),
    "woven_bob": ("meshes/bob/bob_tri.obj", "rgl_bsdf/satin_rosaline_rgb.bsdf"),
}


def brushed_facets(path, seed=0):
    """Write Spot with texture coordinates turned at random in each triangle."""
    import trimesh

    mesh = trimesh.load(ROOT / "capture_sim" / "scenes" / "spot.ply", process=False)
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(mesh.faces))
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack([np.stack([cos, -sin], 1), np.stack([sin, cos], 1)], 1)
    uv = np.einsum("fij,cj->fci", turned, corner).reshape(-1, 2)
    upright = mesh.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in upright]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in uv]
    for i, face in enumerate(mesh.faces):
        lines.append("f " + " ".join(f"{v + 1}/{3 * i + k + 1}" for k, v in enumerate(face)))
    path.write_text("\n".join(lines) + "\n")


def simulated(kind, folder):
    """Simulate a kind of object in a folder; the capture."""
    folder.mkdir(parents=True)
    scene = shutil.copy(SCENES / f"{kind}.toml", folder)
    if kind == "brushed_facets":
        brushed_facets(folder / "brushed_facets.obj")
    for needed in NEEDED.get(kind, ()):
        shutil.copy(DATA / needed, folder)
    ran("capture_sim", ("render", scene, "-o", folder / "capture"), folder / "simulator.txt")
    return folder / "capture"


def measure(results, kind, model, capture, out):
    """Make one field and add its row."""
    words = ("run", capture, "-o", out, "--hold-out", "views=2,lights=2")
    spent = ran(
        "reflfield",
        (*words, "--set", f"compression.model={model}"),
        out.with_suffix(".txt"),
    )
    means, nearest = {}, {}
    for name in ("heldout", "truth"):
        compared = json.loads((out / "stages/comparison/field" / f"{name}.json").read_text())
        means[name] = compared["mean"]
        analysed = json.loads((out / f"stages/error_analysis/{name}.json").read_text())
        nearest[name] = analysed["baselines"]["nearest_photograph"]["mean"]["psnr_ldr"]
    results.add(
        {
            "object": kind,
            "model": model,
            "held out, dB": round(means["heldout"]["psnr_ldr"], 2),
            "unseen, dB": round(means["truth"]["psnr_ldr"], 2),
            "nearest photograph, held out, dB": round(nearest["heldout"], 2),
            "nearest photograph, unseen, dB": round(nearest["truth"], 2),
            "unseen, SSIM": round(means["truth"]["ssim"], 4),
            "unseen, FLIP": round(means["truth"]["flip"], 4),
            "field, kB": round((out / "field.rfld").stat().st_size / 1000, 1),
            "wall time, s": round(spent.wall, 1),
            "CPU time, s": round(spent.cpu, 1),
            "peak memory, GB": round(spent.peak_bytes / 2**30, 2),
        }
    )
    print(results.tables[-1]["rows"][-1], flush=True)


def main():
    """Measure the kinds that are named, or all."""
    every = (*KINDS, *BY_NAME_ONLY)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(every))
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS)
    parser.add_argument("--out", type=Path, help="new folder in which the runs stay")
    options = parser.parse_args()
    if unknown := set(options.kinds) - set(every):
        parser.error(f"KIND: expected {', '.join(every)}, received {', '.join(unknown)}")
    kinds = options.kinds or KINDS
    apart = [kind for kind in kinds if kind in BY_NAME_ONLY]
    title = f"Models on {', '.join(apart) or 'several kinds of objects'}"
    results = Results("_".join(["models", *apart]), title, MEASURED)
    results.table("Images, size, time and memory")
    with ExitStack() as stack:
        root = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for kind in kinds:
            absent = [name for name in NEEDED.get(kind, ()) if not (DATA / name).is_file()]
            if absent:
                print(f"{kind}: skipped: {DATA / absent[0]} not found", flush=True)
                continue
            capture = simulated(kind, root / kind)
            for model in options.models:
                measure(results, kind, model, capture, root / kind / model)
    print(results.write())


if __name__ == "__main__":
    main()
