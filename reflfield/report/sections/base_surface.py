"""Sections on the surface: silhouettes, atlas, coverage, normals."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.render.exposure import COVERAGE_OF_OBJECT, ExposureMeter, encoded_picture
from reflfield.report import pictures, plots
from reflfield.report.page import (
    Cell,
    ColourBar,
    Figure,
    Item,
    Panel,
    Picture,
    Section,
    Table,
    encode_picture,
)
from reflfield.util.blas_threads import thread_pool
from reflfield.util.image_boxes import bounding_box

SHEET_PX = 360
ATLAS_PX = 720


@dataclass(frozen=True, eq=False)
class SilhouetteView:
    """One view for `silhouettes_section`.

    Attributes
    ----------
    name : str
    photograph : callable
        Gives linear radiance (h, w, 3) under any light; called where it is shown.
    silhouette, hull_silhouette : (h, w) float
        Coverage as photographed, and of the hull seen by the same camera.
    """

    name: str
    photograph: Callable[[], NDArray[Any]]
    silhouette: NDArray[Any]
    hull_silhouette: NDArray[Any]


def silhouettes_section(
    views: Sequence[SilhouetteView],
    *,
    origin: str = "",
    workers: int = 1,
    max_pictures: int = 12,
    left_out: Collection[str] = (),
    carved: float = 0.0,
) -> Section:
    """Silhouettes against the hull: outlines over photographs, agreement per view.

    Parameters
    ----------
    views : sequence of SilhouetteView
        Those that are shown are asked for twice.
    origin : str
        Where the silhouettes came from, such as "found by GrabCut".
    workers : int
        Threads, each of which asks for a view.
    max_pictures : int
        Views with the lowest IoU are shown.
    left_out : collection of str
        Names of views that are excluded from the hull.
    carved : float
        Share of the hull's volume that was carved because photographs contradict it.

    Returns
    -------
    Section
    """
    with thread_pool(workers) as pool:
        agreements = pool.map(
            lambda number: (*_agreement(views[number]), number), range(len(views))
        )
        rows = sorted(agreements, key=lambda row: (row[1], row[0]))
    shown = [
        Panel(_overlay(views[number]), f"{name} · IoU {iou:.3f}")
        for name, iou, *_, number in rows[:max_pictures]
    ]
    figure = Figure(
        tuple(shown),
        "Views with the lowest IoU come first. The two outlines should coincide. Red areas "
        "were carved away although the photograph shows the object there (a wrong camera "
        "pose, or a silhouette that is too small in another view); yellow areas are hull "
        "where the photograph shows backdrop.",
        legend=_legend(
            (pictures.SILHOUETTE_COLOUR, "silhouette"),
            (pictures.HULL_COLOUR, "hull"),
            (pictures.MISSING_COLOUR, "missing from the hull"),
            (pictures.EXCESS_COLOUR, "hull beyond the silhouette"),
        ),
    )
    table = Table(
        ("view", "IoU", "missing, %", "beyond, %"),
        tuple(
            (
                _marked(name, left_out),
                f"{iou:.4f}",
                f"{100 * missing:.2f}",
                f"{100 * beyond:.2f}",
            )
            for name, iou, missing, beyond, _ in rows
        ),
        "Agreement per view: intersection over union; area missing from the hull and area "
        "beyond the silhouette, in percent of the silhouette.",
    )
    intro = f"Agreement of the silhouettes with the hull. Silhouettes: {origin or 'given'}."
    if rows:
        overlaps = [row[1] for row in rows]
        intro += f" IoU: median {np.median(overlaps):.3f}, least {min(overlaps):.3f}."
    if carved:
        intro += (
            f" Hollows that no silhouette shows, {carved:.0%} of the hull's volume, are carved "
            "where photographs contradict the hull."
        )
    return Section("Silhouettes and hull", intro, (figure, table))


def _marked(name: str, left_out: Collection[str]) -> str:
    """Name of a view, with a remark if the hull is made without it."""
    return f"{name} (excluded from the hull)" if name in left_out else name


def _agreement(view: SilhouetteView) -> tuple[str, float, float, float]:
    seen, hull = _covered(view.silhouette), _covered(view.hull_silhouette)
    area, union = max(1, int(seen.sum())), max(1, int((seen | hull).sum()))
    missing, beyond = int((seen & ~hull).sum()), int((hull & ~seen).sum())
    return view.name, int((seen & hull).sum()) / union, missing / area, beyond / area


def _covered(silhouette: NDArray[Any]) -> NDArray[np.bool_]:
    return np.asarray(silhouette >= COVERAGE_OF_OBJECT)


def _exposure_of(image: NDArray[Any], shown: NDArray[np.bool_]) -> float:
    """Exposure of an image that is not compared with another."""
    meter = ExposureMeter()
    meter.add(image, shown)
    return meter.exposure_or_one


def _overlay(view: SilhouetteView) -> Picture:
    covered = _covered(view.silhouette)
    hull = _covered(view.hull_silhouette)
    box = bounding_box(covered | hull, margin=8)
    photograph, seen = np.asarray(view.photograph())[box], covered[box]
    exposure = _exposure_of(photograph, seen)
    # Outlines are one pixel wide; on small photographs that would hide the gaps.
    factor = max(1, SHEET_PX // max(seen.shape))
    painted = pictures.silhouettes_overlay(
        pictures.enlarged(encoded_picture(photograph, exposure), factor),
        pictures.enlarged(np.asarray(view.silhouette)[box], factor),
        pictures.enlarged(np.asarray(view.hull_silhouette)[box], factor),
    )
    return encode_picture(pictures.fitted(painted, SHEET_PX))


def atlas_section(
    texel_of_pixel: ArrayLike,
    charts: ArrayLike,
    mean_sample: ArrayLike,
    facts: Mapping[str, Cell] | None = None,
) -> Section:
    """Atlas: layout by chart, mean texture, and facts about it.

    Parameters
    ----------
    texel_of_pixel : (h, w) array_like of int
        -1 for none.
    charts : (n_texels,) array_like of int
        Chart of each texel.
    mean_sample : (n_texels, 3) array_like
        Mean apparent reflectance of each texel, linear; NaN where unobserved.
    facts : mapping, optional
        Such as ``{"charts": 7, "texels": 65536, "stretch": 1.1}``.

    Returns
    -------
    Section
    """
    colours = np.asarray(mean_sample, dtype=np.float64)
    seen = np.isfinite(colours).all(axis=-1)
    exposure = _exposure_of(colours, np.asarray(seen))
    layout = pictures.texture(np.asarray(charts), texel_of_pixel, nothing=-1)
    figure = Figure(
        (
            _atlas_panel(pictures.labels_coloured(layout), texel_of_pixel, "charts"),
            _atlas_panel(
                encoded_picture(pictures.texture(colours, texel_of_pixel), exposure),
                texel_of_pixel,
                "mean over all views and lights",
            ),
        ),
        "Charts should be few and large. The mean texture should be sharp: doubled or "
        "blurred details indicate wrong camera poses or a hull that fills concavities. Grey "
        "texels were never observed.",
        min_width=280,
    )
    items: list[Item] = [figure]
    if facts:
        items.append(Table(("quantity", "value"), tuple(facts.items()), "Atlas in numbers."))
    intro = "UV charts of the surface, and the mean of the photographs projected onto them."
    return Section("Atlas", intro, tuple(items))


def coverage_section(
    texel_of_pixel: ArrayLike, views_per_texel: ArrayLike, lights_per_texel: ArrayLike
) -> Section:
    """Coverage: how many views and lights each texel was observed with.

    Parameters
    ----------
    texel_of_pixel : (h, w) array_like of int
    views_per_texel, lights_per_texel : (n_texels,) array_like of int

    Returns
    -------
    Section
    """
    counts = {"views": np.asarray(views_per_texel), "lights": np.asarray(lights_per_texel)}
    items: list[Item] = [_count_figure(texel_of_pixel, k, v) for k, v in counts.items()]
    items.append(
        Table(
            ("per texel", "none, % of texels", "median", "mean", "most"),
            tuple(
                (
                    k,
                    f"{100 * np.mean(v == 0):.2f}",
                    float(np.median(v)),
                    f"{v.mean():.1f}",
                    int(v.max()),
                )
                for k, v in counts.items()
                if v.size
            ),
            "Texels without any view are completed from similar texels.",
        )
    )
    intro = "Observed views and lights of each texel; the rest is completed from other texels."
    return Section("Coverage", intro, tuple(items))


def _count_figure(texel_of_pixel: ArrayLike, name: str, counts: NDArray[Any]) -> Figure:
    most = max(1, int(counts.max(initial=1)))
    laid_out = pictures.texture(counts.astype(np.float64), texel_of_pixel)
    plot = plots.histogram(
        {name: counts}, f"{name} per texel", "texels, %", limits=(-0.5, most + 0.5),
        n_bins=min(most + 1, 60),
    )  # fmt: skip
    return Figure(
        (
            _atlas_panel(
                pictures.false_colour(laid_out, 0, most), texel_of_pixel, f"{name} per texel"
            ),
            Panel(plot, f"distribution of {name} per texel"),
        ),
        f"Dark texels were observed with few {name}: mostly concavities and the underside.",
        colour_bar=ColourBar("viridis", 0, most, f"{name} per texel"),
        min_width=280,
    )


def normals_section(
    texel_of_pixel: ArrayLike,
    local_from_world: ArrayLike,
    base_from_world: ArrayLike,
) -> Section:
    """Aligned local frames: normals, tangents, and their rotation from the hull's.

    Parameters
    ----------
    texel_of_pixel : (h, w) array_like of int
    local_from_world, base_from_world : (n_texels, 3, 3) array_like
        Aligned frames and frames of the base geometry; rows tangent, binormal,
        normal.

    Returns
    -------
    Section
    """
    local = np.asarray(local_from_world, dtype=np.float64)
    base = np.asarray(base_from_world, dtype=np.float64)
    # The recovered normal and tangent in the texel's base frame.
    normal = np.einsum("nij,nj->ni", base, local[:, 2])
    tangent = np.einsum("nij,nj->ni", base, local[:, 0])
    tilt = np.degrees(np.arctan2(np.hypot(normal[:, 0], normal[:, 1]), normal[:, 2]))
    high = max(1.0, float(np.percentile(tilt, 99))) if tilt.size else 1.0
    colours = (
        (local[:, 2], "normals, world"),
        (base[:, 2], "normals of the hull, world"),
        (normal, "normals, tangent space"),
        (tangent, "tangents, tangent space"),
    )
    maps = tuple(
        _atlas_panel(
            pictures.directions_coloured(pictures.texture(v, texel_of_pixel)),
            texel_of_pixel,
            label,
        )
        for v, label in colours
    )
    tilted = pictures.false_colour(pictures.texture(tilt, texel_of_pixel), 0, high, "magma")
    items = (
        Figure(
            maps,
            "Red, green and blue are X, Y and Z, from -1 (dark) to 1 (bright); +Y is up "
            "(OpenGL). Recovered normals should show relief that the hull lacks, and be "
            "continuous across charts; tangents are determined only where the material is "
            "anisotropic.",
            min_width=340,
        ),
        Figure(
            (
                _atlas_panel(tilted, texel_of_pixel, "angle to the hull's normal"),
                Panel(plots.histogram({"tilt": tilt}, "angle, degrees", "texels, %"), "tilt"),
            ),
            "Angle between the recovered normal and the hull's: large in concavities, on "
            "relief and fabric. Noise indicates that the alignment is undetermined there.",
            colour_bar=ColourBar("magma", 0, high, "degrees"),
            min_width=280,
        ),
    )
    intro = "Local frames estimated from the reflectance alone, compared with the hull's."
    return Section("Normals and tangents", intro, items)


def _atlas_panel(picture: NDArray[np.uint8], texel_of_pixel: ArrayLike, label: str) -> Panel:
    """Image of the atlas, transparent where there is no texel."""
    shown = pictures.with_alpha(picture, np.asarray(texel_of_pixel) >= 0)
    return Panel(encode_picture(pictures.fitted(shown, ATLAS_PX), lossless=True), label)


def _legend(*entries: tuple[pictures.Colour, str]) -> tuple[tuple[str, str], ...]:
    return tuple(("#" + "".join(f"{c:02x}" for c in colour), text) for colour, text in entries)
