"""Findings on silhouettes and on the cameras that they contradict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.checking.camera_fit import CameraError, camera_error, focal_scale
from reflfield.checking.checked_views import CheckedView
from reflfield.checking.findings import ERROR, NOTE, WARNING, Evidence, Finding, robust_spread
from reflfield.checking.mask_edges import MaskEdge
from reflfield.checking.outline_agreement import outline_agreement
from reflfield.checking.shown_images import with_outlines
from reflfield.errors import GeometryError, InputError
from reflfield.geometry.bounding_box import robust_bounds
from reflfield.geometry.contradictions import Verdict
from reflfield.geometry.explanations import (
    Explanation,
    explain_all,
    explain_view,
)
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.visual_hull import MADE_OVERLAP, HullOptions, visual_hull

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Voxels and triangles of the hull that views are compared with.
RESOLUTION, N_TRIANGLES = 64, 6000
FEWEST_VIEWS = 4
# Pixels by which a mask is too large or too small, at least; shares of the object that a mask
# leaves out, or adds, more than the masks of other views do.
EDGE_PX, LEAST_PART, DEVIATIONS = 1.2, 0.02, 6.0
LEAST_HOLE = 0.004
# A mask that leaves out so much is wrong in places rather than along its edge.
WRONG_PART = 0.1
# Outliers whose cameras are fitted, each taking seconds.
MOST_FITTED = 6


@dataclass(frozen=True, eq=False)
class Shape:
    """What the silhouettes say together.

    Parameters
    ----------
    views : tuple of CheckedView
    edges : dict of int to MaskEdge
        By number of the camera, where photographs show the object before an even backdrop.
    astray : frozenset of int
        Cameras whose views contradict the others though no photograph says that it is the
        mask: where they see a point is not known.
    mesh : Mesh or None
        Coarse hull of those that agree.
    """

    views: tuple[CheckedView, ...]
    edges: dict[int, MaskEdge]
    astray: frozenset[int]
    mesh: Mesh | None


def border_findings(views: Sequence[CheckedView], capture: Capture) -> Iterator[Finding]:
    """Findings on objects that the border of the image cuts off, or that are tiny."""
    cut = [view for view in views if view.cone.outline.leaves_image]
    if cut:
        yield Finding(
            "object cut by the border",
            WARNING,
            tuple(view.name for view in cut),
            f"the object touches the border of the image in {len(cut)} of {len(views)} views",
            "show the whole object; what a view does not show, it cannot carve",
            file=_file(capture, cut[0]),
            pictures=tuple(Evidence(_mask_picture(view), view.name) for view in cut[:4]),
        )
    small = [view for view in views if (view.coverage >= 0.5).mean() < 0.01]
    if small:
        yield Finding(
            "small object",
            NOTE,
            tuple(view.name for view in small),
            f"it covers less than 1 % of the image in {len(small)} views",
            "move closer or crop, with principal points and sizes to match",
        )


def edge_findings(
    capture: Capture, views: Sequence[CheckedView], edges: dict[int, MaskEdge]
) -> Iterator[Finding]:
    """Findings on masks that do not end where the object ends in the photographs."""
    checked = [view for view in views if view.number in edges and view.origin != "photographs"]
    if not checked:
        return
    too_large = np.array([edges[view.number].too_large for view in checked])
    common, _ = robust_spread(too_large)
    if abs(common) > EDGE_PX and len(checked) > 2:
        yield _edge(capture, "all masks", checked, common, edges)
    off = off_edges(checked, edges)
    for view in checked:
        if view.number in off:
            yield _edge(capture, "mask", [view], off[view.number], edges)
        if is_hole(edges[view.number]):
            yield _hole(capture, view, edges)


def off_edges(views: Sequence[CheckedView], edges: dict[int, MaskEdge]) -> dict[int, float]:
    """Pixels by which masks are too large, where they are so otherwise than most."""
    checked = [view for view in views if view.number in edges and view.origin != "photographs"]
    too_large = np.array([edges[view.number].too_large for view in checked])
    common, scatter = robust_spread(too_large)
    limit = max(EDGE_PX, DEVIATIONS * scatter)
    return {
        view.number: float(amount)
        for view, amount in zip(checked, too_large, strict=True)
        if abs(amount - common) > limit and edges[view.number].missed < WRONG_PART
    }


def is_hole(edge: MaskEdge) -> bool:
    """Whether a mask leaves out of the object what it surrounds, and little else."""
    return edge.hole > LEAST_HOLE and edge.missed < 1.5 * edge.hole


def _hole(capture: Capture, view: CheckedView, edges: dict[int, MaskEdge]) -> Finding:
    hole = edges[view.number].hole
    return Finding(
        "hole in a mask",
        ERROR,
        (view.name,),
        f"the photographs show the object in a hole of {100 * hole:.1f} % of its area",
        "fill the hole",
        file=_file(capture, view),
        pictures=(_edge_picture(view, edges[view.number]),),
    )


def _edge(
    capture: Capture,
    what: str,
    views: Sequence[CheckedView],
    amount: float,
    edges: dict[int, MaskEdge],
) -> Finding:
    view = views[0]
    times = capture.cameras[view.number].width / view.camera.width
    size = "too large" if amount > 0 else "too small"
    names = tuple(v.name for v in views) if len(views) == 1 else ()
    return Finding(
        f"{what} {size}",
        ERROR if what != "mask" else WARNING,
        names,
        f"{'its' if names else 'their'} outline lies {abs(amount) * times:.1f} pixels "
        f"{'outside' if amount > 0 else 'inside'} of the object's in the photographs",
        f"{'erode' if amount > 0 else 'dilate'} it by as much, or make it again",
        file=_file(capture, view),
        pictures=(_edge_picture(view, edges[view.number]),),
    )


def wrong_masks(views: Sequence[CheckedView], edges: dict[int, MaskEdge]) -> dict[int, str]:
    """Words on masks that leave out, or add, far more than those of other views do."""
    checked = [view for view in views if view.number in edges and view.origin != "photographs"]
    words: dict[int, list[str]] = {}
    for name, text in (
        ("missed", "it leaves out {:.0f} % of the object that the photographs show"),
        ("added", "in {:.0f} % of it the photographs show backdrop"),
    ):
        shares = np.array([getattr(edges[view.number], name) for view in checked])
        median, scatter = robust_spread(shares)
        limit = median + max(LEAST_PART, DEVIATIONS * scatter)
        for view, share in zip(checked, shares, strict=True):
            if share > limit and not is_hole(edges[view.number]):
                words.setdefault(view.number, []).append(text.format(100 * share))
    return {number: ", and ".join(texts) for number, texts in words.items()}


def contradiction_findings(
    capture: Capture, views: Sequence[CheckedView], edges: dict[int, MaskEdge]
) -> tuple[list[Finding], Shape]:
    """Findings on views that contradict each other, and the shape of those that agree."""
    cones = [view.cone for view in views]
    doubted = wrong_masks(views, edges)
    box = robust_bounds(cones) if len(cones) >= 2 else None
    if len(views) < FEWEST_VIEWS or box is None:
        failures = [] if len(views) < FEWEST_VIEWS else [_nothing_common(views)]
        return failures, Shape(tuple(views), edges, frozenset(), None)
    margin = 0.05 * (box[1] - box[0])
    low, high = box[0] - margin, box[1] + margin
    agreement = outline_agreement(cones, low, high)
    verdict = agreement.verdict()
    outliers = verdict.outliers
    good = [view for i, view in enumerate(views) if i not in outliers]
    mesh, failure, fit = _hull(good)
    findings: list[Finding] = []
    if not verdict.agree:
        findings.append(_all_contradict(views, verdict, fit))
    astray = set()
    for i in outliers:
        words = _contradicted(verdict, i, len(good))
        finding = _by_photographs(capture, views, i, outliers, doubted, words, mesh, edges)
        if finding is None:
            astray.add(views[i].number)
            finding = _outlier(capture, views, i, outliers, words, mesh, (low, high), edges)
        findings.append(finding)
    named = {views[i].number for i in outliers}
    findings += [
        _wrong_mask(capture, view, doubted[view.number], edges)
        for view in views
        if view.number in doubted and view.number not in named and _is_certain(view, edges)
    ]
    all_off = abs(np.median([edge.too_large for edge in edges.values()] or [0.0])) > EDGE_PX
    if verdict.agree and not all_off:
        findings += _focal(capture, good, low, high)
    if failure and verdict.agree:
        findings.append(Finding("no hull", ERROR, (), failure, "see the findings above"))
    return findings, Shape(tuple(views), edges, frozenset(astray), mesh)


def _is_certain(view: CheckedView, edges: dict[int, MaskEdge]) -> bool:
    """Whether a mask is wrong though no other view says so: by more than dark parts explain."""
    edge = edges[view.number]
    return edge.missed > LEAST_PART


def _nothing_common(views: Sequence[CheckedView]) -> Finding:
    why = explain_all([v.camera for v in views], [v.coverage for v in views], 0.0)
    return _together(views, why, "the silhouettes bound no common body")


def _all_contradict(views: Sequence[CheckedView], verdict: Verdict, fit: float) -> Finding:
    covered = 1 - float(np.median(verdict.uncovered))
    n = int((verdict.uncovered > np.median(verdict.uncovered) / 2).sum())
    words = (
        f"{n} of {len(views)} outlines are excluded in parts by other views, no few to blame"
    )
    if _all_made(views) and fit > MADE_OVERLAP:
        hull = f"the hull that most allow agrees with them to {100 * fit:.0f} % (median)"
        return _poor_masks(WARNING, f"{words}; {hull}")
    why = explain_all([v.camera for v in views], [v.coverage for v in views], covered)
    return _together(views, why, words)


def _poor_masks(severity: str, words: str) -> Finding:
    """Finding on masks of which nobody but this program says that they are right."""
    return Finding(
        "masks made from photographs",
        severity,
        (),
        f"{words}; so it is where the object is as dark as the backdrop, or this is uneven",
        "give masks, or make better ones with `reflfield masks`; if these look right, check "
        "the calibration (poses, focal lengths, distortion)",
    )


def _together(views: Sequence[CheckedView], why: Explanation | None, words: str) -> Finding:
    if why is None and _all_made(views):
        return _poor_masks(ERROR, words)
    if why is None:
        return Finding(
            "contradicting silhouettes",
            ERROR,
            (),
            words,
            "check the calibration (poses, focal lengths, distortion), and that the masks are "
            "the object's",
        )
    return Finding(
        "convention of poses" if "pose" in why.kind or "axes" in why.kind else "inverted masks",
        ERROR,
        (),
        f"{words}; {why.words}: so read, they agree on {100 * why.after:.0f} % of their area "
        f"instead of {100 * why.before:.0f} %",
        "correct the description",
    )


def _all_made(views: Sequence[CheckedView]) -> bool:
    return all(view.origin == "photographs" for view in views)


def _hull(views: Sequence[CheckedView]) -> tuple[Mesh | None, str, float]:
    """Coarse hull or why there is none, and how well (median overlap) it fits the views."""
    options = HullOptions(resolution=RESOLUTION, n_triangles=N_TRIANGLES)
    cameras, silhouettes = [view.camera for view in views], [view.coverage for view in views]
    try:
        mesh, report = visual_hull(cameras, silhouettes, options, made=_all_made(views))
    except (GeometryError, InputError) as error:
        return None, str(error), 0.0
    return mesh, "", float(np.median(report.overlap))


def _contradicted(verdict: Verdict, number: int, n_others: int) -> str:
    return (
        f"its outline contradicts the {n_others} others (they exclude "
        f"{100 * verdict.uncovered[number]:.0f} % of it)"
    )


def _by_photographs(
    capture: Capture,
    views: Sequence[CheckedView],
    number: int,
    outliers: Sequence[int],
    doubted: dict[int, str],
    evidence: str,
    mesh: Mesh | None,
    edges: dict[int, MaskEdge],
) -> Finding | None:
    """What is wrong with the mask of a view, if its photographs say that it is the mask."""
    view = views[number]
    edge = edges.get(view.number)
    if edge is not None and is_hole(edge):
        return _hole(capture, view, edges)
    if view.number in off_edges(views, edges):
        return _edge(capture, "mask", [view], off_edges(views, edges)[view.number], edges)
    doubt = doubted.get(view.number) or _beyond(view, mesh, edge)
    if doubt:
        why = _explained(views, number, outliers, mesh)
        return _wrong_mask(capture, view, f"{doubt}; {evidence}", edges, why)
    return None


def _outlier(
    capture: Capture,
    views: Sequence[CheckedView],
    number: int,
    outliers: Sequence[int],
    evidence: str,
    mesh: Mesh | None,
    box: tuple[Array, Array],
    edges: dict[int, MaskEdge],
) -> Finding:
    """What is wrong with a view that contradicts the others, by the silhouettes alone."""
    view = views[number]
    others = [v.cone for i, v in enumerate(views) if i not in outliers]
    why = _explained(views, number, outliers, mesh)
    edge = edges.get(view.number)
    mask_fits = edge is not None
    pictures = _overlaps(view, mesh, edge)
    if why is not None and ("pose" in why.kind or "axes" in why.kind):
        return _named("pose of a camera", view, capture, f"{evidence}; {why.words}", pictures)
    error: CameraError | None = None
    if list(outliers).index(number) < MOST_FITTED:
        error = camera_error(view.cone, others, *box)
    if error is not None:
        return _camera(view, capture, f"{evidence}", error, pictures, mask_fits)
    if why is not None:
        words = f"{evidence}; {why.words} (overlap {why.after:.2f} instead of {why.before:.2f})"
        return _named("wrong mask", view, capture, words, pictures)
    kind = "wrong camera" if mask_fits else "wrong mask or camera"
    return _named(kind, view, capture, evidence, pictures)


def _explained(
    views: Sequence[CheckedView], number: int, outliers: Sequence[int], mesh: Mesh | None
) -> Explanation | None:
    """What would make a silhouette agree with the others' hull."""
    view = views[number]
    swapped = [(views[j].name, views[j].coverage) for j in outliers if j != number]
    return explain_view(view.camera, view.coverage, mesh, swapped) if mesh else None


def _beyond(view: CheckedView, mesh: Mesh | None, edge: MaskEdge | None) -> str:
    """Words on a part of a mask that neither the others nor the photographs show."""
    if mesh is None or edge is None:
        return ""
    mask = view.coverage >= 0.5
    beyond = mask & _far_outside(RayScene(mesh).silhouette(view.camera))
    share = float(beyond.sum() / mask.sum())
    if share < LEAST_PART or (beyond & edge.shown).sum() > 0.5 * beyond.sum():
        return ""
    return f"{100 * share:.0f} % of it lie outside of the others' hull and show backdrop"


def _far_outside(silhouette: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels farther from the silhouette of the coarse hull than its voxels are wide."""
    distance = cv2.distanceTransform((~silhouette).astype(np.uint8), cv2.DIST_L2, 5)
    if not silhouette.any():
        return np.ones_like(silhouette)
    rows, columns = np.nonzero(silhouette)
    voxel = max(np.ptp(rows), np.ptp(columns)) / RESOLUTION
    return np.asarray(distance > 1 + voxel)


def _named(
    kind: str, view: CheckedView, capture: Capture, words: str, pictures: tuple[Evidence, ...]
) -> Finding:
    remedy = {
        "wrong mask": "make the mask again",
        "pose of a camera": "correct the convention of its pose",
        "wrong camera": "calibrate the camera again, or leave the view out",
    }.get(kind, "check the mask, then the calibration of the camera")
    return Finding(kind, ERROR, (view.name,), words, remedy, _file(capture, view), pictures)


def _camera(
    view: CheckedView,
    capture: Capture,
    words: str,
    error: CameraError,
    pictures: tuple[Evidence, ...],
    mask_fits: bool,
) -> Finding:
    left = f"which leaves {error.after:.2f} of {error.before:.2f} pixels"
    if error.kind == "turned":
        kind = "turned camera"
        what = f"it agrees with them if the camera is turned by {error.amount:.1f} degrees"
    else:
        kind = "focal length of a camera"
        percent = 100 * abs(error.amount - 1)
        size = "long" if error.amount > 1 else "short"
        what = f"it agrees with them if its focal length is {percent:.1f} % too {size}"
    also = "" if mask_fits else "; or its mask is shifted or of another size"
    return Finding(
        kind,
        ERROR,
        (view.name,),
        f"{words}; {what}, {left}{also}",
        "calibrate the camera again, or leave the view out",
        _file(capture, view),
        pictures,
    )


def _wrong_mask(
    capture: Capture,
    view: CheckedView,
    words: str,
    edges: dict[int, MaskEdge],
    why: Explanation | None = None,
) -> Finding:
    more = f"; {why.words}" if why is not None else ""
    return Finding(
        "wrong mask",
        ERROR,
        (view.name,),
        f"{words}{more}",
        "make the mask again",
        _file(capture, view),
        (_edge_picture(view, edges[view.number]),),
    )


def _focal(
    capture: Capture, views: Sequence[CheckedView], low: Array, high: Array
) -> Iterator[Finding]:
    scale = focal_scale([view.cone for view in views], low, high)
    if scale is not None and scale.is_off:
        percent = 100 * abs(1 / scale.factor - 1)
        size = "long" if scale.factor < 1 else "short"
        yield Finding(
            "focal length",
            ERROR,
            (),
            f"outlines agree best if all focal lengths are {percent:.1f} % too {size} "
            f"(standard error {100 * scale.error:.1f} %)",
            "check the focal lengths: of the images as they are, after cropping and scaling",
            file=str(capture.description or ""),
        )


def _overlaps(
    view: CheckedView, mesh: Mesh | None, edge: MaskEdge | None
) -> tuple[Evidence, ...]:
    expected = None if mesh is None else RayScene(mesh).silhouette(view.camera)
    if expected is None:
        return (Evidence(_mask_picture(view), view.name),)
    grey = np.repeat(0.35 * view.coverage[..., None], 3, axis=2).astype(np.float32)
    if edge is not None:
        grey += 0.35 * edge.shown[..., None]
    label = f"{view.name}: mask (blue), hull of the others (orange)"
    return (Evidence(with_outlines(grey, view.coverage, expected), label),)


def _edge_picture(view: CheckedView, edge: MaskEdge) -> Evidence:
    grey = np.repeat(0.35 * edge.shown[..., None], 3, axis=2).astype(np.float32)
    label = f"{view.name}: mask (blue), object in the photographs (orange)"
    return Evidence(with_outlines(grey, view.coverage, edge.shown), label)


def _mask_picture(view: CheckedView) -> NDArray[np.uint8]:
    grey = np.repeat(view.coverage[..., None], 3, axis=2).astype(np.float32)
    return with_outlines(grey, view.coverage, view.coverage >= 0.5)


def _file(capture: Capture, view: CheckedView) -> str:
    return str(capture.silhouettes[view.number] or capture.description or "")
