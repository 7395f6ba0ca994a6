"""Files that a description names, which lie inside its folder."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from reflfield.errors import CaptureError
from reflfield.util.quoting import has_controls, quoted

# Bytes of a path, and of one of its parts, which is what file systems allow.
LONGEST_PATH, LONGEST_PART = 1000, 255
_ABSOLUTE = re.compile(r"[/\\]|[A-Za-z]:")  # on Unix or on Windows


class NamedFiles:
    r"""Finds the files that a description names.

    A name is tried as it stands, then with ``/`` for ``\`` (Windows), then without regard
    to upper and lower case or to how accents are composed (Windows, macOS), in which case
    one file must fit.

    Parameters
    ----------
    description : Path
        Its folder holds the files.
    follow_links : bool
        Whether symbolic links may lead out of the folder.
    root : Path, optional
        Folder that holds the files, where it is another one.
    """

    def __init__(
        self, description: Path, *, follow_links: bool = False, root: Path | None = None
    ) -> None:
        self.description, self.root = description, root or description.parent
        self.follow_links = follow_links
        self._resolved_root = self.root.resolve()
        self._listings: dict[Path, dict[str, list[str]]] = {}
        self._answers: dict[tuple[str, ...], Path] = {}

    def path(self, text: object, suffixes: Sequence[str] = ()) -> Path:
        """Path of a file that the description names.

        Parameters
        ----------
        text : str
            Relative path as written there.
        suffixes : sequence of str
            Tried after the name itself.

        Returns
        -------
        Path
            Inside the folder. Of a file that does not exist, the name with the first
            suffix.

        Raises
        ------
        CaptureError
            If the path leads outside, is absolute and no end of it names a file in a folder
            here, or holds control characters.
        """
        key = (repr(text), *suffixes)
        if key not in self._answers:
            self._answers[key] = self._sought(text, suffixes)
        return self._answers[key]

    def _sought(self, text: object, suffixes: Sequence[str]) -> Path:
        names = self._names(text)
        below = self._below(names[-1], suffixes)
        names = [below] if below else names
        for name in names:
            self._check_inside(name)
        tried = [name + suffix for suffix in ("", *suffixes) for name in names]
        for name in tried:
            if (self.root / name).is_file():
                return self._checked(name)
        for name in tried:
            other = self._other_spelling(name)
            if other is not None:
                return self._checked(other)
        return self._checked(names[-1] + (suffixes[0] if suffixes else ""))

    def _below(self, name: str, suffixes: Sequence[str]) -> str | None:
        """An absolute path as one below the folder; None if it names no file there.

        The folder may have been moved or come from another computer: then the longest end of
        the path counts that names a file, at least with its folder, since ``train/r_1.png``
        and ``test/r_1.png`` are two.
        """
        if not _ABSOLUTE.match(name) or ".." in name.split("/"):
            return None
        for root in (self.root.absolute(), self._resolved_root):
            if Path(name).is_relative_to(root):
                return Path(name).relative_to(root).as_posix()
        parts = [part for part in name.split("/") if part not in ("", ".")]
        ends = ["/".join(parts[i:]) for i in range(len(parts) - 1) if ":" not in parts[i]]
        return next(
            (e for e in ends for s in ("", *suffixes) if (self.root / (e + s)).is_file()), None
        )

    def path_by_last_parts(self, text: object) -> Path:
        """Path of a file that was moved here with some of its folders, or none.

        Parameters
        ----------
        text : str
            Path, possibly absolute and from another computer.

        Returns
        -------
        Path
            The file that the longest end of the path names inside the folder; else
            as `path`.

        Raises
        ------
        CaptureError
            As `path`, if no end of the path names a file.
        """
        name = self._names(text)[-1]
        parts = [p for p in re.split("/+", name) if p not in ("", ".", "..")]
        ends = ["/".join(parts[i:]) for i in range(len(parts))]
        if not _ABSOLUTE.match(name) and (self.root / name).is_file():
            ends = [name, *ends]
        for end in ends:
            if _leaves(end):
                continue
            other = end if (self.root / end).is_file() else self._other_spelling(end)
            if other is not None:
                return self._checked(other)
        return self.path(text)

    def _names(self, text: object) -> list[str]:
        r"""The text, and where it has ``\`` as Windows reads it."""
        text = usable_path(text, self.description)
        return [text, text.replace("\\", "/")] if "\\" in text else [text]

    def _check_inside(self, name: str) -> None:
        if _ABSOLUTE.match(name) or _leaves(name):
            raise CaptureError(
                f"{self.description}: path {name!r} leaves the folder {self.root}; expected a "
                "relative path to a file inside it: copy the file there, or the description "
                "into a folder that holds all its files"
            )

    def _checked(self, name: str) -> Path:
        """The path, unless symbolic links lead outside."""
        path = self.root / name
        try:
            target = path.resolve()
        except (ValueError, OSError, RuntimeError) as error:
            raise CaptureError(
                f"{self.description}: {name!r} is not a usable path ({error})"
            ) from error
        if not self.follow_links and not target.is_relative_to(self._resolved_root):
            raise CaptureError(
                f"{self.description}: {name!r} is reached through a symbolic link that leads "
                f"out of the folder, to {target}; allow it with "
                "`follow_links=True`, or put the file itself there"
            )
        return path

    def _other_spelling(self, name: str) -> str | None:
        """The one file whose name differs only in case or composition; None if none does."""
        folder, parts = self.root, [p for p in name.split("/") if p not in ("", ".")]
        spelled = []
        for part in parts:
            matches = [part] if part == ".." else self._listing(folder).get(_key(part), [])
            matches = [part] if part in matches else matches
            if len(matches) != 1:
                return None
            spelled.append(matches[0])
            folder /= matches[0]
        return "/".join(spelled) if folder.is_file() else None

    def _listing(self, folder: Path) -> dict[str, list[str]]:
        """Names in a folder by what they have in common with other spellings."""
        if folder not in self._listings:
            listing: dict[str, list[str]] = {}
            try:
                names = [path.name for path in folder.iterdir()]
            except (OSError, ValueError):
                names = []
            for name in names:
                listing.setdefault(_key(name), []).append(name)
            self._listings[folder] = listing
        return self._listings[folder]


def usable_path(text: object, description: Path) -> str:
    """A text of a description that can be a path; whether there is such a file or not.

    Raises
    ------
    CaptureError
        If it is no text, is empty or too long, or holds control characters.
    """
    if not isinstance(text, str) or not _usable(text):
        raise CaptureError(
            f"{description}: expected a path without control characters, of at most "
            f"{LONGEST_PATH} bytes; {quoted(text)} is not a usable path"
        )
    return text


def _usable(text: str) -> bool:
    """Whether a text can be a path in a description."""
    if not text or len(text) > LONGEST_PATH or has_controls(text):
        return False
    longest = max(len(part.encode()) for part in re.split(r"[/\\]", text))
    return longest <= LONGEST_PART and len(text.encode()) <= LONGEST_PATH


def _leaves(name: str) -> bool:
    """Whether a relative path leads out of where it starts, as written.

    Examples
    --------
    >>> _leaves("a/../b"), _leaves("a/../../b")
    (False, True)
    """
    return Path(os.path.normpath(name)).parts[:1] == ("..",)


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
