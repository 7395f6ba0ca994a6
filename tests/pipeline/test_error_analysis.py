"""Baselines and kinds of errors of a run and of `compare`: in metrics, console and page."""

import json
import tomllib
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from reflfield.capture.readers import open_capture
from reflfield.metrics.error_kinds import KINDS
from reflfield.metrics.image_errors import PSNR_CAP_DB, psnr
from reflfield.options import HoldOut, with_tables
from reflfield.pipeline import comparison, error_analysis
from reflfield.pipeline.hold_out import split_of
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.render.exposure import display, object_pixels

DB = 10 / np.log(10)  # decibels of a relative error of a mean square
NAMES = ("black", "nearest_photograph", "mean_texture")


@pytest.fixture(scope="module")
def metrics(finished):
    return json.loads((finished.folder / "metrics.json").read_text())


def test_black_gets_what_a_black_image_gets(metrics, finished, tiny_capture, rounding):
    capture = open_capture(tiny_capture)
    compared = split_of(capture, HoldOut(1, 1)).compared_capture(capture)
    stored = json.loads((finished.folder / "stages/comparison/field/heldout.json").read_text())
    exposure = stored["extra"]["exposure"]
    (image,) = metrics["baselines"]["black"]["images"]
    counted = object_pixels(compared.read_silhouette(0))
    shown = display(compared.read_photograph(0)[counted], exposure)
    assert image["name"] == compared.photographs[0].name
    assert image["n_pixels"] == counted.sum()
    sums = rounding(float, operations=shown.size, scale=DB)
    assert image["psnr_ldr"] == pytest.approx(psnr(shown, np.zeros_like(shown)), abs=sums)


def test_the_baselines_are_those_of_the_compared_photographs(metrics):
    baselines = metrics["baselines"]
    assert baselines["missing"] == {}
    for name in NAMES:
        images = baselines[name]["images"]
        assert [f["name"] for f in images] == [f["name"] for f in metrics["images"]]
        assert [f["n_pixels"] for f in images] == [f["n_pixels"] for f in metrics["images"]]
    # A satin ball of one colour: a field, however coarse, is better than nothing.
    assert metrics["mean"]["psnr_ldr"] > baselines["black"]["mean"]["psnr_ldr"] + 6


def test_the_nearest_photograph_is_one_that_made_the_field(metrics, tiny_capture):
    capture = open_capture(tiny_capture)
    split = split_of(capture, HoldOut(1, 1))
    trained = {p.name for p in split.training(capture).photographs}
    (nearest,) = metrics["baselines"]["nearest_photograph"]["nearest"]
    assert nearest["photograph"] in trained
    assert nearest["view_degrees"] > 10
    assert nearest["light_degrees"] > 10


def test_shares_of_the_kinds_sum_to_one_and_to_the_error(metrics, rounding):
    kinds = metrics["error_kinds"]["kinds"]
    assert list(kinds) == list(KINDS)
    for share in ("share_of_pixels", "share_of_squared_error"):
        total = sum(kind[share] for kind in kinds.values())
        assert total == pytest.approx(1, abs=rounding(float, operations=len(kinds)))
    # Of one photograph the errors of all kinds together are its PSNR.
    squares = sum(
        kind["share_of_pixels"] * 10 ** (-kind["psnr_ldr"] / 10)
        for kind in kinds.values()
        if kind["psnr_ldr"] is not None
    )
    whole = metrics["mean"]["psnr_ldr"]
    # A kind without an error has the largest PSNR that is stated.
    capped = DB * 10 ** ((whole - PSNR_CAP_DB) / 10)
    assert -10 * np.log10(squares) == pytest.approx(whole, abs=capped)


def test_the_command_and_the_page_say_it(finished):
    for text in ("baseline nearest photograph: PSNR", "baseline mean texture: PSNR",
                 "baseline black: PSNR", "squared error: "):  # fmt: skip
        assert text in finished.outcome.out
    page = (finished.folder / "report" / "index.html").read_text()
    for text in ("<h2>Trivial baselines</h2>", "<h2>Where the error lies</h2>",
                 "<td>mean texture</td>", "<td>shadow edge</td>"):  # fmt: skip
        assert text in page


def test_compare_says_that_there_are_no_photographs_of_the_field(
    reflfield, finished, tiny_capture, tmp_path
):
    """Unseen photographs are a capture of their own: those that made the field are named."""
    field, unseen = finished.folder / "field.rfld", tiny_capture / "truth" / "heldout.json"
    words = ("compare", field, unseen, "--rays-per-pixel", "1")
    outcome = reflfield(*words, "-o", tmp_path / "without")
    assert outcome.status == 0, outcome.err
    assert (
        "baseline nearest photograph: none; the photographs that made the field are not at "
        "hand; name their capture with --photographs"
    ) in outcome.out
    without = json.loads((tmp_path / "without" / "metrics.json").read_text())
    assert set(without["baselines"]) & set(NAMES) == {"black", "mean_texture"}
    outcome = reflfield(*words, "-o", tmp_path / "with", "--photographs", tiny_capture)
    assert outcome.status == 0, outcome.err
    beside = json.loads((tmp_path / "with" / "metrics.json").read_text())
    assert len(beside["baselines"]["nearest_photograph"]["images"]) == 2
    assert beside["baselines"]["black"] == without["baselines"]["black"]


def test_one_image_of_a_baseline_is_held_at_a_time():
    """Photographs may have as many pixels as fit in memory a few times."""
    made = []

    def images(*_):
        for name in ("black", "nearest_photograph"):
            assert all(image() is None for image in made)
            image = np.zeros((4, 4, 3), np.float32)
            made.append(weakref.ref(image))
            yielded, image = image, None
            yield name, yielded
            del yielded

    baselines = SimpleNamespace(nearest_to=lambda *_: None, images=images)
    photograph = SimpleNamespace(camera=0, light=0, name="a")
    compared = SimpleNamespace(photographs=[photograph], cameras=[None], lights=[None])
    pairs = SimpleNamespace(capture=compared, read=lambda _: None)
    scores = SimpleNamespace(add=lambda *_: None)
    analyser = error_analysis.Analyser(baselines, None)
    error_analysis._analyse_one(analyser, pairs, 0, scores, None)
    assert len(made) == 2


def test_photographs_analysed_side_by_side_give_the_same(
    finished, tiny_capture, tiny_options, context_of, tmp_path
):
    options = with_tables(PipelineOptions(), tomllib.loads(tiny_options.read_text()))
    context = context_of(open_capture(tiny_capture), finished.folder, options)
    analyser = error_analysis.analyser_of(context)
    pairs = comparison.relit_pairs(context)["truth"]
    compared = comparison.comparison_of(context, "truth")
    assert len(pairs) > 1
    found = []
    for at_once in (1, 3):
        (tmp_path / str(at_once)).mkdir()
        found.append(
            error_analysis.analyse(analyser, pairs, compared, tmp_path / str(at_once), at_once)
        )
    assert found[0] == found[1]
    names = [image["name"] for image in found[1]["baselines"]["black"]["images"]]
    assert names == [photograph.name for photograph in pairs.capture.photographs]
