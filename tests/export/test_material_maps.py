"""The maps of a field: as other software reads them, and how far they are from it."""

import json
import os
import shutil
import subprocess

import numpy as np
import pytest
import trimesh

from reflfield.errors import InputError
from reflfield.export.formats import export_field
from reflfield.export.material_maps import export_atlas, material_maps
from tests.export.test_gltf import chunks
from tests.synthetic_fields import baked_field, lambert, sphere_surface, square_surface
from tests.viewer.shown_fields import half_vector_field

VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then((report) => console.log(JSON.stringify(report.issues)));
"""


def validated(path):
    """Issues of a file by the Khronos validator; skips where Node or the package is absent."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs Node")
    ran = subprocess.run(
        [node, "-e", VALIDATE, str(path)], capture_output=True, text=True, check=False,
        env=os.environ, timeout=120,
    )  # fmt: skip
    if "Cannot find module" in ran.stderr:
        pytest.skip("needs gltf-validator (npm install gltf-validator, NODE_PATH)")
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


@pytest.fixture(scope="module")
def spheres(tmp_path_factory):
    """A field of two lobes, its file and what was said of it."""
    field, path = half_vector_field(), tmp_path_factory.mktemp("gltf") / "spheres.glb"
    return field, path, export_field(field, path, "gltf")


def test_the_validator_of_khronos_has_nothing_to_say(spheres):
    issues = validated(spheres[1])
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_the_file_says_how_far_its_maps_are_from_the_field(spheres):
    document, _ = chunks(spheres[1])
    error = document["asset"]["extras"]["reflfield"]["error"]
    # Two lobes of 6 and 25 degrees cannot be one highlight, but most light is diffuse.
    assert 0.0 < error["relative"] < 0.3
    assert f"{100 * error['relative']:.1f} %" in spheres[2][0]
    used = set(document["extensionsUsed"])
    assert used == {"KHR_materials_anisotropy", "KHR_materials_specular"}
    assert used == set(document["materials"][0]["extensions"])


def test_other_software_reads_the_maps(spheres):
    (loaded,) = trimesh.load_scene(spheres[1]).geometry.values()
    material = loaded.visual.material
    assert material.baseColorTexture.size == spheres[0].texel_of_pixel.shape[::-1]
    assert np.asarray(material.normalTexture)[..., 2].min() > 127


def test_a_matt_field_becomes_a_matt_material():
    """Nothing glossy: colours within a step of 8 bits, gloss near none, normals upright."""
    field = baked_field(square_surface(4), lambert([0.6, 0.4, 0.2]), domain="linear")
    maps = material_maps(field, export_atlas(field))
    assert maps.errors["relative"] < 0.03
    assert np.abs(maps.normal[..., :2].astype(int) - 127.5).max() <= 2
    assert maps.exposure == 1.0


def test_normals_of_the_field_stand_in_the_tangent_space_of_the_mesh():
    """Frames tilted by 20 degrees along u: the map leans to the right."""
    surface = square_surface(4)
    tilt = np.radians(20.0)
    c, s = np.cos(tilt), np.sin(tilt)
    surface.base_from_world[:] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    field = baked_field(surface, lambert(0.5), domain="linear")
    normal = material_maps(field, export_atlas(field)).normal[0, 0] / 127.5 - 1.0
    # The fit may move the normal a little: matt samples say where it is to a degree.
    np.testing.assert_allclose(normal, [s, 0.0, c], atol=0.03)


def test_a_field_that_reflects_more_than_arrives_is_shown_darker(rounding):
    field = baked_field(square_surface(2), lambert(5.0), domain="linear")
    maps = material_maps(field, export_atlas(field))
    assert maps.exposure == pytest.approx(0.9 / 5.0, rel=rounding(np.float32))
    assert maps.errors["relative"] < 0.03
    assert any("darker" in line for line in maps.lines())


def test_an_unknown_light_gives_colours_that_are_not_lit(tmp_path):
    field = baked_field(sphere_surface(6), lambert(0.5), light_side=1, light_model="unknown")
    export_field(field, tmp_path / "a.glb", "gltf")
    document, _ = chunks(tmp_path / "a.glb")
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    with pytest.raises(InputError, match="unknown light"):
        material_maps(field, export_atlas(field))
