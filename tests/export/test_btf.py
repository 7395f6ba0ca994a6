"""Fields as BTF containers, read back."""

import numpy as np
import pytest

from reflfield.capture.btf import read_btf
from reflfield.errors import InputError
from reflfield.export import btf_samples
from reflfield.export.formats import export_field
from reflfield.field.evaluation import evaluate
from reflfield.render.camera_rays import FieldSurface
from tests.export.btf_hh import missing, read_by_btf_hh
from tests.synthetic_fields import baked_field, lambert, square_surface
from tests.viewer.shown_fields import half_vector_field


def test_the_container_shows_the_samples_of_the_field(tmp_path, monkeypatch):
    """Of sums of tables but for the smallest components; frames from the world by hand."""
    field = half_vector_field()
    monkeypatch.setattr(btf_samples, "_SOME_TEXELS", 48)
    (line,) = export_field(field, tmp_path / "a.btf", "btf")
    read = read_btf(tmp_path / "a.btf")
    height, width = field.texel_of_pixel.shape
    assert (read.width, read.height, len(read.views)) == (width, height, 151)
    # Three diffuse channels, and weights of two lobes whose channels are skewed apart.
    # Those that are left out are near what single precision loses of the samples.
    assert 3 <= int(line.split(" components")[0]) <= 8
    column, view, light = 5 * width + 3, 60, 130
    texel = field.texel_of_pixel.ravel()[column]
    world = [d @ field.local_from_world[texel] for d in (read.views[view], read.lights[light])]
    wanted = evaluate(field, [texel], *(np.asarray(d, "f4")[None] for d in world))[0]
    u, v = read.factors[0]
    first = 3 * (light + len(read.lights) * view)
    shown = u[first : first + 3] @ v[column]
    # Singular values below this share of the largest are left out.
    np.testing.assert_allclose(shown, wanted, rtol=btf_samples._LEAST_SHARE)
    assert read.cosine_included


@pytest.mark.reference
@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_a_reader_of_others_shows_the_samples_of_the_field(tmp_path):
    """By btf.hh: samples, directions and frames of texels."""
    field = half_vector_field()
    export_field(field, tmp_path / "a.btf", "btf")
    view, light = 60, 130
    read = read_by_btf_hh(tmp_path / "a.btf", tmp_path, [[view, light]])
    texel_of_pixel = field.texel_of_pixel
    texels = texel_of_pixel[texel_of_pixel >= 0]
    frames = field.local_from_world[texels]
    views, lights = (
        np.einsum("j,njk->nk", read.lights[k], frames).astype("f4") for k in (view, light)
    )
    wanted = evaluate(field, texels, views, lights)
    off = np.linalg.norm(read.images[0][texel_of_pixel >= 0] - wanted)
    # Singular values below this share of the largest are left out.
    assert off < 2 * btf_samples._LEAST_SHARE * np.linalg.norm(wanted)
    assert read.cosine_included
    np.testing.assert_allclose(
        read.rotations.reshape(-1, 3, 3)[texel_of_pixel.ravel() >= 0],
        FieldSurface(field).local_from_texture[texels].astype("f4"), rtol=0, atol=0,
    )  # fmt: skip


def test_rotations_are_those_of_the_flat_sample(tmp_path):
    surface = square_surface(3)
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    surface.base_from_world[:] = turn
    field = baked_field(surface, lambert(0.5))
    export_field(field, tmp_path / "a.btf", "btf")
    # Frames are stored in steps of a hundredth of a degree.
    np.testing.assert_allclose(
        read_btf(tmp_path / "a.btf").rotations, np.tile(turn, (9, 1, 1)), atol=4e-4
    )


def test_an_unknown_light_is_refused(tmp_path):
    field = baked_field(square_surface(2), lambert(0.5), light_side=1, light_model="unknown")
    with pytest.raises(InputError, match="unknown light"):
        export_field(field, tmp_path / "a.btf", "btf")
