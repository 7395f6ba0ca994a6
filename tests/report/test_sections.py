"""Section builders: the numbers they print, and input that lacks something."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.metrics.image_metrics import ImagePair, compare_images
from reflfield.report import plots, sections
from reflfield.report.page import Figure, Note, ReportContent, Table, render_report


def tables(section):
    return [item for item in section.items if isinstance(item, Table)]


def test_rows_run_from_worst_to_best_and_skip_the_rest(rng, samples):
    pairs = samples.frame_pairs(rng, count=7, size=24)
    comparison = compare_images(pairs)
    section = sections.held_out_section(comparison, iter(pairs), max_rows=3)
    titles = [item.title for item in section.items if isinstance(item, Figure) and item.title]
    # Noise grows with the number.
    assert titles == ["heldout_006", "heldout_003", "heldout_000"]
    (table,) = tables(section)
    assert [row[0] for row in table.rows] == [
        "mean",
        *(f"heldout_00{i}" for i in range(6, -1, -1)),
    ]
    assert table.rows[0][1] == f"{comparison.mean['psnr_ldr']:.2f}"


def test_frames_of_one_name_stay_apart_and_others_are_refused(rng, samples):
    pairs = samples.frame_pairs(rng, count=2, size=24)
    same = [ImagePair("0001", p.photograph, p.relit, p.silhouette) for p in pairs]
    comparison = compare_images(same)
    figures = [
        i for i in sections.held_out_section(comparison, same).items if isinstance(i, Figure)
    ]
    # Worst first: the second frame has twice the noise.
    for figure, metrics in zip(figures, comparison.images[::-1], strict=False):
        assert figure.title == "0001"
        assert f"PSNR {metrics.psnr_ldr:.2f} dB" in figure.caption
    with pytest.raises(InputError, match=r"pairs: expected '0001'.*'heldout_000'"):
        sections.held_out_section(comparison, pairs)


def test_silhouette_agreement_is_counted():
    silhouette, hull = np.zeros((20, 20)), np.zeros((20, 20))
    silhouette[:, :10], hull[:, 5:15] = 1, 1
    photograph = np.ones((20, 20, 3))
    section = sections.silhouettes_section(
        [
            sections.SilhouetteView("good", lambda: photograph, silhouette, silhouette),
            sections.SilhouetteView("bad", lambda: photograph, silhouette, hull),
        ],
        max_pictures=1,
    )
    assert tables(section)[0].rows == (
        ("bad", "0.3333", "50.00", "50.00"),
        ("good", "1.0000", "0.00", "0.00"),
    )
    assert [panel.label for panel in section.items[0].panels] == ["bad · IoU 0.333"]


def test_compression_ratio_and_shares():
    section = sections.compression_section({"a": 750, "b": 250}, 8000)
    assert "8 times smaller" in section.intro
    assert tables(section)[0].rows[0] == ("a", "750 B", "75.0 %")


def test_fields_of_other_size_are_not_compared_in_silence(rng, samples):
    pairs = samples.frame_pairs(rng, count=3, size=24)
    comparison = compare_images(pairs)

    def section(other_bytes):
        variants = [
            sections.FieldVariant("ours", {"held out": comparison}, 1000, 0.1234, 0.05),
            sections.FieldVariant("other", {"held out": comparison}, other_bytes, 0.2, 0.07),
        ]
        return sections.ablation_section(variants, [pairs, pairs])

    equal, unequal = section(1019), section(1021)
    assert not [item for item in equal.items if isinstance(item, Note)]
    assert [item.is_warning for item in unequal.items if isinstance(item, Note)] == [True]
    errors, metrics = tables(equal)
    assert errors.rows[0][-2:] == ("12.34", "5.00")
    assert [row[1] for row in metrics.rows] == ["ours", "other"]
    (strip,) = [item for item in equal.items if isinstance(item, Figure)]
    assert [panel.label for panel in strip.panels][:3] == ["photograph", "ours", "other"]
    # All gains are equal: the middle one of three.
    assert strip.title == "heldout_001"


def test_fields_that_were_tried_stand_beside_the_photograph(rng, samples):
    pairs = samples.frame_pairs(rng, count=3, size=24)
    frames = {
        name: [replace(pair, relit=scale * pair.relit) for pair in pairs]
        for name, scale in (("a", 0.5), ("b", 1.0), ("c", 0.7))
    }
    tried = [
        sections.CandidateRun(
            sections.FieldVariant(name, {"held out": compare_images(some)}, 1000, 0.1234, 0.05),
            seconds=75.0,
            unseen=None if name == "c" else compare_images(some).mean,
        )
        for name, some in frames.items()
    ]

    def section(n):
        return sections.candidate_runs_section(
            tried[:n], "b", ["Why."], list(frames.values())[:n]
        )

    (compared,) = tables(section(3))
    best = f"{compare_images(pairs).mean['psnr_ldr']:.2f}"
    assert [row[0] for row in compared.rows] == ["a", "b", "c"]
    assert compared.rows[1][1] == best
    assert [row[4] for row in compared.rows] == ["0 of 3", "3 of 3", "0 of 3"]
    assert compared.rows[0][5:] == ("12.34", "1 kB", "1 min 15 s")
    assert compared.emphasised == (1,)
    # Of unseen frames only where all fields were measured on them.
    assert [row[1] == best for row in tables(section(2))[1].rows] == [False, True]
    (strip,) = [item for item in section(3).items if isinstance(item, Figure)]
    assert [panel.label for panel in strip.panels][:4] == ["photograph", "b", "c", "a"]


def test_what_was_taken_is_among_what_was_tried():
    with pytest.raises(InputError, match=r"runs: .* 'b' among them"):
        sections.candidate_runs_section([], "b", [], [])


def test_a_comparison_needs_two_fields():
    with pytest.raises(InputError, match="variants"):
        sections.ablation_section([], [])


def test_turned_frames_show_their_tilt(samples):
    texels, charts = samples.atlas(32)
    base = np.broadcast_to(np.eye(3), (len(charts), 3, 3))
    c, s = np.cos(0.2), np.sin(0.2)
    tilted = np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) @ base
    section = sections.normals_section(texels, tilted, base)
    # The scale ends at the 99th percentile, here the one tilt that there is.
    assert section.items[1].colour_bar.high == pytest.approx(np.degrees(0.2), rel=1e-12)


def test_stage_times_add_up_and_reuse_is_said():
    section = sections.stages_section(
        [
            sections.StageSummary("hull", 61.0, counts={"views": 32, "faces": 20_000}),
            sections.StageSummary("atlas", 4.0, peak_bytes=10**9, reused=True),
        ]
    )
    rows = tables(section)[0].rows
    assert rows[0] == ("hull", "1 min 01 s", None, "32 views, 20\u202f000 faces", None)
    assert rows[1][:3] == ("atlas (reused)", "4.0 s", "1 GB")
    assert rows[2][1] == "1 min 05 s"


@pytest.mark.stability
def test_degenerate_input_still_makes_a_page(rng, samples):
    """One frame, no texel seen, nothing known: a page all the same."""
    texels, charts = samples.atlas(16)
    n = len(charts)
    frames = np.broadcast_to(np.eye(3), (n, 3, 3))
    pair = samples.frame_pairs(rng, count=1, size=24)
    empty = np.zeros((24, 24))
    page = render_report(
        ReportContent(
            "empty",
            key_numbers=sections.key_numbers(),
            sections=(
                sections.held_out_section(compare_images(pair), pair),
                sections.silhouettes_section(
                    [
                        sections.SilhouetteView(
                            "v", lambda: pair[0].photograph, empty, samples.disk(24, 5)
                        )
                    ]
                ),
                sections.silhouettes_section([]),
                sections.atlas_section(texels, charts, np.full((n, 3), np.nan)),
                sections.coverage_section(texels, np.zeros(n, int), np.zeros(n, int)),
                sections.normals_section(texels, frames, frames),
                sections.alignment_section([], np.full(n, np.nan)),
                sections.truth_section(),
                sections.compression_section({}, 0),
                sections.stages_section([]),
                sections.run_section({}, {}),
            ),
        )
    )
    assert page.count("<section") == 11


def test_plots_are_the_same_bytes_each_time_and_carry_no_date():
    first, second = (
        plots.lines({"$a$ <b>": ([1, 2], [1.0, np.nan])}, "x", "y", log_y=True)
        for _ in range(2)
    )
    assert first == second
    assert b"dc:date" not in first.data


def test_histogram_counts_everything_in_percent():
    # 3 of 4 finite values in the first half; the far one counts in the last bin.
    picture = plots.histogram({"a": [0.1, 0.2, 0.3, 9.0, np.nan]}, "x", "y", limits=(0, 1))
    assert picture.is_plot
    assert (picture.width, picture.height) == (538, 298)


@pytest.mark.parametrize(
    "draw",
    [
        lambda: plots.bars(["held_out_silhouettes", "hull"], [12345.6, 1.0], "seconds"),
        lambda: plots.bars(["hull"], [0.5], "seconds"),
        lambda: plots.lines({"a": ([1, 2], [0, 987654])}, "iteration", "score"),
        lambda: plots.lines(
            {"a": ([0.05, 20], [1e-4, 1])}, "MB", "error", log_x=True, log_y=True
        ),
        lambda: plots.histogram({"a": np.linspace(-1e-4, 1e-4, 99)}, "mm", "points, %"),
    ],
    ids=["bars", "bar", "lines", "logarithmic", "histogram"],
)
def test_texts_of_plots_fit_their_margins(draw, monkeypatch):
    drawings = []

    class Kept(plots.Drawing):
        def __init__(self, **named):
            super().__init__(**named)
            drawings.append(self)

    monkeypatch.setattr(plots, "Drawing", Kept)
    draw()
    (drawing,) = drawings
    box, (width, height) = drawing.get_tightbbox(), drawing.get_size_inches()
    assert box.x0 >= 0
    assert box.y0 >= 0
    assert box.x1 <= width
    assert box.y1 <= height


def test_accounts_that_do_not_add_up_are_said():
    whole = sections.CountedItems("capture", "photographs", 5, {"used": 3, "held out": 2})
    lost = sections.CountedItems("alignment", "texels", 9, {"frame found": 7})
    section = sections.bookkeeping_section([whole, lost])
    notes = [item for item in section.items if isinstance(item, Note)]
    assert [note.text for note in notes if note.is_warning] == [
        "alignment: 2 of 9 texels are unaccounted for."
    ]
    assert ("", "", "unaccounted", 2) in tables(section)[0].rows
    assert len(sections.bookkeeping_section([whole]).items) == 1


def test_rates_are_drawn_and_tabled_and_no_point_is_refused():
    points = [
        sections.RatePoint("with", 800_000, 31.0, 30.5),
        sections.RatePoint("with", 200_000, 28.0, 27.0),
    ]
    section = sections.rate_distortion_section(points, "a note")
    figure, table, note = section.items
    assert len(figure.panels) == 2
    assert table.rows[1][2:] == (200_000, "28.00", "27.00")
    assert note.text == "a note"
    alone = [sections.RatePoint("with", 5, 31.0, None)]
    assert len(sections.rate_distortion_section(alone).items[0].panels) == 1
    with pytest.raises(InputError, match="points"):
        sections.rate_distortion_section([])
