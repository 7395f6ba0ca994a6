"""A small made-up result that fills every section of the report."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.metrics.completion_error import CompletionError
from reflfield.metrics.frame_errors import FrameErrors
from reflfield.metrics.hull_distance import HullDistance
from reflfield.metrics.image_metrics import ImagePair, compare_images
from reflfield.report import sections
from reflfield.report.page import ReportContent


def disk(size, radius):
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return np.clip(radius - np.hypot(x, y) + 0.5, 0, 1)


def shaded_ball(size, light, rng=None, noise=0.0):
    """Return a glossy ball and its silhouette."""
    y, x = (np.mgrid[:size, :size] - (size - 1) / 2) / (0.4 * size)
    z = np.sqrt(np.clip(1 - x**2 - y**2, 0, None))
    cosine = np.clip(np.stack([x, -y, z], axis=-1) @ light, 0, None)
    texture = 0.5 + 0.4 * np.sin(9 * x)[..., None] * np.array([1, 0.6, 0.2])
    image = texture * cosine[..., None] + 1.5 * cosine[..., None] ** 60
    if noise:
        image = image + rng.normal(0, noise, image.shape)
    silhouette = disk(size, 0.4 * size)
    return image * silhouette[..., None], silhouette


def frame_pairs(rng, count=10, size=64, prefix="heldout_"):
    pairs = []
    for i in range(count):
        light = np.array([np.cos(i), np.sin(i), 1.5]) / np.sqrt(3.25)
        photograph, silhouette = shaded_ball(size, light)
        relit, _ = shaded_ball(size, light, rng, noise=0.01 * (i + 1))
        pairs.append(ImagePair(f"{prefix}{i:03d}", photograph, relit, silhouette))
    return pairs


def atlas(side=64):
    """Return texel_of_pixel and the chart of each texel: two round charts."""
    half = side // 2
    chart = np.full((side, side), -1)
    chart[:half, :half][disk(half, half / 2 - 2) > 0.5] = 0
    chart[half:, half:][disk(half, half / 2 - 2) > 0.5] = 1
    texel_of_pixel = np.full((side, side), -1)
    texel_of_pixel[chart >= 0] = np.arange((chart >= 0).sum())
    return texel_of_pixel, chart[chart >= 0]


def full_content(rng, title="vase", prefix="heldout_"):
    pairs = frame_pairs(rng, prefix=prefix)
    comparison = compare_images(pairs)
    texels, charts = atlas()
    n = len(charts)
    base = Rotation.random(n, random_state=rng).as_matrix()
    local = Rotation.from_rotvec(rng.normal(0, 0.1, (n, 3))).as_matrix() @ base
    errors = [
        FrameErrors(np.arange(n), np.abs(rng.normal(0, s, n)), np.abs(rng.normal(0, 3 * s, n)),
                    np.zeros(n, int))
        for s in (1.0, 6.0)
    ]  # fmt: skip
    views = [
        sections.SilhouetteView(f"{prefix}v{i:03d}", partial(getattr, p, "photograph"),
                                p.silhouette, disk(64, 0.4 * 64 + (i - 3) * 0.5))
        for i, p in enumerate(pairs)
    ]  # fmt: skip
    stages = [
        sections.StageSummary("hull", 12.4, 8 * 10**8, {"silhouettes": 36, "vertices": 10002},
                              10**6),
        sections.StageSummary("observations", 75.0, 2 * 10**9,
                              {"photographs": 1024, "samples": 33_000_000}, 2 * 10**8,
                              reused=True),
    ]  # fmt: skip
    return ReportContent(
        title=title,
        subtitle="10 views x 10 lights, simulated.",
        key_numbers=sections.key_numbers(
            comparison, file_bytes=812_000, raw_bytes=4 * 10**8, seconds=143.0
        ),
        sections=(
            sections.held_out_section(comparison, pairs, max_rows=4),
            sections.silhouettes_section(views, origin="simulated"),
            sections.atlas_section(texels, charts, rng.uniform(0, 1, (n, 3)), {"charts": 2}),
            sections.coverage_section(
                texels, rng.integers(0, 20, n), rng.integers(3, 10, n)
            ),
            sections.normals_section(texels, local, base),
            sections.ablation_section(
                [sections.FieldVariant("with alignment", {"a": comparison}, 812_000, 0.1, 0.05),
                 sections.FieldVariant("without", {"a": comparison}, 809_000, 0.2, 0.07)],
                [pairs, pairs],
            ),
            sections.alignment_section([0.80, 0.91, 0.94, 0.945], rng.exponential(0.1, n)),
            sections.truth_section(
                surfaces={
                    "hull": HullDistance(rng.normal(0.001, 0.001, 2000), voxel=0.002),
                    "surface from normals": HullDistance(rng.normal(0.0, 0.001, 2000)),
                },
                frames=errors[0],
                base_frames=errors[1],
                completion=CompletionError(0.08, 0.05, 0.06, 0.04, 40_000, 60_000),
                comparison=comparison,
            ),
            sections.rate_distortion_section(
                [
                    sections.RatePoint("with alignment", 800_000, 31.0, 30.5),
                    sections.RatePoint("with alignment", 200_000, 28.0, 27.0),
                    sections.RatePoint("without alignment", 800_000, 30.0, None),
                ]
            ),
            sections.compression_section(
                {"coefficients": 500_000, "basis": 250_000, "frames": 62_000},
                4 * 10**8,
            ),
            sections.stages_section(stages),
            sections.run_section(
                {"hull": {"resolution": 128}, "seed": 0}, {"reflfield": "0.1", "numpy": "2.4"}
            ),
        ),
        warnings=("2 texels were never observed.",),
        footer="reflfield 0.1",
    )  # fmt: skip


@pytest.fixture(scope="session")
def samples():
    """Return the makers above."""
    return SimpleNamespace(
        disk=disk, frame_pairs=frame_pairs, atlas=atlas, full_content=full_content
    )
