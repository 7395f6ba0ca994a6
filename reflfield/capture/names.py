"""Names of photographs, distinct and short enough for every file system."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from reflfield.errors import CaptureError

IMAGE_SUFFIXES = (".exr", ".png", ".jpg", ".jpeg", ".tif", ".tiff")

# Relit frames are written under the names of photographs; file systems allow 255 bytes, of
# which a letter takes up to four.
LONGEST_NAME = 60


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


def _repeated(names: Iterable[str]) -> set[str]:
    counts = Counter(name.casefold() for name in names)
    return {name for name, count in counts.items() if count > 1}


def check_unique(what: str, ids: Sequence[str]) -> None:
    """Demand ids that differ.

    Raises
    ------
    CaptureError
        Naming the first that repeats.
    """
    seen: set[str] = set()
    for id_ in ids:
        if id_ in seen:
            raise CaptureError(f"{what}: expected ids that differ, received {id_!r} twice")
        seen.add(id_)
