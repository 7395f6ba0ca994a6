"""Captures written in another format: photographs copied, cameras and lights translated.

What the target cannot say is refused: nothing that changes geometry or values is left out.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from reflfield.capture.btf import read_btf
from reflfield.capture.btf_conversion import write_btf_samples
from reflfield.capture.btf_means import read_btf_means
from reflfield.capture.capture import Capture
from reflfield.capture.colmap_writing import colmap_description
from reflfield.capture.native_writing import native_description
from reflfield.capture.transforms_writing import transforms_description
from reflfield.capture.written_files import WrittenFiles
from reflfield.errors import InputError
from reflfield.util.files import filling
from reflfield.util.folders import link_file
from reflfield.util.quoting import printable

# Writes the description of a capture whose files are `WrittenFiles`.
_Writer = Callable[[Capture, WrittenFiles], None]
TARGETS: dict[str, _Writer] = {
    "native": native_description,
    "transforms": transforms_description,
    "colmap": colmap_description,
}


def convert_capture(
    capture: Capture, out: Path | str, to: str = "native", *, link: bool = False
) -> list[Path]:
    """Write a capture in another format.

    Parameters
    ----------
    capture : Capture
        Its photographs exist.
    out : Path or str
        A folder that is new or empty.
    to : {"native", "transforms", "colmap"}
        ``capture.json``; ``transforms.json``; or a COLMAP model with ``images``, ``masks``
        and, where lights are known, ``lights.csv``.
    link : bool
        Hard links in place of copies of the photographs, where the file system has them.

    Returns
    -------
    list of Path
        What was written, the description first.

    Raises
    ------
    InputError
        If the folder is not empty, or the target cannot say what the capture does, such as
        a distant light or an orthographic camera in ``transforms.json``.
    """
    if to not in TARGETS:
        raise InputError(f"to: expected {', '.join(TARGETS)}, received {to!r}")
    out = Path(out)
    check_empty(out)
    with filling(out) as partial:
        files = WrittenFiles(partial, link_file if link else shutil.copyfile)
        TARGETS[to](capture, files)
        return [out / path.relative_to(partial) for path in files.written]


def convert_btf(path: Path | str, out: Path | str) -> int:
    """Write a ``.btf`` container as a native capture; the number of its images.

    Parameters
    ----------
    path : Path or str
        The container, or a folder of means (`btf_means`).
    out : Path or str
        A folder that is new or empty.

    Raises
    ------
    InputError
        If the folder is not empty, or the container cannot be read.
    """
    path, out = Path(path), Path(out)
    check_empty(out)
    btf = read_btf_means(path) if path.is_dir() else read_btf(path)
    return write_btf_samples(btf, out, printable(path.stem) or "btf")


def check_empty(out: Path) -> None:
    """Refuse a folder that holds something.

    Raises
    ------
    InputError
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"out: expected a new or empty folder, received {out}; choose another")
