"""The formats that are read: by which files each is recognised, and by which function read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from reflfield.capture import (
    btf_names,
    colmap,
    diligent_mv,
    kintsugi,
    light_lists,
    llff,
    lp,
    metashape,
    middlebury,
    native,
    near_light_mat,
    openillumination,
    relight_dome,
    rene,
    transforms_json,
)
from reflfield.capture.capture import Capture


@dataclass(frozen=True)
class Reader:
    """A way to read captures.

    Parameters
    ----------
    patterns : tuple of str
        Globs of its descriptions, within the capture's folder.
    read : callable
        ``read(description, follow_links=...)``: the capture.
    recognises : callable, optional
        Whether a file of these names is of the format; by default all are.
    by_one_of_many : bool
        Whether the first of the files stands for all.
    """

    patterns: tuple[str, ...]
    read: Callable[..., Capture]
    recognises: Callable[[Path], bool] = Path.is_file
    by_one_of_many: bool = False

    def descriptions(self, folder: Path) -> list[Path]:
        """Files in a folder that are of this format."""
        patterns = (_of_either_case(pattern) for pattern in self.patterns)
        files = (path for pattern in patterns for path in sorted(folder.glob(pattern)))
        fitting = (path for path in files if not path.is_dir() and self.recognises(path))
        return list(islice(fitting, 1 if self.by_one_of_many else None))


def _of_either_case(pattern: str) -> str:
    """A glob of a suffix that fits it in capital letters, too, as some systems write it."""
    if not pattern.startswith("*.") or "[" in pattern:
        return pattern
    return "".join(f"[{c.lower()}{c.upper()}]" if c.isalpha() else c for c in pattern)


def _any(path: Path) -> bool:
    return True


# Formats that are made for captures: one of them counts before what other programs leave.
OWN_READERS = {
    "native": Reader((native.FILE_NAME,), native.read_native, _any),
    "transforms": Reader((transforms_json.FILE_NAME,), transforms_json.read_transforms, _any),
    "middlebury": Reader(("*" + middlebury.SUFFIX,), middlebury.read_middlebury, _any),
    "lp": Reader(("*" + lp.SUFFIX,), lp.read_lp, _any),
}
OTHER_READERS = {
    "colmap": Reader(colmap.PATTERNS, colmap.read_colmap, colmap.is_colmap),
    "metashape": Reader(("*.xml",), metashape.read_metashape, metashape.is_metashape),
    "kintsugi": Reader(("*" + kintsugi.SUFFIX,), kintsugi.read_view_set),
    "llff": Reader((llff.FILE_NAME,), llff.read_llff),
    "dome": Reader(("*" + relight_dome.SUFFIX,), relight_dome.read_dome),
    "lights": Reader(
        light_lists.PATTERNS, light_lists.read_light_list, light_lists.is_light_list
    ),
    "diligent-mv": Reader(
        (diligent_mv.FILE_NAME,), diligent_mv.read_diligent_mv, diligent_mv.is_diligent_mv
    ),
    "openillumination": Reader(
        (openillumination.PATTERN,),
        openillumination.read_openillumination,
        openillumination.is_openillumination,
    ),
    "rene": Reader(rene.PATTERNS, rene.read_rene, rene.is_rene),
    "btf-images": Reader(
        btf_names.PATTERNS,
        btf_names.read_btf_images,
        btf_names.is_btf_image,
        by_one_of_many=True,
    ),
    "near-light": Reader(
        (near_light_mat.FILE_NAME,),
        near_light_mat.read_near_light_mat,
        near_light_mat.is_near_light_mat,
    ),
}
READERS = {**OWN_READERS, **OTHER_READERS}
