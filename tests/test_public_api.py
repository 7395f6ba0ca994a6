"""`import reflfield`: what it promises, how quickly it comes, and that its pages are made."""

import ast
import inspect
import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import reflfield as rf
from tests.synthetic_fields import baked_field, lambert, sphere_surface, square_surface

ROOT = Path(__file__).parents[1]
# Frozen: a change of it is a change of what is promised. Written anew by
# `python tests/test_public_api.py`.
PROMISE = ROOT / "tests" / "data" / "public_api.txt"

# What opening, evaluating and rendering a field do without: of Open3D, the package around its
# compiled module, which imports what follows it here.
HEAVY = (
    *("dask", "distributed", "matplotlib", "zarr", "trimesh", "rich", "typer", "skimage"),
    *("open3d", "pandas", "sklearn", "plotly", "IPython"),
)
# What is imported when rays are traced.
LATE = ("open3d.cpu.pybind", "cv2", "scipy.ndimage", "scipy.spatial", "scipy.sparse")
HEAVIER = (
    *(*HEAVY, *LATE, "OpenImageIO", "PIL", "psutil"),
    *("xatlas", "jsonschema", "fsspec", "flip_evaluator", "OpenEXR", "multiprocessing.pool"),
)
# Seconds of CPU time: six times what is asked for of an idle core, since work on the other
# hardware threads doubles and trebles it. Imports and opening take .35 to .42 s: .1 for NumPy
# and .25 for Numba with LLVM, which every kernel needs. The first evaluation takes .36 s more,
# in which Numba loads the types of all that it knows before the first compiled kernel; half of
# that is SciPy's linear algebra, by which Numba finds out whether it could call BLAS.
MOST_IMPORTING = 3.0


# Classes of which attributes and methods are promised, too; of the others, how they are made.
WHOLE = ("Camera", "DirectionalLight", "EnvironmentMap", "Field", "PointLight", "Result")


def signature(value):
    """Arguments of a function or class, without types; of a default, that there is one."""
    arguments = [
        argument.replace(
            annotation=argument.empty,
            default=argument.empty if argument.default is argument.empty else ...,
        )
        for argument in inspect.signature(value).parameters.values()
    ]
    return str(inspect.Signature(arguments)).replace("Ellipsis", "...")


def members(value):
    """Public attributes that a class itself defines."""
    for name in sorted(vars(value)):
        if not name.startswith("_") and name not in inspect.signature(value).parameters:
            member = getattr(value, name)
            yield f"{name}{signature(member)}" if callable(member) else name


def promised():
    """Lines: each name with its arguments, and the members of some."""
    for name in rf.__all__:
        value = getattr(rf, name)
        made_by_others = name == "Capture" or name.endswith("Error")
        yield name if made_by_others else f"{name}{signature(value)}"
        if name in WHOLE:
            yield from (f"{name}.{member}" for member in members(value))


class TestPromise:
    def test_names_and_arguments_are_those_frozen(self):
        assert list(promised()) == PROMISE.read_text().splitlines()

    def test_type_checkers_see_the_same_names(self):
        tree = ast.parse((ROOT / "reflfield" / "__init__.py").read_text())
        block = next(node for node in tree.body if isinstance(node, ast.If))
        seen = {alias.name: node.module for node in block.body for alias in node.names}
        assert sorted(seen) == rf.__all__
        assert all(getattr(rf, name).__module__ == seen[name] for name in seen)

    def test_dir_lists_them_and_others_are_unknown(self):
        assert set(rf.__all__) <= set(dir(rf))
        with pytest.raises(AttributeError, match="'wings'"):
            rf.wings  # noqa: B018

    @pytest.mark.parametrize("package", ["reflfield", "capture_sim"])
    def test_types_are_shipped(self, package):
        assert (ROOT / package / "py.typed").is_file()


# Prints modules and the processor time of each step.
STEPS = """
import json, sys, time
def step():
    return [time.process_time(), sorted(sys.modules)]
steps = [step()]
import reflfield as rf
steps.append(step())
field = rf.open_field(sys.argv[1])
field.evaluate([0], [0, 0, 1], [0, 0, 1])
steps.append(step())
camera = rf.Camera.look_at([0, 0, 4], width=8, height=8)
light = rf.PointLight([0, 0, 4])
from reflfield.render import renderer
steps.append(step())
field.render(camera, light)
steps.append(step())
print(json.dumps(steps))
"""


@pytest.fixture(scope="module")
def steps(tmp_path_factory):
    """Processor time and modules: at the start, imported, evaluated, to render, rendered."""
    path = tmp_path_factory.mktemp("field") / "field.rfld"
    rf.Field(baked_field(square_surface(4), lambert(0.5))).save(path)
    command = [sys.executable, "-c", STEPS, str(path)]
    # Once to compile.
    outputs = [subprocess.run(command, check=True, capture_output=True).stdout for _ in "12"]
    return json.loads(outputs[-1])


class TestImports:
    def test_of_the_package_are_none(self, steps):
        assert not {"numpy", "numba"} & set(steps[1][1])

    def test_of_opening_and_evaluating_are_few(self, steps, capsys):
        assert not set(HEAVIER) & set(steps[2][1])
        seconds = steps[2][0] - steps[0][0]
        with capsys.disabled():
            print(f" [opening and evaluating: {seconds:.2f} s of CPU time]", end="")
        assert seconds < MOST_IMPORTING

    def test_of_rendering_are_neither_cluster_nor_plots(self, steps):
        assert not {*HEAVY, *LATE} & set(steps[3][1])
        assert not set(HEAVY) & set(steps[4][1])

    def test_open3d_waits_for_rays(self, steps):
        assert "open3d.cpu.pybind" in steps[4][1]


@pytest.fixture(scope="module")
def square():
    """A white square of 8 x 8 texels in the plane z = 0, one metre wide."""
    return rf.example_field()


class TestField:
    def test_renders_lights_and_maps_and_their_sum(self, square, rounding):
        camera = rf.Camera.look_at([0, 0, 2], up=[0, 1, 0], width=33, height=33, fov_deg=20)
        lamp = rf.DirectionalLight([0, 0, 1], np.pi)
        sky = rf.EnvironmentMap(np.ones((8, 16, 3), np.float32))
        by_lamp, by_sky = square.render(camera, lamp), square.render(camera, environment=sky)
        # Irradiance pi on a white surface, or radiance 1 from everywhere, comes back as 1: the
        # largest value has the largest code, which 16 taps hold in singles, cubed.
        taps = rounding(np.float32, operations=16, condition=3)
        assert by_lamp[16, 16] == pytest.approx(1.0, abs=taps)
        # 512 lights, and the softened cosine: observed .005.
        assert by_sky[16, 16] == pytest.approx(1.0, abs=0.01)
        both = square.render(camera, [lamp], environment=sky)
        sums = rounding(np.float32, operations=3)
        np.testing.assert_allclose(both, by_lamp + by_sky, rtol=sums)

    def test_alpha_is_the_share_that_is_covered(self, square):
        camera = rf.Camera.look_at([0, 0, 2], up=[0, 1, 0], width=32, height=32, fov_deg=60)
        image = square.render(camera, rf.PointLight([0, 0, 2]), alpha=True)
        assert image.shape == (32, 32, 4)
        # A metre of the 2 * 2 tan(30 degrees) that the image shows: each side is known to a
        # quarter pixel, the distance of the rays.
        side = 1 / (4 * np.tan(np.pi / 6))
        assert image[..., 3].mean() == pytest.approx(side**2, abs=2 * side * 0.25 / 32)

    def test_without_light_is_refused(self, square):
        with pytest.raises(rf.InputError, match="lights, environment: expected"):
            square.render(rf.Camera.look_at([0, 0, 2]))

    def test_of_unknown_lighting_shows_that_lighting(self, rounding):
        model = baked_field(
            square_surface(4), lambert(1.0), light_side=1, light_model="unknown"
        )
        image = rf.Field(model).render(rf.Camera.look_at([0, 0, 2], width=9, height=9))
        # The largest value has the largest code.
        taps = rounding(np.float32, operations=16, condition=3)
        assert image[4, 4] == pytest.approx(1 / np.pi, rel=taps)

    def test_one_direction_serves_all_texels(self, square, rounding):
        up, aside = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, 0.8])
        one = square.evaluate([0, 1, 2], up, aside)
        np.testing.assert_array_equal(
            one, square.evaluate([0, 1, 2], np.tile(up, (3, 1)), np.tile(aside, (3, 1)))
        )
        taps = rounding(np.float32, operations=16, condition=3)
        assert one == pytest.approx(np.full((3, 3), 0.8 / np.pi), rel=taps)

    def test_parts_belong_together(self, rounding):
        field = rf.Field(baked_field(sphere_surface(8), lambert(0.5)))
        assert isinstance(field.mesh, trimesh.Trimesh)
        assert field.mesh.visual.uv.shape == (len(field.mesh.vertices), 2)
        arrays = field.to_arrays()
        row, column = np.argwhere(arrays["texel_of_pixel"] == 5)[0]
        uv = np.array([(column + 0.5) / 16, 1 - (row + 0.5) / 8])
        nearest = np.argmin(np.linalg.norm(arrays["uv"] - uv, axis=1))
        # On the unit sphere a texel's normal is where it is, to half a texel along each side.
        tilt = field.normals[5] @ arrays["positions"][nearest]
        assert tilt > np.cos(np.pi / 8)
        assert np.abs(np.sum(field.normals * field.tangents, 1)).max() < rounding(np.float32)
        assert arrays["mean"].shape[1:3] == (
            len(arrays["view_nodes"]), len(arrays["light_nodes"]),
        )  # fmt: skip

    def test_saved_and_opened_is_the_same(self, square, tmp_path):
        square.save(tmp_path / "field.rfld")
        again = rf.open_field(tmp_path / "field.rfld")
        for name, array in square.to_arrays().items():
            np.testing.assert_array_equal(array, again.to_arrays()[name])
        with pytest.raises(rf.FieldFileError, match="raise `max_memory`"):
            rf.open_field(tmp_path / "field.rfld", max_memory=10)


class TestRenamedArgument:
    """`n_frames` of a turntable is `n_images` now."""

    def test_the_old_name_is_accepted_with_one_line(self, square, tmp_path, caplog):
        with caplog.at_level(logging.WARNING, "reflfield"):
            rf.render_turntable(square, tmp_path / "out", light="0,0,1", n_frames=2, size=8)
        names = sorted(path.name for path in (tmp_path / "out").glob("orbit_*.png"))
        assert names == ["orbit_000.png", "orbit_001.png"]
        assert [record.getMessage() for record in caplog.records] == [
            "argument 'n_frames' is now 'n_images'; the old name is accepted until version 0.2"
        ]

    def test_both_names_are_refused(self, square, tmp_path):
        with pytest.raises(
            rf.InputError,
            match=r"^n_images, n_frames: expected one of the two, received both; leave out "
            r"`n_frames`",
        ):
            rf.render_turntable(square, tmp_path / "out", light="0,0,1", n_images=2, n_frames=2)
        assert not (tmp_path / "out").exists()


class TestOptions:
    def test_a_renamed_one_is_accepted_with_one_line(self, monkeypatch, caplog):
        monkeypatch.setitem(
            sys.modules["reflfield.options"].RENAMED_OPTIONS, "hull.side", "hull.resolution"
        )
        with caplog.at_level(logging.WARNING, "reflfield"):
            options = rf.read_options(settings=["hull.side=48", "hull.n_triangles=500"])
        assert (options.hull.resolution, options.hull.n_triangles) == (48, 500)
        assert [record.getMessage() for record in caplog.records] == [
            "option 'hull.side' is now 'hull.resolution'; the old name is accepted until "
            "version 0.2"
        ]

    def test_a_cluster_needs_its_packages(self, monkeypatch):
        monkeypatch.setattr("reflfield.util.dask_cluster.find_spec", lambda name: None)
        with pytest.raises(rf.InputError, match=r'pip install "reflfield\[cluster\]"'):
            rf.Resources(scheduler="tcp://127.0.0.1:1")


def test_the_pages_are_made_without_a_warning(tmp_path):
    pytest.importorskip("pdoc", reason="needs the extra [dev]")
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        [ROOT / ".ci" / "api_pages", tmp_path],
        capture_output=True, text=True, check=False, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    page = (tmp_path / "reflfield.html").read_text()
    assert all(f'id="{name}"' in page for name in rf.__all__)
    assert 'id="Field.render"' in page


if __name__ == "__main__":
    PROMISE.write_text("\n".join(promised()) + "\n")
