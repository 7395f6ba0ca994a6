"""The half-vector model: evaluation against an independent one, scale, and its file."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from reflfield.errors import FieldFileError
from reflfield.field.array_schemas import HALF_VECTOR_ARRAYS
from reflfield.field.build import BaseSurface, Quantisation
from reflfield.field.description import describe
from reflfield.field.evaluation import evaluate, sum_lights
from reflfield.field.file import HEADER, open_field, write_field
from reflfield.field.half_vector import (
    DIFFUSE_NODES,
    HALF_SIDE,
    LOBE_NODES,
    N_DIFFERENCE,
    N_LIGHT,
    N_PHASE,
    N_VIEW,
    SKEW_NODES,
    SKEW_RINGS,
    HalfVectorModel,
)
from reflfield.field.half_vector_build import build_half_vector_field
from reflfield.field.indirect_light import IndirectLight
from reflfield.sphere.hemisphere import softened_cosine
from tests.field.test_fuzz_file import with_array

N_TEXELS = 6


def directions(rng, n):
    vectors = rng.normal(size=(n, 3))
    vectors[:, 2] = np.abs(vectors[:, 2]) + 0.4
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture
def model():
    return random_model()


def random_model():
    rng = np.random.default_rng(5)
    normal = directions(rng, N_TEXELS).astype(np.float64) + np.array([0, 0, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross(rng.normal(size=(N_TEXELS, 3)), normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return HalfVectorModel(
        frames=np.stack([tangent, np.cross(normal, tangent), normal], 1).astype(np.float32),
        diffuse=rng.uniform(0, 1, (N_TEXELS, 3)).astype(np.float32),
        weights=rng.uniform(0, 1, (N_TEXELS, 2)).astype(np.float32),
        lobes=rng.uniform(0, 1, (2, LOBE_NODES, 3)).astype(np.float32),
        skews=rng.uniform(-0.9, 0.9, (2, SKEW_NODES, 3)).astype(np.float32),
        diffuse_table=rng.uniform(0.5, 1.5, DIFFUSE_NODES).astype(np.float32),
    )


def built(model, step=0.0, **options):
    surface = BaseSurface(
        positions=np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
        texel_of_pixel=np.arange(N_TEXELS).reshape(2, 3),
    )
    return build_half_vector_field(surface, model, quantisation=Quantisation(step), **options)


def reference(model, texels, views, lights):
    """The formula of the module, by SciPy's interpolation in double precision."""
    frames = model.frames[texels].astype(np.float64)
    v, light = (np.einsum("nij,nj->ni", frames, d.astype(np.float64)) for d in (views, lights))
    half = v + light
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cos_d = np.clip((light * half).sum(axis=1), 0, 1)
    knee = np.radians(4.0)
    radius = np.arcsinh(np.arccos(np.clip(half[:, 2], 0, 1)) / knee)
    radius /= np.arcsinh(np.pi / 2 / knee)
    across = radius / np.linalg.norm(half[:, :2], axis=1)
    at = np.stack([np.arccos(cos_d), half[:, 1] * across, half[:, 0] * across], axis=1)
    axis = np.linspace(-1, 1, HALF_SIDE)
    grid = (np.linspace(0, np.pi / 2, N_DIFFERENCE), axis, axis)
    lobes = [
        RegularGridInterpolator(grid, lobe.reshape(*map(len, grid), 3))(at)
        for lobe in model.lobes.astype(np.float64)
    ]
    cos_l, cos_v = np.clip(light[:, 2], 0, 1), np.clip(v[:, 2], 0.05, 1)
    grid = tuple(np.linspace(0, 1, n) for n in (N_PHASE, N_VIEW, N_LIGHT))
    table = model.diffuse_table.astype(np.float64).reshape(*map(len, grid))
    base = RegularGridInterpolator(grid, table)(np.stack([1 - cos_d, cos_v, cos_l], axis=1))
    raised = np.maximum(cos_l, 0.05)
    spread = 1 / (raised + cos_v - raised * cos_v)
    shine = sum(
        model.weights[texels, k, None] * lobe * skewed(model.skews[k], half, light)
        for k, lobe in enumerate(lobes)
    )
    value = model.diffuse[texels] * base[:, None] + spread[:, None] * shine
    return softened_cosine(light[:, 2])[:, None] * value


def skewed(skew, half, light):
    """Factor of a lobe by the azimuth of the light about the half vector, (n, 3)."""
    normal = np.array([0.0, 0, 1])
    up = normal - half * half[:, 2:]
    across = np.cross(half, up)
    azimuth = np.arctan2((light * across).sum(axis=1), (light * up).sum(axis=1))
    angles = [np.arccos(np.clip(x, 0, 1)) for x in ((light * half).sum(axis=1), half[:, 2])]
    knee = np.radians(4.0)
    ring = np.arcsinh(angles[1] / knee) / np.arcsinh(np.pi / 2 / knee)
    grid = (np.linspace(0, np.pi / 2, N_DIFFERENCE), np.linspace(0, 1, SKEW_RINGS))
    at = np.stack([angles[0], ring], axis=1)
    table = skew.astype(np.float64).reshape(N_DIFFERENCE, SKEW_RINGS, 3)
    return 1 + np.cos(2 * azimuth)[:, None] * RegularGridInterpolator(grid, table)(at)


def pairs(n=400):
    rng = np.random.default_rng(11)
    return rng.integers(0, N_TEXELS, n), directions(rng, n), directions(rng, n)


def test_samples_are_those_of_an_independent_evaluation(model):
    texels, views, lights = pairs()
    exact = reference(model, texels, views, lights)
    values = evaluate(built(model), texels, views, lights)
    # Singles: 33 nodes over an arc hyperbolic sine of an arc cosine lose some digits near the
    # pole; random tables differ by 1 from node to node. Frames are stored to .01 degrees.
    # Observed: .0019 at most, .00026 on average.
    np.testing.assert_allclose(values, exact, atol=0.006)
    assert np.abs(values - exact).mean() < 8e-4  # three times what was observed


def test_texels_that_do_not_exist_and_lights_below_give_nothing(model):
    up = np.tile(np.float32([0, 0, 1]), (2, 1))
    field = built(model)
    assert not evaluate(field, [-1, -1], up, up).any()
    assert not evaluate(field, [0, 1], up, -up).any()


def test_a_sum_over_lights_is_the_sum_of_samples(model):
    field = built(model)
    rng = np.random.default_rng(3)
    texels, views, lights = np.arange(N_TEXELS), directions(rng, N_TEXELS), directions(rng, 4)
    power = rng.uniform(0, 1, (4, 3)).astype(np.float32)
    summed = sum_lights(field, texels, views, lights, power)
    each = sum(
        evaluate(field, texels, views, np.tile(light, (N_TEXELS, 1))) * p
        for light, p in zip(lights, power, strict=True)
    )
    # Sums of four terms in singles.
    np.testing.assert_allclose(summed, each, rtol=1e-5)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_quantised_samples_scale_with_the_model(model, scale):
    texels, views, lights = pairs(100)
    scaled = replace(
        model,
        diffuse=model.diffuse * np.float32(scale),
        lobes=model.lobes * np.float32(scale),
    )
    step = 0.01 * np.cbrt(scale)
    usual = evaluate(built(model, 0.01), texels, views, lights)
    values = evaluate(built(scaled, step), texels, views, lights)
    # Cube roots are rounded in double precision, decoded in singles.
    np.testing.assert_allclose(values / scale, usual, rtol=2e-2, atol=2e-3)


def test_coarser_steps_make_smaller_files_and_larger_errors(model, tmp_path):
    texels, views, lights = pairs()
    exact = reference(model, texels, views, lights)
    sizes, errors = [], []
    for step in (0.003, 0.03, 0.2):
        write_field(tmp_path / "a.rfld", built(model, step))
        field = open_field(tmp_path / "a.rfld")
        sizes.append((tmp_path / "a.rfld").stat().st_size)
        errors.append(np.abs(evaluate(field, texels, views, lights) - exact).mean())
    assert sizes == sorted(sizes, reverse=True)
    assert errors == sorted(errors)


def test_a_file_gives_back_the_field(model, tmp_path):
    field = built(model, 0.01, metadata={"a": 1})
    write_field(tmp_path / "a.rfld", field)
    opened = open_field(tmp_path / "a.rfld")
    assert opened.model == "half_vector"
    for name in HALF_VECTOR_ARRAYS:
        np.testing.assert_array_equal(opened.arrays[name], field.arrays[name])
    texels, views, lights = pairs(50)
    np.testing.assert_array_equal(
        evaluate(opened, texels, views, lights), evaluate(field, texels, views, lights)
    )
    described = describe(opened)
    assert described.options["model"] == "half_vector"
    assert described.counts["lobes"] == 2


def with_header(source, target, without=(), **changes):
    """Copy of a field file whose header differs; a change to None removes an entry.

    Arrays `without` which it is are removed, and from the header.
    """
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        arrays = json.loads(old.read(HEADER))["arrays"]
        changes = {"arrays": {n: a for n, a in arrays.items() if n not in without}} | changes
        for info in old.infolist():
            if info.filename.removesuffix(".bin") in without:
                continue
            content = old.read(info)
            if info.filename == HEADER:
                header = json.loads(content) | changes
                kept = {k: v for k, v in header.items() if v is not None}
                content = json.dumps(kept).encode()
            new.writestr(info, content)


def test_files_of_version_3_are_clustered_fields(make_field, tmp_path):
    write_field(tmp_path / "new.rfld", make_field())
    with_header(
        tmp_path / "new.rfld", tmp_path / "old.rfld", ["bounce_gain"], version=3, model=None
    )
    assert open_field(tmp_path / "old.rfld").model == "clustered"


def test_an_unknown_model_is_refused(model, tmp_path):
    write_field(tmp_path / "new.rfld", built(model))
    with_header(tmp_path / "new.rfld", tmp_path / "other.rfld", model="splines")
    with pytest.raises(FieldFileError, match="model: expected one of"):
        open_field(tmp_path / "other.rfld")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A field file and its arrays."""
    path = tmp_path_factory.mktemp("written") / "field.rfld"
    write_field(path, built(random_model(), 0.01))
    return path.read_bytes(), dict(open_field(path).arrays)


@pytest.mark.parametrize("name", HALF_VECTOR_ARRAYS)
def test_numbers_that_are_none_are_one_error_or_finite_samples(written, tmp_path, name):
    """Arrays of evil values under checksums that fit them, as of a hostile writer."""
    path = tmp_path / "field.rfld"
    texels, views, lights = pairs(60)
    content, arrays = written
    if arrays[name].dtype.kind == "f":
        values = (0, -1, np.nan, np.inf, np.finfo(np.float32).max, 1e-45, 1e30)
    else:
        limits = np.iinfo(arrays[name].dtype)
        values = (0, 1, limits.max, limits.min)
    for value in values:
        path.write_bytes(content)
        with_array(path, name, np.full_like(arrays[name], value))
        try:
            samples = evaluate(open_field(path), texels, views, lights)
        except FieldFileError as error:
            samples, message = np.zeros(1), str(error)
        else:
            message = str(path)
        assert message.startswith(str(path))
        assert np.isfinite(samples).all(), value
        assert (samples >= 0).all(), value


def test_files_of_version_4_have_lobes_without_skews(model, tmp_path):
    write_field(tmp_path / "new.rfld", built(model))
    absent = ["lobe_skews", "bounce_gain"]
    with_header(tmp_path / "new.rfld", tmp_path / "old.rfld", absent, version=4)
    opened = open_field(tmp_path / "old.rfld")
    texels, views, lights = pairs(50)
    without = built(replace(model, skews=np.zeros_like(model.skews)))
    np.testing.assert_array_equal(
        evaluate(opened, texels, views, lights), evaluate(without, texels, views, lights)
    )
    # A file of a later version must have them.
    with_header(tmp_path / "old.rfld", tmp_path / "cut.rfld", version=5)
    with pytest.raises(FieldFileError):
        open_field(tmp_path / "cut.rfld")


def test_files_of_version_5_trace_no_bounced_light(model, tmp_path):
    light = IndirectLight(
        np.ones((1, 1, 3), np.float32),
        np.zeros((model.n_texels, 0), np.float32),
        gain=np.array([1.0, 0.5, 0.0], np.float32),
    )
    write_field(tmp_path / "new.rfld", built(model, indirect=light, visibility="factored"))
    opened = open_field(tmp_path / "new.rfld").indirect
    np.testing.assert_array_equal(opened.gain, light.gain)
    with_header(tmp_path / "new.rfld", tmp_path / "old.rfld", ["bounce_gain"], version=5)
    old = open_field(tmp_path / "old.rfld").indirect
    assert not old.is_traced
    np.testing.assert_array_equal(old.functions, opened.functions)
    with_header(tmp_path / "old.rfld", tmp_path / "cut.rfld", version=6)
    with pytest.raises(FieldFileError):
        open_field(tmp_path / "cut.rfld")
