"""Wavefront OBJ as it is found: relative indices, comments, tabs, several line ends.

The parser behind `trimesh` takes plain files only: positive indices, one space, no comments
behind faces. Files that are not plain are rewritten so, each line checked.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

from capture_sim.errors import SceneError, scene_error

_NUMBER = rb" ++[-+.eE0-9]++"
_INDEX = rb"[1-9][0-9]*+"
_END = rb" *+\n"
_LINES = (
    rb"v(?:" + _NUMBER + rb"){3,8}+" + _END,
    rb"vt(?:" + _NUMBER + rb"){2,3}+" + _END,
    rb"vn(?:" + _NUMBER + rb"){3}+" + _END,
    rb"f(?: ++%b(?:/%b)?+(?:/%b)?+(?://%b)?+){3,64}+" % (4 * (_INDEX,)) + _END,
    rb"(?:[#ogs]|usemtl|mtllib)[^\n\\]*+\n",
    rb"\n",
)
# As long a beginning of a file as is plain; possessive, so that no line is looked at twice.
_PLAIN = re.compile(rb"(?:" + rb"|".join(_LINES) + rb")*+")
# Numbers that a line of this kind holds at least, and those of them that are kept.
_LENGTHS = {"v": (3, 3), "vt": (1, 2), "vn": (3, 3)}


def plain_obj(content: bytes, path: Path) -> bytes:
    r"""The same surface as a plain OBJ file.

    Parameters
    ----------
    content : bytes
    path : Path
        Named in messages.

    Returns
    -------
    bytes
        Plain files are returned as they are, but for line ends.

    Raises
    ------
    SceneError
        Names file and line if a vertex or a face is not one.

    Examples
    --------
    >>> relative = b"v 0 0 0\nv 1 0 0 # corner\r\nv 1 1 0\nf -3 -2 -1\n"
    >>> plain_obj(relative, Path("a.obj")).splitlines()[1:]
    [b'v 1.0 0.0 0.0', b'v 1.0 1.0 0.0', b'f 1 2 3']
    """
    if b"\0" in content[:4096]:
        raise scene_error(str(path), "an OBJ file, which is text (UTF-8)", "other bytes")
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n") + b"\n"
    beginning = _PLAIN.match(content)
    if beginning is not None and beginning.end() == len(content):
        return content
    return rewritten_obj(content, path)


def rewritten_obj(content: bytes, path: Path) -> bytes:
    """Vertices, coordinates and faces alone, each line checked; see `plain_obj`.

    Parameters
    ----------
    content : bytes
        With line feeds.
    path : Path
        Named in messages.

    Returns
    -------
    bytes

    Raises
    ------
    SceneError
        Names file and line if a vertex or a face is not one, or a face has a vertex that
        is not there.
    """
    counts, last = {"v": 0, "vt": 0, "vn": 0}, {"v": 0, "vt": 0, "vn": 0}
    lines = []
    for number, words in _statements(content.decode("utf-8", errors="replace")):
        try:
            if words[0] in counts:
                counts[words[0]] += 1
                lines.append(_vertex(words))
            elif words[0] == "f":
                lines.append(_face(words[1:], counts, last))
        except ValueError as error:
            raise scene_error(
                f"{path}, line {number}", str(error), repr(" ".join(words)[:80]),
                "export the file again",
            ) from error  # fmt: skip
    for kind, highest in last.items():
        if highest > counts[kind]:
            raise SceneError(
                f"{path}: expected faces among the {counts[kind]} lines '{kind}', received "
                f"index {highest}; the file is not whole: export it again"
            )
    return ("\n".join(lines) + "\n").encode()


def _statements(text: str) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line with something but a comment on it."""
    begun = ""
    for number, line in enumerate(text.split("\n"), 1):
        begun += line
        if begun.endswith("\\"):
            begun = begun[:-1] + " "
            continue
        words, begun = begun.split("#", 1)[0].split(), ""
        if words:
            yield number, words


def _vertex(words: list[str]) -> str:
    least, kept = _LENGTHS[words[0]]
    try:
        numbers = [float(word) for word in words[1:]]
    except ValueError:
        numbers = []
    if len(numbers) < least or not all(map(math.isfinite, numbers)):
        text = f"{least} or more finite numbers with decimal points after {words[0]!r}"
        raise ValueError(text)
    # Coordinates of one dimension have the second zero.
    return " ".join([words[0], *map(repr, [*numbers, 0.0][:kept])])


def _face(corners: list[str], counts: dict[str, int], last: dict[str, int]) -> str:
    """A face with indices from the beginning; raises `last` to the largest of each kind."""
    if len(corners) < 3:
        raise ValueError("three or more corners after 'f'")
    absolute = []
    for corner in corners:
        parts = corner.split("/")
        if len(parts) > 3 or not parts[0]:
            raise ValueError("corners v, v/vt, v//vn or v/vt/vn after 'f'")
        indices = [
            str(_index(part, kind, counts, last)) if part else ""
            for part, kind in zip(parts, ("v", "vt", "vn"), strict=False)
        ]
        absolute.append("/".join(indices).rstrip("/"))
    return " ".join(["f", *absolute])


def _index(part: str, kind: str, counts: dict[str, int], last: dict[str, int]) -> int:
    try:
        index = int(part)
    except ValueError:
        index = 0
    if index < 0:  # counted back from the last line of its kind so far
        index += counts[kind] + 1
    if index <= 0:
        raise ValueError(
            f"whole numbers from 1 on, or back from -1 to -{counts[kind]}, for '{kind}'"
        )
    last[kind] = max(last[kind], index)
    return index
