r"""Visual hull: the largest body that fits all silhouettes.

The hull is the zero level of the smallest signed distance over all views,
:math:`f(x) = \min_v d_v(\pi_v(x))\, z_v(x) / f_v`, where :math:`d_v` is the signed
distance to the outline in pixels and depth over focal length turns it into metres.
Only a narrow band around that level is evaluated, on a grid refined from coarse cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import linprog
from skimage.measure import marching_cubes

from reflfield.capture.cameras import Camera
from reflfield.errors import GeometryError, InputError
from reflfield.geometry.mesh import Mesh, decimate, keep_large_components, smooth
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.silhouettes import SignedDistance, signed_distance
from reflfield.progress import track

Array = NDArray[np.float64]

# Allowance on the slope of the signed distance, for its error far from the outline.
_SLOPE_ALLOWANCE = 1.1

# Coarsest cells along the longest side. Fewer would only add levels, more cost time.
_COARSE_CELLS = 12

_LARGEST_RESOLUTION = 512
_BLOCK_POINTS = 1 << 16

# Directions in which each silhouette is bounded by a straight line when the box is sought.
_N_TANGENTS = 16

# Pixels along the longer side of the pictures in which hull and silhouettes are compared.
_OVERLAP_PIXELS = 256


@dataclass(frozen=True)
class HullOptions:
    """How finely the hull is carved and how it is cleaned.

    Parameters
    ----------
    resolution : int
        Voxels along the longest side of the object's bounding box, 8 .. 512.
    tolerance : int
        Views that may disagree at a point without carving it away. 0 is the hull proper;
        1 or 2 suit photographs whose silhouettes miss thin parts in single views, and
        make the hull fatter wherever that many views carry the shape alone.
    blur : float
        Standard deviation, voxels, of a Gaussian over the signed distance. It removes the
        saw teeth of sharp ridges, which would cost decimation and charts dearly.
    smoothing : int
        Iterations of Taubin smoothing, which remove the rest of the grid.
    n_triangles : int
        Triangles after decimation; 0 keeps all.
    minimum_component : float
        Parts with a smaller share of the largest part's area are dropped.
    bounds : pair of (3,) float, optional
        Lowest and highest corner of a box, metres, to use instead of the one found from
        the silhouettes: needed where the object leaves the frame in too many views.
    """

    resolution: int = 192
    tolerance: int = 0
    blur: float = 0.7
    smoothing: int = 60
    n_triangles: int = 20_000
    minimum_component: float = 0.01
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    def __post_init__(self) -> None:
        if not 8 <= self.resolution <= _LARGEST_RESOLUTION:
            raise InputError(
                f"resolution: expected 8 .. {_LARGEST_RESOLUTION} voxels, "
                f"received {self.resolution}"
            )
        for name in ("tolerance", "blur", "smoothing", "n_triangles", "minimum_component"):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected >= 0, received {getattr(self, name)}")


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
    overlap : (n_views,) float64
        Intersection over union of the mesh's silhouette and the given one, for pixels in
        the frame. Far below 1: calibration or silhouette of that view disagrees.
    leaves_frame : (n_views,) bool
        True where the object touches the border of the image.
    """

    spacing: float
    grid: tuple[int, int, int]
    n_evaluated: int
    volume: float
    area: float
    n_triangles: int
    overlap: Array
    leaves_frame: NDArray[np.bool_]


def visual_hull(
    cameras: Sequence[Camera],
    silhouettes: Sequence[NDArray[np.floating]],
    options: HullOptions | None = None,
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
    views = _prepare(cameras, silhouettes)
    low, high = _object_bounds(views, options)
    grid = _Grid.around(low, high, options.resolution)
    volume, n_evaluated = _carve(views, grid, options.tolerance)
    mesh = _surface(volume, grid, options)
    report = HullReport(
        spacing=grid.spacing,
        grid=grid.shape,
        n_evaluated=n_evaluated,
        volume=mesh.volume,
        area=mesh.area,
        n_triangles=len(mesh.faces),
        overlap=silhouette_overlap(mesh, cameras, silhouettes),
        leaves_frame=np.array([view.outline.leaves_frame for view in views]),
    )
    return mesh, report


def silhouette_overlap(
    mesh: Mesh, cameras: Sequence[Camera], silhouettes: Sequence[NDArray[np.floating]]
) -> Array:
    """Intersection over union of a mesh's silhouettes and given ones, (n_views,) float64.

    Pixels count as covered from one half on. Large images are compared on every k-th
    pixel of every k-th row, so that about 256 remain along the longer side.
    """
    scene = RayScene(mesh)
    found = np.zeros(len(cameras))
    for number, (camera, silhouette) in enumerate(zip(cameras, silhouettes, strict=True)):
        step = max(1, round(max(camera.width, camera.height) / _OVERLAP_PIXELS))
        covered = np.asarray(silhouette)[step // 2 :: step, step // 2 :: step] >= 0.5
        row, col = np.mgrid[: covered.shape[0], : covered.shape[1]] * step + step // 2 + 0.5
        pixels = np.stack([col.ravel(), row.ravel()], axis=1)
        hit = np.isfinite(scene.pixel_depths(camera, pixels)).reshape(covered.shape)
        found[number] = (hit & covered).sum() / max((hit | covered).sum(), 1)
    return found


@dataclass(frozen=True, eq=False)
class _View:
    """One camera with the distance to its silhouette's outline."""

    camera: Camera
    outline: SignedDistance

    def distance(self, points: Array) -> Array:
        """Signed distance (n,) to the silhouette's cone, metres; positive inside."""
        pixels, depth = self.camera.project(points)
        perspective = self.camera.kind != "orthographic"
        imaged = np.isfinite(pixels).all(axis=1) & ((depth > 0.0) | (not perspective))
        # What a camera cannot image is empty, unless it does not see the whole object.
        distance = np.full(len(points), np.inf if self.outline.leaves_frame else -np.inf)
        focal = 0.5 * (self.camera.fl_x + self.camera.fl_y)
        metres = (depth[imaged] if perspective else 1.0) / focal
        distance[imaged] = self.outline.at(pixels[imaged]) * metres
        return distance

    @property
    def steepest(self) -> float:
        """Largest change of the distance per metre: 1 / cos(angle off the optical axis)."""
        if self.camera.kind == "orthographic":
            return 1.0
        tangent = np.linalg.norm(_normalised(self.camera, self.outline.outline), axis=1).max()
        return float(np.hypot(1.0, tangent))


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cubic voxels that cover the box of the object with a border of empty ones."""

    origin: Array
    spacing: float
    shape: tuple[int, int, int]
    n_levels: int

    @classmethod
    def around(cls, low: Array, high: Array, resolution: int) -> _Grid:
        spacing = float((high - low).max()) / resolution
        n_levels = max(0, int(np.log2(resolution / _COARSE_CELLS)))
        block = 1 << n_levels
        # Two empty voxels on each side, then whole coarse cells.
        blocks = np.ceil(((high - low) / spacing + 4.0) / block - 1e-9).astype(int)
        nx, ny, nz = (int(n) * block for n in blocks)
        origin = 0.5 * (low + high) - 0.5 * spacing * np.array([nx, ny, nz])
        return cls(origin, spacing, (nx, ny, nz), n_levels)


def _prepare(
    cameras: Sequence[Camera], silhouettes: Sequence[NDArray[np.floating]]
) -> list[_View]:
    """Check and measure the silhouettes."""
    if len(cameras) != len(silhouettes) or not cameras:
        raise InputError(
            f"silhouettes: expected one for each of {len(cameras)} cameras (at least one), "
            f"received {len(silhouettes)}"
        )
    views = []
    pairs = zip(cameras, silhouettes, strict=True)
    for camera, silhouette in track(pairs, len(cameras), "silhouettes"):
        if np.shape(silhouette) != (camera.height, camera.width):
            raise InputError(
                f"silhouette of view {camera.id!r}: expected {camera.height} rows x "
                f"{camera.width} columns as its camera says, received {np.shape(silhouette)}"
            )
        outline = signed_distance(silhouette, f"silhouette of view {camera.id!r}")
        views.append(_View(camera, outline))
    return views


# ---------------------------------------------------------------- bounding box


def _object_bounds(views: list[_View], options: HullOptions) -> tuple[Array, Array]:
    r"""Box around everything that at most `tolerance` views contradict.

    Among ``tolerance + 1`` groups of views at least one has no view that contradicts
    a point of the hull, so the boxes of the groups' own hulls together hold it.
    """
    if options.bounds is not None:
        low, high = np.array(options.bounds, dtype=np.float64)
        if not (low < high).all():
            raise InputError(
                f"bounds: expected lowest < highest corner, received {low}, {high}"
            )
        return low, high
    origin, scale = _whereabouts(views)
    n_groups = options.tolerance + 1
    boxes = [_box(views[group::n_groups], origin, scale) for group in range(n_groups)]
    found = [box for box in boxes if box is not None]
    if not found:
        _refuse_contradiction(views, origin, scale)
    low = np.min([box[0] for box in found], axis=0)
    high = np.max([box[1] for box in found], axis=0)
    return origin + scale * low, origin + scale * high


def _whereabouts(views: list[_View]) -> tuple[Array, float]:
    """Rough centre and size of the object: where rays through the silhouettes' middles meet.

    The box is sought in these units, in which the solver's tolerances make sense.
    """
    normal_matrix, right_side = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        middle = 0.5 * (view.outline.outline.min(axis=0) + view.outline.outline.max(axis=0))
        start, towards = (ray[0] for ray in view.camera.rays(middle[None]))
        across = np.eye(3) - np.outer(towards, towards)
        normal_matrix += across
        right_side += across @ start
    solution = np.linalg.lstsq(normal_matrix, right_side, rcond=1e-9)[0]
    centre = np.asarray(solution, dtype=np.float64)
    sizes = [_size_at(view, centre) for view in views]
    return centre, float(np.median(sizes))


def _size_at(view: _View, centre: Array) -> float:
    """Length that the silhouette's larger side has at the depth of a point, metres."""
    extent = np.ptp(view.outline.outline, axis=0).max() + 1.0
    if view.camera.kind == "orthographic":
        return float(extent / view.camera.fl_x)
    # A point in the camera itself would give size zero.
    distance = max(np.linalg.norm(view.camera.centre - centre), np.finfo(np.float64).tiny)
    return float(extent * distance / view.camera.fl_x)


def _box(views: list[_View], origin: Array, scale: float) -> tuple[Array, Array] | None:
    """Box of the intersection of the views' outlines' cones, in units of the whereabouts.

    None if there is no such point.
    """
    planes = [_half_spaces(view, origin, scale) for view in views]
    normals = np.concatenate([normal for normal, _ in planes])
    offsets = np.concatenate([offset for _, offset in planes])
    extremes = np.zeros((2, 3))
    for axis in range(3):
        for side, sign in enumerate((1.0, -1.0)):
            solution = linprog(
                sign * np.eye(3)[axis], A_ub=normals, b_ub=offsets, bounds=(None, None)
            )
            if solution.status == 2:
                return None
            if solution.status != 0:
                _refuse_unbounded(axis)
            extremes[side, axis] = sign * solution.fun
    return extremes[0], extremes[1]


def _half_spaces(view: _View, origin: Array, scale: float) -> tuple[Array, Array]:
    """Half spaces ``normals @ x <= offsets`` that hold the silhouette's cone.

    A side on which the object leaves the frame is not bounded.
    """
    camera = view.camera
    outline, rim = (
        _normalised(camera, points) for points in (view.outline.outline, view.outline.rim)
    )
    angles = 2.0 * np.pi * np.arange(_N_TANGENTS) / _N_TANGENTS
    tangents = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pixel = 1.0 / min(camera.fl_x, camera.fl_y)
    reach = (outline @ tangents.T).max(axis=0) + pixel
    rim_reach = (rim @ tangents.T).max(axis=0, initial=-np.inf)
    bounded = rim_reach < reach - 2.0 * pixel
    tangents, reach = tangents[bounded], reach[bounded]
    rotation, shift = camera.rotation, camera.camera_from_world[:3, 3]
    if camera.kind == "orthographic":
        normals = tangents @ rotation[:2]
        offsets = reach - tangents @ shift[:2]
    else:
        # tangent . (X, Y) <= reach * Z, and Z >= 0
        in_camera = np.concatenate([tangents, -reach[:, None]], axis=1)
        in_camera = np.concatenate([in_camera, [[0.0, 0.0, -1.0]]])
        normals, offsets = in_camera @ rotation, -in_camera @ shift
    lengths = np.linalg.norm(normals, axis=1)
    return normals / lengths[:, None], (offsets - normals @ origin) / lengths / scale


def _normalised(camera: Camera, pixels: Array) -> Array:
    """Undistorted image coordinates X/Z, Y/Z (orthographic: X, Y) of pixels (n, 2)."""
    origins, directions = camera.rays(pixels)
    if camera.kind == "orthographic":
        return (origins @ camera.rotation.T + camera.camera_from_world[:3, 3])[:, :2]
    in_camera = directions @ camera.rotation.T
    return in_camera[:, :2] / in_camera[:, 2:]


def _refuse_unbounded(axis: int) -> None:
    raise GeometryError(
        f"hull: expected silhouettes that bound the object on all sides, received views that "
        f"leave it open along world {'xyz'[axis]}; add views from other sides, give "
        "hull.bounds, or use the base geometry 'plane' for a single view"
    )


def _refuse_contradiction(views: list[_View], origin: Array, scale: float) -> None:
    """Name the first view whose cone misses the intersection of those before it."""
    planes = [_half_spaces(view, origin, scale) for view in views]
    for number in range(1, len(views) + 1):
        normals, offsets = (np.concatenate(part) for part in zip(*planes[:number], strict=True))
        solution = linprog(np.zeros(3), A_ub=normals, b_ub=offsets, bounds=(None, None))
        if solution.status == 2:
            _refuse_empty(views[number - 1])
    _refuse_empty(views[-1])


def _refuse_empty(view: _View) -> None:
    raise GeometryError(
        f"hull: expected silhouettes of one object, received contradicting ones: in the order "
        f"of the views, {view.camera.id!r} is the first that leaves nothing; check its camera "
        "and silhouette, leave the view out, or raise hull.tolerance or hull.resolution"
    )


# ---------------------------------------------------------------- carving


def _carve(views: list[_View], grid: _Grid, tolerance: int) -> tuple[NDArray[np.float32], int]:
    """Signed distances at the corners of all voxels, exact near the surface.

    Returns
    -------
    volume : (nx + 1, ny + 1, nz + 1) float32
        In voxels, clipped to [-2, 2]; negative on the border of the grid.
    n_evaluated : int
    """
    state = np.zeros([n >> grid.n_levels for n in grid.shape], dtype=np.int8)
    slope = _SLOPE_ALLOWANCE * max(view.steepest for view in views)
    n_evaluated = 0
    # Of the finest cells the corners are evaluated anyway: centres stop one level above.
    for level in range(grid.n_levels, 0, -1):
        undecided = np.argwhere(state == 0)
        centres = grid.origin + (undecided + 0.5) * (grid.spacing * (1 << level))
        band = slope * 0.5 * np.sqrt(3.0) * grid.spacing * (1 << level)
        values = _smallest(views, centres, tolerance, band)
        n_evaluated += len(centres)
        if not (values > -band).any() and not (state > 0).any():
            _refuse_empty(views[_first_emptying(views, centres, tolerance, band)])
        decided = np.where(values > band, 1, np.where(values < -band, -1, 0))
        state[tuple(undecided.T)] = decided
        state = _halved(state)
    return _corner_values(views, grid, state, tolerance, n_evaluated)


def _halved(state: NDArray[np.int8]) -> NDArray[np.int8]:
    """Each cell becomes eight of the same state."""
    for axis in range(3):
        state = np.repeat(state, 2, axis=axis)
    return state


def _corner_values(
    views: list[_View], grid: _Grid, state: NDArray[np.int8], tolerance: int, n_evaluated: int
) -> tuple[NDArray[np.float32], int]:
    """Evaluate the corners of undecided voxels; the others only have a sign."""
    volume = np.where(_at_corners(state > 0), np.float32(2.0), np.float32(-2.0))
    corners = np.argwhere(_at_corners(state == 0))
    points = grid.origin + corners * grid.spacing
    values = _smallest(views, points, tolerance, 2.0 * grid.spacing)
    if not ((values > 0.0).any() or (state > 0).any()):
        _refuse_empty(views[_first_emptying(views, points, tolerance, 0.0)])
    in_voxels = np.clip(values / grid.spacing, -2.0, 2.0)
    # A value of exactly zero would make triangles without area.
    in_voxels[np.abs(in_voxels) < 1e-3] = 1e-3
    volume[tuple(corners.T)] = in_voxels
    # The outermost layer is empty, so that the surface closes inside the grid.
    for axis in range(3):
        for side in (0, -1):
            layer = np.moveaxis(volume, axis, 0)[side]
            np.minimum(layer, -1e-3, out=layer)
    return volume, n_evaluated + len(corners)


def _at_corners(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True at the eight corners of each voxel that is True."""
    corners = np.pad(voxels, ((0, 1),) * 3)
    for axis in range(3):
        moved = np.moveaxis(corners, axis, 0)
        moved[1:] |= moved[:-1].copy()
    return corners


def _smallest(views: list[_View], points: Array, tolerance: int, cutoff: float) -> Array:
    """Signed distance (n,) that only `tolerance` views undercut, metres.

    Points found below ``-cutoff`` are not followed further: their value is some number
    below ``-cutoff``.
    """
    values = np.zeros(len(points))
    for begin in range(0, len(points), _BLOCK_POINTS):
        block = slice(begin, begin + _BLOCK_POINTS)
        values[block] = _smallest_of_block(views, points[block], tolerance, cutoff)
    return values


def _smallest_of_block(
    views: list[_View], points: Array, tolerance: int, cutoff: float
) -> Array:
    lowest = np.full((tolerance + 1, len(points)), np.inf)
    alive = np.arange(len(points))
    for view in views:
        _insert(lowest, alive, view.distance(points[alive]))
        alive = alive[lowest[-1, alive] >= -cutoff]
    return lowest[-1]


def _insert(lowest: Array, columns: NDArray[np.intp], values: Array) -> None:
    """Put new values into the sorted lists of lowest ones, ascending along axis 0."""
    for row in lowest:
        held = row[columns]
        row[columns] = np.minimum(held, values)
        values = np.maximum(held, values)


def _first_emptying(views: list[_View], points: Array, tolerance: int, cutoff: float) -> int:
    """Index of the view after which no point is left above ``-cutoff``."""
    lowest = np.full((tolerance + 1, len(points)), np.inf)
    columns = np.arange(len(points))
    for number, view in enumerate(views):
        _insert(lowest, columns, view.distance(points))
        if not (lowest[-1] > -cutoff).any():
            return number
    return len(views) - 1


# ---------------------------------------------------------------- surface


def _check_inside(volume: NDArray[np.float32]) -> None:
    """Demand that the object ends before its grid does.

    Raises
    ------
    GeometryError
        If it does not: no closed surface could be made of it.
    """
    ends = [volume.take(end, axis) for axis in range(3) for end in (0, -1)]
    if any((end > 0.0).any() for end in ends):
        raise GeometryError(
            "hull: expected silhouettes that bound the object on all sides, received some that "
            "the borders of their images cut off; leave out views that do not show the whole "
            "object, or add views from other sides"
        )


def _surface(volume: NDArray[np.float32], grid: _Grid, options: HullOptions) -> Mesh:
    """Closed mesh of the zero level, cleaned as the options say."""
    if options.blur:
        volume = gaussian_filter(volume, options.blur, mode="nearest")
        volume[np.abs(volume) < 1e-3] = 1e-3
    if not (volume > 0.0).any():
        raise GeometryError(
            "hull: expected an object thicker than a voxel, received one that smoothing "
            "removes; raise hull.resolution or lower hull.blur"
        )
    _check_inside(volume)
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
