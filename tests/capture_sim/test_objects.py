"""Objects: closed where they should be, consistent normals, tangents and coordinates."""

import numpy as np
import pytest
import trimesh

from capture_sim.errors import SceneError
from capture_sim.objects import make_object, object_presets
from capture_sim.open3d_library import open3d as o3d

SMALL = {
    "vase": {"preset": "vase", "around": 48, "along": 64},
    "open vase": {"preset": "vase", "open": True, "around": 48, "along": 64},
    "amphora": {"preset": "amphora", "around": 48, "along": 64},
    "sphere": {"preset": "sphere", "around": 48},
    "relief": {"preset": "relief", "facets": 32},
    "waves": {"preset": "wavy_plate", "facets": 32},
    "bumps": {"type": "relief", "pattern": "bumps", "facets": 32},
    "plane": {"preset": "flat_sample"},
}


def welded(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=True, merge_norm=True)


def face_normals(mesh):
    corners = mesh.vertices[mesh.faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@pytest.mark.parametrize("name", SMALL)
def test_arrays_belong_together(name, rounding):
    mesh = make_object(SMALL[name])
    n, tolerance = len(mesh.vertices), rounding(float, 16)
    for array, width in ((mesh.uv, 2), (mesh.normals, 3), (mesh.tangents, 3)):
        assert array.shape == (n, width)
        assert np.isfinite(array).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(mesh.tangents, axis=1), 1.0, atol=tolerance)
    np.testing.assert_allclose((mesh.normals * mesh.tangents).sum(axis=1), 0.0, atol=tolerance)
    assert mesh.faces.dtype == np.int32
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < n


@pytest.mark.parametrize("name", SMALL)
def test_smooth_normals_are_on_the_side_of_the_faces(name):
    mesh = make_object(SMALL[name])
    across = face_normals(mesh)
    assert (np.linalg.norm(across, axis=1) > 0.0).all()
    cosine = np.einsum("fc,fkc->fk", across, mesh.normals[mesh.faces])
    cosine /= np.linalg.norm(across, axis=1)[:, None]
    assert cosine.min() > 0.0
    assert np.median(cosine) > 0.98  # coarse facets


@pytest.mark.parametrize("name", [n for n in SMALL if n != "plane"])
def test_closed_and_outward(name):
    solid = welded(make_object(SMALL[name]))
    assert solid.is_watertight
    assert solid.volume > 0.0


def test_thin_relief_is_open_and_without_walls():
    mesh = make_object({"preset": "relief", "facets": 8, "thickness": 0.0})
    assert not welded(mesh).is_watertight
    assert len(mesh.faces) == 2 * 8 * 8


@pytest.mark.parametrize("name", ["vase", "sphere", "waves", "plane"])
def test_tangents_follow_u(name):
    """dP/du of each triangle, by its three corners, against the stored tangents."""
    mesh = make_object(SMALL[name])
    corners, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    steps = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=1)
    usable = np.abs(np.linalg.det(steps)) > 1e-9  # walls of plates have no area in uv
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
    along_u = np.linalg.solve(steps[usable], edges[usable])[:, 0]
    along_u /= np.linalg.norm(along_u, axis=1, keepdims=True)
    stored = mesh.tangents[mesh.faces[usable]].mean(axis=1)
    assert ((along_u * stored).sum(axis=1)).min() > 0.9  # facets of a few degrees


def test_sphere_is_round(rounding):
    mesh = make_object({"type": "sphere", "radius": 0.07, "around": 32})
    radii = np.linalg.norm(mesh.vertices, axis=1)
    np.testing.assert_allclose(radii, 0.07, rtol=rounding(float, 8))
    np.testing.assert_allclose(mesh.normals, mesh.vertices / 0.07, atol=rounding(float, 8))
    assert mesh.convex
    assert mesh.radius == pytest.approx(0.07)


def test_vase_stands_on_the_ground_and_has_its_height():
    mesh = make_object({"type": "vase", "height": 0.3, "around": 32})
    assert mesh.vertices[:, 2].min() == 0.0
    # The lid rises a little over the lip, which is the height.
    assert 0.3 < mesh.vertices[:, 2].max() < 0.3 * 1.03
    assert not mesh.convex


def test_vase_can_be_held_by_a_visual_hull():
    """Horizontal tangents leave the closed vase: its horizontal slices are discs."""
    mesh = make_object({"type": "vase", "around": 64, "along": 96})
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    walls = np.abs(mesh.normals[:, 2]) < 0.9  # top and bottom are seen edge on
    starts = mesh.vertices[walls] + 5e-4 * mesh.normals[walls]
    for sign in (1.0, -1.0):
        rays = np.hstack([starts, sign * mesh.tangents[walls]]).astype(np.float32)
        assert not scene.test_occlusions(o3d.core.Tensor(rays), nthreads=1).numpy().any()


def test_handles_add_volume_on_both_sides(rounding):
    plain, one, two = (
        make_object({"type": "vase", "around": 48, "handles": n}) for n in (0, 1, 2)
    )
    assert np.ptp(plain.vertices[:, 0]) < np.ptp(one.vertices[:, 0])
    assert two.centre[0] == pytest.approx(0.0, abs=rounding(np.float64))
    assert one.centre[0] > 0.0


def test_relief_from_an_image(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "r.png"), np.array([[255, 255], [0, 0]], np.uint8))
    table = {
        "type": "relief",
        "pattern": "image",
        "file": "r.png",
        "height": 0.01,
        "thickness": 0.0,
        "facets": 8,
    }
    mesh = make_object(table, tmp_path)
    heights = mesh.vertices[:, 2]
    assert heights[mesh.uv[:, 1] > 0.8].min() == pytest.approx(0.01)
    assert heights[mesh.uv[:, 1] < 0.2].max() == pytest.approx(0.0)


# --------------------------------------------------------------------------- mesh files

CUBE_CORNER = """v 0 0 0
v 2 0 0
v 0 2 0
vt 0 0
vt 1 0
vt 0 1
f 1/1 2/2 3/3
"""


def test_mesh_file_is_turned_scaled_and_centred(tmp_path, rounding):
    (tmp_path / "m.obj").write_text(CUBE_CORNER)
    table = {
        "type": "mesh",
        "file": "m.obj",
        "size": 0.2,
        "rotation_deg": [90, 0, 0],
        "position": [0, 0, 0.1],
    }
    mesh = make_object(table, tmp_path)
    assert mesh.has_uv
    exact = rounding(np.float64)
    np.testing.assert_allclose(mesh.centre, [0.0, 0.0, 0.1], rtol=0, atol=exact)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.2, 0, 0.2], 0, exact)
    np.testing.assert_allclose(mesh.normals[0], [0.0, -1.0, 0.0], rtol=0, atol=exact)
    np.testing.assert_allclose(mesh.tangents[0], [1.0, 0.0, 0.0], rtol=0, atol=exact)


def test_mirrored_coordinates_turn_the_tangent_round(tmp_path, rounding):
    mirrored = CUBE_CORNER.replace("vt 1 0", "vt -1 0")
    (tmp_path / "m.obj").write_text(mirrored)
    mesh = make_object({"type": "mesh", "file": "m.obj"}, tmp_path)
    exact = rounding(np.float64)
    np.testing.assert_allclose(mesh.tangents, [[-1.0, 0.0, 0.0]] * 3, rtol=0, atol=exact)


def test_mesh_without_coordinates_is_refused_where_they_are_needed(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 2 0\nf 1 2 3\n")
    mesh = make_object({"type": "mesh", "file": "m.obj"}, tmp_path)
    assert not mesh.has_uv
    with pytest.raises(SceneError, match="texture coordinates, which the material"):
        mesh.require_uv("the material")


def test_flat_triangles_on_request(tmp_path, rounding):
    roof = "v 0 0 0\nv 2 0 0\nv 0 1 1\nv 2 1 1\nv 0 2 0\nv 2 2 0\n"
    (tmp_path / "m.obj").write_text(roof + "f 1 2 4\nf 1 4 3\nf 3 4 6\nf 3 6 5\n")
    table = {"type": "mesh", "file": "m.obj"}
    smooth, flat = (make_object({**table, "smooth": s}, tmp_path) for s in (True, False))
    assert len(flat.vertices) == 12
    np.testing.assert_allclose(np.abs(flat.normals[:, 1:]), np.sqrt(0.5), rounding(np.float64))
    ridge = smooth.normals[np.isclose(smooth.vertices[:, 2], smooth.vertices[:, 2].max())]
    assert (ridge[:, 2] > 0.9).all()


@pytest.mark.reference
@pytest.mark.parametrize("name", ["spot/spot.obj", "bob/bob_tri.obj"])
def test_shared_meshes_have_seamless_normals(name, shared_data):
    path = shared_data("meshes") / name
    mesh = make_object({"type": "mesh", "file": str(path), "size": 0.2})
    assert mesh.has_uv
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(0.2)
    _, place = np.unique(np.round(mesh.vertices, 9), axis=0, return_inverse=True)
    place = place.ravel()
    assert place.max() + 1 < len(place)  # seams do repeat vertices
    first = np.unique(place, return_index=True)[1]
    np.testing.assert_array_equal(mesh.normals, mesh.normals[first[place]])
    # Independent: trimesh's normals of the welded mesh.
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True, merge_tex=True)
    nearest = solid.kdtree.query(mesh.vertices)[1]
    cosine = (solid.vertex_normals[nearest] * mesh.normals).sum(axis=1)
    assert np.quantile(cosine, 0.01) > 0.99


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("nothing to see", "a mesh file|triangles"),
        ("v 0 0 0\nv 1 0 0\n", "a mesh file|triangles"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "finite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "a mesh file|faces among"),
    ],
)
def test_unusable_mesh_files(content, message, tmp_path):
    (tmp_path / "m.obj").write_text(content)
    with pytest.raises(SceneError, match=message):
        make_object({"type": "mesh", "file": "m.obj"}, tmp_path)


@pytest.mark.parametrize("name", object_presets())
def test_presets_build(name):
    assert len(make_object({"preset": name}).faces) > 0


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"type": "teapot"}, "type: expected one of"),
        ({"preset": "teapot"}, "preset: expected one of"),
        ({"type": "sphere", "radius": -1}, "radius"),
        ({"type": "sphere", "colour": "red"}, "'colour'"),
        ({"type": "vase", "open": True, "handles": 1}, "open"),
        ({"type": "vase", "around": 3}, "around"),
        ({"type": "plane", "size": [0.1, 0.0]}, "size"),
        ({"type": "relief", "pattern": "fractal"}, "pattern"),
        ({"type": "mesh"}, "file"),
        ({"type": "mesh", "file": "absent.obj"}, "an existing file"),
    ],
)
def test_bad_tables_say_what_is_wrong(table, message):
    with pytest.raises(SceneError, match=message):
        make_object(table)
