import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from reflfield.capture.cameras import Camera
from reflfield.errors import GeometryError, InputError
from reflfield.geometry import uv_atlas as atlas_module
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.plane import image_plane
from reflfield.geometry.texels import frames, texel_table, texture_axes
from reflfield.geometry.uv_atlas import (
    Atlas,
    AtlasOptions,
    UnwrappingError,
    built_atlas,
    fallback_words,
)


def torus(scale=1.0, origin=0.0):
    made = trimesh.creation.torus(1.0, 0.4, major_sections=48, minor_sections=24)
    return Mesh(made.vertices * scale + origin, made.faces)


@pytest.fixture(scope="module", params=["xatlas", "boxes"])
def torus_atlas(request):
    return torus(), built_atlas(
        torus(), AtlasOptions(resolution=128, method=request.param)
    ).atlas


def quad(mirrored=False, height=4, width=8):
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    uv[:, 0] = 1.0 - uv[:, 0] if mirrored else uv[:, 0]
    return Atlas(
        positions=[[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]],
        faces=[[0, 1, 2], [0, 2, 3]],
        uv=uv, chart=[0, 0], normals=[[0, 0, 1]] * 4, height=height, width=width,
    )  # fmt: skip


def texels_covered_more_than_once(atlas):
    """Independent of the texel table: count the texel centres inside each triangle."""
    count = np.zeros((atlas.height, atlas.width), dtype=int)
    col, row = np.meshgrid(np.arange(atlas.width) + 0.5, np.arange(atlas.height) + 0.5)
    for corners in atlas.uv[atlas.faces] * [atlas.width, atlas.height]:
        (ax, ay), (bx, by), (cx, cy) = corners
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        second = ((col - ax) * (cy - ay) - (row - ay) * (cx - ax)) / area
        third = ((bx - ax) * (row - ay) - (by - ay) * (col - ax)) / area
        slack = 1e-4  # single precision of xatlas, in barycentric units
        count += (second > slack) & (third > slack) & (1.0 - second - third > slack)
    return int((count > 1).sum())


def test_charts_cover_all_faces_and_are_disjoint(torus_atlas):
    mesh, atlas = torus_atlas
    np.testing.assert_array_equal(atlas.positions[atlas.faces], mesh.corners)
    assert set(atlas.chart) == set(range(atlas.n_charts))
    assert texels_covered_more_than_once(atlas) == 0
    # A chart is mirrored as a whole: all its faces turn the same way.
    sign = np.where(atlas.mirrored, -1.0, 1.0)[atlas.chart]
    assert (sign * atlas.uv_areas >= 0.0).all()
    assert atlas.n_charts < 60


def test_smooth_normals_are_those_of_the_mesh(torus_atlas):
    mesh, atlas = torus_atlas
    np.testing.assert_array_equal(atlas.normals[atlas.faces], mesh.vertex_normals[mesh.faces])


def test_texels_lie_on_their_triangles_with_orthonormal_frames(torus_atlas, rounding):
    mesh, atlas = torus_atlas
    texels = texel_table(atlas)
    corners = mesh.corners[texels.face]
    on_face = np.einsum("nk,nkd->nd", texels.barycentric.astype(float), corners)
    np.testing.assert_allclose(texels.position, on_face, atol=1e-6)  # float32 of size 1.4
    gram = np.einsum("nij,nkj->nik", texels.local_from_world, texels.local_from_world)
    assert np.abs(gram - np.eye(3)).max() < rounding(np.float32)
    assert np.abs(np.linalg.det(texels.local_from_world) - 1).max() < rounding(np.float32)
    # Charts of a few hundred texels: their rims are cut at whole texels; measured .971, 1.003.
    assert texels.area.sum() == pytest.approx(mesh.area, rel=0.05)
    assert len(np.unique(texels.pixel, axis=0)) == len(texels)


def test_tangents_run_along_u_and_binormals_along_v_unless_mirrored(torus_atlas):
    _, atlas = torus_atlas
    texels = texel_table(atlas)
    u_axis, v_axis = (axis[texels.face] for axis in texture_axes(atlas))
    frame = texels.local_from_world.astype(float)
    assert ((frame[:, 0] * u_axis).sum(axis=1) > 0.0).mean() > 0.999
    up = (frame[:, 1] * v_axis).sum(axis=1) * np.where(atlas.mirrored, -1, 1)[texels.chart]
    assert (up > 0.0).mean() > 0.999


def test_the_gutter_repeats_the_nearest_texel(torus_atlas):
    _, atlas = torus_atlas
    texels = texel_table(atlas)
    np.testing.assert_array_equal(
        texels.texel_of_pixel[tuple(texels.pixel.T)], range(len(texels))
    )
    row, col = np.nonzero(texels.texel_of_pixel >= 0)
    nearest = texels.pixel[texels.texel_of_pixel[row, col]]
    assert np.hypot(*(nearest - np.stack([row, col], axis=1)).T).max() <= 2.5
    assert len(row) > len(texels)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_quad_is_sampled_at_its_texel_centres(mirrored):
    texels = texel_table(quad(mirrored))
    assert len(texels) == 32
    x = (texels.pixel[:, 1] + 0.5) / 4.0
    expected = np.stack([2.0 - x if mirrored else x, 1.0 - (texels.pixel[:, 0] + 0.5) / 4.0], 1)
    # Halves and quarters have no rounding.
    np.testing.assert_array_equal(texels.position[:, :2], expected)
    assert (texels.area == 2.0 / 32.0).all()
    way = -1.0 if mirrored else 1.0
    np.testing.assert_array_equal(texels.local_from_world[0], np.diag([way, way, 1.0]))
    assert texels.mirrored.tolist() == [mirrored]
    assert texels.spacing == pytest.approx(0.25)


@pytest.mark.stability
def test_texels_far_from_the_origin_stay_apart():
    """Coordinates of a survey: single precision there has steps of half a metre."""
    near = texel_table(quad())
    far = np.array([441547.5, 5121946.5, 2345.0])
    moved = texel_table(replace(quad(), positions=0.1 * quad().positions + far))
    # To the rounding of doubles of five million.
    np.testing.assert_allclose(moved.position - far, 0.1 * near.position, atol=1e-8)


def test_degenerate_triangles_have_no_texels_and_break_nothing():
    mesh = torus()
    extra = np.array([[0, 0, 1], [2, 2, 2]])
    mesh = Mesh(mesh.vertices, np.concatenate([mesh.faces, extra]))
    atlas = built_atlas(mesh, AtlasOptions(resolution=64)).atlas
    np.testing.assert_array_equal(atlas.positions[atlas.faces], mesh.corners)
    assert texel_table(atlas).face.max() < len(mesh.faces) - 2


@pytest.mark.stability
@pytest.mark.parametrize("method", ["xatlas", "boxes"])
@pytest.mark.parametrize(("scale", "origin"), [(1e-3, 0.0), (1.0, 1e3)])
def test_a_single_triangle_anywhere_gets_a_chart(method, scale, origin):
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5]]) * scale + origin, [[0, 1, 2]])
    atlas = built_atlas(mesh, AtlasOptions(resolution=32, method=method)).atlas
    texels = texel_table(atlas)
    assert atlas.n_charts == 1
    assert texels.area.sum() == pytest.approx(mesh.area, rel=0.2)  # a coarse raster of one face
    assert len(texels) > 150


def answers(monkeypatch, code):
    """Let a script stand in for the worker; `WORKER` and its two paths are in sys.argv."""
    monkeypatch.setattr(
        atlas_module, "tied", lambda command: [sys.executable, "-c", code, *command[2:]]
    )


def test_a_slow_machine_makes_the_same_atlas(monkeypatch):
    mesh, options = torus(), AtlasOptions(resolution=64)
    usual = built_atlas(mesh, options)
    slow = "import os, runpy, sys, time; os.nice(19); time.sleep(2); sys.argv = sys.argv[1:]; "
    one_core = "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
    run = "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)"
    answers(monkeypatch, slow + one_core + run)
    slowly = built_atlas(mesh, options)
    assert (usual.method, usual.reason) == (slowly.method, slowly.reason) == ("xatlas", "")
    assert slowly.atlas.uv.tobytes() == usual.atlas.uv.tobytes()
    assert slowly.atlas.faces.tobytes() == usual.atlas.faces.tobytes()


def test_a_worker_that_hangs_is_an_error_and_no_other_atlas(monkeypatch):
    answers(monkeypatch, "import time; time.sleep(60)")
    with pytest.raises(GeometryError, match=r"within 0\.2 s, .* raise atlas\.time_limit_s"):
        built_atlas(torus(), AtlasOptions(resolution=64, time_limit_s=0.2))


def test_a_worker_that_crashes_leaves_box_charts_and_says_so(monkeypatch):
    answers(monkeypatch, "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    built = built_atlas(torus(), AtlasOptions(resolution=64))
    assert (built.method, built.reason) == ("boxes", "xatlas crashed (SIGSEGV)")
    assert texels_covered_more_than_once(built.atlas) == 0
    assert "the atlas is made of box charts" in fallback_words(built.reason)


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "killed by signal 9"),
        ("raise ModuleNotFoundError('xatlas')", "ModuleNotFoundError: xatlas"),
    ],
    ids=["killed for memory", "not installed"],
)
def test_a_worker_that_the_machine_fails_is_an_error(monkeypatch, code, why):
    answers(monkeypatch, code)
    with pytest.raises(GeometryError, match=why):
        built_atlas(torus(), AtlasOptions(resolution=64))


def test_meshes_with_too_many_triangles_get_box_charts_on_every_machine(monkeypatch):
    monkeypatch.setattr(atlas_module, "MOST_FACES", 100)
    built = built_atlas(torus(), AtlasOptions(resolution=64))
    assert built.method == "boxes"
    assert "more than 100 triangles, and the mesh has 2304" in built.reason


def test_charts_that_do_not_fit_are_said_not_to():
    with pytest.raises(UnwrappingError, match=r"charts do not fit into 4 x 4 texels"):
        atlas_module._xatlas_atlas(torus(), AtlasOptions(resolution=4, padding=2))


@pytest.mark.stability
def test_padding_that_leaves_no_place_for_charts_is_refused():
    with pytest.raises(InputError, match=r"padding: expected at most 4 texels .*64 x 64"):
        AtlasOptions(resolution=64, padding=5)


def test_an_atlas_that_cannot_be_is_no_reason_for_box_charts(monkeypatch):
    def broken(*_):
        raise InputError("uv: expected values in [0, 1]")

    monkeypatch.setattr(atlas_module, "_run_worker", broken)
    with pytest.raises(InputError, match="uv"):
        built_atlas(torus(), AtlasOptions(resolution=64))


def test_the_worker_is_refused_more_memory_than_it_may_take():
    script = (
        "import numpy as np, reflfield.geometry.xatlas_worker as worker\n"
        "worker._MOST_MEMORY = 2 << 30\n"
        "worker.bound_memory()\n"
        "np.zeros(3 << 27)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode == 1
    assert b"MemoryError" in done.stderr


def test_the_worker_is_found_from_any_folder(tmp_path):
    script = (
        "import numpy as np\n"
        "from reflfield.geometry.uv_atlas import built_atlas\n"
        "from reflfield.geometry.mesh import Mesh\n"
        "atlas = built_atlas(Mesh([[0,0,0],[1,0,0],[0,1,0]], [[0,1,2]])).atlas\n"
        "raise SystemExit(0 if atlas.n_charts == 1 else 1)\n"
    )
    command = [sys.executable, "-W", "error::UserWarning", "-c", script]
    assert subprocess.run(command, cwd=tmp_path, timeout=60, check=False).returncode == 0


def test_bad_input_is_refused():
    with pytest.raises(InputError, match=r"uv: expected values in \[0, 1\]"):
        Atlas(np.eye(3), [[0, 1, 2]], np.full((3, 2), 1.5), [0], np.eye(3), 4, 4)
    with pytest.raises(GeometryError, match="area"):
        built_atlas(Mesh(np.zeros((3, 3)), [[0, 1, 2]]))
    with pytest.raises(InputError, match="method"):
        AtlasOptions(method="magic")
    flat = Atlas(np.eye(3), [[0, 1, 2]], np.zeros((3, 2)), [0], np.eye(3), 4, 4)
    with pytest.raises(GeometryError, match="raise the texture resolution"):
        texel_table(flat)


def test_frames_survive_null_and_parallel_directions():
    normal = np.array([[0.0, 0.0, 1.0]] * 2)
    made = frames(normal, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    np.testing.assert_allclose(np.linalg.det(made), 1.0)


def camera(kind):
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 2.0  # two metres above the plane, looking down
    focal = 40.0 if kind == "opencv" else 20.0
    return Camera("top", kind, 12, 10, focal, focal, 6.0, 5.0, pose)


@pytest.mark.parametrize("kind", ["orthographic", "opencv"])
def test_texels_of_the_image_plane_are_the_pixels(kind, rounding):
    texels = texel_table(image_plane(camera(kind)))
    assert (texels.height, texels.width, len(texels)) == (10, 12, 120)
    pixels, _ = camera(kind).project(texels.position)
    tolerance = rounding(np.float32, scale=12)
    np.testing.assert_allclose(pixels, texels.pixel[:, ::-1] + 0.5, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(texels.local_from_world[0], np.eye(3))


def test_the_plane_is_cropped_to_the_silhouette(rounding):
    silhouette = np.zeros((10, 12), np.float32)
    silhouette[2:7, 3:9] = 1.0
    texels = texel_table(image_plane(camera("orthographic"), silhouette))
    assert (texels.height, texels.width) == (5, 6)
    pixels, _ = camera("orthographic").project(texels.position)
    expected = texels.pixel[:, ::-1] + [3.5, 2.5]
    np.testing.assert_allclose(pixels, expected, rtol=0, atol=rounding(np.float32, scale=12))
    with pytest.raises(GeometryError, match=r"'top'.*no pixel covered"):
        image_plane(camera("orthographic"), np.zeros((10, 12)))
