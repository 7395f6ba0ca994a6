"""Image files as linear float32: EXR, PNG, JPEG, TIFF, Radiance HDR and camera raw.

What a file states about its colour is honoured or refused (`capture.stated_color`); integers
that state nothing are sRGB, floats are linear. Pixels stay as stored: a calibration speaks of
those, so Exif orientation turns nothing.

A photograph whose alpha is not 1 everywhere shows the object before black: colour times alpha.
EXR and float TIFF have it multiplied already, by convention; PNG has not; TIFF says. Below
alpha 0 everything is black, whatever the file holds there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.clipping import (
    BLACK,
    MEASURED,
    SATURATED,
    TRANSPARENT,
    kinds_of_stored,
)
from reflfield.capture.color_spaces import ColorSpace
from reflfield.capture.decoding import StoredImage, decode_stored, raw_size
from reflfield.capture.encoding import LINEAR, SRGB, Encoding, encode_srgb
from reflfield.capture.image_headers import read_header
from reflfield.capture.image_layers import choose_layer
from reflfield.errors import CaptureError

Float32 = NDArray[np.float32]
Kinds = NDArray[np.uint8]


@dataclass(frozen=True)
class ImageReading:
    """What somebody says about image files that the files do not say themselves.

    Parameters
    ----------
    encoding : Encoding, optional
        Curve from stored to linear values. It replaces what the file states about its colour;
        primaries then count as Rec.709's.
    layer : str, optional
        Layer, part or page that is the photograph (`capture.image_layers`).
    white_level : float, optional
        Stored value from which on the sensor is saturated: a code of integer files, a value of
        others (`capture.clipping`).
    """

    encoding: Encoding | None = None
    layer: str | None = None
    white_level: float | None = None


AS_STATED = ImageReading()


@dataclass(frozen=True, eq=False)
class ReadImage:
    """An image file as linear RGB, and how it was stored.

    Parameters
    ----------
    path : Path
    image : (h, w, 3) float32
        As of `read_image`.
    kinds : (h, w, 3) uint8
        As of `read_kinds`.
    alpha : (h, w) float32 or None
        None where there is none, or all is opaque.
    integer : bool
        Whether the file holds integers.
    space : ColorSpace
        What they were decoded by.
    """

    path: Path
    image: Float32
    kinds: Kinds
    alpha: Float32 | None
    integer: bool
    space: ColorSpace

    @property
    def numbers(self) -> str:
        """What the file holds, in words."""
        kind = "integers" if self.integer else "floats"
        primaries = "" if self.space.matrix is None else ", primaries of its own"
        encoding = self.space.encoding
        exponent = f" {encoding.gamma:g}" if encoding.name == "gamma" else ""
        return f"{kind} (encoding {encoding.name}{exponent}{primaries})"

    def is_stored_like(self, other: ReadImage) -> bool:
        """Whether numbers of both files mean the same."""
        own, theirs = (
            np.eye(3) if one.space.matrix is None else one.space.matrix for one in (self, other)
        )
        return (
            self.integer == other.integer
            and self.space.encoding == other.space.encoding
            and np.allclose(own, theirs, atol=1e-4)
        )


def read_image(
    path: Path | str, reading: ImageReading = AS_STATED, *, what: str = "photograph"
) -> Float32:
    """Read an image as linear RGB.

    Parameters
    ----------
    path : Path or str
        EXR, PNG, JPEG, TIFF, Radiance HDR or camera raw, told apart by content.
    reading : ImageReading, optional
        Encoding and layer, where the file does not say them.
    what : str
        What the image is called in messages.

    Returns
    -------
    (height, width, 3) float32
        Linear, primaries of Rec.709, before black where there is alpha; grey is repeated.

    Raises
    ------
    CaptureError
        If the file is missing, truncated, of another kind, too large, states colour that is
        not understood, leaves open which layer is meant, or holds NaN or infinity. The message
        names the file.
    """
    path = Path(path)
    stored = _read(path, reading)
    return _linear(path, stored, reading, what)


def read_kinds(
    path: Path | str, reading: ImageReading = AS_STATED, *, what: str = "photograph"
) -> tuple[Float32, Kinds]:
    """Read an image as linear RGB, and which of its values are measurements.

    Parameters
    ----------
    path, reading, what
        As `read_image`.

    Returns
    -------
    image : (h, w, 3) float32
        As `read_image`.
    kinds : (h, w, 3) uint8
        Of `capture.clipping`: `MEASURED`; `SATURATED` at the limit of the sensor or the file,
        or beyond the last pair of a table; `BLACK`; `TRANSPARENT` under alpha 0.
    """
    read = read_described(path, reading, what=what)
    return read.image, read.kinds


def read_described(
    path: Path | str, reading: ImageReading = AS_STATED, *, what: str = "photograph"
) -> ReadImage:
    """Read an image as `read_kinds` does, and how it is stored."""
    path = Path(path)
    stored = _read(path, reading)
    image = _linear(path, stored, reading, what)
    return ReadImage(
        path=path,
        image=image,
        kinds=np.broadcast_to(_kinds(stored, reading), image.shape),
        alpha=_seen_through(stored),
        integer=stored.integer,
        space=_space(stored, reading),
    )


def read_small_kinds(
    path: Path | str, reading: ImageReading = AS_STATED, *, longest: int
) -> tuple[Float32, Kinds]:
    """Read an image as `read_kinds` does, a large JPEG at a half, a quarter or an eighth.

    Pixels that are saturated alone are lost in it.

    Parameters
    ----------
    path, reading
        As `read_image`.
    longest : int
        The longer side of the answer is at least so many pixels, where the image has them.
    """
    path = Path(path)
    header = read_header(path)
    factor = next((f for f in (8, 4, 2) if max(header.width, header.height) >= f * longest), 1)
    if header.kind != "jpeg":
        factor = 1
    layer = choose_layer(path, header, reading.layer)
    stored = decode_stored(path, header, layer, factor)
    image = _linear(path, stored, reading, "photograph")
    return image, np.broadcast_to(_kinds(stored, reading), image.shape)


def read_exposure(
    path: Path | str, reading: ImageReading = AS_STATED
) -> tuple[Float32, Kinds, Encoding]:
    """Read one of several bracketed exposures as stored: 1 is where it saturates.

    A file of floats is taken as linear up to the sensor's saturation at its white level (1 if
    none is said), and encoded in sRGB.

    Returns
    -------
    encoded : (h, w, 3) float32
        In [0, 1].
    kinds : (h, w, 3) uint8
        As `read_kinds`.
    encoding : Encoding
        From encoded to linear values.
    """
    path = Path(path)
    stored = _read(path, reading)
    image = _linear(path, stored, reading, "photograph")
    kinds = np.broadcast_to(_kinds(stored, reading), image.shape)
    space = _space(stored, reading)
    if not stored.integer or stored.alpha is not None or space.matrix is not None:
        white = 1.0 if stored.integer else reading.white_level or 1.0
        share = image / np.float32(white)
        values = encode_srgb(share).astype(np.float32)
        measured, kinds = kinds == MEASURED, kinds.copy()
        kinds[measured & (share <= 0)] = BLACK
        kinds[measured & (share >= 1)] = SATURATED
        return values, kinds, Encoding(SRGB)
    return np.broadcast_to(stored.values, image.shape), kinds, space.encoding


def read_alpha(path: Path | str, reading: ImageReading = AS_STATED) -> Float32 | None:
    """Alpha of a photograph, (h, w) float32 in [0, 1]; None if it has none or is opaque."""
    return _seen_through(_read(Path(path), reading))


def largest_code_of_16(path: Path | str, reading: ImageReading = AS_STATED) -> int | None:
    """Largest code of a file of 16 bits that is decoded by a curve which nobody asked for.

    Returns
    -------
    int or None
        None for other files, and for linear ones, which are right up to a scale.
    """
    path = Path(path)
    if reading.encoding is not None or read_header(path).kind not in ("png", "tiff"):
        return None
    stored = _read(path, reading)
    if stored.colour.dtype != np.uint16 or stored.stated().encoding.name == LINEAR:
        return None
    return int(stored.colour.max(initial=0))


def stores_alpha(path: Path | str, reading: ImageReading = AS_STATED) -> bool:
    """Whether a file has an alpha channel, by its header; it may be opaque."""
    path = Path(path)
    header = read_header(path)
    if header.kind == "exr":
        return bool(choose_layer(path, header, reading.layer).alpha)
    return header.alpha


def read_coverage(path: Path | str) -> Float32:
    """Read a silhouette: the fraction of each pixel that the object covers.

    Parameters
    ----------
    path : Path or str
        Grey (white = object); of an image with an alpha channel that is not opaque everywhere,
        alpha is taken. Stored values count, whatever encoding the file states.

    Returns
    -------
    (height, width) float32
        Coverage in [0, 1].

    Raises
    ------
    CaptureError
        As `read_image`.
    """
    path = Path(path)
    stored = _read(path, AS_STATED)
    if stored.alpha is not None and (stored.alpha < 1).any():
        _check_finite(path, stored.alpha, "silhouette")
        return stored.alpha
    coverage = stored.values.mean(axis=2, dtype=np.float32)
    _check_finite(path, coverage, "silhouette")
    return np.clip(coverage, 0, 1)


def image_size(path: Path | str, reading: ImageReading | None = None) -> tuple[int, int]:
    """(width, height) from the header alone, nothing decoded.

    Parameters
    ----------
    path : Path or str
    reading : ImageReading, optional
        Says which layer; by default the first part or page counts.

    Raises
    ------
    CaptureError
        If the file is missing or not an image this package reads.
    """
    path = Path(path)
    header = read_header(path)
    if header.kind == "raw":
        return raw_size(path, header)
    if reading is None:
        return header.width, header.height
    layer = choose_layer(path, header, reading.layer)
    return layer.width, layer.height


def image_orientation(path: Path | str) -> int:
    """How a viewer would turn an image by its Exif data, 1 (not at all) to 8."""
    return read_header(Path(path)).orientation


def stated_exposure(path: Path | str) -> tuple[float, float, float]:
    """Seconds, f-number and ISO of a photograph by its Exif data, 0 where they do not say."""
    return read_header(Path(path)).exposure


def _read(path: Path, reading: ImageReading) -> StoredImage:
    header = read_header(path)
    return decode_stored(path, header, choose_layer(path, header, reading.layer))


def _seen_through(stored: StoredImage) -> Float32 | None:
    """Alpha that is not 1 everywhere."""
    alpha = stored.alpha
    return None if alpha is None or not (alpha < 1).any() else alpha


def _space(stored: StoredImage, reading: ImageReading) -> ColorSpace:
    return stored.stated() if reading.encoding is None else ColorSpace(reading.encoding)


def _linear(path: Path, stored: StoredImage, reading: ImageReading, what: str) -> Float32:
    """Linear RGB, before black where there is alpha."""
    space = _space(stored, reading)
    alpha = _seen_through(stored)
    if alpha is not None and not (alpha > 0).any() and stored.colour.any():
        raise CaptureError(
            f"{path}: expected an alpha that leaves something to see, received 0 everywhere; "
            "remove the channel"
        )
    if alpha is None:
        linear = _decoded(stored, space)
    elif not stored.premultiplied:
        linear = _decoded(stored, space) * alpha[..., None]
    elif stored.integer:  # multiplied after encoding
        shares = np.maximum(alpha, np.float32(1e-6))[..., None]
        values = np.clip(stored.values / shares, 0, 1).astype(np.float32)
        linear = space.linear(_three_channels(values)) * alpha[..., None]
    else:
        linear = _decoded(stored, space) * (alpha > 0)[..., None]
    _check_finite(path, linear, what)
    return np.ascontiguousarray(linear, np.float32)


def _decoded(stored: StoredImage, space: ColorSpace) -> Float32:
    """Linear RGB of stored colour; codes are looked up in a table of all there are."""
    top = stored.largest_code
    if top == 1 or stored.colour.size < top:
        return space.linear(_three_channels(stored.values))
    linear = _three_channels(_table(space.encoding, top)[stored.colour])
    if space.matrix is None:
        return linear
    return ColorSpace(Encoding(LINEAR), space.matrix).linear(linear)


@lru_cache(maxsize=8)
def _table(encoding: Encoding, largest_code: int) -> Float32:
    """Linear values of all codes."""
    codes = np.arange(largest_code + 1, dtype=np.float32)
    return encoding.decode(codes / np.float32(largest_code))


def _kinds(stored: StoredImage, reading: ImageReading) -> Kinds:
    """(h, w, 1 or 3): which stored values are no limits, and what the others are."""
    values = stored.values
    level = reading.white_level
    if level is not None:
        level /= stored.largest_code
    kinds = kinds_of_stored(values, integer=stored.integer, white_level=level)
    kinds[values > np.float32(_space(stored, reading).encoding.top)] = SATURATED
    if stored.saturated is not None:
        kinds[stored.saturated] = SATURATED
    if stored.alpha is not None:
        kinds[stored.alpha <= 0] = TRANSPARENT
    return kinds


def _three_channels(values: Float32) -> Float32:
    return values if values.shape[2] == 3 else values.repeat(3, axis=2)


def _check_finite(path: Path, image: Float32, what: str) -> None:
    if np.isfinite(image).all():
        return
    bad = ~np.isfinite(image.reshape(*image.shape[:2], -1)).all(axis=2)
    row, column = np.argwhere(bad)[0]
    raise CaptureError(
        f"{path}: expected finite values, received {int(bad.sum())} pixels with NaN or "
        f"infinity, first at row {row}, column {column}; repair or drop this {what}"
    )
