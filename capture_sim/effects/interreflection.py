r"""Light that the object throws on itself: path tracing with the true lights at every bounce.

From a point that a camera sees, paths leave in random directions, half of them as dense
as the cosine, half as dense as the mirror images of the viewer in the microfacets of a
highlight. Wherever a path meets the surface again, the direct light of all lights at once
is reflected back along it. With :math:`f_i` the BRDF and :math:`p_i` the density at vertex
i, one path adds to light k

.. math:: \sum_{i \ge 1} \Big(\prod_{j < i} \frac{f_j \cos\theta_j}{p_j}\Big)
          L_k(x_i \to x_{i-1}).

The estimate has no bias but that of `Options.bounces`; its variance is estimated from the
scatter of a point's paths. How directions are drawn is in `capture_sim.effects.directions`.

References
----------
J. T. Kajiya, "The rendering equation", SIGGRAPH 1986.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from capture_sim.arrival import LightArrays
from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.effects.bounds import steepness
from capture_sim.effects.directions import cosine_directions, draw_directions, fill_numbers
from capture_sim.materials import Lambert, Material
from capture_sim.materials.textures import Constant
from capture_sim.model import Scene
from capture_sim.objects import SurfaceMesh
from capture_sim.rays import RayTracer, towards_camera
from capture_sim.shading import add_direct_light, direct_light
from capture_sim.surface import SurfacePoints, spread_points, surface_points
from capture_sim.tables import bounded
from capture_sim.visibility import TracedLights

NAME = "interreflection"
STAGE = Stage.TRANSPORT

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Temporaries of a path, and of what it brings of one light.
BYTES_PER_PATH = 1200
BYTES_BROUGHT = 200
# Points and directions that form factors and albedos are measured with.
SAMPLE_POINTS, SAMPLE_DIRECTIONS = 1024, 256
# Highlights steeper than this, 1/rad, are too narrow for these directions.
STEEPEST = 30.0
# Points and lights that the standard error is estimated from.
ERROR_POINTS, ERROR_LIGHTS = 128, 8
# Paths whose throughput has fallen below 1 go on with that probability from here.
ROULETTE_FROM = 2


@dataclass(frozen=True)
class Options:
    """How much work the paths are.

    Attributes
    ----------
    paths : int
        From each shaded point, of which a pixel has several.
    bounces : int
        Reflections before the last one; what is reflected more often is left out.
    """

    paths: int = bounded(32, low=1, high=65536)
    bounces: int = bounded(8, low=1, high=1024)


def needed(scene: Scene) -> Decision:
    r"""Bound the light that the object can throw on itself.

    A point whose horizon is filled by the object to the part :math:`F`, the form factor,
    with an albedo of at most :math:`\rho`, reflects at most :math:`\rho F` of the brightest
    radiance in sight, which itself holds at most that much again:
    :math:`\rho F / (1 - \rho F)` of the brightest direct radiance.
    """
    if scene.mesh.convex:
        return Decision("a convex object throws no light on itself", 0.0)
    factor, albedo = largest_form_factor(scene.mesh), largest_albedo(scene.material)
    gain = albedo * factor
    bound = scene.brightness.headroom * gain / (1.0 - gain) if gain < 1.0 else np.inf
    reason = (
        f"the object fills up to {100 * factor:.2g} % of a point's horizon, albedo up to "
        f"{albedo:.2g}"
    )
    return Decision(reason, float(bound))


def cost(scene: Scene, work: Workload) -> Cost:
    """Paths from every shaded point, few of more than two rays; and what they leave open."""
    options = scene.effects.get(Options)
    paths = work.n_points * options.paths
    note = (
        f"{options.paths} paths a point leave a standard error of "
        f"{100 * stated_error(scene):.1g} %"
    )
    return Cost(rays=2 * paths, operations=paths * work.n_lights, note=note)


def apply(
    scene: Scene,
    tracer: RayTracer,
    points: SurfacePoints,
    views: Array,
    lights: LightArrays,
    traced: TracedLights | None = None,
) -> Float32:
    """Radiance that points send to the viewer after two or more reflections."""
    radiance = np.zeros((len(points), 3, len(lights)), dtype=np.float32)
    for block in _blocks(scene, points, lights):
        by_path = _traced_paths(scene, tracer, points[block], views[block], lights, traced)
        radiance[block] = by_path.mean(axis=1)
    return radiance


def bytes_per_point(scene: Scene, n_lights: int) -> int:
    """Temporaries of the paths of one point.

    Parameters
    ----------
    scene : Scene
    n_lights : int

    Returns
    -------
    int
    """
    return scene.effects.get(Options).paths * (BYTES_PER_PATH + n_lights * BYTES_BROUGHT)


def _blocks(scene: Scene, points: SurfacePoints, lights: LightArrays) -> list[slice]:
    step = scene.blocks.items(bytes_per_point(scene, len(lights)))
    return [slice(first, first + step) for first in range(0, len(points), step)]


def estimate(
    scene: Scene,
    tracer: RayTracer,
    points: SurfacePoints,
    views: Array,
    lights: LightArrays,
    traced: TracedLights | None = None,
) -> tuple[Float32, Float32]:
    """`apply`, and the variance of what it returns.

    Returns
    -------
    radiance, variance : (n, 3, n_lights) float32
        The variance is that of the mean over a point's paths, as if these were
        independent; stratification makes it somewhat smaller. A single path shows no
        scatter: its square, which is above the variance in the mean, stands for it.
    """
    radiance = np.zeros((len(points), 3, len(lights)), dtype=np.float32)
    variance = np.zeros_like(radiance)
    for block in _blocks(scene, points, lights):
        by_path = _traced_paths(scene, tracer, points[block], views[block], lights, traced)
        radiance[block] = by_path.mean(axis=1)
        variance[block] = _variance_of_mean(by_path)
    return radiance, variance


def _variance_of_mean(by_path: Float32) -> Float32:
    """Variance of the mean over the paths, axis 1."""
    n_paths = by_path.shape[1]
    if n_paths == 1:
        return by_path[:, 0] ** 2
    return by_path.var(axis=1, ddof=1) / n_paths


@dataclass(frozen=True)
class _Paths:
    """Ends of paths that go on.

    Attributes
    ----------
    points : SurfacePoints
        m of them.
    views : (m, 3) float64
        Unit directions back along the path, world.
    throughput : (m, 3) float64
        Part of the radiance at the end that arrives at the viewer.
    row : (m,) int64
        Index of the path.
    """

    points: SurfacePoints
    views: Array
    throughput: Array
    row: NDArray[np.int64]


def _traced_paths(
    scene: Scene,
    tracer: RayTracer,
    points: SurfacePoints,
    views: Array,
    lights: LightArrays,
    traced: TracedLights | None,
) -> Float32:
    """What each path of each point brings, (n, n_paths, 3, n_lights)."""
    options = scene.effects.get(Options)
    n, row = len(points), np.repeat(np.arange(len(points)), options.paths)
    keys = np.hstack([points.position, views])[row].view(np.uint64)
    brought = np.zeros((n * options.paths, 3, len(lights)), dtype=np.float32)
    paths = _Paths(points[row], views[row], np.ones((len(row), 3)), np.arange(len(row)))
    for bounce in range(options.bounces):
        numbers = np.zeros((len(paths.row), 4))
        fill_numbers(keys, paths.row, options.paths, bounce, numbers)
        paths = _next(scene, tracer, paths, numbers, roulette=bounce >= ROULETTE_FROM)
        if len(paths.row) == 0:
            break
        values, strength = direct_light(
            scene, tracer, paths.points, paths.views, lights, traced
        )
        colour = lights.colour.T.astype(np.float32)
        throughput = paths.throughput.astype(np.float32)
        add_direct_light(values, strength, colour, paths.row, throughput, brought)
    return brought.reshape(n, options.paths, 3, len(lights))


def _next(
    scene: Scene, tracer: RayTracer, paths: _Paths, numbers: Array, *, roulette: bool
) -> _Paths:
    """Where paths meet the surface next; without those that do not or end by chance."""
    points = paths.points
    local_views = np.einsum("nij,nj->ni", points.shading_from_world, paths.views)
    lobes = scene.material.lobe(points.uv)
    outgoing, density = draw_directions(local_views, lobes, numbers)
    values = scene.material.evaluate(local_views, outgoing, points.uv)
    throughput = paths.throughput * values * (outgoing[:, 2] / density)[:, None]
    survival = np.minimum(throughput.max(axis=1), 1.0) if roulette else (throughput > 0).any(1)
    going = numbers[:, 3] < survival
    directions = np.einsum("nij,ni->nj", points.shading_from_world, outgoing)[going]
    origins = points.position[going] + tracer.start_offset * points.face_normal[going]
    hits = tracer.first_hits(origins, directions)
    chosen = np.flatnonzero(going)[hits.hit]
    arrived = surface_points(
        scene.mesh, scene.material, hits.face[hits.hit], hits.barycentric[hits.hit]
    )
    # Rays that leave below the facets meet the surface from inside, where it is dark.
    outside = np.einsum("nj,nj->n", arrived.face_normal, directions[hits.hit]) < 0.0
    chosen = chosen[outside]
    return _Paths(
        points=arrived[outside],
        views=-directions[hits.hit][outside],
        throughput=(throughput / np.maximum(survival, 1e-300)[:, None])[chosen],
        row=paths.row[chosen],
    )


@lru_cache(maxsize=8)
def largest_form_factor(mesh: SurfaceMesh) -> float:
    """Largest part of a point's horizon, weighted by the cosine, that the mesh fills.

    Parameters
    ----------
    mesh : SurfaceMesh

    Returns
    -------
    float
        In [0, 1]; over points spread evenly, each with `SAMPLE_DIRECTIONS` rays, and
        three standard errors of their fraction above what was found.

    Examples
    --------
    >>> from capture_sim.objects import make_object
    >>> largest_form_factor(make_object({"preset": "flat_sample"}))
    0.0
    """
    rng = np.random.default_rng(0)
    face, barycentric = spread_points(mesh, SAMPLE_POINTS, rng)
    # Any material will do: only the smooth frames count.
    points = surface_points(mesh, Lambert(Constant((0.5,))), face, barycentric)
    tracer = RayTracer(mesh)
    row = np.repeat(np.arange(SAMPLE_POINTS), SAMPLE_DIRECTIONS)
    outgoing = cosine_directions(rng.random((len(row), 2)))
    directions = np.einsum("nij,ni->nj", points.surface_from_world[row], outgoing)
    origins = (points.position + tracer.start_offset * points.face_normal)[row]
    hits = tracer.first_hits(origins, directions)
    above = np.einsum("nj,nj->n", points.face_normal[row], directions) > 0.0
    filled = (hits.hit & above).reshape(SAMPLE_POINTS, -1).mean(axis=1)
    largest = float(filled.max())
    error = np.sqrt(largest * (1.0 - largest) / SAMPLE_DIRECTIONS)
    return min(1.0, largest + 3.0 * float(error))


@lru_cache(maxsize=8)
def largest_albedo(material: Material) -> float:
    """Largest directional albedo of a material in any channel.

    Parameters
    ----------
    material : Material

    Returns
    -------
    float
        In [0, 1], at random places and directions; 1 for lobes that the random
        directions resolve badly.

    Examples
    --------
    >>> from capture_sim.materials import make_material
    >>> round(largest_albedo(make_material({"type": "lambert", "albedo": 0.5})), 3)
    0.5
    """
    if steepness(material) > STEEPEST:
        return 1.0
    rng = np.random.default_rng(0)
    uv, views = rng.random((64, 2)), cosine_directions(rng.random((64, 2)))
    outgoing = cosine_directions(rng.random((4096, 2)))
    lights = np.broadcast_to(outgoing.T, (64, 3, 4096)).astype(material.precision)
    every = np.ones((64, 4096), dtype=bool)
    values = material.evaluate_lights(
        views.astype(material.precision), np.ascontiguousarray(lights), every, uv
    )
    # Densities of directions are cosine / pi: the cosines cancel.
    samples = np.pi * values.astype(np.float64)
    error = samples.std(axis=2) / np.sqrt(samples.shape[2])
    return float(min(1.0, (samples.mean(axis=2) + 3.0 * error).max()))


def stated_error(scene: Scene) -> float:
    """Standard error of the effect in a pixel, as a part of the 99th percentile.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    float
        Root of the mean variance over points spread over the surface, seen by the
        first camera under some lights, divided among the points of a pixel; as a part of
        the 99th percentile of what these points reflect directly.
    """
    tracer = RayTracer(scene.mesh)
    face, barycentric = spread_points(scene.mesh, ERROR_POINTS, np.random.default_rng(1))
    points = surface_points(scene.mesh, scene.material, face, barycentric)
    views = towards_camera(scene.cameras[0], points.position)
    chosen = np.linspace(0, len(scene.lights) - 1, ERROR_LIGHTS).astype(int)
    lights = LightArrays.of(scene, tuple(scene.lights[k] for k in sorted(set(chosen))))
    _, variance = estimate(scene, tracer, points, views, lights)
    values, strength = direct_light(scene, tracer, points, views, lights)
    strong = strength[:, None] * lights.colour.T
    direct = np.where(strong > 0.0, values * strong, 0.0)
    if not direct.any():
        return 0.0
    seen = np.einsum("nj,nj->n", views, points.face_normal) > 0.0
    per_pixel = variance[seen].mean() / scene.image.samples_per_side**2
    return float(np.sqrt(per_pixel) / np.percentile(direct[direct > 0.0], 99.0))
