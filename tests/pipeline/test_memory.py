"""The ceiling of memory sizes the blocks, changes no result, and may be refused."""

import hashlib
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from reflfield.capture.readers import open_capture
from reflfield.errors import InputError
from reflfield.field.file import open_field
from reflfield.observations.image_projection import Projection, project_photographs
from reflfield.options import Resources, parse_bytes, read_toml, with_tables
from reflfield.pipeline import results
from reflfield.pipeline.memory import (
    BASE_BYTES,
    COMPILED_BYTES,
    PHOTOGRAPH_BYTES,
    check_memory,
    least_memory,
    readers_at_once,
    within_memory,
    working_bytes,
)
from reflfield.pipeline.pipeline_options import PipelineOptions, TextureOptions
from reflfield.pipeline.texel_columns import (
    BlockedColumns,
    Resampling,
    half_columns,
    texels_at_once,
)
from reflfield.render.renderer import Renderer, RenderOptions
from reflfield.util.blocks import Blocks, Scheduler, Tally
from tests.pipeline.conftest import HELD_OUT

GB = 1 << 30


@pytest.fixture(scope="module")
def context(finished, tiny_capture, tiny_options, context_of):
    """The finished run, to read from."""
    options = with_tables(PipelineOptions(), read_toml(tiny_options))
    return context_of(open_capture(tiny_capture), finished.folder, options)


class TestColumns:
    @pytest.mark.parametrize("at_once", [1, 7, 100])
    def test_do_not_depend_on_the_block(self, context, at_once):
        texels = results.measured_texels(context)[::3][:100]
        columns = np.random.default_rng(0).permutation(len(texels))
        whole = BlockedColumns(results.base_reader(context), texels, GB).read(columns)
        tight = BlockedColumns(results.base_reader(context), texels, 1)
        assert texels_at_once(results.base_reader(context), 1) == 1
        parts = [tight.read(part) for part in np.array_split(columns, -(-100 // at_once))]
        for i in range(2):
            joined = np.concatenate([part[i] for part in parts], axis=1)
            np.testing.assert_array_equal(joined, whole[i])

    def test_are_the_same_from_files(self, context, tmp_path):
        texels = results.measured_texels(context)[:300]
        shared = Resampling(results.base_reader(context), GB)
        blocks = Blocks(Scheduler(2), tmp_path / "blocks")
        (tmp_path / "held").mkdir()
        in_memory = half_columns(blocks, shared, texels, GB, tmp_path / "held")
        in_files = half_columns(blocks, shared, texels, 0, tmp_path)
        assert list((tmp_path / "held").iterdir()) == []
        n_bytes = 300 * (in_files.shape[0] + in_files.shape[0] // 3) * 2
        assert sum(p.stat().st_size for p in tmp_path.iterdir() if p.is_file()) == n_bytes
        assert blocks.tally == Tally(computed=2, resumed=2)
        columns = np.array([299, 0, 256, 5])
        for one, other in zip(in_memory.read(columns), in_files.read(columns), strict=True):
            np.testing.assert_array_equal(one, other)
        exact, _ = shared.columns(texels[columns])
        # Halves: 11 bits.
        np.testing.assert_allclose(in_files.read(columns)[0], exact, rtol=2**-11, atol=1e-7)


def test_projection_does_not_depend_on_the_budget(context, tmp_path):
    # One photograph at a time instead of many.
    tight = Projection(
        context.training,
        results.texels(context).position,
        results.view_visible(context),
        tmp_path / "s",
        1,
    )
    project_photographs(tight, Blocks(Scheduler(2), tmp_path / "blocks"), at_once=2)
    for path in sorted(p for p in (tmp_path / "s").rglob("*") if p.is_file()):
        ample = results.samples_location(context) / path.relative_to(tmp_path / "s")
        assert path.read_bytes() == ample.read_bytes(), path


def test_pictures_do_not_depend_on_the_block(context, finished):
    options = RenderOptions(samples_per_pixel=4, workers=2)
    tight = replace(options, block_pixels=64)
    capture, field = context.capture, open_field(finished.folder / "field.rfld")
    one, other = (
        Renderer(field, o).render(capture.cameras[4], capture.lights[2])
        for o in (options, tight)
    )
    assert one.image.max() > 0
    np.testing.assert_array_equal(one.image, other.image)
    np.testing.assert_array_equal(one.coverage, other.coverage)


def test_blocks_of_pixels_follow_ceiling_and_threads():
    options = RenderOptions(samples_per_pixel=16, block_pixels=4096)
    ample = within_memory(options, Resources(workers=2, max_memory=8 * GB))
    tight = within_memory(options, Resources(workers=16, max_memory=GB))
    assert ample.block_pixels == 4096
    assert 64 <= tight.block_pixels < 1024
    assert tight.workers == 16


@pytest.mark.parametrize("ceiling", [2, 3, 4, 8, 16])
def test_photographs_read_at_a_time_fit_beside_what_a_fit_holds(ceiling):
    camera = SimpleNamespace(width=4000, height=4000)
    wanted = SimpleNamespace(
        training=SimpleNamespace(cameras=[camera]), resources=Resources(2, ceiling * GB)
    )
    n = readers_at_once(wanted)
    assert n >= 1
    held = BASE_BYTES + COMPILED_BYTES + n * PHOTOGRAPH_BYTES * 4000**2
    assert held + working_bytes(wanted) // 2 <= ceiling * GB
    assert (n > 1) == (ceiling >= 4)


class TestCeiling:
    @pytest.mark.parametrize("ceiling", ["1GB", pytest.param("8GB", marks=pytest.mark.slow)])
    def test_changes_no_byte_and_holds(
        self, finished, run_copy, subprocess_run, tiny_capture, tiny_options, ceiling
    ):
        """In a process of its own: this one holds what other tests have left."""
        again = ("--from", "observations", "--until", "compression", "--max-memory", ceiling)
        words = ("run", tiny_capture, "-o", run_copy, "--config", tiny_options, *HELD_OUT)
        done = subprocess_run("-m", "reflfield", *words, *again)
        assert done.status == 0, done.err
        timings = json.loads((run_copy / "timings.json").read_text())
        assert timings["max_memory"] == parse_bytes(ceiling)
        computed = [stage for stage in timings["stages"] if not stage["reused"]]
        assert {stage["name"] for stage in computed} >= {"observations", "compression"}
        assert max(stage["peak_bytes"] for stage in computed) < parse_bytes(ceiling)
        one, other = (
            hashlib.sha256((folder / "field.rfld").read_bytes()).hexdigest()
            for folder in (run_copy, finished.folder)
        )
        assert one == other

    def test_holds(self, finished):
        # The default is 4 GB; what the libraries take is most of what this capture needs.
        timings = json.loads((finished.folder / "timings.json").read_text())
        assert timings["max_memory"] == 4 * GB
        assert 100 << 20 < timings["peak_bytes"] < GB

    def test_estimate_bounds_what_a_small_run_takes(self, context, finished):
        tight = replace(context, resources=Resources(1, GB))
        timings = json.loads((finished.folder / "timings.json").read_text())
        assert timings["peak_bytes"] < least_memory(tight) + (128 << 20)
        check_memory(tight)

    def test_estimate_grows_with_texels_and_pixels(self, context):
        larger = PipelineOptions(texture=TextureOptions(largest=4096))
        cameras = tuple(replace(c, width=4000, height=3000) for c in context.capture.cameras)
        big = replace(context.capture, cameras=cameras)
        assert least_memory(replace(context, options=larger)) > least_memory(context) + GB
        # A compared frame of 12 Mpixel, 46 bytes a pixel and more; 9 silhouettes, a bit each.
        assert least_memory(replace(context, capture=big)) > least_memory(context) + 7e8

    def test_too_low_is_refused(self, context):
        larger = PipelineOptions(texture=TextureOptions(largest=4096))
        tight = replace(context, options=larger, resources=Resources(1, GB))
        with pytest.raises(InputError, match=r"max_memory: expected at least \d.\d GB .* 9 v"):
            check_memory(tight)

    def test_what_is_asked_for_suffices(self, context):
        larger = PipelineOptions(texture=TextureOptions(largest=4096))
        tight = replace(context, options=larger, resources=Resources(1, GB))
        check_memory(replace(tight, resources=Resources(1, least_memory(tight) * 17 // 16)))

    def test_refusal_by_the_command_makes_nothing(self, reflfield, tiny_capture, tmp_path):
        words = ("--max-memory", "1GB", "--set", "texture.largest=8192")
        outcome = reflfield("run", tiny_capture, "-o", tmp_path / "out", *words)
        assert outcome.status == 2
        assert "--max-memory: expected at least" in outcome.err
        assert "received 1.0 GB" in outcome.err
        assert not (tmp_path / "out").exists()


def test_the_demo_has_a_ceiling(reflfield, monkeypatch, tmp_path):
    """What it is comes to the run, whose estimate refuses what is too little."""
    runs = []

    def refused(*_, **options):
        runs.append(options)
        raise InputError("too little")

    monkeypatch.setattr("reflfield.demo.simulate", lambda *_: None)
    monkeypatch.setattr("reflfield.demo.reconstruct", refused)
    words = ("demo", "-o", tmp_path / "demo", "--workers", "1", "--max-memory")
    assert reflfield(*words, "1.5GB").status == 2
    assert [one["resources"] for one in runs] == [Resources(1, parse_bytes("1.5GB"))]
    assert "max" in reflfield(*words, "much").err
    assert len(runs) == 1
