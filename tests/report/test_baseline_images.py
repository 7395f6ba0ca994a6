"""Sections on baselines and kinds of errors, from plain numbers."""

import re

import numpy as np
import pytest

from reflfield.metrics.error_kinds import DEFINITIONS, KINDS, NO_KIND
from reflfield.metrics.image_metrics import ImagePair, compare_images
from reflfield.report.page import Figure, Note, ReportContent, Table, render_report
from reflfield.report.sections import AnalysedImage, AnalysedImages, analysis_sections
from reflfield.report.sections.baseline_images import KIND_COLOURS, kinds_coloured


@pytest.fixture
def images(rng):
    photograph = rng.uniform(0.1, 0.9, (24, 24, 3))
    pair = ImagePair("f0", photograph, 0.9 * photograph, np.ones((24, 24)))
    comparison = compare_images([pair])
    mean = comparison.mean | {"psnr_ldr": 12.345}
    scores = {"mean": mean, "images": [{"name": "f0", "psnr_ldr": 12.345}]}
    kinds = {
        name: {"share_of_pixels": 0.25, "share_of_squared_error": 0.5, "psnr_ldr": None}
        for name in KINDS
    }
    return AnalysedImages(
        "Held-out photographs",
        comparison,
        {"black": scores, "mean_texture": scores,
         "missing": {"nearest_photograph": "<no photographs>"}},
        {"kinds": kinds, "definitions": DEFINITIONS},
        [AnalysedImage(pair, {"mean_texture": 0.5 * photograph},
                       np.full((24, 24), KINDS.index("rest"), np.uint8))],
    )  # fmt: skip


def test_the_field_stands_above_the_baselines_and_what_is_missing_is_said(images):
    beside, _ = analysis_sections([images])
    table, note, figure = beside.items
    assert isinstance(table, Table)
    assert [row[0] for row in table.rows] == ["field", "mean texture", "black"]
    assert table.rows[1][1] == "12.35"
    assert table.emphasised == (0,)
    assert note == Note("No nearest photograph: <no photographs>.")
    assert isinstance(figure, Figure)
    assert [p.label for p in figure.panels[2:]] == ["mean texture, 12.35 dB"]
    assert "Black, not shown, gets 12.35 dB" in figure.caption


def test_kinds_have_shares_colours_and_definitions(images):
    _, where = analysis_sections([images])
    note, table, figure = where.items
    assert all(DEFINITIONS[kind].lower() in note.text.lower() for kind in KINDS)
    assert table.rows[0] == ("silhouette", "25.0 %", "50.0 %", "")
    assert figure.legend == tuple(zip(KIND_COLOURS, KINDS, strict=True))
    assert len(figure.panels) == 4
    page = render_report(ReportContent("x", sections=(where,)))
    assert re.search(r"<h2>Where the error lies</h2>", page)


def test_every_kind_has_a_colour_of_its_own():
    colours = kinds_coloured(np.array([[*range(len(KINDS)), NO_KIND]], np.uint8))[0]
    assert len({tuple(c) for c in colours.tolist()}) == len(KINDS) + 1
