"""The paper's Tables 1 and 2 and Figures 4 to 10 on one page, each with its command.

Every part is kept as it is finished, under a key of its code and options, so that the same
command goes on where it stopped.
"""

from __future__ import annotations

import base64
import hashlib
import json
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from reflfield.errors import InputError
from reflfield.pipeline.code_digests import code_digest
from reflfield.report.page import (
    ColourBar,
    Figure,
    Item,
    Note,
    Panel,
    Picture,
    ReportContent,
    Section,
    Table,
    format_seconds,
    write_report,
)
from reflfield.reproduction import (
    correlation_tables,
    object_figures,
    synthetic_figures,
    texture_figures,
)
from reflfield.reproduction.measured_felt import read_felt
from reflfield.util.files import read_bytes, replacing

# A part's file; pictures of a few hundred kilobytes each.
LARGEST_PART = 64 << 20
TITLE = "Data-driven Local Coordinate Systems for Image-Based Rendering"


@dataclass(frozen=True)
class Reproduction:
    """What is reproduced, and at which size.

    Parameters
    ----------
    felt : Path, optional
        Folder `ubo2014_felt05`; Figures 7 and 8 then show the measured felt, too.
    map_width, map_height : int
        Texels of the synthetic map of Figures 4 to 6; the paper's has 124 x 90.
    texture_width, texture_height : int
        Texels of the BTFs of Figures 7 and 8 on 151 x 151 directions.
    n_directions : int
        Cameras, and lamps, of the object of Figures 9 and 10; 151 is the paper's.
    photograph_side : int
        Pixels of the side of the object's photographs.
    workers : int
        Threads.
    """

    felt: Path | None = None
    map_width: int = 124
    map_height: int = 90
    texture_width: int = 32
    texture_height: int = 24
    n_directions: int = 32
    photograph_side: int = 96
    workers: int = 1

    def __post_init__(self) -> None:
        ranges = {
            "map_width": (4, 512), "map_height": (4, 512),
            "texture_width": (4, 256), "texture_height": (4, 256),
            "n_directions": (8, 151), "photograph_side": (32, 512), "workers": (1, 1024),
        }  # fmt: skip
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise InputError(f"{name}: expected {least} to {most}, received {value}")


Work = Callable[[Reproduction, Path], list[Section]]


def _table_1(wanted: Reproduction, folder: Path) -> list[Section]:
    return [correlation_tables.table_1()]


def _table_2(wanted: Reproduction, folder: Path) -> list[Section]:
    return [correlation_tables.table_2()]


def _synthetic(wanted: Reproduction, folder: Path) -> list[Section]:
    some = synthetic_figures.recovered(wanted.map_width, wanted.map_height, wanted.workers)
    figures = (
        synthetic_figures.figure_4,
        synthetic_figures.figure_5,
        synthetic_figures.figure_6,
    )
    return [draw(some) for draw in figures]


def _textures(wanted: Reproduction, folder: Path) -> list[Section]:
    size = wanted.texture_width, wanted.texture_height
    textures = [texture_figures.simulated_texture(*size)]
    if wanted.felt is not None:
        textures.append(texture_figures.measured_texture(wanted.felt, *size))
    sections = []
    for one in textures:
        frames = texture_figures.frames_by_method(one, wanted.workers)
        sections += [
            texture_figures.figure_7(one, frames),
            texture_figures.figure_8(one, frames),
        ]
    return sorted(sections, key=lambda section: section.title.split(":")[0])


def _object(wanted: Reproduction, folder: Path) -> list[Section]:
    at = folder / "object"
    result = object_figures.make_object(
        at, wanted.n_directions, wanted.photograph_side, wanted.workers
    )
    return [
        object_figures.figure_9(result, at / "capture", wanted.n_directions),
        object_figures.figure_10(result.field),
    ]


@dataclass(frozen=True)
class Part:
    """What is computed together: its sections, the module of its code, its options."""

    name: str
    work: Work
    module: str
    options: tuple[str, ...]


PARTS = (
    Part("table1", _table_1, correlation_tables.__name__, ()),
    Part("table2", _table_2, correlation_tables.__name__, ()),
    Part("figures4-6", _synthetic, synthetic_figures.__name__, ("map_width", "map_height")),
    Part(
        "figures7-8",
        _textures,
        texture_figures.__name__,
        ("felt", "texture_width", "texture_height"),
    ),
    Part("figures9-10", _object, object_figures.__name__, ("n_directions", "photograph_side")),
)
NAMES = tuple(part.name for part in PARTS)


def reproduce(
    out: Path, wanted: Reproduction, only: Sequence[str] = (), command: str = "reflfield"
) -> Path:
    """Make all parts, or some, and the page of all that are there.

    Parameters
    ----------
    out : Path
        Folder; gets ``index.html``, ``parts`` and what the object of Figures 9 and 10 needs.
    wanted : Reproduction
    only : sequence of str
        Of `NAMES`; all if empty.
    command : str
        Shown with each part, without the part's name.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    InputError
        If a part does not exist, or the felt's files are no such files.
    """
    unknown = set(only) - set(NAMES)
    if unknown:
        raise InputError(
            f"only: expected parts of {', '.join(NAMES)}, received {sorted(unknown)[0]}"
        )
    if wanted.felt is not None:
        read_felt(wanted.felt)  # before hours of other work
    sections: list[Section] = []
    for part in PARTS:
        if not only or part.name in only:
            sections += _made(part, out, wanted, command)
        else:
            sections += _kept(_path(out, part), key_of(part, wanted)) or []
    page = out / "index.html"
    write_report(
        page,
        ReportContent(
            "The paper's tables and figures, made anew",
            f"G. Müller, R. Sarlette, R. Klein: {TITLE}, Eurographics 2006. Beside the paper's "
            "figures stand ours, each with the command that made it.",
            sections=tuple(sections),
        ),
    )
    return page


def key_of(part: Part, wanted: Reproduction) -> str:
    """Digest of all that a part depends on."""
    options = {name: str(getattr(wanted, name)) for name in part.options}
    text = json.dumps([part.name, code_digest(part.module), options], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _path(out: Path, part: Part) -> Path:
    return out / "parts" / f"{part.name}.json"


def _made(part: Part, out: Path, wanted: Reproduction, command: str) -> list[Section]:
    """Sections of a part, from its file or computed."""
    key, path = key_of(part, wanted), _path(out, part)
    kept = _kept(path, key)
    if kept is not None:
        return kept
    started = time.perf_counter()
    sections = part.work(wanted, out)
    took = format_seconds(time.perf_counter() - started)
    line = f"{command} --only {part.name}"
    said = Note(f"Made by: {line} (this part took {took})")
    sections = [Section(s.title, s.intro, (*s.items, said)) for s in sections]
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        content = {"key": key, "sections": [to_json(section) for section in sections]}
        partial.write_text(json.dumps(content), encoding="utf-8")
    return sections


def _kept(path: Path, key: str) -> list[Section] | None:
    """Sections of a finished part; None where there is none of this key."""
    if not path.is_file():
        return None
    try:
        content = json.loads(read_bytes(path, LARGEST_PART))
        if content["key"] != key:
            return None
        return [from_json(section) for section in content["sections"]]
    except (ValueError, KeyError, TypeError, IndexError):
        # Not what this program has written: computed again.
        return None


def command_of(out: Path, wanted: Reproduction) -> str:
    """The command line of a reproduction, without its parts."""
    default, words = Reproduction(), ["reflfield", "reproduce", "-o", str(out)]
    for name, flag in FLAGS.items():
        if getattr(wanted, name) != getattr(default, name):
            words += [flag, str(getattr(wanted, name))]
    return shlex.join(words)


FLAGS = {"felt": "--felt", "n_directions": "--directions", "photograph_side": "--pixels"}


# --- sections as JSON ---------------------------------------------------------------------


def to_json(section: Section) -> dict[str, Any]:
    """A section as JSON has it; pictures in base64.

    Examples
    --------
    >>> section = Section("Figure 1", "What it shows.", (Note("A note."),))
    >>> from_json(to_json(section)) == section
    True
    """

    def plain(value: Any) -> Any:
        if isinstance(value, bytes):
            return base64.b64encode(value).decode()
        if isinstance(value, dict):
            return {name: plain(one) for name, one in value.items()}
        if isinstance(value, list | tuple):
            return [plain(one) for one in value]
        return value.item() if hasattr(value, "item") else value

    items = [[type(item).__name__, plain(asdict(item))] for item in section.items]
    return {"title": section.title, "intro": section.intro, "items": items}


def from_json(content: dict[str, Any]) -> Section:
    """The section that `to_json` made the content of."""
    items = tuple(_item(kind, fields) for kind, fields in content["items"])
    return Section(content["title"], content["intro"], items)


def _item(kind: str, fields: dict[str, Any]) -> Item:
    if kind == "Note":
        return Note(**fields)
    if kind == "Table":
        rows = tuple(map(tuple, fields["rows"]))
        emphasised = tuple(fields["emphasised"])
        return Table(tuple(fields["header"]), rows, fields["caption"], emphasised)
    panels = tuple(
        Panel(
            Picture(**(one["picture"] | {"data": base64.b64decode(one["picture"]["data"])})),
            one["label"],
        )
        for one in fields["panels"]
    )
    bar = fields["colour_bar"]
    return Figure(
        panels,
        fields["caption"],
        fields["title"],
        ColourBar(**bar) if bar else None,
        tuple((colour, text) for colour, text in fields["legend"]),
        fields["min_width"],
    )
