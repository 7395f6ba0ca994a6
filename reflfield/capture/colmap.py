"""Reader of COLMAP's sparse models, beside or below their folder ``images``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from reflfield.capture.calibrated_views import View, capture_of_views
from reflfield.capture.capture import Capture
from reflfield.capture.colmap_model import model_camera, read_model
from reflfield.capture.view_folders import view_folders
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

FILE_NAMES = ("cameras.bin", "cameras.txt")
# Where COLMAP and programs that call it put a model, from the capture's folder.
_FOLDERS = (
    *("", "sparse/0/", "sparse/", "colmap/sparse/0/"),
    *("dense/sparse/", "dense/0/sparse/"),
)
PATTERNS = tuple(folder + name for folder in _FOLDERS for name in FILE_NAMES)


def is_colmap(path: Path) -> bool:
    """Whether a file is the ``cameras`` of a model, by the names beside it."""
    if path.name not in FILE_NAMES or not path.with_name(f"images{path.suffix}").is_file():
        return False
    # A binary model counts before a text model of the same folder.
    return path.suffix == ".bin" or not path.with_suffix(".bin").is_file()


def read_colmap(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a capture from a COLMAP model.

    Parameters
    ----------
    description : Path
        ``cameras.bin`` or ``cameras.txt``; ``images`` stands beside it, ``points3D``, rigs
        and frames are not needed.
    follow_links : bool
        Whether symbolic links may lead out of the folder of the photographs and masks.

    Returns
    -------
    Capture
        Of one constant, unknown light. Images of one pose and lens are one camera.

    Raises
    ------
    CaptureError
        If the model is damaged, a camera model is not supported, there is no folder of
        photographs, or a photograph has another size than its camera.
    """
    lenses, images = read_model(description.parent, description.suffix)
    views = []
    for image in images:
        what = f"{description.parent}: image {quoted(image.name)}"
        if image.camera not in lenses:
            raise CaptureError(
                f"{what}: expected the id of a camera in {description.name}, received "
                f"{image.camera}; export the whole model"
            )
        views.append(View(image.name, model_camera(lenses[image.camera], image, what)))
    if not views:
        raise CaptureError(
            f"{description.with_name('images' + description.suffix)}: expected registered "
            "images, received none; did the reconstruction succeed?"
        )
    folders = view_folders(description, follow_links=follow_links)
    models = Counter(lens.model for lens in lenses.values())
    kinds = ", ".join(f"{n} {name}" for name, n in models.items())
    form = "binary" if description.suffix == ".bin" else "text"
    return capture_of_views(
        views,
        folders,
        format="colmap",
        details=[
            f"COLMAP model {description.parent} ({form}): {len(views)} images, lenses: {kinds}",
            f"photographs in {folders.root / folders.images}",
        ],
    )
