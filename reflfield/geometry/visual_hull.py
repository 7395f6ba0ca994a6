r"""Visual hull: the largest body that fits all silhouettes.

The hull is the zero level of the smallest signed distance over all views,
:math:`f(x) = \min_v d_v(\pi_v(x))\, z_v(x) / f_v`, where :math:`d_v` is the signed
distance to the outline in pixels and depth over focal length turns it into metres.
Only a narrow band around that level is evaluated, on a grid refined from coarse cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from skimage.measure import marching_cubes

from reflfield.capture.cameras import Camera
from reflfield.errors import GeometryError, InputError
from reflfield.geometry.bounding_box import object_bounds
from reflfield.geometry.carving import Grid, carve
from reflfield.geometry.cones import View, measured_views
from reflfield.geometry.contradictions import CONTRADICTION, FINEST_VOTES
from reflfield.geometry.disagreement import Contradiction, Disagreement
from reflfield.geometry.explanations import (
    compared_pixels,
    explain_all,
    explain_view,
)
from reflfield.geometry.hull_agreement import Agreement, agreement_of
from reflfield.geometry.mesh import Mesh, decimate, keep_large_components, smooth
from reflfield.geometry.specks import noting_small_parts, specks_words, without_specks
from reflfield.util.quoting import listed
from reflfield.util.validation import check_ranges

Array = NDArray[np.float64]

_MOST_VIEWS = 100_000
# Blur takes memory, smoothing time; the smallest component is a share of the largest.
_RANGES = {
    "blur": (0, 100),
    "smoothing": (0, 1000),
    "n_triangles": (0, 10_000_000),
    "minimum_component": (0, 1),
}
_LARGEST_RESOLUTION = 512
# What `tolerance` is by default.
AUTO: Literal["auto"] = "auto"

# Share of a silhouette that the hull does not cover, a pixel and a voxel inside of the
# outline, above which it is asked who disagrees; and of all of a silhouette, however thin.
_SUSPICIOUS = 0.005
_SUSPICIOUS_IF_THIN = 0.25
# Median overlap below which a hull has nothing to do with the object.
_COLLAPSED = 0.1
# Median share of the silhouettes on which views must agree for a hull to be of use.
_HOPELESS = 0.5

# Of so many silhouettes that were made from photographs one may miss a part of the object.
MADE_VIEWS_PER_WRONG = 10
# Fewer than so many of those are judged like silhouettes that are given.
_MANY_MADE = 60
# Median overlap of those with the hull from which they are taken to be of one object.
MADE_OVERLAP = 0.8

# Fewer views than these do not outweigh one that says the object is larger.
LEAST_WITNESSES = 6


@dataclass(frozen=True)
class HullOptions:
    """How finely the hull is carved and how it is cleaned.

    Parameters
    ----------
    resolution : int
        Voxels along the longest side of the object's bounding box, 8 .. 512.
    tolerance : int or "auto"
        Views that may disagree at a point without carving it away. 0 is the hull proper;
        1 or 2 suit photographs whose silhouettes miss thin parts in single views, and
        make the hull fatter wherever that many views carry the shape alone. "auto" is 0,
        but makes the hull without views that contradict all others, saying so; of many views
        whose silhouettes were made from photographs, and may each miss a dark part, it is one
        in `MADE_VIEWS_PER_WRONG`.
    blur : float
        Standard deviation, voxels, of a Gaussian over the signed distance. It removes the
        saw teeth of sharp ridges, which would cost decimation and charts dearly.
    smoothing : int
        Iterations of Taubin smoothing, which remove the rest of the grid.
    n_triangles : int
        Triangles after decimation; 0 keeps all.
    minimum_component : float
        Parts with a smaller share of the largest part's area are removed.
    bounds : pair of (3,) float, optional
        Lowest and highest corner of a box, metres, to use instead of the one found from
        the silhouettes: needed where the object leaves the frame in too many views.
    hollows : bool
        Carve what no silhouette shows to be empty but photographs do: under several lights
        (`geometry.hollow_carving`), or by stereo (`geometry.stereo_carving`).
    """

    resolution: int = 192
    tolerance: int | Literal["auto"] = AUTO
    blur: float = 0.7
    smoothing: int = 60
    n_triangles: int = 20_000
    minimum_component: float = 0.01
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    hollows: bool = True

    def __post_init__(self) -> None:
        if not 8 <= self.resolution <= _LARGEST_RESOLUTION:
            raise InputError(
                f"resolution: expected 8 .. {_LARGEST_RESOLUTION} voxels, "
                f"received {self.resolution}"
            )
        if isinstance(self.tolerance, str) and self.tolerance != AUTO:
            raise InputError(
                f"tolerance: expected a number of views or 'auto', received {self.tolerance!r}"
            )
        if self.tolerance != AUTO:
            check_ranges(self, {"tolerance": (0, _MOST_VIEWS)})
        check_ranges(self, _RANGES)
        if self.bounds is not None and not np.less(*self.bounds).all():
            raise InputError(
                f"bounds: expected lowest < highest corner, received {self.bounds[0]}, "
                f"{self.bounds[1]}"
            )


@dataclass(frozen=True, eq=False)
class HullReport:
    """What was carved, and how well it agrees with the silhouettes.

    Parameters
    ----------
    spacing : float
        Side of a voxel, metres.
    grid : tuple of int
        Voxels along x, y and z.
    n_evaluated : int
        Points at which the silhouettes were looked up.
    volume, area : float
        Of the final mesh, m^3 and m^2.
    n_triangles : int
        Of the final mesh.
    tolerance : int
        Views that may disagree at a point of this hull.
    overlap : (n_views,) float64
        Intersection over union of the mesh's silhouette and the given one, for pixels in
        the frame. Far below 1: calibration or silhouette of that view disagrees.
    missing : (n_views,) float64
        Share of each silhouette that the mesh does not cover.
    leaves_image : (n_views,) bool
        True where the object touches the border of the image.
    contradictions : tuple of Contradiction
        Views that contradict all others.
    left_out : tuple of str
        Names of those that the hull is made without.
    specks : dict of str to int
        Small parts of silhouettes that were removed, by the names of the views.
    warnings : tuple of str
        What a user must know of all this, in sentences.
    """

    spacing: float
    grid: tuple[int, int, int]
    n_evaluated: int
    volume: float
    area: float
    n_triangles: int
    tolerance: int
    overlap: Array
    missing: Array
    leaves_image: NDArray[np.bool_]
    contradictions: tuple[Contradiction, ...] = ()
    left_out: tuple[str, ...] = ()
    specks: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def visual_hull(
    cameras: Sequence[Camera],
    silhouettes: Sequence[NDArray[np.floating]],
    options: HullOptions | None = None,
    *,
    scratch: Path | None = None,
    made: bool = False,
    workers: int = 1,
) -> tuple[Mesh, HullReport]:
    """Watertight mesh of the visual hull, smoothed and decimated.

    Views in which the object leaves the frame carve only what they see.

    Parameters
    ----------
    cameras : sequence of Camera
        At least two that look from different sides.
    silhouettes : sequence of (height, width) float
        Coverage of the object in [0, 1], one for each camera.
    options : HullOptions, optional
    scratch : Path, optional
        Folder in which the distances of large silhouettes are kept, 4 bytes for each pixel,
        instead of in memory. The hull is the same.
    made : bool
        Whether the silhouettes were made from photographs; see `HullOptions.tolerance`.
    workers : int
        Threads; the hull does not depend on their number.

    Returns
    -------
    mesh : Mesh
        Closed, outward-facing, metres.
    report : HullReport

    Raises
    ------
    InputError
        If the numbers of cameras and silhouettes, or the size of a camera's images and
        of its silhouette, differ.
    GeometryError
        If a silhouette is empty (the view is named), the silhouettes contradict each
        other (the first view that leaves nothing is named), or they do not bound the
        object on all sides.

    Notes
    -----
    Time grows with the square of the resolution and linearly with the views.
    """
    options = options or HullOptions()
    views = measured_views(cameras, silhouettes, scratch, workers)
    views, silhouettes, specks = without_specks(views, silhouettes, scratch, workers)
    bears_wrong = made and options.tolerance == AUTO and len(views) >= _MANY_MADE
    n_wrong = len(views) // MADE_VIEWS_PER_WRONG if bears_wrong else 0
    with noting_small_parts(views):
        carver = _Carver(options, workers)
        outcome = _hull_of_made(views, silhouettes, carver, n_wrong) if n_wrong else None
        if outcome is None:
            outcome = _agreed_hull(views, silhouettes, carver, scratch)
    grid, mesh = outcome.carved.grid, outcome.carved.mesh
    agreement = outcome.fit or agreement_of(mesh, cameras, silhouettes, workers)
    report = HullReport(
        spacing=grid.spacing,
        grid=grid.shape,
        n_evaluated=outcome.carved.n_evaluated,
        volume=mesh.volume,
        area=mesh.area,
        n_triangles=len(mesh.faces),
        tolerance=outcome.carved.tolerance,
        overlap=agreement.overlap,
        missing=agreement.missing,
        leaves_image=np.array([view.outline.leaves_image for view in views]),
        contradictions=outcome.contradictions,
        left_out=outcome.left_out,
        specks=specks,
        warnings=(*specks_words(specks), *outcome.warnings),
    )
    return mesh, report


@dataclass(frozen=True, eq=False)
class _Carved:
    """Hull of some views."""

    mesh: Mesh
    grid: Grid
    n_evaluated: int
    tolerance: int


@dataclass(frozen=True, eq=False)
class _Outcome:
    """Hull of the views that agree, and what is to be said about the others."""

    carved: _Carved
    contradictions: tuple[Contradiction, ...] = ()
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    fit: Agreement | None = None


@dataclass(frozen=True)
class _Carver:
    """Carves views as options say, with so many threads."""

    options: HullOptions
    workers: int

    def carved(self, views: Sequence[View], tolerance: int) -> _Carved:
        options = self.options
        low, high = np.array(options.bounds or object_bounds(views, tolerance))
        grid = Grid.around(low, high, options.resolution)
        volume, n_evaluated = carve(views, grid, tolerance, self.workers)
        mesh = closed_surface(volume, grid, options, views)
        return _Carved(mesh, grid, n_evaluated, tolerance)


def _hull_of_made(
    views: Sequence[View],
    silhouettes: Sequence[NDArray[np.floating]],
    carver: _Carver,
    n_wrong: int,
) -> _Outcome | None:
    """Hull that so many views may undercut; None where the silhouettes hardly agree with it."""
    try:
        carved = carver.carved(views, n_wrong)
    except GeometryError:
        return None
    cameras = [view.camera for view in views]
    fit = agreement_of(carved.mesh, cameras, silhouettes, carver.workers)
    return _Outcome(carved, fit=fit) if np.median(fit.overlap) > MADE_OVERLAP else None


def _agreed_hull(
    views: Sequence[View],
    silhouettes: Sequence[NDArray[np.floating]],
    carver: _Carver,
    scratch: Path | None,
) -> _Outcome:
    """Hull of all views, or of those that agree, as `options.tolerance` says."""
    cameras, options = [view.camera for view in views], carver.options
    tolerance = 0 if options.tolerance == AUTO else int(options.tolerance)
    try:
        carved, failure = carver.carved(views, tolerance), None
    except GeometryError as error:
        carved, failure = None, error
    n = carver.workers
    fit = None if carved is None else agreement_of(carved.mesh, cameras, silhouettes, n)
    if carved is not None and fit is not None and not _suspicious(views, carved, fit):
        return _Outcome(carved, fit=fit)
    disagreement = Disagreement.of(views, options.bounds)
    if disagreement.outliers:
        usable = carved if fit is not None and np.median(fit.overlap) > _COLLAPSED else None
        return _outcome_with_outliers(views, silhouettes, carver, disagreement, usable)
    if carved is not None and disagreement.agree:
        return _Outcome(carved)
    covered = disagreement.covered if carved else 0.0
    why = explain_all(cameras, silhouettes, covered, scratch)
    if why is not None:
        raise GeometryError(
            "hull: expected silhouettes of one object, received contradicting ones: "
            f"{why.words}, it seems: so read, they agree on {100 * why.after:.0f} % of their "
            f"area instead of {100 * why.before:.0f} %; correct the masks or the poses"
        )
    words = (
        f"{disagreement.words()}; check the calibration, and that the masks are the object's"
    )
    if failure is not None and (disagreement.agree or disagreement.verdict is None):
        raise failure
    if carved is None or disagreement.covered < _HOPELESS:
        raise GeometryError(
            f"hull: expected silhouettes of one object, received contradicting ones: {words}"
        ) from failure
    return _Outcome(carved, warnings=(words,))


def _outcome_with_outliers(
    views: Sequence[View],
    silhouettes: Sequence[NDArray[np.floating]],
    carver: _Carver,
    disagreement: Disagreement,
    usable: _Carved | None,
) -> _Outcome:
    """Hull without the views that contradict the others, or with them, as options say."""
    kept = [view for i, view in enumerate(views) if i not in disagreement.outliers]
    options = carver.options
    try:
        others = carver.carved(kept, 0)
    except GeometryError:
        others = None
    contradictions = tuple(_contradictions(views, silhouettes, disagreement, others))
    words = [contradiction.words(len(kept)) for contradiction in contradictions]
    harmless = len(kept) < LEAST_WITNESSES and all(
        one.excluded < CONTRADICTION and one.explanation is None for one in contradictions
    )
    if options.tolerance == AUTO and usable is not None and harmless:
        # A silhouette that is too large removes nothing of the object, and where no mistake
        # explains it, it may be the few others that miss a dark side.
        said = tuple(f"{text}; the hull is made with it" for text in words)
        return _Outcome(usable, contradictions, (), said)
    if options.tolerance == AUTO and others is not None:
        left_out = tuple(contradiction.view for contradiction in contradictions)
        said = tuple(f"{text}; the hull is made without it" for text in words)
        return _Outcome(others, contradictions, left_out, said)
    remedy = "correct it or leave the view out"
    if options.tolerance != AUTO:
        remedy += ', or set hull.tolerance = "auto", which makes the hull without it'
    if usable is None:
        raise GeometryError(
            "hull: expected silhouettes of one object, received contradicting ones: "
            f"{'; '.join(words)}; {remedy}"
        )
    return _Outcome(usable, contradictions, (), tuple(f"{text}; {remedy}" for text in words))


def _contradictions(
    views: Sequence[View],
    silhouettes: Sequence[NDArray[np.floating]],
    disagreement: Disagreement,
    others: _Carved | None,
) -> Iterator[Contradiction]:
    """What each view that contradicts the others does, and the mistake that explains it."""
    assert disagreement.verdict is not None
    for i in disagreement.outliers:
        camera = views[i].camera
        swapped = [
            (views[j].camera.id, silhouettes[j]) for j in disagreement.outliers if j != i
        ]
        why = None
        if others is not None:
            why = explain_view(camera, silhouettes[i], others.mesh, swapped)
        verdict = disagreement.verdict
        yield Contradiction(
            camera.id, float(verdict.excluded[i]), float(verdict.uncovered[i]), why
        )


def _suspicious(views: Sequence[View], carved: _Carved, fit: Agreement) -> bool:
    """Whether a hull misses more of a silhouette than its voxels and blurred edges explain."""
    if fit.missing.max() > _SUSPICIOUS_IF_THIN:
        return True
    bounds, spacing = carved.mesh.bounds, carved.grid.spacing
    # Who disagrees is asked on a coarser grid, where less is seen.
    spacing = max(spacing, float(np.ptp(bounds, axis=0).max()) / FINEST_VOTES)
    centre = bounds.mean(axis=0)[None]
    for view, lost in zip(views, fit.lost, strict=True):
        some, _, _ = compared_pixels(view.camera)
        pixel = max(float(view.distance_and_pixel(centre)[1][0]), np.finfo(np.float64).tiny)
        depth = view.outline.values[some, some]
        inner = lost & (depth > 1.0 + spacing / pixel)
        if inner.sum() > _SUSPICIOUS * (depth > 0.0).sum():
            return True
    return False


def _check_inside(volume: NDArray[np.float32], views: Sequence[View]) -> None:
    """Demand that the object ends before its grid does; name the views that cut it off.

    Raises
    ------
    GeometryError
        If it does not: no closed surface could be made of it.
    """
    ends = [volume.take(end, axis) for axis in range(3) for end in (0, -1)]
    if any((end > 0.0).any() for end in ends):
        cut = listed([view.camera.id for view in views if view.outline.leaves_image])
        raise GeometryError(
            "hull: expected silhouettes that bound the object on all sides, received some that "
            f"the borders of their images cut off ({cut or 'none'}); leave out views that do "
            "not show the whole object, or add views from other sides"
        )


def closed_surface(
    volume: NDArray[np.float32], grid: Grid, options: HullOptions, views: Sequence[View]
) -> Mesh:
    """Closed mesh of the zero level, cleaned as the options say."""
    if options.blur:
        volume = gaussian_filter(volume, options.blur, mode="nearest")
        volume[np.abs(volume) < 1e-3] = 1e-3
    if not (volume > 0.0).any():
        raise GeometryError(
            "hull: expected an object thicker than a voxel, received one that smoothing "
            "removes; raise hull.resolution or lower hull.blur"
        )
    _check_inside(volume, views)
    points, faces, _, _ = marching_cubes(volume, level=0.0, gradient_direction="ascent")
    mesh = Mesh(grid.origin + points.astype(np.float64) * grid.spacing, faces)
    mesh = keep_large_components(mesh, options.minimum_component)
    if not mesh.watertight:
        raise GeometryError(
            "hull: expected a closed surface, received one with open or shared edges; "
            "change hull.resolution slightly"
        )
    mesh = smooth(mesh, options.smoothing)
    return decimate(mesh, options.n_triangles) if options.n_triangles else mesh
