"""One self-contained web page on the quality of a result.

The page is composed of `Section` s; builders for the usual ones are in
`reflfield.report.sections`. Images are embedded; there is no script and
no reference to anything outside of the file, and its content security policy
forbids loading any. All texts are escaped: names of captures and photographs
are not trusted.
"""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image as PillowImage

from reflfield.errors import ShapeError
from reflfield.report.pictures import colour_stops
from reflfield.util.files import replacing

# Texts, counts, measures, or nothing. Numbers are aligned right.
Cell = str | int | float | bool | None

MISSING = "–"
# Browsers show narrower pictures enlarged; smoothing would hide their pixels.
PIXELATED_BELOW = 200
LONG_TABLE_ROWS = 24
NARROW_COLUMNS = 4
COMPACT_PX = 240
WEBP_QUALITY = 90

_NUMBER = re.compile(r"[−-]?[\d\u202f]+(\.\d+)?( ?(%|[kMG]?B|s|min|min \d\d s|h \d\d min))?")


@dataclass(frozen=True)
class Picture:
    """An encoded picture, ready to be embedded.

    Attributes
    ----------
    data : bytes
    media_type : str
        Such as ``image/webp``.
    width, height : int
        In pixels.
    is_plot : bool
        True for drawings on a transparent ground, whose lightness is inverted
        where the reader prefers dark pages.
    """

    data: bytes
    media_type: str
    width: int
    height: int
    is_plot: bool = False


@dataclass(frozen=True)
class ColourBar:
    """What the colours of a picture mean."""

    colours: str
    low: float
    high: float
    label: str


@dataclass(frozen=True)
class Panel:
    """One picture of a figure, with a short label under it."""

    picture: Picture
    label: str = ""


@dataclass(frozen=True)
class Figure:
    """Images side by side under one caption that says what to look for.

    Attributes
    ----------
    panels : tuple of Panel
    caption : str
    title : str
        Set above the pictures; may be empty.
    colour_bar : ColourBar, optional
    legend : tuple of (colour, text)
        Colours as ``#rrggbb``.
    min_width : int
        Panels are never narrower than this many CSS pixels; they wrap instead.
        0 keeps all panels in one row at any width.
    """

    panels: tuple[Panel, ...]
    caption: str
    title: str = ""
    colour_bar: ColourBar | None = None
    legend: tuple[tuple[str, str], ...] = ()
    min_width: int = 220


@dataclass(frozen=True)
class Table:
    """Rows under a header, with a caption.

    Attributes
    ----------
    header : tuple of str
    rows : tuple of tuple
        As long as the header. None is shown as a dash.
    caption : str
    emphasised : tuple of int
        Rows set in bold, such as the mean.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str
    emphasised: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Demand rows as long as the header."""
        for i, row in enumerate(self.rows):
            if len(row) != len(self.header):
                raise ShapeError(
                    f"table {self.caption!r}, row {i}: expected {len(self.header)} cells, "
                    f"received {len(row)}"
                )


@dataclass(frozen=True)
class Note:
    """A paragraph; a warning is set apart."""

    text: str
    is_warning: bool = False


Item = Figure | Table | Note


@dataclass(frozen=True)
class Section:
    """A title, one sentence that says what follows, figures and tables."""

    title: str
    intro: str
    items: tuple[Item, ...] = ()


@dataclass(frozen=True)
class KeyNumber:
    """A number for the head of the page: what, how much, a few words on it."""

    label: str
    value: str
    detail: str = ""


@dataclass(frozen=True)
class ReportContent:
    """Everything the page shows.

    Attributes
    ----------
    title : str
        Name of the capture.
    subtitle : str
        One sentence: what was done with what.
    key_numbers : tuple of KeyNumber
    sections : tuple of Section
        In the order of the page.
    warnings : tuple of str
        Shown at the top.
    footer : str
        Such as version and date.
    object_page : str
        Address of the page that relights the object, relative to this one; none if empty.
    """

    title: str
    subtitle: str = ""
    key_numbers: tuple[KeyNumber, ...] = ()
    sections: tuple[Section, ...] = ()
    warnings: tuple[str, ...] = ()
    footer: str = ""
    object_page: str = ""


# --- pictures ---------------------------------------------------------------------


def encode_picture(image: ArrayLike, lossless: bool = False) -> Picture:
    """Compress an 8-bit picture for the page (WebP).

    Parameters
    ----------
    image : (h, w, 3 or 4) array_like of uint8
        sRGB, and alpha.
    lossless : bool
        True keeps every pixel: for false colours and labels.

    Returns
    -------
    Picture

    Raises
    ------
    ShapeError
        If it is not an 8-bit colour picture with at least one pixel.

    Examples
    --------
    >>> picture = encode_picture(np.zeros((4, 6, 3), np.uint8), lossless=True)
    >>> picture.media_type, picture.width, picture.height
    ('image/webp', 6, 4)
    """
    pixels: NDArray[np.generic] = np.asarray(image)
    has_colour = pixels.ndim == 3 and pixels.shape[2] in (3, 4)
    if pixels.dtype != np.uint8 or not has_colour or not pixels.size:
        raise ShapeError(
            "picture: expected (h, w, 3 or 4) uint8 with pixels, received "
            f"{pixels.shape} {pixels.dtype}"
        )
    stream = io.BytesIO()
    saved = PillowImage.fromarray(np.ascontiguousarray(pixels))
    saved.save(stream, "WEBP", lossless=lossless, quality=WEBP_QUALITY, method=4)
    return Picture(stream.getvalue(), "image/webp", saved.width, saved.height)


# --- the page ---------------------------------------------------------------------


def write_report(path: Path | str, content: ReportContent) -> None:
    """Write the page, replacing an earlier one only when it is complete.

    Parameters
    ----------
    path : Path or str
        Such as ``report/index.html``; its folder is created.
    content : ReportContent
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        partial.write_text(render_report(content), encoding="utf-8")


def render_report(content: ReportContent) -> str:
    """The page as HTML text; same content, same text.

    Examples
    --------
    >>> page = render_report(ReportContent("vase <1>"))
    >>> "<h1>vase &lt;1&gt;</h1>" in page
    True
    """
    files = resources.files("reflfield.report")
    template = Template((files / "report.html").read_text(encoding="utf-8"))
    anchors = _anchors([section.title for section in content.sections])
    return template.substitute(
        style=(files / "report.css").read_text(encoding="utf-8"),
        title=escape(content.title),
        subtitle=_paragraph(content.subtitle, "subtitle"),
        key_numbers=_key_numbers(content.key_numbers),
        links=OBJECT_LINK.format(escape(content.object_page)) if content.object_page else "",
        warnings="\n".join(_note(Note(t, is_warning=True)) for t in content.warnings),
        navigation=_navigation(content.sections, anchors),
        sections="\n".join(
            _section(s, a) for s, a in zip(content.sections, anchors, strict=True)
        ),
        footer=escape(content.footer),
    )


def format_number(value: float) -> str:
    r"""Four significant digits; thousands apart; integers whole.

    Examples
    --------
    >>> [format_number(v) for v in (31.4159, 22801, 0.000123, 1.0, float("nan"))]
    ['31.42', '22\u202f801', '0.000123', '1', '–']
    """
    if not math.isfinite(value):
        return MISSING if math.isnan(value) else ("∞" if value > 0 else "−∞")
    if value == round(value) or abs(value) >= 10_000:
        return f"{round(value):,}".replace(",", "\u202f").replace("-", "−")
    return f"{value:.4g}".replace("-", "−")


def format_bytes(count: float) -> str:
    """Size in bytes with a decimal unit.

    Examples
    --------
    >>> format_bytes(812), format_bytes(1_234_567)
    ('812 B', '1.23 MB')
    """
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{round(count)} B"


def format_seconds(seconds: float) -> str:
    """Duration in the largest unit that leaves it readable.

    Examples
    --------
    >>> format_seconds(0.042), format_seconds(7.25), format_seconds(3725)
    ('0.04 s', '7.2 s', '1 h 02 min')
    """
    if seconds < 1:
        return f"{seconds:.2f} s"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


# --- parts of the page ------------------------------------------------------------

OBJECT_LINK = '<p class="link"><a href="{}">Turn the object and move the light</a></p>'


def _anchors(titles: Sequence[str]) -> list[str]:
    """Distinct fragment names: made of safe characters only."""
    words = (re.sub(r"[^a-z0-9]+", "-", t.lower()).strip("-") for t in titles)
    return [f"s{i}-{word}" if word else f"s{i}" for i, word in enumerate(words, start=1)]


def _paragraph(text: str, css_class: str = "") -> str:
    css = f' class="{css_class}"' if css_class else ""
    return f"<p{css}>{escape(text)}</p>" if text else ""


def _key_numbers(numbers: Sequence[KeyNumber]) -> str:
    cards = "\n".join(
        f"<div><dt>{escape(n.label)}</dt><dd><b>{escape(n.value)}</b>"
        f"<span>{escape(n.detail)}</span></dd></div>"
        for n in numbers
    )
    return f'<dl class="key-numbers">\n{cards}\n</dl>' if cards else ""


def _navigation(sections: Sequence[Section], anchors: Sequence[str]) -> str:
    links = "\n".join(
        f'<li><a href="#{anchor}">{escape(section.title)}</a></li>'
        for section, anchor in zip(sections, anchors, strict=True)
    )
    return f'<nav aria-label="Sections"><ol>\n{links}\n</ol></nav>' if links else ""


def _section(section: Section, anchor: str) -> str:
    body = "\n".join(_item(item) for item in section.items)
    return (
        f'<section id="{anchor}">\n<h2>{escape(section.title)}</h2>\n'
        f"{_paragraph(section.intro, 'intro')}\n{body}\n</section>"
    )


def _item(item: Item) -> str:
    if isinstance(item, Figure):
        return _figure(item)
    return _table(item) if isinstance(item, Table) else _note(item)


def _note(note: Note) -> str:
    css = "note warning" if note.is_warning else "note"
    mark = "<strong>Warning.</strong> " if note.is_warning else ""
    return f'<p class="{css}">{mark}{escape(note.text)}</p>'


def _figure(figure: Figure) -> str:
    title = f"<h3>{escape(figure.title)}</h3>\n" if figure.title else ""
    described = figure.title or figure.caption
    panels = "\n".join(_panel(panel, described) for panel in figure.panels)
    columns = _columns(figure.min_width, len(figure.panels))
    keys = _colour_bar(figure.colour_bar) + _legend(figure.legend)
    return (
        f'<figure>\n{title}<div class="panels" style="grid-template-columns: {columns}">\n'
        f"{panels}\n</div>\n{keys}<figcaption>{escape(figure.caption)}</figcaption>\n</figure>"
    )


def _columns(min_width: int, count: int) -> str:
    """CSS grid columns: fixed in one row, or wrapping below a width."""
    if not min_width:
        return f"repeat({max(1, count)}, 1fr)"
    # Small pictures stay two in a row on a telephone, large ones take it all.
    share = "47%" if min_width <= COMPACT_PX else "100%"
    return f"repeat(auto-fit, minmax(min({share}, {min_width:d}px), 1fr))"


def _panel(panel: Panel, described: str) -> str:
    picture = panel.picture
    css = " ".join(
        name
        for name, applies in (
            ("plot", picture.is_plot),
            ("pixelated", max(picture.width, picture.height) < PIXELATED_BELOW),
        )
        if applies
    )
    source = f"data:{picture.media_type};base64,{base64.b64encode(picture.data).decode()}"
    label = f"<span>{escape(panel.label)}</span>" if panel.label else ""
    return (
        f'<div class="panel"><img class="{css}" src="{source}" width="{picture.width}" '
        f'height="{picture.height}" alt="{escape(panel.label or described)}">{label}</div>'
    )


def _colour_bar(bar: ColourBar | None) -> str:
    if bar is None:
        return ""
    gradient = ", ".join(colour_stops(bar.colours))
    return (
        f'<div class="colour-bar"><span>{format_number(bar.low)}</span>'
        f'<i style="background: linear-gradient(to right, {gradient})"></i>'
        f"<span>{format_number(bar.high)}</span><em>{escape(bar.label)}</em></div>\n"
    )


def _legend(entries: Sequence[tuple[str, str]]) -> str:
    if not entries:
        return ""
    keys = "".join(
        f'<li><i style="background: {escape(colour)}"></i>{escape(text)}</li>'
        for colour, text in entries
    )
    return f'<ul class="legend">{keys}</ul>\n'


def _table(table: Table) -> str:
    numeric = [
        all(_is_number(row[i]) or row[i] in (None, "") for row in table.rows)
        for i in range(len(table.header))
    ]
    head = "".join(
        f'<th scope="col"{_right(n)}>{escape(text)}</th>'
        for text, n in zip(table.header, numeric, strict=True)
    )
    rows = "\n".join(
        f"<tr{_strong(i in table.emphasised)}>"
        + "".join(f"<td{_right(n)}>{_cell(c)}</td>" for c, n in zip(row, numeric, strict=True))
        + "</tr>"
        for i, row in enumerate(table.rows)
    )
    caption = escape(table.caption)
    framed = (
        f'<div class="table" tabindex="0" role="region" aria-label="{caption}">\n'
        f"<table{_narrow(len(table.header) <= NARROW_COLUMNS)}>\n"
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>\n</div>"
    )
    if len(table.rows) <= LONG_TABLE_ROWS:
        return f"<figure>\n<figcaption>{caption}</figcaption>\n{framed}\n</figure>"
    summary = f"{caption} ({len(table.rows)} rows)"
    return f"<details>\n<summary>{summary}</summary>\n{framed}\n</details>"


def _is_number(cell: Cell) -> bool:
    """Whether a cell is a number or the text of one, possibly with its unit."""
    if isinstance(cell, str):
        return _NUMBER.fullmatch(cell) is not None
    return isinstance(cell, int | float) and not isinstance(cell, bool)


def _cell(cell: Cell) -> str:
    if cell is None:
        return MISSING
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return escape(cell) if isinstance(cell, str) else format_number(cell)


def _right(applies: bool) -> str:
    return ' class="number"' if applies else ""


def _narrow(applies: bool) -> str:
    return ' class="narrow"' if applies else ""


def _strong(applies: bool) -> str:
    return ' class="emphasised"' if applies else ""
