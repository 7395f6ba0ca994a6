"""Which layer of an image file is the photograph.

Renderers write what they compute beside the image: normals, depth, albedo, single light
paths. The image is, in this order:

1. the layer that is asked for by name;
2. the only layer there is, if it has colour or luminance;
3. the channels R, G, B without a layer's name, if the file has one part;
4. the one layer, or the one part, with a name of `COMBINED`, whatever its case; of a layer's
   name (``ViewLayer.Combined``) the last word counts;
5. the channels R, G, B without a layer's name of the first part, if that part has no name;

else the file is refused with a list of what is in it. A file of several pages (TIFF) is its
first page where the others are smaller copies or masks of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from reflfield.capture.exr_headers import ExrPart
from reflfield.capture.image_headers import ImageHeader
from reflfield.errors import CaptureError

# Names that renderers and compositors give the image itself.
COMBINED = frozenset(
    ("combined", "beauty", "rgba", "rgb", "c", "ci", "color", "colour", "composite", "final")
)
# What grey images call their one channel. Depth (Z) and the like are none.
LUMINANCE_CHANNELS = frozenset(("y", "l", "v", "i", "r", "gray", "grey", "luminance"))
MOST_LISTED = 20


@dataclass(frozen=True)
class Layer:
    """An image within a file.

    Parameters
    ----------
    part : int
        Number of the part or page.
    name : str
        What it is called in messages and asked for by.
    colour : tuple of str
        Names of its channels, three or one; empty where the file says nothing (no EXR).
    alpha : str
        Name of the channel of its alpha, or empty.
    width, height : int
        Pixels.
    """

    part: int
    name: str
    colour: tuple[str, ...]
    alpha: str
    width: int
    height: int


def choose_layer(path: Path, header: ImageHeader, wanted: str | None = None) -> Layer:
    """The layer of a file that is the photograph.

    Parameters
    ----------
    path : Path
        Named in messages.
    header : ImageHeader
        What `read_header` says of the file.
    wanted : str, optional
        Name of a layer, part or page, or the last word of one; case does not matter. Files
        that can have no layers (PNG, JPEG, Radiance) have none to choose from.

    Returns
    -------
    Layer

    Raises
    ------
    CaptureError
        If none has that name, several have, or none is unambiguously the image. The
        message lists what is there.
    """
    if header.kind == "exr":
        layers = [layer for part in header.parts for layer in _layers(part, header)]
        candidates = _asked_for(layers, wanted) if wanted else _combined(layers, header)
    elif header.kind == "tiff":
        layers = [
            Layer(page.index, page.name or str(page.index), (), "", page.width, page.height)
            for page in header.pages
        ]
        candidates = _asked_for(layers, wanted) if wanted else _pages(layers, header)
    else:
        return Layer(0, "", (), "", header.width, header.height)
    if len(candidates) != 1:
        raise _doubt(path, header, layers, wanted)
    return candidates[0]


def _layers(part: ExrPart, header: ImageHeader) -> list[Layer]:
    """Layers of a part that have colour or luminance."""
    channels: dict[str, dict[str, str]] = {}
    if part.luminance_chroma:
        channels[""] = {"r": "R", "g": "G", "b": "B"}  # what the decoder makes of it
        if "A" in part.channels:
            channels[""]["a"] = "A"
    else:
        for name in part.channels:
            prefix, _, letter = name.rpartition(".")
            channels.setdefault(prefix, {}).setdefault(letter.lower(), name)  # R before r
    layers = []
    for prefix, names in channels.items():
        colour = _colour(names)
        label = ".".join(filter(None, (part.name if len(header.parts) > 1 else "", prefix)))
        if colour:
            layers.append(
                Layer(part.index, label or ", ".join(colour), colour, names.get("a", ""),
                      *part.display_window.size)
            )  # fmt: skip
    return layers


def _colour(names: dict[str, str]) -> tuple[str, ...]:
    """Channels of colour or luminance among those of a layer; (X, Y, Z) are none."""
    for letters in ("rgb", ("red", "green", "blue")):
        if all(letter in names for letter in letters):
            return tuple(names[letter] for letter in letters)
    others = [letter for letter in names if letter not in ("a", "alpha")]
    return (names[others[0]],) if len(others) == 1 and others[0] in LUMINANCE_CHANNELS else ()


def _asked_for(layers: list[Layer], wanted: str) -> list[Layer]:
    """Layers of a name; the whole name comes before the last word of one."""
    name = wanted.lower()
    whole = [layer for layer in layers if layer.name.lower() == name]
    by_number = [layer for layer in layers if str(layer.part) == name]
    return whole or [layer for layer in layers if _last(layer) == name] or by_number


def _combined(layers: list[Layer], header: ImageHeader) -> list[Layer]:
    """The layers that the rules of this module take; one if there is no doubt."""
    n_channels = sum(len(part.channels) for part in header.parts)
    if len(layers) == 1 and n_channels == len(layers[0].colour) + bool(layers[0].alpha):
        return layers
    plain = [layer for layer in layers if all("." not in name for name in layer.colour)]
    if len(header.parts) == 1 and plain and len(plain[0].colour) == 3:
        return plain
    named = [layer for layer in layers if _last(layer) in COMBINED]
    first = [layer for layer in plain if layer.part == 0 and not header.parts[0].name]
    return named or first


def _pages(layers: list[Layer], header: ImageHeader) -> list[Layer]:
    """Pages that are no smaller copies or masks of the first of them."""
    full = [layer for layer in layers if not header.pages[layer.part].reduced] or layers
    area = full[0].width * full[0].height
    return [
        layer for layer in full if layer is full[0] or 2 * layer.width * layer.height > area
    ]


def _last(layer: Layer) -> str:
    return layer.name.rpartition(".")[2].lower()


def _doubt(
    path: Path, header: ImageHeader, layers: list[Layer], wanted: str | None
) -> CaptureError:
    names = [layer.name for layer in layers]
    shown = ", ".join(names[:MOST_LISTED]) + (", ..." if len(names) > MOST_LISTED else "")
    channels = sorted({name for part in header.parts for name in part.channels})
    if not names:
        listed = ", ".join(channels[:MOST_LISTED])
        return CaptureError(
            f"{path}: expected channels R, G, B (or Y), received {listed}; export the image "
            "itself"
        )
    what = "pages" if header.kind == "tiff" else "layers or parts"
    expected = f"the layer {wanted!r}" if wanted else "one that is unambiguously the image"
    return CaptureError(
        f"{path}: expected {expected}, received the {what} {shown}; say which one with "
        '`layer="NAME"` or "layer" in capture.json'
    )
