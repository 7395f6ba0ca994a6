"""Where photographs and masks of a calibration lie: folders beside it or above it.

Programs that calibrate cameras name photographs within a folder of photographs, not the
folder itself. It is ``images`` beside the calibration or up to three levels above it; masks lie
in ``masks`` beside that, named as COLMAP does (``masks/a.jpg.png`` of ``images/a.jpg``) or with
the suffix of the mask in the place of the photograph's (``masks/a.png``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from reflfield.capture.names import IMAGE_SUFFIXES
from reflfield.capture.paths import NamedFiles
from reflfield.errors import CaptureError
from reflfield.util.quoting import listed, quoted

IMAGES, MASKS = "images", "masks"
# A model in `sparse/0` stands two levels below its workspace, in `dense/0/sparse` three.
LEVELS_UP = 3
# Folders that other programs call the one of masks, without case and an s at the end.
OTHER_MASKS = ("mask", "silhouette", "matte", "alpha", "segmentation", "foreground")


@dataclass(frozen=True)
class ViewFolders:
    """Folders of the photographs and masks of a calibration.

    Parameters
    ----------
    files : NamedFiles
        Finds files in the folder that holds both.
    images : str
        Folder of the photographs in it, "" for the folder itself.
    masks : str or None
        Folder of the masks in it; None where there is none.
    """

    files: NamedFiles
    images: str
    masks: str | None

    @property
    def root(self) -> Path:
        """The folder that holds both."""
        return self.files.root

    def photograph(self, name: str) -> Path:
        """File of a photograph that the calibration names, with or without its suffix.

        Raises
        ------
        CaptureError
            If the name leads out of the folder.
        """
        suffixes = () if name.lower().endswith(IMAGE_SUFFIXES) else IMAGE_SUFFIXES
        parts = name.replace("\\", "/").split("/")
        if ".." in parts or name.startswith(("/", "\\")) or ":" in parts[0]:
            raise CaptureError(
                f"{self.files.description}: photograph {quoted(name)}: expected a name within "
                f"the folder {self.root / self.images}, received one that leaves it; name "
                "photographs relative to that folder"
            )
        return self.files.path(self._within(self.images, name), suffixes)

    def mask(self, photograph: Path) -> Path | None:
        """Mask of a photograph; None where there is none."""
        if self.masks is None:
            return None
        name = photograph.relative_to(self.root / self.images)
        for candidate in (f"{name.as_posix()}.png", name.with_suffix("").as_posix()):
            path = self.files.path(self._within(self.masks, candidate), IMAGE_SUFFIXES)
            if path.is_file():
                return path
        return None

    def notes_on_other_masks(self) -> list[str]:
        """A note on folders that seem to hold masks, where there is none of the usual name."""
        names = sorted(entry.name for entry in self.root.iterdir() if entry.is_dir())
        others = [n for n in names if n.casefold().removesuffix("s") in OTHER_MASKS]
        if self.masks is not None or not others:
            return []
        return [
            f"{self.root}: no folder 'masks', and {listed(others)} beside the photographs is "
            "not read; rename it to 'masks' if it holds masks"
        ]

    def _within(self, folder: str, name: str) -> str:
        return f"{folder}/{name}" if folder else name


def view_folders(
    description: Path, *, follow_links: bool, images: Sequence[str] = (IMAGES,)
) -> ViewFolders:
    """Folders of the photographs and masks of a calibration file.

    Parameters
    ----------
    description : Path
        The calibration.
    follow_links : bool
        Whether symbolic links may lead out of the folder that holds both.
    images : sequence of str
        Names of the folder of photographs that are looked for, in order.

    Raises
    ------
    CaptureError
        If there is no such folder.
    """
    start = description.absolute().parent
    above = [description.parent, *start.parents[:LEVELS_UP]]
    for root in above:
        for name in images:
            if (root / name).is_dir():
                files = NamedFiles(description, follow_links=follow_links, root=root)
                return ViewFolders(files, name, masks_in(root))
    raise CaptureError(
        f"{description}: expected the photographs in a folder {' or '.join(images)!r} beside "
        f"it or above it, received none up to {above[-1]}; put or link the photographs there"
    )


def masks_in(root: Path) -> str | None:
    """Name of the folder of masks; None where there is none.

    Raises
    ------
    CaptureError
        If there is something else of that name.
    """
    folder = root / MASKS
    if folder.is_dir():
        return MASKS
    if folder.exists() or folder.is_symlink():
        raise CaptureError(
            f"{folder}: expected a folder of masks, received a file or a link that leads to "
            "none; remove it, or put the masks there"
        )
    return None
