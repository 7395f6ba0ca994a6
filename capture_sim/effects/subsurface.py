r"""Light that enters a translucent body and leaves it elsewhere: the dipole, over the surface.

The body sends to all sides the radiance

.. math:: L(x) = \frac{1}{\pi} \int R(|x - y|)\, E(y)\, \mathrm{d}A_y,

with the irradiance `E` by direct light and the profile `R` of `Dipole`. It depends on no
viewer and is computed once for all of them, on nodes of a grid in every triangle; points in
between take the mean of the nodes about them. Close to `x`, where `R` is steeper than the
grid resolves, the surface is taken for flat and `E` for even.

Limits: the dipole is that of a flat, thick, homogeneous medium, so that thin parts let too
little light through and too much light crosses gaps; what enters and leaves is matte, its
Fresnel terms are part of the albedo; light thrown by other parts of the object does not enter
the body.

References
----------
H. W. Jensen and J. Buhler, "A rapid hierarchical rendering technique for translucent
materials", SIGGRAPH 2002 (irradiance on points of the surface first).
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from capture_sim.arrival import LightArrays
from capture_sim.effects import Cost, Decision, Stage, Workload, simulated
from capture_sim.effects import shadows as shadows_effect
from capture_sim.effects.bounds import pixels_per_metre
from capture_sim.errors import scene_error
from capture_sim.materials.translucent import Translucent
from capture_sim.model import Scene
from capture_sim.objects import SurfaceMesh
from capture_sim.rays import RayTracer
from capture_sim.shading import BYTES_PER_PAIR, direct_light
from capture_sim.surface import SurfacePoints, surface_points
from capture_sim.tables import bounded
from capture_sim.visibility import Nodes, TracedLights, nodes_about

NAME = "subsurface"
STAGE = Stage.TRANSPORT

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Where the profile has fallen to e^-9 of itself; less than 1e-3 of the light gets farther.
REACH = 9.0
# Nodes that cell sizes are refused beyond: their pairs would take hours.
MOST_NODES = 200_000
# Light of a body that is kept for other views, and the irradiance that it is made of.
BYTES_KEPT = 12
BYTES_PER_PAIR_OF_NODE = 8
# Values of the profile that are tabulated: a hundredth of the light's depth apart.
TABLE = 1 << 13
# The profile is replaced by its integral within so many steps of the grid.
STEPS_NEARBY = 2.0


@dataclass(frozen=True)
class Options:
    """How finely the surface is cut.

    Attributes
    ----------
    steps : float
        Steps of the grid in the shortest diffusion length.
    """

    steps: float = bounded(3.0, low=0.5, high=100.0)


def needed(scene: Scene) -> Decision:
    """Bound the change: all that the body reflects, or what crosses a part of a pixel."""
    material = scene.material
    if not isinstance(material, Translucent):
        return Decision("the material is not translucent", 0.0)
    reach = max(material.length)
    crossed = min(1.0, REACH * reach * pixels_per_metre(scene))
    reason = f"light gets {1e3 * reach:.2g} mm through the body (dipole)"
    return Decision(reason, scene.brightness.headroom * max(material.albedo) * crossed)


def cost(scene: Scene, work: Workload) -> Cost:
    """Irradiance at the nodes, and exchange among those in reach of each other."""
    if not isinstance(scene.material, Translucent):
        return Cost()
    nodes = len(Nodes.of(scene.mesh, _spacing(scene, scene.material)))
    return Cost(rays=nodes * work.n_lights, operations=work.n_points * work.n_lights)


def apply(
    scene: Scene,
    tracer: RayTracer,
    points: SurfacePoints,
    views: Array,
    lights: LightArrays,
    traced: TracedLights | None = None,
) -> Float32:
    """What scattering below the surface adds to that of a Lambertian body, or takes away."""
    change = np.zeros((len(points), 3, len(lights)), dtype=np.float32)
    material = scene.material
    if not isinstance(material, Translucent):
        return change
    nodes, body = _body_light(scene, tracer, material, lights)
    _interpolate(points.face, points.barycentric, nodes.per_side, nodes.first, body, change)
    _, strength = direct_light(scene, tracer, points, views, lights, traced)
    lambert = np.array(material.albedo)[:, None] / np.pi * lights.colour.T
    change -= (strength[:, None] * lambert).astype(np.float32)
    return change


_found: WeakKeyDictionary[RayTracer, dict[int, tuple[Nodes, Float32]]] = WeakKeyDictionary()
_finding = threading.Lock()


def _body_light(
    scene: Scene, tracer: RayTracer, material: Translucent, lights: LightArrays
) -> tuple[Nodes, Float32]:
    """`_scattered`, kept as long as the tracer lives: all views share it."""
    parts = (lights.place, lights.near, lights.colour, lights.axis, lights.exponent)
    key = hash(
        (
            *(part.tobytes() for part in parts),
            material,
            scene.effects.get(Options),
            simulated(scene, shadows_effect),
        )
    )
    with _finding:
        kept = _found.setdefault(tracer, {})
        if key not in kept:
            nodes = _nodes(scene, material)
            _make_room(kept, scene.blocks.tables - BYTES_KEPT * len(nodes) * len(lights))
            kept[key] = _scattered(scene, tracer, material, lights)
        kept[key] = kept.pop(key)  # the last that was asked for
        return kept[key]


def _make_room(kept: dict[int, tuple[Nodes, Float32]], bytes_left: int) -> None:
    """Forget what has not been asked for longest."""
    while kept and sum(body.nbytes for _, body in kept.values()) > bytes_left:
        del kept[next(iter(kept))]


def _spacing(scene: Scene, material: Translucent) -> float:
    return min(material.length) / scene.effects.get(Options).steps


def _nodes(scene: Scene, material: Translucent) -> Nodes:
    """The grid; a `SceneError` if its pairs would take hours."""
    nodes = Nodes.of(scene.mesh, _spacing(scene, material))
    if len(nodes) > MOST_NODES:
        raise scene_error(
            "effects.subsurface.steps",
            f"a grid of at most {MOST_NODES} nodes",
            f"{len(nodes)} for a diffusion length of {min(material.length):g} m",
            "lower steps, lengthen material.length, or switch the effect off",
        )
    return nodes


def bytes_per_light(scene: Scene) -> int:
    """Memory that one light takes for all views; 0 for materials that are not translucent."""
    if not isinstance(scene.material, Translucent):
        return 0
    return (BYTES_KEPT + BYTES_PER_PAIR_OF_NODE) * len(_nodes(scene, scene.material))


def _scattered(
    scene: Scene, tracer: RayTracer, material: Translucent, lights: LightArrays
) -> tuple[Nodes, Float32]:
    """Nodes and the radiance of the body there, (n_nodes, 3, n_lights)."""
    nodes = _nodes(scene, material)
    points = surface_points(scene.mesh, material, *nodes.places())
    shining = _irradiance(scene, tracer, points, lights)
    area = node_areas(scene.mesh, nodes)
    near = STEPS_NEARBY * _spacing(scene, material)
    body = np.zeros((len(nodes), 3, len(lights)), dtype=np.float32)
    for channel, dipole in enumerate(material.dipoles):
        flux = shining * lights.colour[:, channel].astype(np.float32)
        inside = float(dipole.within(np.array(near)))
        reach = REACH * dipole.length
        table = dipole.profile(np.linspace(0.0, reach, TABLE)).astype(np.float32)
        for cell, others in _neighbours(points.position, reach):
            _exchange(
                points.position, area, cell, others, table, reach, near, inside, flux,
                body[:, channel],
            )  # fmt: skip
    return nodes, body


def _irradiance(
    scene: Scene, tracer: RayTracer, points: SurfacePoints, lights: LightArrays
) -> Float32:
    """Irradiance over the lights' colours, (n, n_lights)."""
    shining = np.zeros((len(points), len(lights)), dtype=np.float32)
    step = scene.blocks.items(len(lights) * BYTES_PER_PAIR)
    for first in range(0, len(points), step):
        block = slice(first, first + step)
        here = points[block]
        # Seen along the normal, every point counts.
        views = here.shading_from_world[:, 2]
        shining[block] = direct_light(scene, tracer, here, views, lights)[1]
    return shining


def node_areas(mesh: SurfaceMesh, nodes: Nodes) -> Array:
    """Area that each node stands for, (n_nodes,): a third of the small triangles about it.

    Examples
    --------
    >>> from capture_sim.objects import make_object
    >>> plate = make_object({"preset": "flat_sample", "size": [0.2, 0.1]})
    >>> round(float(node_areas(plate, Nodes.of(plate, 0.01)).sum()), 9)
    0.02
    """
    corners = mesh.vertices[mesh.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    small = 0.5 * np.linalg.norm(doubled, axis=1) / nodes.per_side**2
    areas = np.zeros(len(nodes))
    _fill_areas(nodes.per_side, nodes.first, small, areas)
    return areas


def _neighbours(
    positions: Array, reach: float
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Cells of nodes close together, and all nodes in reach of any of them."""
    tree = cKDTree(positions)
    cells = np.floor(positions / reach).astype(np.int64)
    order = np.lexsort(cells.T)
    starts = np.flatnonzero(np.any(np.diff(cells[order], axis=0) != 0, axis=1)) + 1
    for cell in np.split(order, starts):
        centre = positions[cell].mean(axis=0)
        radius = np.linalg.norm(positions[cell] - centre, axis=1).max()
        yield cell, np.array(tree.query_ball_point(centre, radius + reach), dtype=np.intp)


_compiled = numba.njit(cache=True, nogil=True)
_Values = NDArray[Any]


@_compiled
def _distance(a: _Values, b: _Values) -> Any:
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@_compiled
def _from_table(table: _Values, place: Any) -> Any:
    """Linear interpolation between entries."""
    i = min(int(place), len(table) - 2)
    return (1.0 - (place - i)) * table[i] + (place - i) * table[i + 1]


@_compiled
def _finish(total: _Values, rest: Any, flux: _Values, body: _Values) -> None:
    """Radiance from the radiosity of others and the rest of a node's own."""
    for k in range(len(total)):
        body[k] = max(total[k] + rest * flux[k], np.float32(0.0)) / np.float32(np.pi)


@_compiled
def _exchange(
    positions: _Values,
    area: _Values,
    cell: _Values,
    others: _Values,
    table: _Values,
    reach: float,
    near: float,
    inside: float,
    flux: _Values,
    body: _Values,
) -> None:
    """Radiance at the nodes of a cell (n_nodes, n_lights) by the flux at all in reach.

    The profile comes from a table over [0, reach]. Each light is summed by itself, in the
    order of the nodes: not a bit depends on what others there are, as in a product of
    matrices.
    """
    scale = (len(table) - 1) / reach
    rows = 8  # nodes that take their part of a flux while it is in the cache
    total = np.zeros((rows, flux.shape[1]), dtype=flux.dtype)
    exchanged = np.zeros(rows)
    for first in range(0, len(cell), rows):
        block = cell[first : first + rows]
        total[:] = 0.0
        exchanged[:] = 0.0
        for m in others:
            for r in range(len(block)):
                distance = _distance(positions[m], positions[block[r]])
                if distance >= reach:
                    continue
                value = _from_table(table, distance * scale) * area[m]
                if distance < near:
                    exchanged[r] += value
                weight = np.float32(value)
                for k in range(total.shape[1]):
                    total[r, k] += weight * flux[m, k]
        for r in range(len(block)):
            # Near the node the profile's integral stands for its sum.
            _finish(total[r], np.float32(inside - exchanged[r]), flux[block[r]], body[block[r]])


@_compiled
def _fill_areas(per_side: _Values, first: _Values, small: _Values, areas: _Values) -> None:
    """A third of the area of each of the k^2 small triangles to its three nodes."""
    for face in range(len(per_side)):
        k = per_side[face]
        third = small[face] / 3.0
        at = first[face]
        for i in range(k + 1):
            for j in range(k + 1 - i):
                # Triangles about a node: 6 inside, 3 on an edge, 1 at a corner.
                on_edges = int(i == 0) + int(j == 0) + int(i + j == k)
                n_about = 6 if on_edges == 0 else (3 if on_edges == 1 else 1)
                areas[at] = n_about * third
                at += 1


@_compiled
def _interpolate(
    face: _Values,
    barycentric: _Values,
    per_side: _Values,
    first: _Values,
    values: _Values,
    result: _Values,
) -> None:
    """Linear interpolation of node values (n_nodes, 3, n_lights) in the small triangles."""
    for n in range(len(face)):
        nodes, weights = nodes_about(barycentric[n], per_side[face[n]], first[face[n]])
        for c in range(values.shape[1]):
            for light in range(values.shape[2]):
                result[n, c, light] += (
                    weights[0] * values[nodes[0], c, light]
                    + weights[1] * values[nodes[1], c, light]
                    + weights[2] * values[nodes[2], c, light]
                )
