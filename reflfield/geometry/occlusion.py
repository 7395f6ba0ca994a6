"""What each texel sees: occlusion towards cameras and lights by ray tracing.

Near cameras and near lights are points: every texel has its own ray to them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.lights import Light
from reflfield.errors import InputError
from reflfield.geometry.ray_scene import RayScene, row_strips
from reflfield.geometry.texels import TexelTable
from reflfield.util.image_boxes import bounding_box
from reflfield.util.late_import import LateImport
from reflfield.util.validation import check_ranges, check_shape
from reflfield.util.vector_lengths import lengths

cv2: Any = LateImport("cv2")

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Pixels, and a share of the object's diagonal.
_RANGES = {
    "edge_band": (0, 1e6),
    "edge_slope": (0, 1e6),
    "ray_offset": (0, 0.1),
}
# Lights that come from everywhere or from nowhere known: no single ray can miss them.
_WITHOUT_DIRECTION = ("environment", "unknown")


@dataclass(frozen=True)
class VisibilityOptions:
    """When a texel counts as seen and as lit.

    Parameters
    ----------
    grazing_cosine : float
        Views whose angle to the smooth normal has a smaller cosine are rejected: a pixel
        there covers many texels.
    light_cosine : float
        Lights at or below this cosine over the smooth normal do not light the texel.
    edge_band : float
        Rejected distance from depth discontinuities in the photograph, pixels.
    edge_slope : float
        Neighbouring pixels whose depths differ by more than this many pixel footprints
        are a discontinuity. At the grazing limit .15 a plane differs by 6.6 footprints.
    ray_offset : float
        Start of the rays above the surface, in diagonals of the mesh's bounding box.
    coverage : float
        Least coverage of a pixel by the silhouette, where one is given.
    """

    grazing_cosine: float = 0.15
    light_cosine: float = 0.0
    edge_band: float = 1.5
    edge_slope: float = 10.0
    ray_offset: float = 2e-4
    coverage: float = 0.5

    def __post_init__(self) -> None:
        for name in ("grazing_cosine", "light_cosine", "coverage"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise InputError(
                    f"{name}: expected a number in [0, 1), received {getattr(self, name)}"
                )
        check_ranges(self, _RANGES)


def lifted_positions(
    texels: TexelTable,
    scene: RayScene,
    options: VisibilityOptions,
    rows: NDArray[np.intp] | slice = slice(None),
) -> Array:
    """Positions of texels, or some, raised off the surface by the ray offset, (n, 3)."""
    lift = options.ray_offset * scene.diagonal
    return texels.position[rows] + lift * texels.face_normal[rows]


def view_visibility(
    texels: TexelTable,
    scene: RayScene,
    camera: Camera,
    options: VisibilityOptions | None = None,
    edges: Bools | None = None,
    silhouette: NDArray[np.floating] | Bools | None = None,
) -> Bools:
    """Which texels a camera sees well enough to sample its photograph.

    A texel is visible when it projects into the frame, is not seen at a grazing
    angle, nothing blocks the ray to the camera, no depth discontinuity lies
    within `edge_band` pixels of it in the photograph, and the photograph's
    silhouette, if given, covers its pixel.

    Parameters
    ----------
    texels : TexelTable
    scene : RayScene
        Of the mesh the texels lie on.
    camera : Camera
    options : VisibilityOptions, optional
    edges : (height, width) bool, optional
        Result of `depth_edges` for this camera, to share it between blocks of texels.
    silhouette : (height, width) float or bool, optional
        Coverage of the object in [0, 1]; texels on pixels below `coverage` are not seen.
        Of use where the base geometry is larger than the object, as an image plane is.

    Returns
    -------
    (n,) bool

    Raises
    ------
    ShapeError
        If `edges` or `silhouette` has another size than the camera's images.
    """
    options = options or VisibilityOptions()
    usable = np.ones((camera.height, camera.width), dtype=bool)
    if silhouette is not None:
        check_shape("silhouette", silhouette, usable.shape)
        usable &= silhouette >= options.coverage
    if options.edge_band > 0.0:
        edges = depth_edges(scene, camera, options) if edges is None else edges
        check_shape("edges", edges, usable.shape)
        usable &= ~edges
    visible = _faces_camera(texels, camera, options)
    visible &= _on_usable_pixel(texels, camera, usable)
    seen = np.flatnonzero(visible)
    if not _is_flat(scene):
        starts = lifted_positions(texels, scene, options, seen)
        visible[seen] = ~scene.occluded(
            starts, camera.view_directions(starts), _camera_distances(camera, starts)
        )
    return visible


def depth_edges(scene: RayScene, camera: Camera, options: VisibilityOptions) -> Bools:
    """Pixels within `edge_band` of a depth discontinuity, (height, width) bool.

    A discontinuity lies between two neighbouring pixels if only one of them hits
    the surface, or their depths differ by more than `edge_slope` footprints.

    Examples
    --------
    >>> from reflfield.geometry.mesh import Mesh
    >>> square = Mesh([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], [[0, 2, 1], [0, 3, 2]])
    >>> pose = np.eye(4)
    >>> pose[2, 3] = 1.0
    >>> camera = Camera("v", "orthographic", 6, 1, 1.0, 1.0, 0.0, 0.0, pose)
    >>> depth_edges(RayScene(square), camera, VisibilityOptions(edge_band=1.0))
    array([[False, False, False,  True,  True, False]])
    """
    reach = math.ceil(options.edge_band) + 1
    edges = np.zeros((camera.height, camera.width), dtype=bool)
    for first, end in row_strips(camera):
        low, high = max(first - reach, 0), min(end + reach, camera.height)
        strip = _edges_of_rows(scene, camera, options, low, high)
        edges[first:end] = strip[first - low : end - low]
    return edges


def _edges_of_rows(
    scene: RayScene, camera: Camera, options: VisibilityOptions, first: int, end: int
) -> Bools:
    """`depth_edges` of some rows, which alone are looked at."""
    depth = scene.row_depths(camera, first, end)
    footprint = _footprint(camera, depth)
    across, down = _jumps(depth, footprint, options), _jumps(depth.T, footprint.T, options)
    beside = np.zeros(depth.shape, dtype=bool)
    beside[:, 1:] |= across
    beside[:, :-1] |= across
    beside[1:] |= down.T
    beside[:-1] |= down.T
    near = np.zeros(depth.shape, dtype=bool)
    if beside.any():
        window = bounding_box(beside, math.ceil(options.edge_band))
        away = cv2.distanceTransform(
            (~beside[window]).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
        )
        # The centres of the two pixels beside an edge are half a pixel away from it.
        near[window] = away + 0.5 <= options.edge_band
    return near


def light_visibility(
    texels: TexelTable,
    scene: RayScene,
    light: Light,
    options: VisibilityOptions | None = None,
) -> Bools:
    """Which texels a light reaches: above the horizon and not shadowed by the mesh.

    Parameters
    ----------
    texels : TexelTable
    scene : RayScene
        Of the mesh the texels lie on.
    light : Light
        Environment and unknown lights reach every texel.
    options : VisibilityOptions, optional

    Returns
    -------
    (n,) bool
    """
    options = options or VisibilityOptions()
    if light.kind in _WITHOUT_DIRECTION:
        return np.ones(len(texels), dtype=bool)
    lit = _faces_light(texels, light, options)
    if _is_flat(scene):
        return lit
    rows = np.flatnonzero(lit)
    starts = lifted_positions(texels, scene, options, rows)
    lit[rows] = ~scene.occluded(starts, light.directions(starts), light.distances(starts))
    return lit


def _is_flat(scene: RayScene) -> bool:
    """Whether the mesh lies in a plane z = constant, no point of which hides another."""
    return bool(np.ptp(scene.mesh.vertices[:, 2]) == 0.0)


def check_light_outside(scene: RayScene, light: Light) -> None:
    """Refuse a light that stands inside the object.

    Raises
    ------
    InputError
        Naming the light.
    """
    if light.kind in ("point", "spot") and scene.inside(light.position[None])[0]:
        raise InputError(
            f"light {light.id!r}: expected a position outside the object, received "
            f"{np.round(light.position, 4).tolist()} inside its hull; check the light's "
            "position, its units (metres) and its frame"
        )


def cameras_inside(scene: RayScene, cameras: Sequence[Camera]) -> tuple[str, ...]:
    """Names of the cameras that stand inside the object.

    Raises
    ------
    InputError
        If all do.
    """
    standing = [camera for camera in cameras if camera.kind != "orthographic"]
    inside = scene.inside(np.array([camera.centre for camera in standing]).reshape(-1, 3))
    if len(cameras) and inside.sum() == len(cameras):
        raise InputError(
            f"cameras: expected positions outside the object, received {len(cameras)} that are "
            f"all inside its hull, such as {standing[0].id!r} at "
            f"{np.round(standing[0].centre, 4).tolist()}; check the poses, their units and "
            "whether they are camera-to-world"
        )
    return tuple(camera.id for camera, within in zip(standing, inside, strict=True) if within)


def _faces_camera(texels: TexelTable, camera: Camera, options: VisibilityOptions) -> Bools:
    """True where the camera is in front of both the smooth and the real surface."""
    towards = camera.view_directions(texels.position)
    cosine = np.einsum("nd,nd->n", towards, texels.normal)
    in_front = np.einsum("nd,nd->n", towards, texels.face_normal) > 0
    return np.asarray((cosine >= options.grazing_cosine) & in_front)


def _on_usable_pixel(texels: TexelTable, camera: Camera, usable: Bools) -> Bools:
    """True where a texel projects into the image, onto a pixel that may be sampled."""
    pixels, depth = camera.project(texels.position)
    in_front = (depth > 0.0) | (camera.kind == "orthographic")
    in_image = np.flatnonzero(in_front & camera.contains(pixels))
    col, row = np.floor(pixels[in_image]).astype(np.int64).T
    on_usable = np.zeros(len(texels), dtype=bool)
    on_usable[in_image] = usable[row, col]
    return on_usable


def _faces_light(texels: TexelTable, light: Light, options: VisibilityOptions) -> Bools:
    cosine = np.einsum("nd,nd->n", light.directions(texels.position), texels.normal)
    return np.asarray(cosine > options.light_cosine)


def _camera_distances(camera: Camera, points: Array) -> Array:
    if camera.kind == "orthographic":
        return np.full(len(points), np.inf)
    return lengths(camera.centre - points)


def _footprint(camera: Camera, depth: Array) -> Array:
    """Width of a pixel at the depth of the surface, metres."""
    focal = min(camera.fl_x, camera.fl_y)
    if camera.kind == "orthographic":
        return np.full(depth.shape, 1.0 / focal)
    return depth / focal


def _jumps(depth: Array, footprint: Array, options: VisibilityOptions) -> Bools:
    """True between horizontal neighbours of very different depth, (h, w - 1)."""
    left, right = depth[:, :-1], depth[:, 1:]
    one_misses = np.isfinite(left) != np.isfinite(right)
    both_hit = np.isfinite(left) & np.isfinite(right)
    step = np.abs(np.subtract(left, right, out=np.zeros_like(left), where=both_hit))
    nearer = np.minimum(footprint[:, :-1], footprint[:, 1:])
    limit = options.edge_slope * np.where(both_hit, nearer, 0.0)
    return one_misses | (both_hit & (step > limit))
