"""A flat field as the material of another mesh."""

import numpy as np
import pytest
import trimesh

import reflfield as rf
from reflfield.api.fields import Field
from reflfield.errors import InputError
from reflfield.field.evaluation import evaluate
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.textured_mesh import TexturedMesh, read_textured_mesh
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.draped_field import draped_field
from tests.synthetic_fields import baked_field, lambert, sphere_surface, square_surface

SIDE = 4


def striped(tilt=0.0):
    """Flat field of two colours, by columns, whose frames lean towards u."""
    surface = square_surface(SIDE)
    c, s = np.cos(tilt), np.sin(tilt)
    surface.base_from_world[:] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    return baked_field(surface, lambert(0.5))


def standing_square():
    """A square in the plane y = 0 that faces -y, u along x and v along z."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TexturedMesh(Mesh(corners, faces), corners[:, [0, 2]][faces])


def test_frames_are_turned_from_the_texture_to_the_mesh():
    """What leans towards u on the plane leans towards x on the wall."""
    draped = draped_field(striped(tilt=0.3), standing_square())
    normal = draped.local_from_world[:, 2]
    # Frames are stored in steps of a hundredth of a degree.
    np.testing.assert_allclose(
        normal, np.tile([np.sin(0.3), -np.cos(0.3), 0.0], (len(normal), 1)), atol=1e-3
    )
    assert draped.visibility == "factored"


def test_texels_lie_where_the_texture_says_and_repeat(rounding):
    field = striped()
    numbered = FieldSurface(field).texels.position  # 16 texels, told apart by their places
    draped = draped_field(field, standing_square(), tiles=2.0)
    # Two tiles of 4 texels along each axis: 64 of them and half as many empty ones at least.
    assert draped.n_texels >= 64
    assert len(numbered) == 16
    lit = evaluate(
        draped,
        np.arange(draped.n_texels),
        *(np.tile([[0, -1.0, 0]], (draped.n_texels, 1)),) * 2,
    )
    # 16 taps in singles, cubed; the largest value has the largest code.
    taps = rounding(np.float32, operations=16, condition=3)
    np.testing.assert_allclose(lit, 0.5 / np.pi, rtol=taps)


def torus(n=24, m=12, major=1.0, minor=0.4):
    """Torus with UVs, u around the axis, v around the tube."""
    u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
    ring = major + minor * np.cos(2 * np.pi * v)
    points = np.stack([ring * np.cos(2 * np.pi * u), ring * np.sin(2 * np.pi * u),
                       minor * np.sin(2 * np.pi * v)], axis=-1)  # fmt: skip
    corner = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return points.reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2)


@pytest.fixture
def torus_file(tmp_path):
    points, faces, uv = torus()
    mesh = trimesh.Trimesh(
        points, faces, visual=trimesh.visual.TextureVisuals(uv=uv), process=False
    )
    path = tmp_path / "torus.obj"
    path.write_text(trimesh.exchange.obj.export_obj(mesh, include_normals=False))
    return path


def test_a_mesh_of_a_file_is_closed_and_has_its_texture(torus_file):
    read = read_textured_mesh(torus_file)
    assert read.mesh.watertight
    assert len(read.mesh.faces) == 2 * 24 * 12
    assert (read.corner_uv.min(axis=(0, 1)) == 0).all()
    assert (read.corner_uv.max(axis=(0, 1)) == 1).all()


@pytest.mark.reference
def test_a_matt_torus_is_lit_by_the_cosine(torus_file):
    """Under a light along its axis: the sample is 0.5 / pi times the normal's z."""
    torus_field = Field(striped()).on_mesh(torus_file, tiles=3)
    camera = rf.Camera.look_at([0, 0, 8.0], up=(0, 1, 0), width=48, height=48, fov_deg=24)
    image = torus_field.render(camera, rf.DirectionalLight([0, 0, 1.0], np.pi), alpha=True)
    across = (np.arange(48) + 0.5) / 48 * 2 - 1
    radius = np.hypot(across[:, None], across) * 8 * np.tan(np.radians(12)) * (8 - 0.3) / 8
    height = np.sqrt(np.clip(0.4**2 - (radius - 1.0) ** 2, 0, None))
    inside = (np.abs(radius - 1) < 0.25) & (image[..., 3] == 1)
    assert inside.sum() > 100
    off = image[..., 0][inside] - 0.5 * height[inside] / 0.4
    # Perspective and facets of 15 and 30 degrees.
    assert np.abs(off).mean() < 0.03


def test_solid_fields_and_meshes_without_texture_are_refused(tmp_path, torus_file):
    solid = baked_field(sphere_surface(6), lambert(0.5), view_side=3, light_side=3)
    with pytest.raises(InputError, match="flat"):
        Field(solid).on_mesh(torus_file)
    with pytest.raises(InputError, match="tiles"):
        Field(striped()).on_mesh(torus_file, tiles=0)
    bare = tmp_path / "bare.obj"
    bare.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match="texture coordinates"):
        read_textured_mesh(bare)
    with pytest.raises(InputError, match=r"\.obj or \.glb"):
        read_textured_mesh(tmp_path / "a.stl")
