import numpy as np
import pytest
import trimesh

from reflfield.errors import InputError, ShapeError
from reflfield.geometry.mesh import (
    Mesh,
    decimate,
    face_components,
    keep_large_components,
    read_ply,
    smooth,
    without_degenerate_faces,
    write_ply,
)


def sphere(subdivisions=3, radius=1.0, centre=(0, 0, 0)):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh(ball.vertices + np.asarray(centre), ball.faces)


def box():
    made = trimesh.creation.box(extents=(1, 2, 3))
    return Mesh(made.vertices, made.faces)


def both(first, second):
    faces = np.concatenate([first.faces, second.faces + len(first.vertices)])
    return Mesh(np.concatenate([first.vertices, second.vertices]), faces)


def test_box_has_the_area_and_volume_of_a_box(rounding):
    assert box().area == pytest.approx(22.0, rel=rounding(float, 3))
    assert box().volume == pytest.approx(6.0, rel=rounding(float, 3))
    assert box().watertight


def test_vertex_normals_do_not_depend_on_the_triangulation(rounding):
    # Corners of a box see three square sides under equal angles, however those are cut.
    expected = np.sign(box().vertices) / np.sqrt(3.0)
    np.testing.assert_allclose(box().vertex_normals, expected, rtol=rounding(float, 3))


def test_volume_keeps_its_digits_far_from_the_origin():
    far = Mesh(box().vertices + 1e3, box().faces)
    assert far.volume == pytest.approx(6.0, rel=1e-11)  # 1e3 * eps on each coordinate


def test_a_hole_is_not_watertight_and_neither_is_an_edge_of_four_faces():
    assert not Mesh(box().vertices, box().faces[1:]).watertight
    doubled = Mesh(box().vertices, np.concatenate([box().faces, box().faces]))
    assert not doubled.watertight
    assert not Mesh(box().vertices, np.zeros((0, 3))).watertight


def test_flipping_one_face_is_not_watertight():
    faces = box().faces.copy()
    faces[0] = faces[0, ::-1]
    assert not Mesh(box().vertices, faces).watertight


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "quantity"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], ShapeError, "vertices"),
        (np.zeros((3, 3)), [[0, 1, 3]], InputError, "faces"),
        (np.zeros((3, 3)), [[0, 1, -1]], InputError, "faces"),
        ([[0, 0, np.nan]], np.zeros((0, 3)), InputError, "row 0"),
    ],
)
def test_bad_arrays_are_refused(vertices, faces, error, quantity):
    with pytest.raises(error, match=quantity):
        Mesh(vertices, faces)


def test_degenerate_faces_go_and_have_no_normal():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], [[0, 1, 2], [0, 1, 1], [0, 1, 3]])
    np.testing.assert_array_equal(mesh.face_normals[1:], 0.0)
    np.testing.assert_array_equal(mesh.vertex_normals, [[0, 0, 1]] * 4)
    assert len(without_degenerate_faces(mesh).faces) == 2


def test_small_components_are_dropped():
    mesh = both(sphere(2), sphere(1, radius=0.05, centre=(3, 0, 0)))
    assert face_components(mesh).max() == 1
    kept = keep_large_components(mesh, minimum_share=0.01)
    assert len(kept.faces) == len(sphere(2).faces)
    assert len(keep_large_components(mesh, 0.001).faces) == len(mesh.faces)


def test_smoothing_removes_noise_and_keeps_the_volume(rng):
    ball = sphere(4)
    radial = rng.normal(scale=0.01, size=(len(ball.vertices), 1))
    noisy = Mesh(ball.vertices * (1.0 + radial), ball.faces)
    smoothed = smooth(noisy, 10)
    before = np.std(np.linalg.norm(noisy.vertices, axis=1))
    after = np.std(np.linalg.norm(smoothed.vertices, axis=1))
    assert after < 0.45 * before  # white noise: most of its power is at short wavelengths
    # The pass band's gain is slightly above one: ten pairs of steps swell a ball by .2 %.
    assert smoothed.volume == pytest.approx(noisy.volume, rel=4e-3)
    np.testing.assert_array_equal(smoothed.faces, noisy.faces)


@pytest.mark.stability
@pytest.mark.parametrize(("origin", "size"), [(0.0, 1.0), (1e3, 1.0), (0.0, 1e-3), (1e3, 1e-3)])
def test_decimation_stays_closed_anywhere_at_any_size(origin, size):
    ball = sphere(4)
    moved = Mesh(ball.vertices * size + origin, ball.faces)
    small = decimate(moved, 800)
    assert small.watertight
    assert len(small.faces) <= 800
    radii = np.linalg.norm(small.vertices - origin, axis=1) / size
    np.testing.assert_allclose(
        radii, 1.0, atol=0.015
    )  # edges of .12: tangent planes meet at 1.007


def test_decimation_repeats_itself_exactly():
    first, second = decimate(sphere(4), 500), decimate(sphere(4), 500)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)


def test_ply_comes_back_exactly_and_trimesh_reads_it(tmp_path, rng):
    mesh = Mesh(sphere(2).vertices + rng.normal(size=3) * 1e3, sphere(2).faces)
    write_ply(tmp_path / "deep" / "ball.ply", mesh)
    again = read_ply(tmp_path / "deep" / "ball.ply")
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    other = trimesh.load_mesh(tmp_path / "deep" / "ball.ply", process=False)
    np.testing.assert_array_equal(other.vertices, mesh.vertices)
    # trimesh computes normals of its own; the stored ones are singles.
    stored = other.metadata["_ply_raw"]["vertex"]["data"]
    for name, values in zip(("nx", "ny", "nz"), mesh.vertex_normals.T, strict=True):
        np.testing.assert_array_equal(stored[name], values.astype(np.float32))
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["ball.ply"]


def test_what_is_not_a_ply_file_is_refused(tmp_path):
    path = tmp_path / "broken.ply"
    path.write_bytes(b"not a mesh")
    with pytest.raises(InputError, match=r"broken\.ply"):
        read_ply(path)
    with pytest.raises(InputError, match=r"missing\.ply"):
        read_ply(tmp_path / "missing.ply")
