"""Masks in a folder beside the photographs, of descriptions that name none themselves.

They lie in ``masks`` beside the folder of all photographs, named as `view_folders` says, where
``reflfield masks`` puts them and other programs do.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from reflfield.capture.capture import HULL, Capture
from reflfield.capture.paths import NamedFiles
from reflfield.capture.view_folders import ViewFolders, masks_in
from reflfield.util.quoting import listed


def with_masks_beside(capture: Capture, *, follow_links: bool = False) -> Capture:
    """The capture with masks that lie beside its photographs; as it is where it has some.

    Parameters
    ----------
    capture : Capture
    follow_links : bool
        Whether symbolic links may lead out of the capture's folder.

    Returns
    -------
    Capture
        What is not read of such a folder is noted.

    Raises
    ------
    CaptureError
        If ``masks`` is no folder, or a link leads out of the capture's folder.
    """
    if any(capture.silhouettes) or capture.base_geometry != HULL or not capture.photographs:
        return capture
    folders = _folders(capture, follow_links)
    if folders is None:
        return capture
    candidates: list[list[Path]] = [[] for _ in capture.cameras]
    for photograph in capture.photographs:
        mask = folders.mask(photograph.path)
        if mask is not None and mask not in candidates[photograph.camera]:
            candidates[photograph.camera].append(mask)
    masks = tuple(paths[0] if paths else None for paths in candidates)
    notes, details = _notes(folders, candidates), []
    if any(masks):
        details.append(f"masks in {folders.root / (folders.masks or '')}")
    return replace(
        capture,
        silhouettes=masks,
        notes=(*capture.notes, *notes),
        details=(*capture.details, *details),
    )


def _folders(capture: Capture, follow_links: bool) -> ViewFolders | None:
    """Where photographs and masks lie; None for photographs outside of the capture's folder."""
    root, paths = capture.root, [photograph.path for photograph in capture.photographs]
    common = Path(os.path.commonpath([path.parent for path in paths]))
    if not common.is_relative_to(root) or capture.description is None:
        return None
    files = NamedFiles(capture.description, follow_links=follow_links, root=root)
    images = common.relative_to(root).as_posix()
    for base in dict.fromkeys((root if common == root else common.parent, root)):
        masks = masks_in(base)
        if masks is not None:
            return ViewFolders(files, images, (base.relative_to(root) / masks).as_posix())
    return ViewFolders(files, images, None)


def _notes(folders: ViewFolders, candidates: Sequence[Sequence[Path]]) -> list[str]:
    """What is not read of the masks."""
    if folders.masks is None:
        return folders.notes_on_other_masks()
    where, without = folders.root / folders.masks, sum(not paths for paths in candidates)
    if without == len(candidates):
        return [
            f"{where}: not read, since none of its files is named as a photograph (a.jpg.png "
            "or a.png of a.jpg); rename them if they are masks"
        ]
    several = [paths for paths in candidates if len(paths) > 1]
    notes = [f"{where}: no mask for {without} of {len(candidates)} cameras"] if without else []
    if several:
        names = listed([path.name for path in several[0]])
        notes.append(
            f"{where}: {len(several)} of {len(candidates)} cameras have several masks, of "
            f"which the first is used ({names})"
        )
    return notes
