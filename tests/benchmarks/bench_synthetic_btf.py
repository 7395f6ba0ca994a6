"""Frames of a synthetic BTF from its reflectance alone: section 5.1 of the paper.

A relief of 124 x 90 texels with cosine-modulated tangents and one anisotropic material is seen
from 81 directions under 81 lights. Prints times, memory and errors of the harmonic search
alone and with the refinement, for clean samples, for noise and for unobserved ones, and how
many unaligned components equal two aligned ones (the paper: 20). Draws what its figures 4, 5
and 6 show.

    python tests/benchmarks/bench_synthetic_btf.py [--size 124 90] [-o synthetic_btf]

The aligned matrix holds the material as it would be sampled from the same 81 directions in
the recovered frames, so its components tell the error of the frames and nothing else.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib
import numpy as np
from benchmarks.measuring import Results, spent
from matplotlib.colors import LogNorm

from reflfield.alignment import align
from reflfield.report.plots import SERIES_COLOURS
from reflfield.reproduction.paper_scene import (
    ashikhmin_shirley,
    dome_directions,
    frame_errors,
    relief_frames,
    sample_texels,
    with_the_truths_tangents,
)

matplotlib.use("Agg")
from matplotlib import pyplot

# Texels whose singular values are computed, as many as in the trial that counted 72.
MATRIX_TEXELS = 2000
STAGES = {"harmonic": False, "refined": True}
MEASURED = ("reflfield.alignment",)


class Recovered(NamedTuple):
    """Frames that one stage recovered, and what it took from the samples on."""

    local_from_base: np.ndarray
    cost: dict  # time of all that it needs, and peak memory


def part(stage, texels):
    """Frames of some texels."""
    return stage._replace(local_from_base=stage.local_from_base[texels])


def degraded(samples, noise, unobserved):
    """Samples with noise, in shares of their deviation, and with some of them missing."""
    rng = np.random.default_rng(1)
    deviation = samples.std()
    out = samples.copy()
    # Texel by texel: a second array of this size is not needed.
    for texel in out if noise or unobserved else ():
        texel += noise * deviation * rng.standard_normal(texel.shape, np.float32)
        texel[rng.random(texel.shape, np.float32) < unobserved] = np.nan
    return out


def recovered(samples, directions, truth, n_threads):
    """Frames after each stage."""
    stages = {}
    for stage, refine in STAGES.items():
        result, cost = spent(
            lambda how=refine: align(
                samples, directions, directions, refine=how, n_threads=n_threads
            )
        )
        frames = with_the_truths_tangents(result.local_from_base, truth)
        stages[stage] = Recovered(frames, cost)
    return stages


def show(condition, stages, truth, results):
    """Rows of the table of times and errors."""
    for stage, (frames, cost) in stages.items():
        normals, tangents = frame_errors(frames, truth)
        shown = " | ".join(f"{value:.2f}" for value in cost.values())
        print(
            f"| {condition} | {stage} | {shown} | {normals.mean():.3f} | "
            f"{np.median(normals):.3f} | {np.percentile(normals, 95):.3f} | "
            f"{tangents.mean():.3f} | {np.percentile(tangents, 95):.3f} |",
            flush=True,
        )
        results.add(
            {
                "samples": condition,
                "stage": stage,
                "normals, mean": normals.mean(),
                "normals, 95 %": np.percentile(normals, 95),
                "tangents, mean": tangents.mean(),
                "tangents, 95 %": np.percentile(tangents, 95),
                **cost,
            }
        )


# --- components -----------------------------------------------------------------------------


def in_recovered_frames(truth, local_from_base, directions):
    """(n, k * k): the material sampled from the directions of the recovered frames."""
    base = directions @ local_from_base
    local = np.matmul(base, np.swapaxes(truth, 1, 2))
    parts = [
        ashikhmin_shirley(part, part).astype(np.float32).reshape(len(part), -1)
        for part in np.array_split(local, max(1, len(local) // 128))
    ]
    return np.concatenate(parts)


def singular_values(matrix):
    """Of a matrix with few rows, largest first."""
    squares = np.linalg.eigvalsh(matrix.astype(np.float64) @ matrix.T.astype(np.float64))
    return np.sqrt(squares[::-1].clip(0))


def matrices(truth, stages, directions):
    """The data matrix (texels, pairs of directions) unaligned and after each stage."""
    upright = np.tile(np.eye(3), (len(truth), 1, 1))
    frames = {"unaligned": upright} | {
        name: one.local_from_base for name, one in stages.items()
    }
    return {
        name: in_recovered_frames(truth, frame, directions) for name, frame in frames.items()
    }


def residual(values):
    """Share of the energy that 1, 2, .. components leave."""
    return 1.0 - np.cumsum(values**2) / np.sum(values**2)


def equal_components(values, stage, n=2):
    """How many unaligned components leave no more energy than n aligned ones."""
    left = residual(values[stage])[n - 1]
    return int(np.argmax(residual(values["unaligned"]) <= left)) + 1


# --- figures --------------------------------------------------------------------------------


def draw_matrix(truth, stages, directions, width, path):
    """Figure 4: the data matrix before and after, with zooms that show features line up."""
    height = len(truth) // width
    rows = (height // 4, height // 2, 3 * height // 4)
    texels = np.concatenate([np.arange(width) + row * width for row in rows])
    some = {name: part(one, texels) for name, one in stages.items()}
    shown = matrices(truth[texels], some, directions)
    top = np.percentile(shown["unaligned"], 99.5)
    figure, axes = pyplot.subplots(
        2, 2, figsize=(13, 9), layout="constrained", width_ratios=(3, 2)
    )
    n = len(directions)
    zoom = slice(30 * n, 33 * n)
    for line, name in zip(axes, ("unaligned", "refined"), strict=True):
        matrix = np.sqrt(shown[name].T.clip(0, top) / top)
        options = {"aspect": "auto", "cmap": "gray", "vmin": 0, "vmax": 1}
        line[0].imshow(matrix, **options, interpolation="antialiased")
        line[0].set_title(f"{name}: {len(rows)} lines of the map")
        line[1].imshow(matrix[zoom, :width], **options, interpolation="nearest")
        line[1].set_title("three of the views, first line")
        for axis in line:
            axis.set(xlabel="texel", ylabel="view and light")
    figure.suptitle(
        "Figure 4: features of the reflectance become horizontal once every texel is sampled "
        "in its own frame"
    )
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def draw_singular_values(values, path, most=100):
    """Figure 5: how fast singular values fall."""
    figure, axes = pyplot.subplots(figsize=(8, 5), layout="constrained")
    styles = zip(values.items(), SERIES_COLOURS, ("-", "--", "-."), strict=False)
    for (name, one), colour, style in styles:
        count = np.arange(1, min(most, len(one)) + 1)
        axes.semilogy(count, one[: len(count)] / one[0], style, color=colour, label=name, lw=2)
    axes.set(
        xlabel="component", ylabel="singular value over the largest",
        title="Figure 5: singular values; two refined components leave as little energy as "
        f"{equal_components(values, 'refined')} unaligned ones",
        ylim=(1e-6, 1.5),
    )  # fmt: skip
    axes.title.set_fontsize(10)
    axes.grid(True, alpha=0.3)
    axes.legend(title="lower is better")
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def draw_maps(truth, stages, width, path):
    """Figure 6: maps of normals and tangents, true and recovered, and their errors."""
    shape = (len(truth) // width, width)
    figure, axes = pyplot.subplots(4, 3, figsize=(14, 13), layout="constrained")
    columns = {"true": truth} | {name: one.local_from_base for name, one in stages.items()}
    for column, (name, frames) in zip(axes.T, columns.items(), strict=True):
        normals = frames[:, 2].reshape(*shape, 3)
        column[0].imshow(0.5 + 0.5 * normals.clip(-1, 1))
        column[0].set_title(f"normals, {name} (RGB = (n + 1) / 2)")
        angle = np.rad2deg(np.arctan2(frames[:, 0, 1], frames[:, 0, 0])) % 180.0
        shown = column[2].imshow(angle.reshape(shape), cmap="twilight", vmin=0, vmax=180)
        column[2].set_title(f"tangents, {name}: azimuth of the axis, degrees")
        figure.colorbar(shown, ax=column[2], shrink=0.75)
        if name == "true":
            column[1].axis("off")
            column[3].axis("off")
            continue
        for axis, errors, what in zip(
            column[1::2], frame_errors(frames, truth), ("normals", "tangents"), strict=True
        ):
            shown = axis.imshow(
                errors.reshape(shape).clip(1e-3), cmap="cividis", norm=LogNorm(1e-3, 30)
            )
            figure.colorbar(shown, ax=axis, shrink=0.75, label="degrees")
            axis.set_title(f"error of {what}, {name}: mean {errors.mean():.3f} degrees")
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    figure.suptitle(
        "Figure 6: frames recovered from reflectance alone (darker error is better)"
    )
    figure.savefig(path, dpi=90)
    pyplot.close(figure)


def draw(truth, stages, directions, width, folder, results):
    """All figures, and the count of components."""
    some = np.unique(np.linspace(0, len(truth) - 1, min(MATRIX_TEXELS, len(truth))).astype(int))
    sampled = matrices(
        truth[some],
        {name: part(one, some) for name, one in stages.items()},
        directions,
    )
    values = {name: singular_values(matrix) for name, matrix in sampled.items()}
    results.table("Unaligned components that leave as little energy as two aligned ones")
    for stage in STAGES:
        equal = equal_components(values, stage)
        left = residual(values[stage])[1]
        results.add({"stage": stage, "energy left by two": left, "unaligned ones": equal})
        print(
            f"{stage}: two aligned components leave {residual(values[stage])[1]:.2e} of the "
            f"energy, as {equal_components(values, stage)} unaligned ones"
        )
    folder.mkdir(parents=True, exist_ok=True)
    draw_matrix(truth, stages, directions, width, folder / "figure_4_data_matrix.png")
    draw_singular_values(values, folder / "figure_5_singular_values.png")
    draw_maps(truth, stages, width, folder / "figure_6_maps.png")
    print(folder)


def main() -> None:
    """Align under all conditions, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(124, 90), help="of the map")
    parser.add_argument("--noise", type=float, default=0.02, help="share of the deviation")
    parser.add_argument("--unobserved", type=float, default=0.5, help="share of the samples")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, default=Path("synthetic_btf"))
    options = parser.parse_args()
    truth, directions = relief_frames(*options.size), dome_directions()
    results = Results("synthetic_btf", "The paper's synthetic scene", MEASURED)
    results.table(f"{len(truth)} texels, errors in degrees")
    samples = sample_texels(truth, directions, directions)
    # Compile the kernels before the clock starts.
    align(samples[:2], directions, directions)
    print(
        f"{len(samples)} texels, errors in degrees\n"
        "| samples | stage | s | CPU s | GB | normals | median | 95 % | tangents | 95 % |\n"
        "|---|---|---|---|---|---|---|---|---|---|"
    )
    clean = recovered(samples, directions, truth, options.threads)
    show("clean", clean, truth, results)
    for name, noise, unobserved in (
        (f"noise {options.noise:.0%}", options.noise, 0.0),
        (f"{options.unobserved:.0%} unobserved", 0.0, options.unobserved),
    ):
        if noise or unobserved:
            worse = degraded(samples, noise, unobserved)
            show(name, recovered(worse, directions, truth, options.threads), truth, results)
    draw(truth, clean, directions, options.size[0], options.output, results)
    print(results.write())


if __name__ == "__main__":
    main()
