"""Scenes that cannot be right: an error that names the key, or a repair that is stated."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from capture_sim.errors import SceneError
from capture_sim.objects import make_object, object_presets
from capture_sim.objects.convexity import is_convex
from capture_sim.objects.repair import open_edges, repaired
from capture_sim.photograph import set_up
from capture_sim.placement import is_inside, winding_number
from capture_sim.scene import parse_scene

pytestmark = pytest.mark.stability


def scene(tmp_path=None, **changed):
    good = {
        "object": {"preset": "sphere", "radius": 0.1, "around": 32},
        "material": {"preset": "grey_card"},
        "cameras": {"preset": "rti"},
        "lights": {"preset": "rti", "n": 3},
    }
    return parse_scene({**good, **changed}, folder=tmp_path)


@pytest.fixture
def ball():
    """Vertices and faces of a closed ball."""
    mesh = trimesh.creation.icosphere(3, radius=0.5)
    return np.array(mesh.vertices), np.array(mesh.faces, np.int32)


def saved(tmp_path, vertices, faces):
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "thing.obj")
    return make_object({"type": "mesh", "file": "thing.obj", "size": 0.2}, tmp_path)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"cameras": {"preset": "rti", "distance": 0.05}}, r"cameras \(v000\): .*outside"),
        ({"lights": {"preset": "rti", "distance": 0.05}}, r"lights \(l000\): .*outside"),
        (
            {"lights": {"preset": "rti", "distance": 0.5, "target": [0, 0, -0.45]}},
            r"lights \(l000\).*change lights\.distance or lights\.target",
        ),
        ({"object": {"preset": "sphere", "radius": -1}}, r"sphere.*radius|object\.radius"),
        ({"object": {"type": "mesh", "file": "no.obj"}}, r"object\.file: expected an existing"),
        (
            {"material": {"type": "lambert", "albedo": {"type": "image", "file": "no.png"}}},
            r"material\.albedo\.file: expected an existing file, received .*no\.png",
        ),
        ({"material": {"type": "lambert", "albedo": 2.0}}, r"material\.albedo"),
        ({"cameras": {"preset": "rti", "height": 10**9}}, r"cameras\.height"),
        ({"effects": {"defocus": {"f_number": 0}}}, r"effects\.defocus\.f_number"),
        ({"effects": {"defocus": {"aperture": 1}}}, r"effects\.defocus: .*'aperture'"),
        ({"effects": {"environment": {"tint": [1, 1]}}}, r"effects\.environment\.tint"),
        ({"effects": {"bayer": {"demosaicing": "ai"}}}, r"bayer\.demosaicing: .*malvar"),
        ({"effects": {"quantisation": {"bits": 0}}}, r"effects\.quantisation\.bits"),
        ({"effects": {"saturation": {"radiance": float("nan")}}}, r"saturation\.radiance"),
    ],
)
def test_mistakes_name_the_key(tmp_path, changed, named):
    with pytest.raises(SceneError, match=named):
        scene(tmp_path, **changed)


def test_a_lamp_in_the_hollow_of_an_open_vase_is_outside():
    vase = {"preset": "vase", "open": True}
    lamp = {"preset": "list", "directions": [[0, 0, 1]], "distance": 0.1}
    assert scene(object=vase, lights=lamp).lights[0]["position"] == [0.0, 0.0, 0.1]
    with pytest.raises(SceneError, match="lights"):
        scene(object={"preset": "vase"}, lights=lamp)


def test_errors_of_the_rig_cannot_bring_a_lamp_inside():
    close = {"preset": "list", "directions": [[0, 0, 1]] * 20, "distance": 0.101}
    error = {"simulate": ["light_position_error"], "light_position_error": {"position": 0.05}}
    with pytest.raises(SceneError, match="lights"):
        set_up(scene(lights=close, effects=error))


def test_winding_number_against_the_radius(rng, rounding):
    mesh = make_object({"preset": "sphere", "radius": 1.0, "around": 32})
    points = rng.uniform(-1.2, 1.2, (60, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = np.abs(radius - 0.995) > 0.01  # the facets lie within .995 to 1
    assert (is_inside(mesh, points) == (radius < 1.0))[clear].all()
    # Roundings of a sum of solid angles are independent.
    tolerance = rounding(np.float64, operations=len(mesh.faces) ** 0.5)
    assert winding_number(mesh, np.zeros(3)) == pytest.approx(1.0, abs=tolerance)
    assert winding_number(mesh, np.array([3.0, 0, 0])) == pytest.approx(0.0, abs=tolerance)


def test_flawless_meshes_are_left_alone(ball):
    mesh = repaired(*ball, None)
    assert mesh.notes == ()
    assert mesh.faces is ball[1] or (mesh.faces == ball[1]).all()


def test_empty_and_repeated_faces_are_dropped(tmp_path, ball):
    vertices, faces = ball
    middle = len(vertices)
    vertices = np.vstack([vertices, vertices[faces[0, :2]].mean(axis=0)])
    needle = [[faces[0, 0], faces[0, 1], middle], [0, 0, 5]]
    bad = np.vstack([faces, needle, faces[3:5]])
    mesh = saved(tmp_path, vertices, bad)
    assert len(mesh.faces) == len(faces)
    assert mesh.notes == (
        "thing.obj: 2 triangles without area dropped",
        "thing.obj: 2 triangles that occur twice dropped",
    )


@pytest.mark.parametrize("share", [0.05, 0.4, 1.0])
def test_flipped_faces_are_turned_back(tmp_path, ball, rng, share):
    vertices, faces = ball
    flipped = rng.choice(len(faces), int(share * len(faces)), replace=False)
    bad = faces.copy()
    bad[flipped] = bad[flipped, ::-1]
    mesh = saved(tmp_path, vertices, bad)
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("nc,nc->n", normal, corners.mean(axis=1)) > 0.0).all()
    assert np.einsum("nc,nc->n", mesh.normals, mesh.vertices).min() > 0.0
    assert mesh.notes == (f"thing.obj: {len(flipped)} triangles turned to face outwards",)


def test_small_holes_are_closed_and_wide_openings_kept(tmp_path, ball):
    vertices, faces = ball
    around = np.linalg.norm(vertices[faces].mean(axis=1) - [0, 0, 0.5], axis=1)
    holed = faces[around > 0.06]
    mesh = saved(tmp_path, vertices, holed)
    assert mesh.notes == ("thing.obj: 1 small hole closed",)
    assert len(open_edges(mesh.vertices, mesh.faces)) == 0
    bowl = saved(tmp_path, vertices, faces[around > 0.5])
    assert bowl.notes == ("thing.obj: 1 wide opening left open: taken as meant",)
    assert len(open_edges(bowl.vertices, bowl.faces)) > 0


def test_nothing_but_empty_faces_is_refused(tmp_path):
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(SceneError, match=r"file: expected triangles with an area"):
        make_object({"type": "mesh", "file": "flat.obj"}, tmp_path)


def test_convexity_is_found_not_assumed(tmp_path, ball):
    assert saved(tmp_path, *ball).convex
    box = trimesh.creation.box()
    assert saved(tmp_path, box.vertices, box.faces).convex
    two = trimesh.util.concatenate([box, box.copy().apply_translation([3, 0, 0])])
    assert not saved(tmp_path, two.vertices, two.faces).convex
    dented = ball[0].copy()
    dented[7] *= 0.99
    assert not saved(tmp_path, dented, ball[1]).convex
    torus = trimesh.creation.torus(0.4, 0.1)
    assert not saved(tmp_path, torus.vertices, torus.faces).convex


@pytest.mark.reference
@pytest.mark.parametrize("name", sorted(object_presets()))
def test_convexity_of_presets_against_the_convex_hull(name):
    mesh = make_object({"preset": name})
    if np.ptp(mesh.vertices, axis=0).min() == 0.0:
        assert is_convex(mesh)  # a flat sheet has no volume to compare
        return
    corners = mesh.vertices[mesh.faces]
    volume = np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2]))
    hull = ConvexHull(mesh.vertices).volume
    assert mesh.convex is bool(abs(volume / 6.0 - hull) < 1e-6 * hull)
