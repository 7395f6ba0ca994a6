"""Texture atlas: the surface cut into charts and laid out in one texture."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import GeometryError, InputError, ReflfieldError
from reflfield.geometry.box_charts import box_charts
from reflfield.geometry.mesh import Mesh
from reflfield.util.child_processes import tied
from reflfield.util.validation import check_ranges, check_shape

Array = NDArray[np.float64]

_METHODS = ("xatlas", "boxes")
# Side of a texture: more texels than photographs have pixels.
LARGEST_TEXTURE = 1 << 15
# Seconds beyond a week are a slip, and more than the system can wait for.
_RANGES = {"padding": (0, 64), "time_limit_s": (0, 1e6), "max_cost": (-1e6, 1e6)}
# A texture with more padding than this share of its side has no place for charts, and packing
# looks for one for minutes.
LEAST_TEXELS_PER_PADDING, LEAST_PADDING = 16, 2

# Triangles that xatlas unwraps in at most a few minutes of one core, however rough they are:
# 20,000 take 2 to 13 s, 80,000 smooth ones 23 s.
MOST_FACES = 100_000

WORKER = "reflfield.geometry.xatlas_worker"
# Signals by which a process ends that has gone wrong by itself.
CRASHES = (signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGILL)


@dataclass(frozen=True)
class AtlasOptions:
    """How the surface is cut and laid out.

    Parameters
    ----------
    resolution : int
        Side of the square texture, texels; about half of them will be used. 0 leaves the
        choice to the pipeline, which looks at the photographs.
    padding : int
        Empty texels between charts; at most a sixteenth of the texture's side.
    time_limit_s : float
        A guard against a hang: xatlas is stopped after this time, and that is an error. What
        it may take is bounded otherwise (`MOST_FACES`), so that a busy machine makes the same
        atlas.
    max_cost : float
        Growth of xatlas' charts: higher gives fewer, more distorted charts.
    method : {"xatlas", "boxes"}
        "boxes": charts by the six main directions, always fast, many seams.
    """

    resolution: int = 256
    padding: int = 2
    time_limit_s: float = 3600.0
    max_cost: float = 2.0
    method: str = "xatlas"

    def __post_init__(self) -> None:
        if self.method not in _METHODS:
            raise InputError(
                f"method: expected one of {', '.join(_METHODS)}, received {self.method!r}"
            )
        if self.resolution != 0 and not 4 <= self.resolution <= LARGEST_TEXTURE:
            raise InputError(
                f"resolution: expected 4 to {LARGEST_TEXTURE} texels, or 0 for a density of "
                f"texels, received {self.resolution}"
            )
        check_ranges(self, _RANGES)
        most = max(LEAST_PADDING, self.resolution // LEAST_TEXELS_PER_PADDING)
        if self.resolution and self.padding > most:
            raise InputError(
                f"padding: expected at most {most} texels in a texture of {self.resolution} x "
                f"{self.resolution}, received {self.padding}; lower it, or raise the resolution"
            )
        if not self.time_limit_s > 0:
            raise InputError(f"time_limit_s: expected > 0, received {self.time_limit_s}")


@dataclass(frozen=True, eq=False)
class Atlas:
    """A mesh with texture coordinates; vertices are repeated along chart borders.

    Parameters
    ----------
    positions : (n, 3) float64
        Vertices, metres.
    faces : (m, 3) int32
        Triangles, in the order of the mesh they come from.
    uv : (n, 2) float64
        Texture coordinates in [0, 1]; u to the right, v UP: v = 1 is the top row
        of the texture. (glTF counts v downwards: its v is 1 - v.)
    chart : (m,) int32
        Chart of each triangle, 0 .. n_charts - 1.
    normals : (n, 3) float64
        Smooth unit normals.
    height, width : int
        Size of the texture in texels that the charts were laid out for.

    Raises
    ------
    ShapeError
        If arrays do not fit each other.
    InputError
        If a coordinate leaves [0, 1] or a face names a vertex that does not exist.
    """

    positions: Array
    faces: NDArray[np.int32]
    uv: Array
    chart: NDArray[np.int32]
    normals: Array
    height: int
    width: int

    def __post_init__(self) -> None:
        for name, dtype in _COLUMNS.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            object.__setattr__(self, name, array)
        check_shape("uv", self.uv, (len(self.positions), 2))
        check_shape("normals", self.normals, (len(self.positions), 3))
        check_shape("chart", self.chart, (len(self.faces),))
        if self.height < 1 or self.width < 1:
            raise InputError(
                f"atlas: expected a texture of at least 1 x 1 texels, received "
                f"{self.width} x {self.height}"
            )
        if not ((self.uv >= 0.0) & (self.uv <= 1.0)).all():
            raise InputError(
                f"uv: expected values in [0, 1], received {self.uv.min():.4g} .. "
                f"{self.uv.max():.4g}; divide by the size of the texture"
            )
        _ = self.mesh  # checks positions and faces

    @cached_property
    def mesh(self) -> Mesh:
        """Triangles without texture coordinates, vertices as here."""
        return Mesh(self.positions, self.faces)

    @property
    def n_charts(self) -> int:
        """Number of charts."""
        return int(self.chart.max(initial=-1)) + 1

    @cached_property
    def mirrored(self) -> NDArray[np.bool_]:
        """True for charts that the texture shows mirrored, (n_charts,)."""
        return np.bincount(self.chart, self.uv_areas, minlength=self.n_charts) < 0.0

    @cached_property
    def uv_areas(self) -> Array:
        """Signed area of each triangle in texture space, (m,); negative: mirrored."""
        first, second, third = np.moveaxis(self.uv[self.faces], 1, 0)
        (a1, b1), (a2, b2) = (second - first).T, (third - first).T
        return 0.5 * (a1 * b2 - a2 * b1)


_COLUMNS = {
    "positions": np.float64,
    "faces": np.int32,
    "uv": np.float64,
    "chart": np.int32,
    "normals": np.float64,
}


class UnwrappingError(ReflfieldError):
    """xatlas cannot unwrap a mesh, on no machine: simpler charts can."""


@dataclass(frozen=True, eq=False)
class BuiltAtlas:
    """An atlas, and how it was made.

    Parameters
    ----------
    atlas : Atlas
    method : {"xatlas", "boxes"}
    reason : str
        Why the method is not the one asked for; empty if it is.
    """

    atlas: Atlas
    method: str
    reason: str = ""


def fallback_words(reason: str) -> str:
    """Sentence on why an atlas is made of box charts, without its end."""
    return f"{reason}; the atlas is made of box charts, which have more seams"


def built_atlas(mesh: Mesh, options: AtlasOptions | None = None) -> BuiltAtlas:
    """Cut a mesh into charts and pack them into a square texture; say how.

    xatlas runs in a process of its own. Meshes that are too much work for it (more than
    `MOST_FACES` triangles), that crash it or whose charts do not fit get the simple charts of
    `box_charts`. All of this depends on the mesh alone: how fast or busy the machine is, and
    how many cores it has, changes nothing.

    Parameters
    ----------
    mesh : Mesh
        About 20,000 smooth triangles unwrap in a few seconds into some tens of charts;
        raw marching cubes would give thousands.
    options : AtlasOptions, optional

    Returns
    -------
    BuiltAtlas

    Raises
    ------
    GeometryError
        If the mesh has no area, its charts do not fit into the texture at all, or xatlas
        does not answer for a reason that lies in the machine (time, memory, installation).
    """
    options = options or AtlasOptions()
    if not mesh.area > 0.0:
        raise GeometryError("mesh: expected a surface with area, received none")
    reason = ""
    if options.method == "xatlas":
        try:
            return BuiltAtlas(_xatlas_atlas(mesh, options), "xatlas")
        except UnwrappingError as error:
            reason = str(error)
    charts = box_charts(mesh, options.resolution, options.padding)
    atlas = _assembled(
        mesh, charts.source_vertex, charts.faces, charts.chart, charts.uv, options
    )
    return BuiltAtlas(atlas, "boxes", reason)


def _xatlas_atlas(mesh: Mesh, options: AtlasOptions) -> Atlas:
    if len(mesh.faces) > MOST_FACES:
        raise UnwrappingError(
            f"xatlas is not asked to unwrap more than {MOST_FACES} triangles, and the mesh has "
            f"{len(mesh.faces)} (hull.n_triangles lowers that)"
        )
    # Area 1 around the origin: xatlas works in single precision with fixed tolerances.
    unit = (mesh.vertices - mesh.bounds.mean(axis=0)) / np.sqrt(mesh.area)
    job = {
        "positions": unit.astype(np.float32),
        "normals": mesh.vertex_normals.astype(np.float32),
        "faces": mesh.faces.astype(np.uint32),
        "resolution": np.array(options.resolution),
        "padding": np.array(options.padding),
        "max_cost": np.array(options.max_cost),
    }
    made = _run_worker(job, options.time_limit_s)
    if "refused" in made:
        raise UnwrappingError(f"xatlas could not unwrap the mesh: {made['refused']}")
    faces, chart = made["faces"].astype(np.int64), made["chart"].astype(np.int64)
    source = made["source_vertex"].astype(np.int64)
    if not np.array_equal(source[faces], mesh.faces):
        raise UnwrappingError("xatlas returned other triangles than it was given")
    uv = made["uv"].astype(np.float64) / options.resolution
    uncharted = chart < 0
    # Faces without area belong to no chart: they become a point of the first one.
    uv[faces[uncharted]] = uv[faces[np.argmax(~uncharted), 0]]
    chart[uncharted] = 0
    return _assembled(mesh, source, faces, chart, uv, options)


def _run_worker(
    job: dict[str, NDArray[np.generic]], time_limit_s: float
) -> dict[str, NDArray[np.generic]]:
    """Hand the job to `xatlas_worker` and wait for its answer."""
    package_parent = str(Path(__file__).resolve().parents[2])
    paths = [package_parent, os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    with tempfile.TemporaryDirectory(prefix="reflfield-") as folder:
        source, target = Path(folder, "in.npz"), Path(folder, "out.npz")
        np.savez(source, allow_pickle=False, **job)
        command = tied([sys.executable, "-m", WORKER, str(source), str(target)])
        done = _answer(command, environment, time_limit_s, len(job["faces"]))
        _check_answer(done.returncode, done.stderr)
        with np.load(target, allow_pickle=False) as made:
            return dict(made)


def _answer(
    command: list[str], environment: dict[str, str], time_limit_s: float, n_faces: int
) -> subprocess.CompletedProcess[str]:
    """Outcome of the worker's process, which is stopped if it hangs."""
    try:
        return subprocess.run(
            command,
            env=environment,
            timeout=time_limit_s,
            capture_output=True,
            text=True,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise GeometryError(
            f"atlas: expected xatlas to unwrap {n_faces} triangles within "
            f"{time_limit_s:g} s, received no answer; raise atlas.time_limit_s if the machine "
            'is busy, lower hull.n_triangles, or set atlas.method = "boxes"'
        ) from None


def _check_answer(status: int, said: str) -> None:
    """Refuse what the worker failed at, by whether that is the mesh's doing.

    Raises
    ------
    UnwrappingError
        If xatlas crashed: it would again.
    GeometryError
        If the process was killed or could not do its work.
    """
    last = "".join(said.strip().splitlines()[-1:])
    if status < 0 and -status in CRASHES:
        raise UnwrappingError(f"xatlas crashed ({signal.Signals(-status).name})")
    if status:
        why = f"was killed by signal {-status}" if status < 0 else last or f"status {status}"
        raise GeometryError(
            f"atlas: expected xatlas to unwrap the mesh, but its process failed ({why}); run "
            'again with more memory free, or set atlas.method = "boxes"'
        )


def _assembled(
    mesh: Mesh,
    source_vertex: NDArray[np.integer],
    faces: NDArray[np.integer],
    chart: NDArray[np.integer],
    uv: NDArray[np.floating],
    options: AtlasOptions,
) -> Atlas:
    """Atlas whose vertices are copies of the mesh's."""
    return Atlas(
        positions=mesh.vertices[source_vertex],
        faces=faces.astype(np.int32),
        uv=np.clip(uv, 0.0, 1.0),
        chart=chart.astype(np.int32),
        normals=mesh.vertex_normals[source_vertex],
        height=options.resolution,
        width=options.resolution,
    )
