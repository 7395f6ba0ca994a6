"""Image files: linear float32 in, OpenEXR and PNG out.

Reading always gives linear RGB, float32, (height, width, 3). EXR files are linear as they
are; PNG, JPEG and TIFF are taken as sRGB and decoded, 16 bits kept. EXIF orientation and
colour profiles are ignored: a calibration speaks of the pixels as stored.

Writers write to a temporary name first and rename, so a killed run leaves no half file.
"""

from __future__ import annotations

import io
import os
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray
from PIL import JpegImagePlugin, PngImagePlugin, TiffImagePlugin
from PIL.Image import Image

from reflfield.capture.clipping import measured_values
from reflfield.errors import CaptureError, InputError, ShapeError

Float32 = NDArray[np.float32]
Window = tuple[NDArray[np.int64], NDArray[np.int64]]

# A header that asks for more is damaged or hostile: 2^28 pixels are 3 GB of float32 RGB.
MAX_PIXELS = 2**28

# Bracketed exposures: an encoded value this close to 0 or 1 says nothing about radiance.
BRACKET_MARGIN = 0.02

EXR_MAGIC = b"\x76\x2f\x31\x01"
_PLUGINS: dict[bytes, Any] = {
    b"\x89PNG": PngImagePlugin.PngImageFile,
    b"\xff\xd8\xff": JpegImagePlugin.JpegImageFile,
    b"II*\x00": TiffImagePlugin.TiffImageFile,
    b"MM\x00*": TiffImagePlugin.TiffImageFile,
}


def decode_srgb(encoded: ArrayLike) -> NDArray[np.floating[Any]]:
    r"""Linear values of sRGB-encoded ones (IEC 61966-2-1), both in [0, 1].

    :math:`c / 12.92` up to 0.04045, else :math:`((c + 0.055) / 1.055)^{2.4}`.

    Examples
    --------
    >>> decode_srgb([0.0, 0.5, 1.0]).round(4)
    array([0.   , 0.214, 1.   ])
    """
    values = _floating(encoded)
    curved = ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(values <= 0.04045, values / 12.92, curved).astype(values.dtype)


def encode_srgb(linear: ArrayLike) -> NDArray[np.floating[Any]]:
    """sRGB-encoded values of linear ones, clipped to [0, 1]; inverse of `decode_srgb`.

    Examples
    --------
    >>> encode_srgb([0.0, 0.214, 1.0, 7.0]).round(3)
    array([0. , 0.5, 1. , 1. ])
    """
    values = np.clip(_floating(linear), 0.0, 1.0)
    curved = 1.055 * np.maximum(values, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(values <= 0.0031308, values * 12.92, curved).astype(values.dtype)


def read_image(path: Path | str) -> Float32:
    """Read an image as linear RGB.

    Parameters
    ----------
    path : Path or str
        EXR, PNG, JPEG or TIFF, told apart by content.

    Returns
    -------
    (height, width, 3) float32
        Linear; grey is repeated over the channels, alpha dropped.

    Raises
    ------
    CaptureError
        If the file is missing, truncated, of another kind, absurdly large, or holds
        NaN or infinity. The message names the file.
    """
    path = Path(path)
    image = _exr_rgb(path) if _is_exr(path) else _decoded(path)
    _check_finite(path, image)
    return image


def read_measured(
    path: Path | str, white_level: float | None = None
) -> tuple[Float32, NDArray[np.bool_]]:
    """Read an image as linear RGB, and which of its values are neither too bright nor too dark.

    Parameters
    ----------
    path : Path or str
        As `read_image`.
    white_level : float, optional
        Stored value from which on the sensor is saturated (`capture.clipping`).

    Returns
    -------
    image : (h, w, 3) float32
    measured : (h, w, 3) bool
    """
    path = Path(path)
    if _is_exr(path):
        image = read_image(path)
        return image, measured_values(image, integer=False, white_level=white_level)
    encoded = read_encoded(path)
    colour = _three_channels(encoded)
    measured = measured_values(colour, integer=True, white_level=white_level)
    if encoded.shape[2] in (2, 4):
        measured &= encoded[..., -1:] > 0
    image = decode_srgb(colour).astype(np.float32)
    _check_finite(path, image)
    return image, measured


def read_encoded(path: Path | str) -> Float32:
    """Read an 8- or 16-bit image without decoding sRGB: (h, w, channels) in [0, 1]."""
    path = Path(path)
    with _named(path, "PNG, JPEG or TIFF"), _picture(path) as picture:
        _check_size(path, *picture.size)
        if _bits(path, picture) <= 8:
            return np.asarray(_eight_bit(picture), dtype=np.float32) / np.float32(255)
        picture.load()  # raises on a truncated file, which OpenCV before 5 fills with grey
        return _sixteen_bit(path)


def read_exposure(path: Path | str) -> Float32:
    """Read one of several bracketed exposures: sRGB-encoded RGB, (h, w, 3) in [0, 1].

    An EXR is taken as linear up to the sensor's saturation at 1, and encoded.
    """
    path = Path(path)
    if _is_exr(path):
        return encode_srgb(read_image(path)).astype(np.float32)
    return _three_channels(read_encoded(path))


def read_coverage(path: Path | str) -> Float32:
    """Read a silhouette: the fraction of each pixel that the object covers.

    Parameters
    ----------
    path : Path or str
        8- or 16-bit grey (white = object); of an image with an alpha channel that is not
        opaque everywhere, alpha is taken. EXR: channel A, else Y, else the mean of RGB.

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
    if _is_exr(path):
        channels = _exr_channels(path)
        names = [name for name in ("A", "Y") if name in channels]
        coverage = channels[names[0]] if names else _select_rgb(path, channels).mean(axis=2)
        coverage = coverage.astype(np.float32)
        _check_finite(path, coverage)
        return np.clip(coverage, 0, 1)
    encoded = read_encoded(path)
    has_alpha = encoded.shape[2] in (2, 4) and bool((encoded[..., -1] < 1).any())
    return encoded[..., -1] if has_alpha else encoded[..., :3].mean(axis=2, dtype=np.float32)


def image_size(path: Path | str) -> tuple[int, int]:
    """(width, height) from the header alone, nothing decoded.

    Raises
    ------
    CaptureError
        If the file is missing or not an image this package reads.
    """
    path = Path(path)
    if _is_exr(path):
        low, high = _exr_windows(path)[0]
        return int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)
    with _named(path, "PNG, JPEG or TIFF"), _picture(path) as picture:
        width, height = picture.size
    return int(width), int(height)


def merge_exposures(encoded: Sequence[Float32], seconds: Sequence[float]) -> Float32:
    r"""Merge sRGB-encoded exposures of one scene to linear radiance.

    :math:`L = \sum_i w(z_i)\, g(z_i) \,/\, \sum_i w(z_i)\, t_i` with the hat
    :math:`w(z) = \min(z, 1 - z)` less a margin, `g` the sRGB decoding and `t` the exposure
    time: the maximum-likelihood estimate under photon noise. Where every exposure is
    saturated the shortest one counts, where every one is black the longest.

    Parameters
    ----------
    encoded : sequence of (h, w, 3) float32
        Values in [0, 1] as stored in the files.
    seconds : sequence of float
        Exposure times, > 0.

    Returns
    -------
    (h, w, 3) float32
        Radiance per second of exposure.

    Raises
    ------
    InputError
        If there are no exposures, a time is not positive, or the sizes differ.

    References
    ----------
    .. [1] P. Debevec, J. Malik, "Recovering high dynamic range radiance maps from
       photographs", SIGGRAPH 1997.

    Examples
    --------
    Half a second at encoded .5 (linear .214) is radiance .428; the saturated one is ignored:

    >>> grey, white = np.full((1, 1, 3), 0.5), np.ones((1, 1, 3))
    >>> merge_exposures([grey, white], [0.5, 4.0]).round(3)
    array([[[0.428, 0.428, 0.428]]], dtype=float32)
    """
    order = _exposure_order(encoded, seconds)
    total, time = np.zeros_like(encoded[0], np.float64), np.zeros_like(encoded[0], np.float64)
    for i in order:
        weight = np.clip(np.minimum(encoded[i], 1 - encoded[i]) - BRACKET_MARGIN, 0, None)
        total += weight * decode_srgb(encoded[i].astype(np.float64))
        time += weight * seconds[i]
    shortest, longest = order[0], order[-1]
    bright = encoded[shortest] > 0.5
    fallback = np.where(
        bright,
        decode_srgb(encoded[shortest]) / seconds[shortest],
        decode_srgb(encoded[longest]) / seconds[longest],
    )
    weighted = total / np.where(time > 0, time, 1)
    return np.where(time > 0, weighted, fallback).astype(np.float32)


def measured_exposures(encoded: Sequence[Float32]) -> NDArray[np.bool_]:
    """True where at least one of several bracketed exposures measures, (h, w, 3)."""
    measured = np.zeros(encoded[0].shape, dtype=bool)
    for image in encoded:
        measured |= measured_values(image, integer=True)
    return measured


def write_exr(
    path: Path | str,
    image: NDArray[Any],
    names: Sequence[str] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write an OpenEXR image, ZIP-compressed, atomically.

    Parameters
    ----------
    path : Path or str
        Target; replaced only when the new file is complete.
    image : (height, width) or (height, width, channels) float16 or float32
        float16 is stored as half, everything else as float.
    names : sequence of str, optional
        Channel names; by default ``R G B`` for three channels, ``R G B A`` for four and
        ``Y`` for one.
    attributes : mapping, optional
        Further header attributes, such as ``{"comments": "..."}``.

    Raises
    ------
    ShapeError
        If the names do not match the channels.
    """
    stack = image[..., None] if image.ndim == 2 else image
    if stack.dtype != np.float16:
        stack = stack.astype(np.float32)
    names = list(names) if names is not None else _default_names(stack.shape[-1])
    if stack.ndim != 3 or len(names) != stack.shape[2]:
        raise ShapeError(
            f"image: expected (height, width, {len(names)}) for channels {names}, "
            f"received {image.shape}"
        )
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header.update(attributes or {})
    channels = {name: np.ascontiguousarray(stack[..., i]) for i, name in enumerate(names)}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, channels).write(str(temporary))


def write_png(path: Path | str, encoded: NDArray[Any]) -> None:
    """Write an 8- or 16-bit PNG, atomically.

    Parameters
    ----------
    path : Path or str
        Target; replaced only when the new file is complete.
    encoded : (h, w), (h, w, 1), (h, w, 3) or (h, w, 4) uint8 or uint16
        Grey, RGB or RGBA, already encoded.

    Raises
    ------
    ShapeError
        If shape or dtype is another.
    """
    channels = 1 if encoded.ndim == 2 else encoded.shape[-1]
    if encoded.dtype not in (np.uint8, np.uint16) or channels not in (1, 3, 4):
        raise ShapeError(
            "encoded: expected uint8 or uint16 of shape (h, w), (h, w, 3) or (h, w, 4), "
            f"received {encoded.dtype} {encoded.shape}; encode with encode_srgb first"
        )
    blue_first = [2, 1, 0, 3][:channels]
    stored = np.ascontiguousarray(encoded if channels == 1 else encoded[..., blue_first])
    ok, buffer = cv2.imencode(".png", stored)
    if not ok:
        raise InputError(f"{path}: OpenCV could not encode this image as PNG")
    write_bytes(path, buffer.tobytes())


def write_bytes(path: Path | str, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary name beside `path`; rename it on success, remove it on failure."""
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _floating(values: ArrayLike) -> NDArray[np.floating[Any]]:
    array = np.asarray(values)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


@contextmanager
def _named(path: Path, expected: str) -> Iterator[None]:
    """Turn whatever a decoder raises into an error that names the file."""
    try:
        yield
    except CaptureError:
        raise
    except (OSError, ValueError, RuntimeError, SyntaxError, KeyError, cv2.error) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise CaptureError(
            f"{path}: expected {expected}, received a damaged, truncated or different file "
            f"({text}); copy or export it again"
        ) from error


def _magic(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(4)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error})") from error


def _is_exr(path: Path) -> bool:
    return _magic(path) == EXR_MAGIC


@contextmanager
def _picture(path: Path) -> Iterator[Image]:
    """Open a PNG, JPEG or TIFF; only its header is read until its pixels are asked for.

    The plugins are called directly: `PIL.Image.open` has a global size limit that warns.
    """
    magic = _magic(path)
    for start, plugin in _PLUGINS.items():
        if magic.startswith(start):
            with plugin(str(path)) as picture:
                yield picture
            return
    raise CaptureError(
        f"{path}: expected an EXR, PNG, JPEG or TIFF image, received a file that starts with "
        f"{magic!r}"
    )


def _check_size(path: Path, width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise CaptureError(
            f"{path}: expected an image of 1 to {MAX_PIXELS} pixels, "
            f"received {width} x {height}"
        )


def _bits(path: Path, picture: Image) -> int:
    """Bits per channel as stored (Pillow itself reduces 16-bit RGB to 8)."""
    if isinstance(picture, PngImagePlugin.PngImageFile):
        with path.open("rb") as file:
            return file.read(25)[24]
    if isinstance(picture, TiffImagePlugin.TiffImageFile):
        return int(max(picture.tag_v2.get(258, (1,))))
    return 8


def _eight_bit(picture: Image) -> NDArray[np.uint8]:
    """(h, w, 1 | 2 | 3 | 4) values of an 8-bit picture."""
    if picture.mode not in ("L", "LA", "RGB", "RGBA"):
        transparent = picture.mode == "PA" or "transparency" in picture.info
        gray = picture.mode in ("1", "I", "F")
        mode = "RGBA" if transparent else "L" if gray else "RGB"
        values = np.asarray(picture.convert(mode))
    else:
        values = np.asarray(picture)
    return values[..., None] if values.ndim == 2 else values


def _sixteen_bit(path: Path) -> Float32:
    """(h, w, 1 | 3 | 4) values in [0, 1] of a 16-bit or float file, by OpenCV."""
    stored = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise ValueError("OpenCV cannot decode it")
    values = stored[..., None] if stored.ndim == 2 else stored
    if values.shape[2] >= 3:
        values = values[..., [2, 1, 0, 3][: values.shape[2]]]
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
    return values.astype(np.float32)


def _decoded(path: Path) -> Float32:
    """Linear RGB of an 8- or 16-bit file."""
    return decode_srgb(_three_channels(read_encoded(path))).astype(np.float32)


def _three_channels(encoded: Float32) -> Float32:
    """RGB without alpha; grey is repeated."""
    return encoded[..., :3] if encoded.shape[2] >= 3 else encoded[..., :1].repeat(3, axis=2)


def _exr_rgb(path: Path) -> Float32:
    image = _select_rgb(path, _exr_channels(path))
    return np.ascontiguousarray(image, dtype=np.float32)


class _Quiet:
    """Keeps what is printed from standard output, also where threads overlap.

    `contextlib.redirect_stdout` gives each thread back what it found: of two that overlap, the
    second found the first one's buffer, and leaves it in place for good.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._outer: TextIO = sys.stdout

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._outer, sys.stdout = sys.stdout, io.StringIO()
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                sys.stdout = self._outer


_QUIET = _Quiet()


def _exr_channels(path: Path) -> dict[str, Float32]:
    """All channels of the first part, placed in the display window."""
    display, data = _exr_windows(path)
    for low, high in (display, data):
        _check_size(path, *(int(n) for n in high - low + 1))
    with (
        _named(path, "an OpenEXR image"),
        # Of a damaged file OpenEXR prints a warning besides failing: the error says it.
        _QUIET,
        OpenEXR.File(str(path), separate_channels=True) as file,
    ):
        return {
            name: _in_display_window(channel.pixels, display, data)
            for name, channel in file.channels().items()
        }


def _exr_windows(path: Path) -> tuple[Window, Window]:
    """Display and data window of an EXR: lowest and highest (x, y), both included."""
    with (
        _named(path, "an OpenEXR image"),
        OpenEXR.File(str(path), header_only=True) as file,
    ):
        header = file.header()
        display, data = (
            np.array(header[name], dtype=np.int64) for name in ("displayWindow", "dataWindow")
        )
    return (display[0], display[1]), (data[0], data[1])


def _in_display_window(pixels: NDArray[Any], display: Window, data: Window) -> Float32:
    """Crop or pad (with 0) a data window to the display window."""
    size = display[1] - display[0] + 1
    image = np.zeros((size[1], size[0]), dtype=np.float32)
    first, last = np.maximum(display[0], data[0]), np.minimum(display[1], data[1]) + 1
    if (first < last).all():
        (x0, y0), (x1, y1) = first - display[0], last - display[0]
        (u0, v0), (u1, v1) = first - data[0], last - data[0]
        image[y0:y1, x0:x1] = pixels[v0:v1, u0:u1]
    return image


def _select_rgb(path: Path, channels: Mapping[str, Float32]) -> Float32:
    """R, G, B by name, else by suffix of the first layer, else Y, else a single channel."""
    layers = sorted({n.removesuffix("R") for n in channels if n == "R" or n.endswith(".R")})
    for layer in layers:
        names = [layer + letter for letter in "RGB"]
        if all(name in channels for name in names):
            return np.stack([channels[name] for name in names], axis=-1)
    grey = [n for n in channels if n == "Y" or n.endswith(".Y")]
    grey = sorted(grey, key=len) or (list(channels) if len(channels) == 1 else [])
    if grey:
        return np.repeat(channels[grey[0]][..., None], 3, axis=2)
    raise CaptureError(
        f"{path}: expected channels R, G, B (or Y), received {', '.join(sorted(channels))}"
    )


def _check_finite(path: Path, image: Float32) -> None:
    if np.isfinite(image).all():
        return
    bad = ~np.isfinite(image.reshape(*image.shape[:2], -1)).all(axis=2)
    row, column = np.argwhere(bad)[0]
    raise CaptureError(
        f"{path}: expected finite values, received {int(bad.sum())} pixels with NaN or "
        f"infinity, first at row {row}, column {column}; repair or drop this photograph"
    )


def _exposure_order(encoded: Sequence[Float32], seconds: Sequence[float]) -> list[int]:
    """Indices from the shortest to the longest exposure, after checking them."""
    if not encoded or len(encoded) != len(seconds):
        raise InputError(
            f"exposures: expected one time per image and at least one image, "
            f"received {len(encoded)} images and {len(seconds)} times"
        )
    if not all(np.isfinite(t) and t > 0 for t in seconds):
        raise InputError(f"exposures: expected seconds > 0, received {list(seconds)}")
    shapes = {image.shape for image in encoded}
    if len(shapes) > 1:
        raise InputError(f"exposures: expected images of one size, received {sorted(shapes)}")
    return sorted(range(len(seconds)), key=lambda i: seconds[i])


def _default_names(n_channels: int) -> list[str]:
    names = {1: ["Y"], 3: ["R", "G", "B"], 4: ["R", "G", "B", "A"]}.get(n_channels)
    if names is None:
        raise ShapeError(
            f"names: expected channel names for {n_channels} channels, received None"
        )
    return names
