"""Scores against the truth that simulated captures carry.

The truth is read from files alone (``truth/`` of a capture directory); the
scores are pure functions of arrays:

* `hull_distance`: how far the visual hull lies from the true surface;
* `frame_errors`: angles between recovered and true normals and tangents;
* `completion_error`: samples filled in, against the true apparent BRDFs.

Pictures against true pictures are `reflfield.comparison.metrics.compare_frames`.
"""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from reflfield.capture.documents import read_json
from reflfield.checks import check_shape
from reflfield.errors import CaptureError, InputError, ShapeError
from reflfield.files import load_arrays, read_bytes
from reflfield.geometry.open3d_library import open3d

Array = NDArray[np.float64]

TRUTH_VERSION = 1
# A file that takes more memory is not read; nor a view of more than eleven doubles a pixel.
MOST_BYTES = 1 << 30
BYTES_PER_PIXEL = 88
# Arrays of the files, and the lengths of their axes; one name is one length within a file.
VIEW_SHAPES = {
    "depth": "h w",
    "position": "h w 3",
    "normal": "h w 3",
    "tangent": "h w 3",
    "label": "h w",
}
SAMPLE_SHAPES = {
    "position": "n 3",
    "frame": "n 3 3",
    "views": "n views 3",
    "lights": "n lights 3",
    "light_visible": "n lights",
    "samples": "n views lights 3",
}
# Enough for percentiles to one part in a hundred; a second of work.
HULL_SAMPLES = 20_000
# Frames between surface points: a line through that many, of one material and
# no farther apart in angle than a curved surface is between pixels.
FRAME_NEIGHBOURS = 12
NEIGHBOUR_COSINE = 0.85
TEXELS_PER_BLOCK = 16_384
# Surface points kept of all views together to match texels with.
MAX_SURFACE_POINTS = 1_000_000


# --- files ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TruthView:
    """What one camera truly sees, per pixel.

    Attributes
    ----------
    depth : (h, w) float32
        Distance along the ray of the pixel centre, metres; inf where it misses.
    position, normal, tangent : (h, w, 3) float32
        Surface point, shading normal and shading tangent, world frame.
    label : (h, w) int
        Material; -1 where the ray misses.
    """

    depth: NDArray[np.float32]
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    tangent: NDArray[np.float32]
    label: NDArray[np.integer[Any]]


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth of a simulated capture; pictures and views are read on demand.

    Attributes
    ----------
    root : Path
        Folder of the capture.
    description : mapping
        Content of ``truth.json``.
    """

    root: Path
    description: Mapping[str, Any]

    def mesh(self) -> tuple[Array, NDArray[np.int32]]:
        """Vertices (n, 3), metres, and faces (m, 3) of the true surface."""
        path = self.path("mesh", "truth/mesh.ply")
        if path.suffix.lower() != ".ply":
            raise CaptureError(f"{path}: expected a mesh in a PLY file")
        content = read_bytes(path, MOST_BYTES, CaptureError)
        try:
            loaded = trimesh.load(
                io.BytesIO(content), file_type="ply", process=False, force="mesh"
            )
            vertices = np.array(loaded.vertices, np.float64).reshape(-1, 3)
            faces = np.array(loaded.faces, np.int32).reshape(-1, 3)
        except Exception as error:  # whatever its readers raise on damaged files
            text = " ".join(str(error).split()) or type(error).__name__
            raise CaptureError(
                f"{path}: expected a mesh, received a damaged or different file ({text})"
            ) from error
        promised = re.search(rb"element[ \t]+face[ \t]+(\d{1,18})", content)
        whole = promised is None or int(promised[1]) <= len(faces)
        inside = whole and ((faces >= 0) & (faces < len(vertices))).all()
        if not len(faces) or not inside or not np.isfinite(vertices).all():
            raise CaptureError(
                f"{path}: expected a mesh of faces between finite vertices, received "
                f"{len(vertices)} vertices and {len(faces)} faces that are not, or not all"
            )
        return vertices, faces

    def view(self, camera_id: str, size: tuple[int, int] | None = None) -> TruthView:
        """What the camera of this name, of (width, height) pixels, truly sees."""
        path, names = self._view_path(camera_id), TruthView.__annotations__
        most = MOST_BYTES if size is None else BYTES_PER_PIXEL * (size[0] * size[1] + 1024)
        arrays = load_arrays(path, most, CaptureError, names)
        _check_arrays(path, arrays, VIEW_SHAPES)
        if size is not None and arrays["depth"].shape != size[::-1]:
            raise CaptureError(
                f"{path}: expected {size[0]} x {size[1]} pixels as the camera has, received "
                f"{arrays['depth'].shape[1]} x {arrays['depth'].shape[0]}"
            )
        for name in ("position", "normal", "tangent", "depth"):
            if np.isnan(arrays[name]).any():
                raise CaptureError(f"{path}: {name}: expected numbers, received NaN")
        return TruthView(**{name: arrays[name] for name in names})

    def has_view(self, camera_id: str) -> bool:
        """Whether the truth of this camera's pixels was written."""
        return os.path.lexists(self._view_path(camera_id))

    def heldout(self) -> Path | None:
        """The frames file of unseen views and lights, if there is one."""
        path = self.path("heldout", "truth/heldout.json")
        return path if os.path.lexists(path) else None

    def samples(self) -> dict[str, NDArray[Any]] | None:
        """True apparent BRDFs of some surface points (``abrdf.npz``), if written.

        See `SAMPLE_SHAPES`. Positions and directions are finite; samples may be NaN.
        """
        path = self.path("abrdf", "truth/abrdf.npz")
        if not os.path.lexists(path):
            return None
        arrays = load_arrays(path, MOST_BYTES, CaptureError, SAMPLE_SHAPES)
        _check_arrays(path, arrays, SAMPLE_SHAPES)
        for name in ("position", "views", "lights", "frame"):
            if not np.isfinite(arrays[name]).all():
                raise CaptureError(f"{path}: {name}: expected finite numbers")
        return arrays

    def path(self, key: str, default: str) -> Path:
        """File that ``truth.json`` names under a key, inside the capture."""
        return _inside(self.root, self._named(key, default))

    def _view_path(self, camera_id: str) -> Path:
        pattern = self._named("views", "truth/views/{camera}.npz")
        return _inside(self.root, pattern.replace("{camera}", camera_id))

    def _named(self, key: str, default: str) -> str:
        named = self.description.get(key, default)
        if not isinstance(named, str):
            raise CaptureError(
                f"{self.root / 'truth' / 'truth.json'}: {key}: expected a path, received "
                f"{named!r:.100}"
            )
        return named


def open_truth(root: Path | str) -> Truth | None:
    """Open the truth of a capture directory.

    Parameters
    ----------
    root : Path or str
        Folder that holds ``truth/truth.json``.

    Returns
    -------
    Truth or None
        None where the capture carries no truth (photographs).

    Raises
    ------
    CaptureError
        If the file is not valid or of a newer version.
    """
    path = Path(root) / "truth" / "truth.json"
    if not os.path.lexists(path):
        return None
    description = read_json(path)
    version = description.get("version")
    if version != TRUTH_VERSION:
        raise CaptureError(
            f"{path}: expected version {TRUTH_VERSION}, received {version!r}; simulate again "
            "or update reflfield"
        )
    return Truth(Path(root), description)


# --- hull -------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class HullDistance:
    """Signed distances of points on the hull from the true surface, metres.

    Attributes
    ----------
    signed : (n_samples,) float64
        Positive outside of the object.
    voxel : float or None
        Edge of the hull's finest grid cell, metres.
    """

    signed: Array
    voxel: float | None = None

    @property
    def outside(self) -> float:
        """Share of the hull's area that lies outside of the object."""
        return float((self.signed > 0).mean())

    def summary(self) -> dict[str, float]:
        """Mean, RMS, 95th percentile and maximum distance; shares of either side."""
        size = np.abs(self.signed)
        in_metres = {
            "mean": size.mean(),
            "rms": np.sqrt(np.mean(size**2)),
            "p95": np.percentile(size, 95),
            "max": size.max(),
        }
        found = {f"{name}_mm": float(v * 1e3) for name, v in in_metres.items()}
        if self.voxel is not None:
            found |= {f"{name}_voxels": float(v / self.voxel) for name, v in in_metres.items()}
        return found | {"outside_share": self.outside, "inside_share": 1.0 - self.outside}


def hull_distance(
    hull: tuple[ArrayLike, ArrayLike],
    truth: tuple[ArrayLike, ArrayLike],
    *,
    voxel: float | None = None,
    n_samples: int = HULL_SAMPLES,
    seed: int = 0,
) -> HullDistance:
    """Distance of the hull's surface from the true surface.

    Parameters
    ----------
    hull, truth : ((n, 3) float, (m, 3) int)
        Vertices (metres) and faces. Faces of the truth are counter-clockwise
        seen from outside; it need not be closed.
    voxel : float, optional
        Edge of the hull's grid cell, metres, to express the distances in.
    n_samples : int
        Points drawn on the hull, uniform by area.
    seed : int
        Of the draw.

    Returns
    -------
    HullDistance

    Raises
    ------
    InputError
        If a mesh has no face or no area, or `voxel` is not positive.

    Notes
    -----
    Inside or outside is decided by the true surface's interpolated vertex
    normal at the nearest point. Counting crossings would need a closed mesh.

    Examples
    --------
    A cube of edge 2.2 around a cube of edge 2: everything outside, .1 away from
    the faces, up to .1 * sqrt(3) near the corners:

    >>> import trimesh
    >>> cubes = [trimesh.creation.box([edge] * 3) for edge in (2.2, 2.0)]
    >>> d = hull_distance(*((c.vertices, c.faces) for c in cubes))
    >>> float(np.median(d.signed).round(6)), d.outside
    (0.1, 1.0)
    """
    if voxel is not None and not voxel > 0.0:
        raise InputError(f"voxel: expected a positive length in metres, received {voxel}")
    points = _points_on(*_checked_mesh("hull", hull), n_samples, seed)
    return HullDistance(_signed_distances(points, *_checked_mesh("truth", truth)), voxel)


# --- frames -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of the true surface that some view sees, to match texels with.

    Attributes
    ----------
    position, normal, tangent : (n, 3) float64
    label : (n,) int64
    """

    position: Array
    normal: Array
    tangent: Array
    label: NDArray[np.int64]


def surface_points(
    views: Sequence[TruthView] | Iterator[TruthView], max_points: int = MAX_SURFACE_POINTS
) -> SurfacePoints:
    """True surface points with their shading frames, from the pixels of views.

    Parameters
    ----------
    views : iterable of TruthView
        Read once.
    max_points : int
        Evenly thinned to at most about this many.

    Returns
    -------
    SurfacePoints
        Pixels that miss the surface or have no frame are left out.
    """
    parts = [_seen_pixels(view) for view in views]
    columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
    if not columns:
        columns = [np.zeros((0, 3))] * 3 + [np.zeros(0, np.int64)]
    step = max(1, math.ceil(len(columns[0]) / max_points))
    position, normal, tangent, label = (column[::step] for column in columns)
    return SurfacePoints(position, normal, tangent, label)


@dataclass(frozen=True)
class FreeTurn:
    r"""Turn about the normal that the reflectance leaves open, taken out of the tangents.

    A target's own tangent is a choice: turned together with all of its frames it explains
    the samples as well. So for every target, and every material that it serves, the turn
    :math:`\frac12 \arg \sum_i e^{2 i \varphi_i}` is removed, :math:`\varphi_i` being the angle
    from the true to the recovered tangent; doubled, as half a turn changes nothing.

    Attributes
    ----------
    target, label : int
        Target of the alignment, and true material.
    degrees : float
        -90 to 90.
    n_texels : int
    """

    target: int
    label: int
    degrees: float
    n_texels: int


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """Angles between recovered and true frames, degrees.

    Attributes
    ----------
    texel : (n_matched,) int64
        Texels that have a true frame near them.
    normal, tangent : (n_matched,) float64
        Angle between normals, and between the *lines* of the tangents: turning
        a tangent by 180 degrees does not change an anisotropic reflectance.
        One turn about the normal is free for each target and material, and removed.
    label : (n_matched,) int64
        Material of the matched surface point.
    turns : tuple of FreeTurn
        What was removed; empty if no targets were named.
    """

    texel: NDArray[np.int64]
    normal: Array
    tangent: Array
    label: NDArray[np.int64]
    turns: tuple[FreeTurn, ...] = ()

    def of_material(self, label: int) -> FrameErrors:
        """Errors of the texels of one material."""
        mine = self.label == label
        turns = tuple(turn for turn in self.turns if turn.label == label)
        return FrameErrors(
            self.texel[mine], self.normal[mine], self.tangent[mine], self.label[mine], turns
        )

    def summary(self) -> dict[str, float]:
        """Mean, median and 95th percentile of both angles, degrees, and the count."""
        found: dict[str, float] = {"n_texels": float(len(self.texel))}
        for name, angles in (("normal", self.normal), ("tangent", self.tangent)):
            known = angles if angles.size else np.array([math.nan])
            found[f"{name}_mean_deg"] = float(np.mean(known))
            found[f"{name}_median_deg"] = float(np.median(known))
            found[f"{name}_p95_deg"] = float(np.percentile(known, 95))
        return found


def frame_errors(
    positions: ArrayLike,
    local_from_world: ArrayLike,
    surface: SurfacePoints,
    max_distance: float,
    targets: ArrayLike | None = None,
) -> FrameErrors:
    """Angles of texel frames to the true shading frames nearest to them.

    Parameters
    ----------
    positions : (n_texels, 3) array_like
        Metres, world frame.
    local_from_world : (n_texels, 3, 3) array_like
        Rows tangent, binormal, normal: recovered frames, or base frames for
        comparison. Frames that are not finite are left out.
    surface : SurfacePoints
        From `surface_points`. Between its points normals and tangents are
        interpolated linearly, within one material.
    max_distance : float
        Texels farther than this from any true point are left out, metres: where
        the hull bridges a hollow, no texel shows one point of the surface.
    targets : (n_texels,) array_like of int, optional
        Target that each texel was aligned to: one turn about the normal is removed for
        each of them and each material, see `FreeTurn`. None removes nothing.

    Returns
    -------
    FrameErrors

    Raises
    ------
    ShapeError
        If the arrays do not belong together.

    Examples
    --------
    A frame turned by 180 degrees about its normal is right; one tilted by 90
    degrees about its tangent has the right tangent and a wrong normal:

    >>> point = SurfacePoints(*np.eye(3)[[0, 2, 0], None], np.zeros(1, int))
    >>> turned = np.diag([-1.0, -1.0, 1.0])
    >>> tilted = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    >>> errors = frame_errors(np.eye(3)[[0, 0]], np.stack([turned, tilted]), point, 0.1)
    >>> errors.normal.round(9).tolist(), errors.tangent.round(9).tolist()
    ([0.0, 90.0], [0.0, 0.0])
    """
    texels = np.asarray(positions, dtype=np.float64)
    frames = np.asarray(local_from_world, dtype=np.float64)
    check_shape("positions", texels, (None, 3))
    check_shape("local_from_world", frames, (len(texels), 3, 3))
    nothing = np.zeros(0, np.int64)
    if not len(surface.position):
        return FrameErrors(nothing, np.zeros(0), np.zeros(0), nothing)
    tree = cKDTree(surface.position)
    distance, nearest = tree.query(texels)
    usable = (distance <= max_distance) & np.isfinite(frames).all(axis=(1, 2))
    matched, found = np.flatnonzero(usable), frames[usable]
    true = [(np.zeros((0, 3)), np.zeros((0, 3)))]
    for first in range(0, len(matched), TEXELS_PER_BLOCK):
        block = matched[first : first + TEXELS_PER_BLOCK]
        true.append(_interpolated_frames(tree, surface, texels[block]))
    normal, tangent = (np.concatenate(part) for part in zip(*true, strict=True))
    label = surface.label[nearest[matched]]
    turns: tuple[FreeTurn, ...] = ()
    own_tangent = found[:, 0]
    if targets is not None:
        target = np.asarray(targets)
        check_shape("targets", target, (len(texels),))
        turns, own_tangent = _without_free_turns(found, normal, tangent, target[matched], label)
    return FrameErrors(
        matched,
        angle_deg(found[:, 2], normal),
        _line_angle_deg(own_tangent, tangent),
        label,
        turns,
    )


def _without_free_turns(
    frames: Array,
    normal: Array,
    tangent: Array,
    target: NDArray[np.integer[Any]],
    label: NDArray[np.int64],
) -> tuple[tuple[FreeTurn, ...], Array]:
    """Turns that are free, and the tangents (n, 3) without them."""
    # The doubled angle in the plane of the true normal.
    across = np.cross(normal, tangent)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    tangent = np.cross(across, normal)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-300)
    along, aside = (np.einsum("nd,nd->n", frames[:, 0], axis) for axis in (tangent, across))
    doubled = np.exp(2j * np.arctan2(aside, along))
    turns, angle = [], np.zeros(len(frames))
    for key in np.unique(np.stack([target, label], axis=1), axis=0):
        mine = (target == key[0]) & (label == key[1])
        angle[mine] = 0.5 * np.angle(doubled[mine].sum())
        degrees = float(np.degrees(angle[mine][0]))
        turns.append(FreeTurn(int(key[0]), int(key[1]), degrees, int(mine.sum())))
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return tuple(turns), c * frames[:, 0] - s * frames[:, 1]


def angle_deg(a: ArrayLike, b: ArrayLike) -> Array:
    r"""Angle between vectors, degrees, accurate near 0 and 180.

    :math:`2 \arctan(|a' - b'| / |a' + b'|)` with unit :math:`a', b'` (Kahan).

    Parameters
    ----------
    a, b : (..., 3) array_like
        Not zero.

    Returns
    -------
    (...) float64

    Examples
    --------
    >>> angle_deg([[1, 0, 0], [1, 0, 0]], [[0, 2, 0], [1, 1e-9, 0]]).round(9).tolist()
    [90.0, 5.7e-08]
    """
    first, second = (np.asarray(v, dtype=np.float64) for v in (a, b))
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    apart = np.linalg.norm(first - second, axis=-1)
    return np.degrees(2.0 * np.arctan2(apart, np.linalg.norm(first + second, axis=-1)))


# --- completion -------------------------------------------------------------------


@dataclass(frozen=True)
class CompletionError:
    r"""Relative error :math:`\|x - t\| / \|t\|` of completed samples.

    Attributes
    ----------
    unobserved, observed : float
        Over entries that were filled in, and over those that were measured;
        nan if there is none.
    unobserved_cube_root, observed_cube_root : float
        The same after the cube root, in which dark samples count too.
    n_unobserved, n_observed : int
        Entries of either kind.
    """

    unobserved: float
    observed: float
    unobserved_cube_root: float
    observed_cube_root: float
    n_unobserved: int
    n_observed: int


def completion_error(
    completed: ArrayLike, true: ArrayLike, observed: ArrayLike
) -> CompletionError:
    """Error of filled-in samples against the true apparent BRDFs.

    Parameters
    ----------
    completed, true : (...) array_like
        Linear samples on the same directions. Entries whose truth is not finite
        are left out.
    observed : (...) array_like of bool
        True where the sample was measured. May lack trailing axes (colour).

    Returns
    -------
    CompletionError

    Raises
    ------
    ShapeError
        If the shapes do not agree.
    InputError
        If a completed entry is not finite although its truth is.

    Examples
    --------
    The one unobserved entry is 1 instead of 2:

    >>> e = completion_error([[4.0, 1.0]], [[4.0, 2.0]], [[True, False]])
    >>> e.unobserved, e.observed
    (0.5, 0.0)
    """
    got, want = (np.asarray(a, dtype=np.float64) for a in (completed, true))
    seen = np.asarray(observed, dtype=bool)
    if got.shape != want.shape or got.shape[: seen.ndim] != seen.shape:
        raise ShapeError(
            f"completed, true, observed: expected one shape, received {got.shape}, "
            f"{want.shape}, {seen.shape}"
        )
    seen = np.broadcast_to(seen.reshape(seen.shape + (1,) * (got.ndim - seen.ndim)), got.shape)
    known = np.isfinite(want)
    if not np.isfinite(got[known]).all():
        raise InputError("completed: expected finite samples, received NaN or infinity")
    hidden, measured = known & ~seen, known & seen
    return CompletionError(
        unobserved=_relative_error(got[hidden], want[hidden]),
        observed=_relative_error(got[measured], want[measured]),
        unobserved_cube_root=_relative_error(np.cbrt(got[hidden]), np.cbrt(want[hidden])),
        observed_cube_root=_relative_error(np.cbrt(got[measured]), np.cbrt(want[measured])),
        n_unobserved=int(hidden.sum()),
        n_observed=int(measured.sum()),
    )


# --- helpers ----------------------------------------------------------------------


def _inside(root: Path, relative: str) -> Path:
    path = root / relative
    try:
        inside = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a NUL character
        raise CaptureError(f"{relative!r}: expected a path, received none ({error})") from error
    if not inside:
        raise CaptureError(f"{relative!r}: expected a path inside {root}, received one outside")
    return path


def _check_arrays(
    path: Path, arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, str]
) -> None:
    """Demand numbers, and axes of one name to be of one length in all arrays."""
    lengths: dict[str, int] = {}
    for name, axes in shapes.items():
        array, expected = arrays[name], axes.split()
        fits = array.ndim == len(expected) and array.dtype.kind in "biuf"
        if not fits or any(
            lengths.setdefault(axis, int(axis) if axis.isdigit() else length) != length
            for axis, length in zip(expected, array.shape, strict=True)
        ):
            raise CaptureError(
                f"{path}: {name}: expected numbers of shape ({', '.join(expected)}), received "
                f"{array.dtype} of shape {array.shape}"
            )


def _checked_mesh(
    name: str, mesh: tuple[ArrayLike, ArrayLike]
) -> tuple[Array, NDArray[np.int64]]:
    vertices = np.asarray(mesh[0], dtype=np.float64)
    faces = np.asarray(mesh[1], dtype=np.int64)
    check_shape(f"{name} vertices", vertices, (None, 3))
    check_shape(f"{name} faces", faces, (None, 3))
    if not len(faces):
        raise InputError(f"{name}: expected a mesh with faces, received none")
    return vertices, faces


def _face_vectors(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Twice the area times the normal of each face."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def _points_on(vertices: Array, faces: NDArray[np.int64], n_samples: int, seed: int) -> Array:
    area = np.linalg.norm(_face_vectors(vertices, faces), axis=1)
    if not area.sum() > 0.0:
        raise InputError("hull: expected faces with an area, received degenerate ones only")
    rng = np.random.default_rng(seed)
    # One draw per equal slice of area: even coverage, and less noise than free draws.
    share = (np.arange(n_samples) + rng.uniform(size=n_samples)) / n_samples
    face = np.searchsorted(np.cumsum(area) / area.sum(), share, side="right")
    u, v = rng.uniform(size=(2, n_samples))
    root = np.sqrt(u)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)
    corners = vertices[faces[np.minimum(face, len(faces) - 1)]]
    return np.einsum("nk,nkd->nd", weights, corners)


def _signed_distances(points: Array, vertices: Array, faces: NDArray[np.int64]) -> Array:
    scene = open3d.t.geometry.RaycastingScene()
    # Embree works in float32: measured from the mesh's own centre and in its own size.
    centre, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    scene.add_triangles(
        open3d.core.Tensor(((vertices - centre) / size).astype(np.float32)),
        open3d.core.Tensor(faces.astype(np.uint32)),
    )
    query = open3d.core.Tensor(((points - centre) / size).astype(np.float32))
    found = scene.compute_closest_points(query)
    face = found["primitive_ids"].numpy().astype(np.int64)
    uv = found["primitive_uvs"].numpy().astype(np.float64)
    weights = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
    nearest = np.einsum("nk,nkd->nd", weights, vertices[faces[face]])
    normal = np.einsum("nk,nkd->nd", weights, _vertex_normals(vertices, faces)[faces[face]])
    offset = points - nearest
    sign = np.where(np.einsum("nd,nd->n", offset, normal) < 0.0, -1.0, 1.0)
    return sign * np.linalg.norm(offset, axis=1)


def _vertex_normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Unit mean of the faces' unit normals, weighted by the angle at the vertex."""
    corners = vertices[faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    cosine = np.einsum("fkd,fkd->fk", ahead, behind)
    sine = np.linalg.norm(np.cross(ahead, behind), axis=2)
    vectors = _face_vectors(vertices, faces)
    unit = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces, np.arctan2(sine, cosine)[..., None] * unit[:, None])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _seen_pixels(view: TruthView) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    frames = np.concatenate([view.position, view.normal, view.tangent], axis=-1)
    seen = (view.label >= 0) & np.isfinite(view.depth) & np.isfinite(frames).all(axis=-1)
    seen &= (np.abs(view.normal).max(axis=-1) > 0) & (np.abs(view.tangent).max(axis=-1) > 0)
    position, normal, tangent = (
        a[seen].astype(np.float64) for a in (view.position, view.normal, view.tangent)
    )
    return position, normal, tangent, view.label[seen].astype(np.int64)


def _interpolated_frames(
    tree: cKDTree, surface: SurfacePoints, positions: Array
) -> tuple[Array, Array]:
    """Normals and tangents of the surface at positions between its points."""
    count = min(FRAME_NEIGHBOURS, len(surface.position))
    distance, near = tree.query(positions, k=range(1, count + 1))
    offset = surface.position[near] - positions[:, None]
    normal, tangent = surface.normal[near], surface.tangent[near]
    alike = (surface.label[near] == surface.label[near[:, :1]]) & (
        np.einsum("nkd,nd->nk", normal, normal[:, 0]) > NEIGHBOUR_COSINE
    )
    reach = np.maximum(distance[:, -1:], 1e-300)
    weight = alike * np.exp(-2.0 * (distance / reach) ** 2)
    # Tangents are lines: turn all to the side of the nearest.
    side = np.where(np.einsum("nkd,nd->nk", tangent, tangent[:, 0]) < 0.0, -1.0, 1.0)
    vectors = np.concatenate([normal, side[..., None] * tangent], axis=2)
    fitted = _value_at_origin(offset / reach[..., None], vectors, weight)
    return fitted[:, :3], fitted[:, 3:]


def _value_at_origin(offset: Array, values: Array, weight: Array) -> Array:
    r"""Constant part of a weighted linear fit, for every row.

    Minimises :math:`\sum_k w_k |v_k - a - B x_k|^2 + \epsilon |B|^2`; the second
    term keeps slopes at 0 in directions without points, such as the normal.

    Parameters
    ----------
    offset : (n, k, 3) float64
    values : (n, k, d) float64
    weight : (n, k) float64

    Returns
    -------
    (n, d) float64
    """
    design = np.concatenate([np.ones_like(offset[..., :1]), offset], axis=2)
    weighted = weight[..., None] * design
    gram = np.einsum("nki,nkj->nij", weighted, design)
    gram[:, [1, 2, 3], [1, 2, 3]] += 1e-6 * gram[:, :1, 0]
    solved = np.linalg.solve(gram, np.einsum("nki,nkd->nid", weighted, values))
    return np.asarray(solved[:, 0])


def _line_angle_deg(a: Array, b: Array) -> Array:
    angle = angle_deg(a, b)
    return np.minimum(angle, 180.0 - angle)


def _relative_error(got: Array, want: Array) -> float:
    size = float(np.linalg.norm(want))
    return float(np.linalg.norm(got - want)) / size if size > 0.0 else math.nan
