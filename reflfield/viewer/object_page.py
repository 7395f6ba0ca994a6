"""One self-contained web page that shows a field from any side under any light.

The page holds the field, a script that draws it with WebGL 2, and nothing that is fetched: its
content security policy allows its own script and style by their digests, and no connection.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.lights import DIRECTIONAL, POINT, UNKNOWN, Light
from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.util.files import replacing
from reflfield.util.quoting import printable
from reflfield.viewer.page_asset import page_asset

# In the order in which they are put together.
SCRIPTS = (
    *("space.js", "decode.js", "shaders.js", "textures.js", "painter.js", "maps.js", "exr.js"),
    *("scene.js", "viewer.js", "pointer.js", "panel.js", "start.js"),
)
PAGE_FILES = ("page.html", "page.css", *SCRIPTS)
MOST_BYTES = 30_000_000
# Between the parts of the page: see page.html.
CALLS = ("reflfield.block(0)", "reflfield.block(1)")


@dataclass(frozen=True)
class Bookmark:
    """A photograph to compare with: its camera, its lights and itself.

    Parameters
    ----------
    name : str
    note : str
        A sentence under the picture.
    camera : Camera
        That keeps lines straight.
    lights : tuple of Light
        Points and directions.
    exposure : float
        Factor from radiance to what is encoded as sRGB.
    picture : bytes
        The photograph, encoded.
    media_type : str
        Such as ``image/jpeg``.
    """

    name: str
    note: str
    camera: Camera
    lights: tuple[Light, ...]
    exposure: float
    picture: bytes
    media_type: str = "image/jpeg"


def can_be_shown(camera: Camera, light: Light) -> bool:
    """Whether the page can draw what a camera sees under a light."""
    drawn = all(
        source.falls_off and source.kind in (POINT, DIRECTIONAL, UNKNOWN)
        for source in light.sources
    )
    return camera.keeps_lines_straight and drawn


def write_object_page(
    path: Path | str,
    field: ReflectanceField,
    name: str = "",
    bookmarks: Sequence[Bookmark] = (),
    moved: NDArray[np.floating] | None = None,
) -> None:
    """Write the page; it appears when it is whole.

    Parameters
    ----------
    path : Path or str
        Such as ``object.html``; its folder is created.
    field : ReflectanceField
    name : str
        Of the object; that of the field's capture by default.
    bookmarks : sequence of Bookmark
        Photographs to compare with.
    moved : (n_vertices,) float, optional
        How far the surface lies outside of the hull that it was made from.

    Raises
    ------
    InputError
        If the page would be larger than `MOST_BYTES`.
    """
    text = object_page(field, name, bookmarks, moved=moved)
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as partial:
        partial.write_text(text, encoding="utf-8")


def object_page(
    field: ReflectanceField,
    name: str = "",
    bookmarks: Sequence[Bookmark] = (),
    most_bytes: int = MOST_BYTES,
    moved: NDArray[np.floating] | None = None,
) -> str:
    """The page as HTML text; same content, same text.

    Parameters
    ----------
    field : ReflectanceField
    name : str
        Of the object; that of the field's capture by default.
    bookmarks : sequence of Bookmark
        Photographs to compare with.
    most_bytes : int
        Of the page.
    moved : (n_vertices,) float, optional
        See `write_object_page`.

    Raises
    ------
    InputError
        If the page would be larger.
    """
    asset = page_asset(field, moved)
    script = '"use strict";\n(() => {\n' + "\n".join(map(_file, SCRIPTS)) + "})();\n"
    style = _file("page.css")
    blocks = [base64.b64encode(block.content).decode("ascii") for block in asset.blocks]
    text = Template(_file("page.html")).substitute(
        title=escape(printable(name or title_of(field))),
        subtitle=escape(_subtitle(field)),
        script_hashes=" ".join(sorted({_digest(part) for part in (script, *CALLS)})),
        style_hash=_digest(style),
        style=style,
        script=script,
        header=_json(asset.header | {"bookmarks": list(map(_described, bookmarks))}),
        pictures=_json([_data_url(bookmark) for bookmark in bookmarks]),
        block_0=blocks[0],
        block_1=blocks[1],
    )
    if len(text) > most_bytes:
        raise InputError(
            f"page: expected at most {most_bytes:,} bytes, received {len(text):,}; make a "
            "smaller field with `size`"
        )
    return text


def too_large_page(name: str) -> str:
    """A page that stands for one that would be too large, and says what to do."""
    title = escape(printable(name))
    return (
        f'<!DOCTYPE html>\n<html lang="en"><meta charset="utf-8"><title>{title}</title>\n'
        f"<h1>{title}</h1>\n<p>This field is too large for one file. See it with "
        "<code>reflfield view field.rfld</code>, or make a smaller one with "
        "<code>reflfield run --size</code>.</p>\n</html>\n"
    )


def title_of(field: ReflectanceField) -> str:
    """Name of a field's capture."""
    return str(field.metadata.get("capture") or "object")


def page_digest() -> str:
    """SHA-256 of the files of the package that pages are made of."""
    return hashlib.sha256("\0".join(map(_file, PAGE_FILES)).encode()).hexdigest()


def _subtitle(field: ReflectanceField) -> str:
    if field.light_model == "unknown":
        return "In the light that it was photographed in. Drag to turn it."
    return "Drag to turn it. Drag the dot to move the light."


def _file(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """Source expression of a content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _json(value: Any) -> str:
    """JSON that no parser of HTML takes for markup."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def camera_values(camera: Camera) -> dict[str, Any]:
    """A camera as the script reads it."""
    names = ("kind", "width", "height", "fl_x", "fl_y", "cx", "cy")
    values = {name: getattr(camera, name) for name in names}
    return values | {"camera_from_world": camera.camera_from_world.tolist()}


def light_values(light: Light) -> dict[str, Any]:
    """A light as the script reads it."""
    vectors = ("position", "direction", "intensity")
    return {"kind": light.kind} | {name: getattr(light, name).tolist() for name in vectors}


def _described(bookmark: Bookmark) -> dict[str, Any]:
    """A bookmark as the script reads it, without its picture."""
    return {
        "name": printable(bookmark.name),
        "note": printable(bookmark.note),
        "exposure": bookmark.exposure,
        "camera": camera_values(bookmark.camera),
        "lights": [light_values(light) for light in bookmark.lights],
    }


def _data_url(bookmark: Bookmark) -> str:
    encoded = base64.b64encode(bookmark.picture).decode("ascii")
    return f"data:{bookmark.media_type};base64,{encoded}"
