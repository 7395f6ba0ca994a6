"""Photographs against Mitsuba 3: same mesh, material, light and rays.

Rays go through the centres of pixels on both sides, so that no reconstruction filter is in
the way. Where a float32 ray falls to the other side of an edge is chance on both sides:
such pixels are counted, not compared.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture_sim.arrival import LightArrays
from capture_sim.effects import interreflection
from capture_sim.files import write_ply
from capture_sim.model import EffectOptions, ImageOptions
from capture_sim.rays import RayTracer, camera_rays, towards_camera
from capture_sim.render import shade
from capture_sim.scene import parse_scene
from capture_sim.shading import direct_light
from capture_sim.view_samples import sample_view

ONE_RAY = ImageOptions(samples_per_side=1, edge_samples_per_side=1)
# Mitsuba lifts shadow rays by 9e-5 of one unit plus the largest coordinate: in metres a
# tenth of a millimetre, which lets light in under lips; in millimetres 0.02 mm.
MILLIMETRES = 1000.0
MITSUBA_LIFT = 2e-5  # metres; ours is 5e-7
PICTURE = Path(__file__).parent / "data" / "anisotropic_highlight.png"

pytestmark = pytest.mark.reference


@pytest.fixture(scope="module")
def mi():
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def scene_of(thing, material, *, camera, light, side, target=(0, 0, 0.1), extent=0.22):
    scene = parse_scene(
        {
            "object": thing,
            "material": material,
            "cameras": {
                "preset": "list",
                "directions": [camera],
                "width": side,
                "height": side,
                "target": list(target),
                "extent": extent,
            },
            "lights": {
                "preset": "list",
                "directions": [light],
                "target": list(target),
                "distance": 0.5,
                "intensity": [2.0, 3.0, 4.0],
            },
            "effects": ["shadows", "near_lights"],
        }
    )
    return replace(scene, image=ONE_RAY, mesh=with_tangents_per_face(scene.mesh))


def with_tangents_per_face(mesh, *, flat=False):
    """The same surface with each face's own dP/du, which Mitsuba shades with."""
    corners, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    edges = corners[:, 1:] - corners[:, :1]
    du, dv = np.moveaxis(uv[:, 1:] - uv[:, :1], 2, 0)
    area = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    tangent = (dv[:, 1:] * edges[:, 0] - dv[:, :1] * edges[:, 1]) * np.sign(area)[:, None]
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    stored = mesh.tangents[mesh.faces[:, 0]]
    tangent = np.where(length > 0.0, tangent / np.where(length > 0.0, length, 1.0), stored)
    normals = mesh.normals[mesh.faces]
    if flat:
        normal = np.cross(edges[:, 0], edges[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normals = np.repeat(normal[:, None], 3, axis=1)
    return replace(
        mesh,
        vertices=corners.reshape(-1, 3),
        faces=np.arange(len(corners) * 3, dtype=np.int32).reshape(-1, 3),
        uv=uv.reshape(-1, 2),
        normals=normals.reshape(-1, 3),
        tangents=np.repeat(tangent, 3, axis=0),
    )


def photograph(scene, *, lift=None):
    tracer = RayTracer(scene.mesh)
    tracer.start_offset = lift or tracer.start_offset
    view = sample_view(scene, tracer, scene.cameras[0])
    return shade(scene, tracer, view, scene.lights)[0].reshape(-1, 3).astype(float)


def reference(mi, scene, bsdf, folder, integrator, *, pixels=None, samples=1):
    """Radiance along the rays of some pixels, (n, samples, 3)."""
    larger = replace(scene.mesh, vertices=MILLIMETRES * scene.mesh.vertices)
    write_ply(folder / "mesh.ply", larger)
    light = scene.lights[0]
    position = (MILLIMETRES * np.array(light["position"])).tolist()
    intensity = (MILLIMETRES**2 * np.array(light["intensity"])).tolist()
    world = mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "mesh": {"type": "ply", "filename": str(folder / "mesh.ply"), "bsdf": bsdf},
            "light": {
                "type": "point",
                "position": position,
                "intensity": {"type": "rgb", "value": intensity},
            },
        }
    )
    camera = scene.cameras[0]
    grid = np.stack(np.meshgrid(np.arange(camera["w"]), np.arange(camera["h"])), axis=-1)
    points = grid.reshape(-1, 2)[slice(None) if pixels is None else pixels] + 0.5
    sampler = mi.load_dict({"type": "independent"})
    trace = world.integrator().sample
    return np.array(
        [
            [np.array(trace(world, sampler, ray)[0]) for _ in range(samples)]
            for o, d in zip(*camera_rays(camera, points), strict=True)
            for ray in [mi.RayDifferential3f(mi.Ray3f(MILLIMETRES * o, d))]
        ]
    )


DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
RGB = [0.7, 0.4, 0.2]
METAL = {"type": "ggx", "eta": 0.0, "kappa": 1.0, "specular": RGB,
         "alpha_x": 0.15, "alpha_y": 0.4, "correlated": False}  # fmt: skip
MITSUBA_METAL = {
    "type": "roughconductor",
    "material": "none",
    "distribution": "ggx",
    "alpha_u": 0.15,
    "alpha_v": 0.4,
    "specular_reflectance": {"type": "rgb", "value": RGB},
}
LAMBERT = {"type": "lambert", "albedo": RGB}
MITSUBA_LAMBERT = {"type": "diffuse", "reflectance": {"type": "rgb", "value": RGB}}


def compare(ours, theirs):
    """Part of the pixels of the object that only one side lights, and error in the others."""
    lit, reference_lit = (ours > 0).any(axis=1), (theirs > 0).any(axis=1)
    both = lit & reference_lit
    error = np.linalg.norm((ours - theirs)[both]) / np.linalg.norm(theirs[both])
    return (lit != reference_lit), error


@pytest.mark.parametrize(
    ("thing", "material", "bsdf"),
    [
        ({"preset": "amphora", "around": 96, "along": 96}, LAMBERT, MITSUBA_LAMBERT),
        ({"preset": "vase", "around": 96, "along": 96}, METAL, MITSUBA_METAL),
    ],
    ids=["diffuse amphora", "brushed vase"],
)
def test_direct_light_and_shadows(mi, thing, material, bsdf, tmp_path, rounding):
    scene = scene_of(thing, material, camera=[1, -2, 1.5], light=[2, -1, 1.0], side=128)
    # Facets as they are: both sides trace shadow rays from the same flat triangles.
    scene = replace(scene, mesh=with_tangents_per_face(scene.mesh, flat=True))
    ours = photograph(scene)
    theirs = reference(mi, scene, bsdf, tmp_path, DIRECT)[:, 0]
    view = sample_view(scene, RayTracer(scene.mesh), scene.cameras[0])
    # Away from edges: of facets, where rays may fall to either side, and of shadows,
    # which the height that shadow rays start at decides.
    lifted = photograph(scene, lift=MITSUBA_LIFT)
    away = (lifted > 0).any(axis=1) == (ours > 0).any(axis=1)
    away[view.pixel[view.points.barycentric.min(axis=1) < 1e-3]] = False  # of a facet's width
    assert away.mean() > 0.99
    disagree, error = compare(ours[away], theirs[away])
    assert (theirs > 0).any(axis=1).sum() > 1500
    assert not disagree.any()
    assert error <= rounding(np.float32, operations=4)


def test_smooth_normals_differ_only_at_the_terminator(mi, tmp_path):
    """Shadow rays start on the smooth surface here, on the facets there."""
    thing = {"preset": "vase"}
    scene = scene_of(thing, LAMBERT, camera=[1, -2, 1.5], light=[2, -1, 1.0], side=96)
    ours = photograph(scene)
    theirs = reference(mi, scene, MITSUBA_LAMBERT, tmp_path, DIRECT)[:, 0]
    view = sample_view(scene, RayTracer(scene.mesh), scene.cameras[0])
    lights = LightArrays.of(scene, scene.lights)
    points = view.points
    towards = lights.place - points.position
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    # 192 facets around: their normals are off by up to pi / 192 = 0.016.
    at_terminator = (
        np.abs(np.einsum("nj,nj->n", towards, points.shading_from_world[:, 2])) < 0.02
    )
    elsewhere = np.ones(len(ours), dtype=bool)
    elsewhere[view.pixel[at_terminator]] = False
    disagree, error = compare(ours[elsewhere], theirs[elsewhere])
    assert not disagree.any()
    assert error <= 2e-5  # observed 5e-6: single precision of the interpolated normals there
    assert np.abs(ours - theirs)[~elsewhere].max() < 0.03 * theirs.max()


def brushed_plate(side):
    """A plate lit and seen from above, rough along x, smooth along y."""
    material = {**METAL, "alpha_x": 0.4, "alpha_y": 0.1}
    return scene_of(
        {"preset": "flat_sample", "size": [0.4, 0.4]},
        material,
        camera=[0, 0, 1],
        light=[0, 0, 1],
        side=side,
        target=(0, 0, 0),
        extent=0.4,
    )


def test_anisotropic_highlight_stretches_along_the_rougher_axis(mi, tmp_path, rounding):
    scene = brushed_plate(64)
    ours = photograph(scene)
    bsdf = {**MITSUBA_METAL, "alpha_u": 0.4, "alpha_v": 0.1}
    theirs = reference(mi, scene, bsdf, tmp_path, DIRECT)[:, 0]
    disagree, error = compare(ours, theirs)
    assert not disagree.any()
    assert error <= rounding(np.float32, operations=4)
    # The tangent dP/du of the plate is +X, to the right in the image: rough there.
    image = ours.reshape(64, 64, 3)[..., 0]
    ticks = np.arange(64) - 31.5
    width = np.average(ticks**2, weights=image.sum(axis=0)) ** 0.5
    height = np.average(ticks**2, weights=image.sum(axis=1)) ** 0.5
    assert width > 1.5 * height
    encoded = np.rint(255 * (image / image.max()) ** (1 / 2.2))
    pinned = cv2.imread(str(PICTURE), cv2.IMREAD_GRAYSCALE)
    assert np.abs(encoded - pinned).max() <= 1  # one level of rounding


@pytest.mark.parametrize("name", ["paper_white", "satin_rosaline", "cc_ibiza_sunset"])
def test_measured_materials_within_a_percent(mi, name, tmp_path, shared_data):
    path = str(shared_data("rgl_bsdf") / f"{name}_rgb.bsdf")
    scene = scene_of(
        {"preset": "sphere"},
        {"type": "rgl", "file": path},
        camera=[1, -2, 1.5],
        light=[2, -1, 1.0],
        side=64,
        target=(0, 0, 0),
    )
    scene = replace(scene, mesh=replace(scene.mesh, convex=False))
    ours = photograph(scene)
    bsdf = {"type": "measured", "filename": path}
    theirs = reference(mi, scene, bsdf, tmp_path, DIRECT)[:, 0]
    theirs = np.maximum(theirs, 0.0)  # the tables have negative noise, ours has none
    disagree, error = compare(ours, theirs)
    # The terminator: see above; half a percent of the pixels of a sphere.
    assert disagree.mean() <= 5e-3
    assert error <= 1e-2


@pytest.mark.parametrize(
    ("material", "bsdf"), [(LAMBERT, MITSUBA_LAMBERT), (METAL, MITSUBA_METAL)],
    ids=["diffuse", "metal"],
)  # fmt: skip
def test_interreflection_in_a_bowl(mi, material, bsdf, tmp_path):
    scene = scene_of(
        {"preset": "bowl", "around": 64, "along": 48},
        material,
        camera=[0.6, -1, 2],
        light=[0.7, 0.2, 0.9],
        side=24,
        target=(0, 0, 0.03),
        extent=0.13,
    )
    bounces, n = 5, 400
    options = interreflection.Options(paths=n, bounces=bounces)
    effects = EffectOptions(simulate=("shadows", "near_lights"), parameters=(options,))
    scene = replace(scene, effects=effects, mesh=with_tangents_per_face(scene.mesh, flat=True))
    tracer = RayTracer(scene.mesh)
    view = sample_view(scene, tracer, scene.cameras[0])
    views = towards_camera(view.camera, view.points.position)
    lights = LightArrays.of(scene, scene.lights)
    indirect, variance = (
        part[..., 0].astype(float)
        for part in interreflection.estimate(scene, tracer, view.points, views, lights)
    )
    values, strength = direct_light(scene, tracer, view.points, views, lights)
    lit = strength[:, None, 0] > 0.0
    direct = np.where(lit, values[..., 0] * strength, 0.0) * lights.colour
    path = {"type": "path", "max_depth": bounces + 2, "rr_depth": 1000}
    samples = reference(mi, scene, bsdf, tmp_path, path, pixels=view.pixel, samples=n)
    theirs, error = samples.mean(axis=1), samples.var(axis=1, ddof=1) / n
    # It is the indirect light that is compared: several per cent of the whole, or most.
    assert indirect.sum() > 0.1 * direct.sum()
    difference = direct + indirect - theirs
    # Both sides also round in float32, five digits in the end.
    spread = np.sqrt(variance + error + (1e-5 * (theirs + 1e-3)) ** 2)
    total = difference.sum(axis=0) / np.sqrt((variance + error).sum(axis=0))
    assert np.abs(total).max() < 4.0  # standard errors of the whole picture
    scores = difference / spread
    # Unit variance: the stated errors are those of the estimates. Heavy tails of the
    # metal's paths leave both variances estimated too small now and then.
    assert (np.abs(scores) > 4.0).mean() < 0.01
    assert 0.6 < np.median(np.abs(scores)) / 0.6745 < 1.3
