"""RTI: one view under many lights, against polynomial textures, harmonics and interpolation.

    python tests/benchmarks/bench_rti.py                  # 800 x 800 x 64, lion, gray sphere
    python tests/benchmarks/bench_rti.py plate --side 256
    python tests/benchmarks/bench_rti.py scale --side 400 800 1789     # .16 to 3.2 megapixels
    python tests/benchmarks/bench_rti.py scale --side 800 3464 --max-memory 14GB

`plate` is the simulated `rti_plate`, `lion` is rti_loewenkopf of the test data, `gray` the matt
sphere of uw_photometric_stereo. `reflfield run` makes a field of all but some held-out lights
in a process of its own. The same photographs are fitted here, pixel by pixel: polynomial
texture maps (6 terms of the light's direction) and hemispherical harmonics of orders 3 and 4 (9
and 16), by least squares of the encoded values; and thin-plate interpolation over the light's
direction, of all photographs and of as many principal components as the field has bytes for a
pixel. All are measured on the held-out photographs by the same code. Terms are counted as one
byte each.

Normals are those of the field, beside the least-squares ones of a matt surface. The truth of
the plate is the simulator's; that of the sphere is its outline's. The lights of the sphere's
set are those of its lights.txt; rows beside them have those of its chrome sphere, as
`reflfield lights` finds them, and those that fit the sphere's true normals best, which nobody
has: what a matt surface can reach with any lights. So do normals by regression on the truth,
linear in the values and quadratic in their ratios: what can be reached without a model of
light at all.

`scale` measures time, CPU time and memory of the plate at several sizes, without held-out
lights; photographs of more than 800 pixels a side are those of 800, each pixel many times.
Writes results/rti.json, `scale` results/rti_scale.json.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import RBFInterpolator

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(HERE.parent), str(ROOT)]

from benchmarks.bench_captures import ran  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

from reflfield.alignment.photometric_normals import photometric_normals  # noqa: E402
from reflfield.api.light_calibration import (  # noqa: E402
    light_references,
    lights_of_photographs,
)
from reflfield.capture.encoding import decode_srgb, encode_srgb  # noqa: E402
from reflfield.capture.lights import facing_irradiance  # noqa: E402
from reflfield.capture.readers import open_capture  # noqa: E402
from reflfield.field.file import open_field  # noqa: E402
from reflfield.metrics.frame_errors import angle_deg  # noqa: E402
from reflfield.metrics.image_metrics import common_exposure, compare_images  # noqa: E402
from reflfield.options import HoldOut, Resources  # noqa: E402
from reflfield.pipeline import results as stage_results  # noqa: E402
from reflfield.pipeline import stages  # noqa: E402
from reflfield.pipeline.comparison import relit_pairs  # noqa: E402
from tests.large_captures import enlarged_capture  # noqa: E402

DATA = Path(os.environ.get("REFLFIELD_DATA", ROOT.parent / "shared" / "data"))
HELD_OUT = {"plate": 6, "lion": 24, "gray": 2}
FOLDERS = {"lion": "rti_loewenkopf", "gray": "uw_photometric_stereo/gray"}
# Share of a photograph's brightest value above which a matt surface faces the light.
MATT_SHARE = 0.15
# Share of the sphere's radius within which its normals count: beyond, pixels mix with the
# backdrop and no light reaches most of it.
SPHERE_SHARE = 0.95
# Pixels of a side that the simulator makes; it needs 3 GB of memory for them.
LARGEST_SIMULATED = 800
SCENE = ROOT / "capture_sim" / "scenes" / "rti_plate.toml"


# --- fitted here --------------------------------------------------------------------------


def polynomial_terms(directions):
    """The six terms of polynomial texture maps (Malzbender et al., SIGGRAPH 2001)."""
    x, y, _ = directions.T
    return np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], axis=1)


def harmonic_terms(directions, order):
    """Hemispherical harmonics below an order (Gautron et al., EGSR 2004): order**2 terms."""
    from scipy.special import sph_harm_y

    z = np.clip(directions[:, 2], 0, 1)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    # Cosines 0 to 1 of the hemisphere are stretched to -1 to 1 of the sphere.
    polar = np.arccos(2 * z - 1)
    terms = []
    for ell in range(order):
        for m in range(-ell, ell + 1):
            value = sph_harm_y(ell, abs(m), polar, azimuth)
            terms.append(value.imag if m < 0 else value.real)
    return np.stack(terms, axis=1)


def by_terms(terms):
    """Predictor by least squares in some terms of the light's direction."""

    def predict(directions, values, asked):
        return terms(asked) @ np.linalg.lstsq(terms(directions), values, rcond=None)[0]

    return predict


def interpolated(directions, values, asked):
    """Thin-plate interpolation over the light's direction."""
    plate = RBFInterpolator(
        directions[:, :2], values, kernel="thin_plate_spline", smoothing=1e-6
    )
    return plate(asked[:, :2])


def by_components(n_components):
    """Thin-plate interpolation of principal components of all photographs."""

    def predict(directions, values, asked):
        mean = values.mean(axis=0)
        _, vectors = np.linalg.eigh((values - mean) @ (values - mean).T)
        basis = vectors[:, ::-1][:, :n_components]
        planes = basis.T @ (values - mean)
        return mean + interpolated(directions, basis, asked) @ planes

    return predict


def methods(field_bytes):
    """Predictors by name, with the bytes that they take for a pixel; `field_bytes` is ours."""
    n = max(1, round(field_bytes))
    return {
        "polynomial (PTM)": (by_terms(polynomial_terms), 18),
        "harmonics, order 3": (by_terms(lambda d: harmonic_terms(d, 3)), 27),
        "harmonics, order 4": (by_terms(lambda d: harmonic_terms(d, 4)), 48),
        f"interpolated, {n} components": (by_components(n), n),
        "interpolated, all photographs": (interpolated, None),
    }


# --- measured -----------------------------------------------------------------------------


class Photographs:
    """Photographs of one view as radiance over irradiance, encoded."""

    def __init__(self, capture, white):
        camera = capture.cameras[0]
        rows, columns = np.mgrid[: camera.height, : camera.width]
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5
        origins, towards = camera.rays(pixels)
        points = origins - (origins[:, 2:] / towards[:, 2:]) * towards
        centre = points.mean(axis=0, keepdims=True)
        lights = [capture.lights[p.light] for p in capture.photographs]
        self.directions = np.concatenate([light.directions(centre) for light in lights])
        self.irradiance = facing_irradiance(tuple(lights), points)
        self.shape = (camera.height, camera.width, 3)
        self.white = white
        self.capture = capture

    def encoded(self):
        """(n_photographs, n_pixels * 3)."""
        rows = []
        for i in range(len(self.capture.photographs)):
            radiance = self.capture.read_kinds(i)[0].reshape(-1, 3)
            sample = radiance / np.maximum(self.irradiance[:, i], 1e-12) / self.white
            rows.append(encode_srgb(np.clip(sample, 0, 1)).astype(np.float32).ravel())
        return np.stack(rows)

    def decoded(self, index, values):
        """Radiance (height, width, 3) of a photograph from encoded values."""
        sample = decode_srgb(np.clip(values, 0, 1)).reshape(-1, 3) * self.white
        return (sample * self.irradiance[:, index]).reshape(self.shape).astype(np.float32)


def white_of(capture):
    """What samples are divided by before they are encoded: their 99.5th percentile."""
    photographs = Photographs(capture, 1.0)
    values = [
        capture.read_kinds(i)[0].reshape(-1, 3)
        / np.maximum(photographs.irradiance[:, i], 1e-12)
        for i in range(0, len(capture.photographs), 4)
    ]
    return float(np.quantile(np.concatenate(values), 0.995))


def compare_methods(results, name, context, field_bytes):
    """Rows of our field and of the others on the held-out photographs."""
    pairs = relit_pairs(context)["heldout"]
    exposure = common_exposure((p.photograph, p.counted) for p in pairs)
    ours = compare_images(pairs, exposure)
    n_pixels = len(stage_results.measured_texels(context))
    each = field_bytes / n_pixels
    add_row(results, name, "this field", each, ours)
    white = white_of(context.training)
    made, asked = Photographs(context.training, white), Photographs(pairs.capture, white)
    values = made.encoded()
    for method, (predict, n_bytes) in methods(each).items():
        shown = predict(made.directions, values, asked.directions)
        relit = [
            replace(pair, relit=asked.decoded(i, shown[i])) for i, pair in enumerate(pairs)
        ]
        n_bytes = 3 * len(made.directions) if n_bytes is None else n_bytes
        add_row(results, name, method, n_bytes, compare_images(relit, exposure))


def add_row(results, name, method, n_bytes, compared):
    """One row of the table of images."""
    mean = compared.mean
    row = {
        "photographs": name,
        "method": method,
        "bytes a pixel": round(n_bytes, 1),
        "PSNR, dB": round(mean["psnr_ldr"], 2),
        "SSIM": round(mean["ssim"], 4),
        "FLIP": round(mean["flip"], 4),
    }
    results.add(row)
    print(json.dumps(row), flush=True)


def matt_normals(luminance, lights):
    """Normals (n, 3) of a matt surface by least squares: (n, k) values, (n, k, 3) lights."""
    gram = np.einsum("njd,nje->nde", lights, lights)
    right = np.einsum("njd,nj->nd", lights, luminance)
    return unit(np.linalg.solve(gram, right[..., None])[..., 0])


def unit(vectors):
    """Vectors (n, k) of length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


def chrome_lights(capture):
    """Directions (n_photographs, 3) that the chrome sphere beside the gray one shows."""
    folder = capture.root.parent / "chrome"
    covered = cv2.imread(str(folder / "chrome.mask.png"), cv2.IMREAD_GRAYSCALE) > 127
    rows, columns = np.nonzero(covered)
    circle = (
        0.5 * (columns.min() + columns.max() + 1),
        0.5 * (rows.min() + rows.max() + 1),
        0.25 * (np.ptp(rows) + np.ptp(columns) + 2),
    )
    files = [
        folder / photograph.path.name.replace("gray", "chrome")
        for photograph in capture.photographs
    ]
    references = light_references([",".join(f"{number:.2f}" for number in circle)])
    found, _ = lights_of_photographs(files, references, encoding="linear")
    by_name = {light.name: light.direction for light in found}
    return np.stack([by_name[file.name] for file in files])


def sphere_normals(context, luminance, truth):
    """Normals of the gray sphere by other lights than its file's, by what they are."""
    pairs = stage_results.base_reader(context).store.observed.pairs
    photographs = [context.training.photographs[i] for i in range(len(pairs))]
    chrome = chrome_lights(context.training)[[p.light for p in photographs]]
    # Of a matt surface: values above the shade are those of lights in front of it.
    bright = luminance > MATT_SHARE * luminance.max(axis=0)
    fitted = [
        np.linalg.lstsq(truth[lit], values[lit], rcond=None)[0]
        for values, lit in zip(luminance.T, bright.T, strict=True)
    ]
    n, upright = len(luminance), np.array([0.0, 0.0, 1.0])
    view = np.tile(upright, (n, 1))
    several = {"lights of the chrome sphere": chrome, "lights that fit the truth": unit(fitted)}
    shown = {}
    for lights_of, directions in several.items():
        lights = np.tile(directions, (n, 1, 1))
        found, _ = photometric_normals(luminance, lights, view, view)
        shown[f"as this field, {lights_of}"] = found
        shown[f"matt, least squares, {lights_of}"] = matt_normals(luminance, lights)
    values = np.column_stack([luminance, np.ones(n)])
    ratios = unit(luminance)
    i, j = np.triu_indices(ratios.shape[1])
    squares = np.column_stack([np.ones(n), ratios, ratios[:, i] * ratios[:, j]])
    for terms, columns in (("values", values), ("ratios, quadratic", squares)):
        normals = columns @ np.linalg.lstsq(columns, truth, rcond=None)[0]
        shown[f"regression on the truth, {terms}"] = unit(normals)
    return shown


def true_normals(name, context):
    """True normals (n, 3) of the texels, and which count."""
    camera, texels = context.training.cameras[0], stage_results.texels(context)
    pixels, _ = camera.project(texels.position)
    column, row = pixels.astype(int).T
    if name == "plate":
        truth = np.load(context.capture.root / "truth" / "views" / f"{camera.id}.npz")
        normals = truth["normal"][row, column].astype(np.float64)
        return normals, np.abs(normals).sum(axis=1) > 0
    covered = stage_results.silhouettes(context)[0] > 0.5
    rows, columns = np.nonzero(covered)
    radius = 0.25 * (np.ptp(rows) + np.ptp(columns) + 2)
    x = (pixels[:, 0] - 0.5 * (columns.min() + columns.max() + 1)) / radius
    y = (0.5 * (rows.min() + rows.max() + 1) - pixels[:, 1]) / radius
    square = x * x + y * y
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - square, 0))], axis=1)
    return normals, square < SPHERE_SHARE**2


def compare_normals(results, name, context):
    """Rows of the field's normals and of those of a matt surface, against the truth."""
    truth, counted = true_normals(name, context)
    measured = np.zeros(len(truth), bool)
    measured[stage_results.measured_texels(context)] = True
    chosen = np.flatnonzero(counted & measured)
    field = open_field(stage_results.field_file(context))
    samples = stage_results.base_reader(context).measured(chosen)
    # Values that were not measured are below the first code.
    luminance = np.nan_to_num(samples.samples.astype(np.float32)).mean(axis=2)
    lights = samples.lights[:, samples.pairs.light]
    shown = {
        "this field": field.local_from_world[chosen, 2],
        "matt, least squares": matt_normals(luminance, lights),
    }
    if name == "gray":
        shown |= sphere_normals(context, luminance, truth[chosen])
    for method, normals in shown.items():
        errors = angle_deg(normals, truth[chosen])
        lean = np.degrees(np.linalg.norm((normals - truth[chosen]).mean(axis=0)[:2]))
        row = {
            "photographs": name,
            "normals": method,
            "mean error, degrees": round(float(errors.mean()), 2),
            "median": round(float(np.median(errors)), 2),
            "common lean, degrees": round(float(lean), 2),
        }
        results.add(row)
        print(json.dumps(row), flush=True)


# --- runs ---------------------------------------------------------------------------------


def simulated(side, folder):
    """Folder of the plate at so many pixels a side."""
    folder.mkdir(parents=True, exist_ok=True)
    if side > LARGEST_SIMULATED:
        return enlarged(side, folder)
    text = SCENE.read_text()
    for name in ("width", "height"):
        text = text.replace(f"{name} = 256", f"{name} = {side}")
    (folder / "plate.toml").write_text(text)
    capture = folder / "capture"
    if not (capture / "capture.json").is_file():
        limits = ("--workers", 1, "--max-memory", "6GB")
        words = ("render", folder / "plate.toml", "-o", capture, *limits)
        ran("capture_sim", words, folder / "sim.log")
    return capture


def enlarged(side, folder):
    """Folder of the largest simulated plate with its pixels repeated."""
    capture = folder / f"enlarged_{side}"
    if not (capture / "capture.json").is_file():
        shutil.rmtree(capture, ignore_errors=True)
        source = simulated(LARGEST_SIMULATED, folder / "simulated")
        enlarged_capture(source, capture, side, views=(0,), lights=range(64))
    return capture


def run(capture, folder, n_lights, workers):
    """Time of a whole run, and its context."""
    held_out = ("--hold-out", f"lights={n_lights}") if n_lights else ()
    words = ("run", capture, "-o", folder / "out", *held_out, "--workers", workers)
    spent = ran("reflfield", words, folder / "run.log")
    context = stages.run(
        open_capture(capture),
        folder / "out",
        hold_out=HoldOut(lights=n_lights),
        resources=Resources(workers=workers),
    )
    return spent, context


def add_time(results, name, spent, n_pixels, n_photographs):
    """Row of what a run took."""
    row = {
        "photographs": f"{name}, {n_pixels / 1e6:.2f} megapixels x {n_photographs}",
        "wall time, s": round(spent.wall, 1),
        "CPU time, s": round(spent.cpu, 1),
        "CPU time, us a pixel": round(spent.cpu / n_pixels * 1e6, 1),
        "peak memory, GB": round(spent.peak_bytes / 2**30, 2),
    }
    results.add(row)
    print(json.dumps(row), flush=True)


def measure(name, options, folder, results):
    """All tables of one set of photographs."""
    folder.mkdir(parents=True, exist_ok=True)
    simulates = name == "plate"
    capture = simulated(options.side[0], folder) if simulates else DATA / FOLDERS[name]
    if not capture.is_dir():
        print(f"{name}: skipped: {capture} not found: set REFLFIELD_DATA", flush=True)
        return
    spent, context = run(capture, folder, HELD_OUT[name], options.workers)
    results.table(f"{name}: time")
    n_photographs = len(context.capture.photographs)
    n_pixels = context.training.cameras[0].width * context.training.cameras[0].height
    add_time(results, name, spent, n_pixels, n_photographs)
    results.table(f"{name}: held-out lights")
    n_bytes = (folder / "out" / "field.rfld").stat().st_size
    compare_methods(results, name, context, n_bytes)
    if name != "lion":  # of which nobody knows the normals
        results.table(f"{name}: normals")
        compare_normals(results, name, context)


def measure_sizes(options, folder):
    """Rows of what runs of several sizes take."""
    results = Results("rti_scale", "RTI: time and memory by size", ["reflfield.cli"])
    results.table("sizes")
    for side in options.side:
        here = folder / str(side)
        capture = simulated(side, here)
        words = ("run", capture, "-o", here / "out", "--workers", options.workers)
        words = (*words, "--max-memory", options.max_memory)
        spent = ran("reflfield", words, here / "run.log")
        add_time(results, "plate", spent, side * side, 64)
    print(results.write())


def main():
    """Measure what is named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = (*HELD_OUT, "scale")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(names))
    parser.add_argument(
        "--side", type=int, nargs="+", default=[800], help="pixels of the plate"
    )
    parser.add_argument("--out", type=Path, help="folder in which captures and runs stay")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--max-memory", default="4GB", help="of the runs of `scale`")
    options = parser.parse_args()
    for name in options.names:
        if name not in names:
            parser.error(f"NAME: expected {', '.join(names)}, received {name}")
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        if "scale" in options.names:
            measure_sizes(options, folder)
            return
        results = Results("rti", "RTI: one view under many lights", ["reflfield.cli"])
        for name in options.names or HELD_OUT:
            measure(name, options, folder / name, results)
        print(results.write())


if __name__ == "__main__":
    main()
