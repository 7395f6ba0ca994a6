"""Names of photographs, and text of others' making in messages."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

IMAGE_SUFFIXES = (".exr", ".png", ".jpg", ".jpeg", ".tif", ".tiff")

# Relit frames are written under the names of photographs; file systems allow 255 bytes, of
# which a letter takes up to four.
LONGEST_NAME = 60
LONGEST_QUOTE = 200
# Names in one message.
MOST_LISTED = 5


def frame_name(path: Path) -> str:
    """File name without an image suffix; other dots stay.

    Examples
    --------
    >>> frame_name(Path("a/r_0.5.exr")), frame_name(Path("a/r_0.5"))
    ('r_0.5', 'r_0.5')
    """
    return path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name


def unique_names(paths: list[Path], root: Path) -> list[str]:
    """Name each file: its stem, with folders in front where stems repeat.

    Parameters
    ----------
    paths : list of Path
    root : Path
        Folder that folders are counted from.

    Returns
    -------
    list of str
        Distinct even where upper and lower case are one, of at most `LONGEST_NAME`
        characters and a number.

    Examples
    --------
    >>> unique_names([Path("/c/a/1.exr"), Path("/c/b/1.exr"), Path("/c/2.exr")], Path("/c"))
    ['a_1', 'b_1', '2']
    >>> unique_names([Path("a.png"), Path("a.jpg"), Path("a_1.png"), Path("A_2.png")], Path())
    ['a', 'a_3', 'a_1', 'A_2']
    """
    names = [frame_name(path) for path in paths]
    repeated = _repeated(names)
    for i, path in enumerate(paths):
        if names[i].casefold() in repeated:
            folder = path.parent.relative_to(root) if path.is_relative_to(root) else Path()
            names[i] = "_".join([*folder.parts, names[i]])
        names[i] = names[i][-LONGEST_NAME:]
    repeated = _repeated(names)
    used = {name.casefold() for name in names}
    numbers: dict[str, int] = {}
    for i, name in enumerate(names):
        key = name.casefold()
        if key not in repeated:
            continue
        n = numbers.get(key, 0)
        while n and f"{key}_{n}" in used:
            n += 1
        numbers[key] = n + 1
        if n:
            names[i] = f"{name}_{n}"
            used.add(f"{key}_{n}")
    return names


def has_controls(text: str) -> bool:
    r"""Whether a text holds control characters, line ends or halves of surrogate pairs.

    Examples
    --------
    >>> has_controls("M\u00fcnze\u202f1"), has_controls("a\nb"), has_controls("\ud800")
    (False, True, True)
    """
    return not text.isprintable() and any(
        unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in text
    )


def printable(text: str) -> str:
    r"""Text with what cannot be printed (control characters, halves of pairs) escaped.

    Examples
    --------
    >>> printable("M\u00fcnze 1"), printable("a\nb\ud800")
    ('Münze 1', 'a\\nb\\ud800')
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def listed(names: Sequence[str]) -> str:
    """Names for messages, printable, the first few of many.

    Examples
    --------
    >>> listed([f"v{i}" for i in range(7)])
    'v0, v1, v2, v3, v4 and 2 more'
    """
    more = len(names) - MOST_LISTED
    shown = ", ".join(printable(name) for name in names[:MOST_LISTED])
    return f"{shown} and {more} more" if more > 0 else shown


def quoted(value: Any) -> str:
    """A value for messages: printable, and not longer than `LONGEST_QUOTE`."""
    if isinstance(value, (list, dict, str)) and len(value) > LONGEST_QUOTE:
        kept = dict(list(value.items())[:9]) if isinstance(value, dict) else value[:99]
        return f"{quoted(kept)} ..."
    text = repr(value)
    return text if len(text) <= LONGEST_QUOTE else text[:LONGEST_QUOTE] + " ..."


def _repeated(names: Iterable[str]) -> set[str]:
    counts = Counter(name.casefold() for name in names)
    return {name for name, count in counts.items() if count > 1}
