"""Check a capture before anything is made of it: all findings, the gravest first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import PLANE, Capture
from reflfield.capture.inspect import object_centre, spread_evenly
from reflfield.checking.checked_views import CheckedView, UnusableView, checked_views
from reflfield.checking.dark_frame_findings import dark_frame_findings
from reflfield.checking.description_findings import (
    code_range_finding,
    coverage_findings,
    description_findings,
    directions,
    file_findings,
)
from reflfield.checking.findings import ERROR, Finding, Findings
from reflfield.checking.flat_surface import axes_findings, flat_samples
from reflfield.checking.left_out import all_left_out, left_out_findings, without_surface
from reflfield.checking.light_findings import (
    Misplaced,
    gain_findings,
    misplaced_lights,
    order_findings,
)
from reflfield.checking.light_order import LightFit, gram_matrix, light_fit
from reflfield.checking.mask_edges import MaskEdge, mask_edge
from reflfield.checking.photograph_findings import PhotographFits, misplaced_photographs
from reflfield.checking.photograph_statistics import (
    PhotographSet,
    read_photographs,
    reduced,
)
from reflfield.checking.quality_findings import (
    ambient_findings,
    clipping_findings,
    colour_findings,
    repeated_findings,
    sharpness_findings,
    vignetting_findings,
)
from reflfield.checking.shading_fit import Shading, light_means, nanmean, shading_of
from reflfield.checking.silhouette_findings import (
    Shape,
    border_findings,
    contradiction_findings,
    edge_findings,
)
from reflfield.checking.surface_samples import SurfaceSamples, sample_surface
from reflfield.observations.intensity_agreement import other_intensities
from reflfield.observations.light_agreement import Look, other_light_axes

Array = NDArray[np.float64]

# Photographs that are looked at for the axes of all lights.
MOST_LOOKS = 64
# Brightness over what is expected of a photograph, or a light, that shows nothing.
DARK = 0.05
# Kinds of finding on photographs that do not show what they should.
OUT_OF_PLACE = (
    *("swapped photographs", "photograph of another light", "odd photograph"),
    *("turned photograph", "exposure of a photograph"),
)


def check_capture(capture: Capture) -> Findings:
    """Find what is wrong with a capture.

    Every photograph is decoded once.

    Parameters
    ----------
    capture : Capture
        As `open_capture(..., require_photographs=False)` opens it: what it would refuse is
        found here.

    Returns
    -------
    Findings
    """
    findings = list(description_findings(capture))
    of_dark_frames, capture = dark_frame_findings(capture)
    findings += of_dark_frames
    of_files, usable = file_findings(capture)
    findings += of_files
    if not usable:
        return Findings.sorted(findings, measures(capture))
    findings += coverage_findings(capture)
    findings += code_range_finding(capture) if len(usable) == len(capture.photographs) else ()
    photographs = read_photographs(capture, usable)
    findings += _unreadable(capture, photographs)
    if not photographs.of:
        return Findings.sorted(findings, measures(capture))
    checked = list(checked_views(capture, photographs)) if capture.n_views else []
    if capture.base_geometry == PLANE:
        checked = []
    findings += _unusable(capture, checked)
    views = [view for view in checked if isinstance(view, CheckedView)]
    findings += _of_photographs(capture, photographs, views)
    fits: list[PhotographFits] = []
    poses_hold = all(finding.kind != "convention of poses" for finding in findings)
    if capture.base_geometry == PLANE:
        findings += _of_flat_sample(capture, photographs, fits)
    elif views and poses_hold:
        of_views, shape = _of_views(capture, photographs, views)
        findings += of_views
        findings += _of_surface(capture, photographs, shape, fits)
    told = {name for one in findings if one.kind in OUT_OF_PLACE for name in one.subjects}
    for finding in findings:
        # Exchanged, both are where pixels may repeat others'.
        told -= set(finding.subjects) if finding.kind == "swapped photographs" else set()
    findings += repeated_findings(capture, photographs, told if fits else None)
    return Findings.sorted(findings, measures(capture))


def measures(capture: Capture) -> dict[str, Any]:
    """Counts of a capture."""
    return {
        "views": capture.n_views,
        "lights": capture.n_lights,
        "photographs": len(capture.photographs),
        "base geometry": capture.base_geometry,
    }


def _unreadable(capture: Capture, photographs: PhotographSet) -> Iterator[Finding]:
    for index, words in photographs.failures.items():
        photograph = capture.photographs[index]
        yield Finding(
            "damaged photograph",
            ERROR,
            (photograph.name,),
            words,
            "copy or develop it again",
            str(photograph.path),
        )


def _unusable(
    capture: Capture, checked: Sequence[CheckedView | UnusableView]
) -> Iterator[Finding]:
    for view in checked:
        if isinstance(view, UnusableView):
            yield Finding(
                "unusable silhouette",
                ERROR,
                (capture.cameras[view.number].id,),
                view.words,
                "give a mask of the object, white on black",
                str(capture.silhouettes[view.number] or ""),
            )


def _of_photographs(
    capture: Capture, photographs: PhotographSet, views: Sequence[CheckedView]
) -> Iterator[Finding]:
    coverage = {view.number: view.coverage for view in views}
    yield from clipping_findings(capture, photographs, coverage)
    yield from sharpness_findings(capture, photographs)
    yield from colour_findings(capture, photographs)


def _of_views(
    capture: Capture, photographs: PhotographSet, views: Sequence[CheckedView]
) -> tuple[list[Finding], Shape]:
    findings = list(border_findings(views, capture))
    edges: dict[int, MaskEdge] = {}
    for view in views:
        mean = photographs.means.get(view.number)
        edge = mask_edge(view, mean) if mean is not None else None
        if edge is not None:
            edges[view.number] = edge
    contradictions, shape = contradiction_findings(capture, views, edges)
    named = {name for finding in contradictions for name in finding.subjects}
    findings += [
        finding
        for finding in edge_findings(capture, views, edges)
        if not named.intersection(finding.subjects)
    ]
    return [*findings, *contradictions], shape


def _of_surface(
    capture: Capture, photographs: PhotographSet, shape: Shape, fits: list[PhotographFits]
) -> Iterator[Finding]:
    """Findings on lights and photographs, by what a coarse hull should look like."""
    why = without_surface(capture, shape)
    if shape.mesh is None or why:
        yield all_left_out(why)
        return
    numbers = [view.number for view in shape.views if view.number not in shape.astray]
    samples = sample_surface(capture, shape.mesh, photographs, numbers)
    coverage = {view.number: view.coverage for view in shape.views}
    looks = _looks(capture, samples)
    axes = other_light_axes(looks)
    if axes:
        yield Finding(
            "axes of lights",
            ERROR,
            (),
            axes,
            "correct the lights' positions, their order, or the axes they are in",
            str(capture.description or ""),
        )
        yield all_left_out("the axes of the lights are in doubt")
        return
    shading = shading_of(capture, samples)
    fits.append(PhotographFits(capture, photographs, shading, shading.fits()))
    yield from _of_shading(fits[0], coverage, other_intensities(looks))


def _of_flat_sample(
    capture: Capture, photographs: PhotographSet, fits: list[PhotographFits]
) -> Iterator[Finding]:
    """Findings on lights and photographs of a flat sample, by photometric stereo."""
    flat = flat_samples(capture, photographs)
    if flat is None:
        return
    samples, normals = flat
    axes = list(axes_findings(capture, normals))
    yield from axes
    if not axes:
        shading = shading_of(capture, samples)
        fits.append(PhotographFits(capture, photographs, shading, shading.fits()))
        yield from _of_shading(fits[0], {}, "")


def _of_shading(
    by_fit: PhotographFits, coverage: dict[int, NDArray[np.float32]], intensities: str
) -> Iterator[Finding]:
    """Findings on places and strengths of lights, and on photographs in wrong places."""
    capture, photographs, shading = by_fit.capture, by_fit.photographs, by_fit.shading
    towards = directions(capture, object_centre(capture))[1]
    wrong = _misplaced(capture, photographs, coverage, shading, by_fit.fits, towards)
    yield from order_findings(capture, wrong, towards)
    wrong_lights = {one.light for one in wrong}
    if 0 < len(wrong_lights) <= capture.n_lights // 2:
        by_fit = _without_lights(by_fit, wrong_lights)
        shading = by_fit.shading
    wrong_photographs: set[int] = set()
    dark = _dark(shading)
    for indices, finding in misplaced_photographs(by_fit, wrong_lights, dark):
        wrong_photographs.update(indices)
        yield finding
    gains = list(gain_findings(capture, shading, frozenset(wrong_photographs), wrong_lights))
    yield from gains
    if intensities and len(gains) > 3:
        yield Finding(
            "intensities of lights",
            ERROR,
            (),
            intensities,
            "check their order and unit",
            str(capture.description or ""),
        )
    yield from ambient_findings(capture, shading)
    yield from vignetting_findings(shading, capture)
    yield from left_out_findings(by_fit)


def _without_lights(by_fit: PhotographFits, lights: set[int]) -> PhotographFits:
    """Fits of the other lights' photographs, to albedo that these say nothing of."""
    capture, samples = by_fit.capture, by_fit.shading.samples
    luminance = {
        index: values
        for index, values in samples.luminance.items()
        if capture.photographs[index].light not in lights
    }
    shading = shading_of(capture, replace(samples, luminance=luminance))
    return PhotographFits(capture, by_fit.photographs, shading, shading.fits())


def _dark(shading: Shading) -> frozenset[int]:
    """Photographs of which little but noise is seen, which says nothing of their place.

    Those are far darker than expected, and nowhere bright: a photograph that shows another
    side than it should is dark where light is expected, but bright elsewhere.
    """
    darkest = np.nanmedian(shading.peaks) + np.log(DARK)
    rows = np.flatnonzero((shading.gains < np.log(DARK)) & ~(shading.peaks > darkest))
    return frozenset(int(shading.photographs[row]) for row in rows)


def _misplaced(
    capture: Capture,
    photographs: PhotographSet,
    coverage: dict[int, NDArray[np.float32]],
    shading: Shading,
    fits: Array,
    towards: Array,
) -> list[Misplaced]:
    """Lights in another place, by shading, and by likeness of photographs."""
    by_shading = light_means(capture, shading.photographs, fits)
    wrong = misplaced_lights(by_shading, towards)
    by_likeness = misplaced_lights(_likeness(capture, photographs, coverage, towards), towards)
    dead = _dead_lights(capture, shading)
    told = {one.light for one in wrong}
    pairs = {(one.light, one.better) for one in by_likeness}
    # By likeness alone only those are named that exchange their places.
    wrong += [
        one for one in by_likeness if one.light not in told and (one.better, one.light) in pairs
    ]
    return [one for one in wrong if one.light not in dead]


def _dead_lights(capture: Capture, shading: Shading) -> set[int]:
    """Lights all of whose photographs are dark.

    A light that stands elsewhere leaves dark what it should light, but it lights something.
    """
    lights = np.array([capture.photographs[int(i)].light for i in shading.photographs])
    known = np.nan_to_num(shading.peaks, nan=-np.inf)
    peaks = {int(light): float(known[lights == light].max()) for light in np.unique(lights)}
    darkest = float(np.median(list(peaks.values()))) + np.log(DARK)
    return {light for light, peak in peaks.items() if peak < darkest}


def _likeness(
    capture: Capture,
    photographs: PhotographSet,
    coverage: dict[int, NDArray[np.float32]],
    towards: Array,
) -> LightFit:
    grams = []
    for view in range(capture.n_views):
        images = {}
        for index, statistics in photographs.of.items():
            photograph = capture.photographs[index]
            if photograph.camera == view:
                bright = statistics.luminance
                inside = _inside(coverage.get(view), bright.shape)
                images[photograph.light] = bright[inside]
        grams.append(gram_matrix(images, capture.n_lights))
    return light_fit(nanmean(np.array(grams)), towards)


def _inside(coverage: NDArray[np.float32] | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    if coverage is None:
        return np.ones(shape, bool)
    small = reduced(coverage, max(shape))
    return small > 0.9 if small.shape == shape else np.ones(shape, bool)


def _looks(capture: Capture, samples: SurfaceSamples) -> list[Look]:
    """What points look like in some photographs, evenly spread."""
    indices = sorted(samples.luminance)
    looks = []
    for number in spread_evenly(len(indices), MOST_LOOKS):
        photograph = capture.photographs[indices[number]]
        bright = samples.luminance[indices[number]].astype(np.float64)
        seen = np.isfinite(bright)
        looks.append(
            Look(
                capture.cameras[photograph.camera],
                capture.lights[photograph.light],
                samples.points[seen],
                samples.normals[seen],
                bright[seen],
            )
        )
    return looks
