"""The exported folder, used as its reader would, without this package."""

import importlib
import json
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

import reflfield as rf
from reflfield.errors import InputError
from reflfield.export.formats import export_field
from reflfield.field.evaluation import evaluate
from reflfield.render.renderer import RenderOptions, render
from tests.viewer.shown_fields import clustered_field, half_vector_field

pytestmark = pytest.mark.reference
SIDE = 32


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    field, folder = half_vector_field(), tmp_path_factory.mktemp("mitsuba") / "out"
    export_field(field, folder, "mitsuba")
    return field, folder


PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drjit as dr
print(dr.maximum(mi.Float([1.0, 2.0]), 1.5))
"""


@cache
def has_llvm():
    """Whether LLVM is there and new enough for what Mitsuba asks of it; else it aborts."""
    ran = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, check=False)
    return ran.returncode == 0


def loaded(monkeypatch, folder, variant):
    """Mitsuba, the plug-in and the script of the folder."""
    mi = pytest.importorskip("mitsuba")
    if variant.startswith("llvm") and not has_llvm():
        pytest.skip("needs LLVM that Mitsuba can use, such as 19 (DRJIT_LIBLLVM_PATH)")
    mi.set_variant(variant)
    monkeypatch.syspath_prepend(str(folder))
    for name in ("reflfield_bsdf", "render"):
        sys.modules.pop(name, None)
    importlib.import_module("reflfield_bsdf")
    script = importlib.import_module("render")
    for name in ("reflfield_bsdf", "render"):
        sys.modules.pop(name)
    return mi, script


def cameras(folder, nearer=0.4):
    """Direction and distance for the script, and the same camera here."""
    about = json.loads((folder / "scene.json").read_text())
    towards = nearer * np.array(about["camera"])
    position = np.array(about["centre"]) + about["distance"] * towards
    camera = rf.Camera.look_at(
        position, about["centre"], about["up"], width=SIDE, height=SIDE, fov_deg=about["fov"]
    )
    return towards.tolist(), camera


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
def test_samples_are_those_of_the_field(exported, monkeypatch, rng, variant):
    """At centres of texels, where nothing is blended."""
    field, folder = exported
    mi, _ = loaded(monkeypatch, folder, variant)
    bsdf = mi.load_dict({"type": "reflfield", "model": str(folder / "model.npz")})
    height, width = field.texel_of_pixel.shape
    for _ in range(12 if variant == "scalar_rgb" else 40):
        row, column = int(rng.integers(2, height - 2)), int(rng.integers(2, width - 2))
        texel = int(field.texel_of_pixel[row, column])
        normal = field.local_from_world[texel, 2].astype(float)
        view, light = (normal + rng.uniform(-0.8, 0.8, 3) for _ in range(2))
        view, light = view / np.linalg.norm(view), light / np.linalg.norm(light)
        si = mi.SurfaceInteraction3f()
        si.uv = mi.Point2f((column + 0.5) / width, 1 - (row + 0.5) / height)
        si.n = mi.Normal3f(normal)
        si.sh_frame = mi.Frame3f(mi.Vector3f(normal))
        si.wi = si.to_local(mi.Vector3f(view))
        value = bsdf.eval(mi.BSDFContext(), si, si.to_local(mi.Vector3f(light)), True)
        wanted = evaluate(field, [texel], view[None].astype("f4"), light[None].astype("f4"))
        # Places on tables are differences of singles: a ten-thousandth of a node.
        np.testing.assert_allclose(np.ravel(value), wanted[0], rtol=2e-3, atol=1e-4)


def test_directions_are_sampled_by_the_density(exported, monkeypatch):
    """Weights of samples give the reflected light; densities of the samples sum to one."""
    field, folder = exported
    mi, _ = loaded(monkeypatch, folder, "llvm_ad_rgb")
    bsdf = mi.load_dict({"type": "reflfield", "model": str(folder / "model.npz")})
    height, width = field.texel_of_pixel.shape
    texel = int(field.texel_of_pixel[9, 5])
    normal = field.local_from_world[texel, 2].astype(float)
    side, n = np.array([normal[1], -normal[0], 0.0]), 1 << 16
    view = normal + 0.7 * side / np.linalg.norm(side)
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f(5.5 / width, 1 - 9.5 / height)
    si.n, si.sh_frame = mi.Normal3f(normal), mi.Frame3f(mi.Vector3f(normal))
    si.wi = si.to_local(mi.Vector3f(view / np.linalg.norm(view)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, n)
    sampled, weight = bsdf.sample(
        mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), True
    )
    by_lobes = np.array(weight)
    even = mi.warp.square_to_uniform_hemisphere(sampler.next_2d())
    values = np.array(bsdf.eval(mi.BSDFContext(), si, even, True)) * 2 * np.pi
    spread = values.std(axis=1) / np.sqrt(n)
    # Five standard errors of the plain estimate, which is the noisier one.
    assert (np.abs(by_lobes.mean(axis=1) - values.mean(axis=1)) < 5 * spread).all()
    assert by_lobes.std(axis=1).max() < 0.6 * values.std(axis=1).max()
    density = np.array(bsdf.pdf(mi.BSDFContext(), si, even, True)) * 2 * np.pi
    error = density.std() / np.sqrt(n)
    below = 1 - np.mean(np.array(sampled.pdf) > 0)  # sampled below the horizon
    assert abs(density.mean() - (1 - below)) < 5 * error + 0.005


@pytest.mark.parametrize(
    "variant", ["llvm_ad_rgb", pytest.param("scalar_rgb", marks=pytest.mark.slow)]
)
def test_images_agree_with_those_of_the_field(exported, monkeypatch, variant):
    """One view, one light, direct light alone, off the edges of object and shadows."""
    field, folder = exported
    mi, script = loaded(monkeypatch, folder, variant)
    direction, camera = cameras(folder)
    light = np.add(direction, [0.2, 0.4, 0.5]).tolist()
    described = script.scene(direction, SIDE, 16, light, None, depth=2)
    shown = np.array(mi.render(mi.load_dict(described)))[..., :3]
    wanted = render(field, camera, rf.DirectionalLight(light, np.pi), RenderOptions(16))
    lit = wanted.image.sum(axis=2) > 0.6  # in shadow there is light that Mitsuba has not
    inside = ndimage.binary_erosion((wanted.coverage == 1) & lit, iterations=2)
    assert inside.sum() > 100
    off = np.linalg.norm((shown - wanted.image)[inside])
    # 16 rays of a pixel are random there (1.7 % here), and texels blend over one width, here
    # over that of a pixel at the distance of each (2 %).
    assert off < 0.035 * np.linalg.norm(wanted.image[inside])


def test_clustered_fields_are_refused(tmp_path):
    with pytest.raises(InputError, match="half-vector"):
        export_field(clustered_field(), tmp_path / "out", "mitsuba")
    assert not list(tmp_path.iterdir())
