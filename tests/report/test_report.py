"""The report: one valid page, nothing from outside, all texts escaped."""

import re
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest

from reflfield.errors import ShapeError
from reflfield.metrics.image_metrics import compare_images
from reflfield.report import sections
from reflfield.report.page import (
    ColourBar,
    Figure,
    KeyNumber,
    Note,
    Panel,
    ReportContent,
    Section,
    Table,
    encode_picture,
    format_bytes,
    format_number,
    format_seconds,
    render_report,
    write_report,
)

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Elements in order, attributes, text; demands that every element is closed."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.open, self.elements, self.attributes, self.text = [], [], [], []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        names = [name for name, _ in attributes]
        assert len(names) == len(set(names))
        self.elements.append(tag)
        self.attributes += [(tag, name, value) for name, value in attributes]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def values(self, name):
        return [value for _, attribute, value in self.attributes if attribute == name]


@pytest.fixture(scope="module")
def page_text(samples):
    return render_report(samples.full_content(np.random.default_rng(5)))


@pytest.fixture(scope="module")
def page(page_text):
    return Page(page_text)


def test_every_section_is_there_with_figures_and_captions(page):
    text = " ".join(page.text)
    for title in (
        "Held-out photographs", "Silhouettes and hull", "Atlas", "Coverage",
        "Normals and tangents",
        "Alignment", "Against the truth", "Compression", "Stages", "Options and versions",
    ):  # fmt: skip
        assert text.count(title) >= 2, f"{title}: heading and navigation"
    assert page.elements.count("figure") == page.elements.count("figcaption") > 20
    assert page.elements.count("main") == page.elements.count("h1") == 1
    assert "2 texels were never observed." in text
    assert "hull.resolution" in text
    assert "493 : 1" in text  # 400 MB in 812 kB


def test_navigation_leads_to_sections(page):
    links = [value[1:] for value in page.values("href")]
    ids = page.values("id")
    assert len(links) == 12
    assert set(links) <= set(ids)
    assert len(ids) == len(set(ids))


def test_nothing_is_loaded_from_outside(page, page_text):
    assert all(value.startswith("data:image/") for value in page.values("src"))
    assert all(value.startswith("#") for value in page.values("href"))
    assert not {"script", "link", "iframe", "object", "base"} & set(page.elements)
    assert re.search(r"https?:|//[a-z]|url\(|@import", _without_data(page_text)) is None
    assert "default-src 'none'" in page_text


def test_every_picture_says_its_size_and_what_it_is(page):
    count = page.elements.count("img")
    assert count > 20
    for name in ("width", "height", "alt"):
        values = [
            v for tag, attribute, v in page.attributes if (tag, attribute) == ("img", name)
        ]
        assert len(values) == count
        assert all(values)


def test_same_content_gives_same_bytes(samples):
    def page():
        pairs = samples.frame_pairs(np.random.default_rng(5), count=2, size=24)
        section = sections.held_out_section(compare_images(pairs), pairs)
        return render_report(ReportContent("vase", sections=(section,)))

    assert page() == page()


HOSTILE = "<script>alert('x')</script>\"'&$title"


def test_names_from_outside_are_escaped(samples):
    def page(name):
        pairs = samples.frame_pairs(np.random.default_rng(5), 2, 24, prefix=name)
        view = sections.SilhouetteView(
            name, lambda: pairs[0].photograph, *[pairs[0].silhouette] * 2
        )
        shown = (
            sections.held_out_section(compare_images(pairs), pairs),
            sections.silhouettes_section([view]),
            sections.run_section({name: name}, {}),
        )
        return render_report(ReportContent(name, sections=shown))

    html = page(HOSTILE)
    hostile = Page(html)
    assert "<script" not in html
    assert hostile.elements == Page(page("vase")).elements
    assert any(HOSTILE in text for text in hostile.text)
    assert not any(name.startswith("on") for _, name, _ in hostile.attributes)


def test_every_text_field_is_escaped():
    picture = encode_picture(np.zeros((2, 2, 3), np.uint8))
    section = Section(
        HOSTILE,
        HOSTILE,
        (
            Figure(
                (Panel(picture, HOSTILE),),
                HOSTILE,
                title=HOSTILE,
                colour_bar=ColourBar("viridis", 0, 1, HOSTILE),
                legend=((HOSTILE, HOSTILE),),
            ),
            Table((HOSTILE, "n"), ((HOSTILE, 1),) * 30, HOSTILE),
            Table((HOSTILE, "n"), ((HOSTILE, 1),), HOSTILE),
            Note(HOSTILE, is_warning=True),
        ),
    )
    html = render_report(
        ReportContent(
            HOSTILE,
            HOSTILE,
            (KeyNumber(HOSTILE, HOSTILE, HOSTILE),),
            (section,),
            (HOSTILE,),
            HOSTILE,
        )
    )
    assert "script" not in Page(html).elements
    assert "<script" not in html
    assert "'x'" not in html
    # Nothing is lost, and the template does not look into what it is given.
    assert unescape(html).count(HOSTILE) > 50


def test_page_is_replaced_only_when_complete(tmp_path, monkeypatch):
    path = tmp_path / "report" / "index.html"
    write_report(path, ReportContent("first"))
    before = path.read_text(encoding="utf-8")
    broken = ReportContent("second", sections=(Section("a", "b", (Figure((None,), ""),)),))
    with pytest.raises(AttributeError):
        write_report(path, broken)
    assert path.read_text(encoding="utf-8") == before
    assert [p.name for p in path.parent.iterdir()] == ["index.html"]


def test_rows_of_another_length_are_refused():
    with pytest.raises(ShapeError, match=r"sizes.*row 1: expected 2 cells, received 3"):
        Table(("a", "b"), ((1, 2), (1, 2, 3)), "sizes")


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((0, 4, 3), np.uint8)]
)
def test_pictures_that_are_not_8_bit_colour_are_refused(image):
    with pytest.raises(ShapeError, match="picture: expected"):
        encode_picture(image)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (format_number(0.0), "0"),
        (format_number(-1234567.0), "−1\u202f234\u202f567"),
        (format_number(float("inf")), "∞"),
        (format_number(1e-9), "1e−09"),
        (format_bytes(0), "0 B"),
        (format_bytes(9_126_805_504), "9.13 GB"),
        (format_seconds(59.96), "1 min 00 s"),
        (format_seconds(3599.7), "1 h 00 min"),
    ],
)
def test_numbers_are_readable(text, expected):
    assert text == expected


def test_numbers_and_their_texts_are_aligned_right():
    html = render_report(
        ReportContent("t", sections=(Section("s", "", (
            Table(("name", "n", "size", "time", "part"),
                  (("v1", 3, "1.2 MB", "3 min 04 s", "7.6 %"),
                   ("v2", None, "9 B", "0.02 s", "")),
                  "c"),
        )),))
    )  # fmt: skip
    assert html.count('scope="col" class="number"') == 4


def _without_data(html):
    return re.sub(r"data:image/[a-z+]+;base64,[A-Za-z0-9+/=]+", "data:", html)
