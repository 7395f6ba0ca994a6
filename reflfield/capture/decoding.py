"""Stored pixels of image files, through OpenImageIO and, for camera raw files, rawpy.

Results depend on the file alone: colour is never converted by the library, so that neither its
configuration nor OpenColorIO's enters, and its own threads are off, since whoever reads many
files reads several at once. Its errors become `CaptureError`; it prints nothing.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from reflfield.capture.color_spaces import LARGEST_PROFILE, ColorSpace
from reflfield.capture.encoding import LINEAR, Encoding
from reflfield.capture.image_headers import READABLE, ImageHeader, check_png, check_size
from reflfield.capture.image_layers import Layer
from reflfield.capture.stated_color import radiance_scale, stated_space
from reflfield.errors import CaptureError
from reflfield.util.files import utf8_name
from reflfield.util.late_import import LateImport

cv2: Any = LateImport("cv2")
Float32 = NDArray[np.float32]

FORMATS = {"exr": "openexr", "png": "png", "jpeg": "jpeg", "tiff": "tiff", "hdr": "hdr"}
RAW_HINT = "pip install 'reflfield[raw]' to have it developed, or convert it to a 16-bit TIFF"
# Sensors are full a little below the level that their makers state.
SATURATED_SHARE = 0.98
_FLOATS = ("half", "float", "double")
_INTEGERS = ("uint8", "uint16", "uint")

LARGEST_CODES = {"uint8": 255, "uint16": 65535}

# One process may read in many threads of its own.
oiio.attribute("threads", 1)
oiio.attribute("exr_threads", -1)  # none but the caller's
oiio.attribute("try_all_readers", 1)  # a wrong suffix does no harm
oiio.attribute("oiio:print_uncaught_errors", 0)
# Which of two readers opens an EXR is a global setting; only one knows luminance and chroma.
_EXR_READER = threading.Lock()


@dataclass(frozen=True, eq=False)
class StoredImage:
    """Pixels as a file has them, and what they mean.

    Parameters
    ----------
    colour : (h, w, 3) or (h, w, 1) uint8, uint16 or float32
        Codes of integer files of up to 16 bits, else values; those of 32 bits in [0, 1].
    alpha : (h, w) float32 or None
        In [0, 1]; None where there is none.
    integer : bool
        Whether the file holds integers.
    premultiplied : bool
        Whether colour was multiplied by alpha before it was stored.
    stated : callable
        Gives the colour space that the file states, or refuses it.
    saturated : (h, w) bool or None
        Of camera raw files, where the sensor was full: developed values do not tell.
    """

    colour: NDArray[Any]
    alpha: Float32 | None
    integer: bool
    premultiplied: bool
    stated: Callable[[], ColorSpace]
    saturated: NDArray[np.bool_] | None = None

    @property
    def largest_code(self) -> int:
        """What a code is divided by; 1 of values."""
        return LARGEST_CODES.get(self.colour.dtype.name, 1)

    @property
    def values(self) -> Float32:
        """Colour with 1 for the largest code, (h, w, channels) float32."""
        top = self.largest_code
        return self.colour if top == 1 else self.colour.astype(np.float32) / np.float32(top)


def decode_stored(
    path: Path, header: ImageHeader, layer: Layer, factor: int = 1
) -> StoredImage:
    """Decode one layer of a file.

    Parameters
    ----------
    path : Path
    header : ImageHeader
        What `read_header` says of it.
    layer : Layer
        What `choose_layer` chose.
    factor : {1, 2, 4, 8}, optional
        By which a JPEG is made smaller while it is decoded, in a fraction of the time.

    Returns
    -------
    StoredImage
        Of an EXR its display window; zero where that has no data.

    Raises
    ------
    CaptureError
        If the file is damaged, truncated, or of a kind of pixel that is no photograph.
    """
    if header.kind == "raw":
        return _developed(path, header)
    if header.kind == "png":
        check_png(path)
    with _named(path), _opened(path, header, layer) as file:
        spec = file.spec()
        names = layer.colour or _colour_names(path, spec)
        alpha = layer.alpha or _alpha_name(spec)
        _check_pixels(path, header, layer, spec)
        wanted = [*names, *([alpha] if alpha else [])]
        small = _reduced_jpeg(path, spec, factor) if factor > 1 else None
        pixels = small
        if pixels is None:
            pixels = _pixels(path, file, spec, header, layer, wanted)
        stated = partial(
            stated_space,
            path,
            header,
            layer.part,
            profile=_profile(spec),
            is_float=pixels.dtype == np.float32 and str(spec.format) in _FLOATS,
        )
        straight = header.kind == "png" or bool(
            spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
        )
    colour = pixels[..., : len(names)]
    return StoredImage(
        colour=colour,
        alpha=_share(pixels[..., -1]) if alpha else None,
        integer=str(spec.format) in _INTEGERS,
        premultiplied=not straight,
        stated=stated,
    )


def _reduced_jpeg(path: Path, spec: Any, factor: int) -> NDArray[Any] | None:
    """A whole JPEG of one or three channels, smaller by a factor; None for other files."""
    flags = {
        1: {2: cv2.IMREAD_REDUCED_GRAYSCALE_2, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
            8: cv2.IMREAD_REDUCED_GRAYSCALE_8},
        3: {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4,
            8: cv2.IMREAD_REDUCED_COLOR_8},
    }.get(spec.nchannels, {})  # fmt: skip
    content = path.read_bytes()
    if factor not in flags or not content.endswith(b"\xff\xd9"):  # the end of a whole JPEG
        return None
    stored = np.frombuffer(content, np.uint8)
    pixels = cv2.imdecode(stored, flags[factor] | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        return None
    return pixels[..., None] if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1])


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Turn what the library raises, such as on text that is none, into a `CaptureError`."""
    try:
        yield
    except CaptureError:
        raise
    except (OSError, ValueError, RuntimeError, LookupError, TypeError, MemoryError) as error:
        raise _damaged(path, str(error) or type(error).__name__) from error


def _error_of(source: Any) -> str:
    """What the library, or a file that it reads, has to say of what went wrong; once."""
    try:
        return str(source.geterror())
    except UnicodeError:
        return "it holds text that is none"


@contextmanager
def _opened(path: Path, header: ImageHeader, layer: Layer) -> Iterator[Any]:
    """A file that the library reads, at the part or page that is wanted."""
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1  # as stored: never multiplied on reading
    with _exr_reader(header, layer):
        file = oiio.ImageInput.open(utf8_name(path, CaptureError), config)
    if file is None:
        raise _damaged(path, _error_of(oiio))
    try:
        if file.format_name() != FORMATS[header.kind]:
            raise CaptureError(
                f"{path}: expected a suffix that fits a file of kind {header.kind}, received "
                f"{path.suffix!r}; rename it"
            )
        if not file.seek_subimage(layer.part, 0):
            raise _damaged(path, _error_of(file))
        yield file
    finally:
        file.close()
        _error_of(oiio)  # of this thread; left there it would be printed at its end


@contextmanager
def _exr_reader(header: ImageHeader, layer: Layer) -> Iterator[None]:
    """Choose the reader of OpenEXR files that knows luminance and chroma, where needed."""
    if not header.parts or not header.parts[layer.part].luminance_chroma:
        yield
        return
    with _EXR_READER:
        oiio.attribute("openexr:core", 0)
        try:
            yield
        finally:
            oiio.attribute("openexr:core", 1)


def _pixels(
    path: Path, file: Any, spec: Any, header: ImageHeader, layer: Layer, names: list[str]
) -> NDArray[Any]:
    """Channels by name, (h, w, n)."""
    stored_names = spec.channelnames
    missing = [name for name in names if name not in stored_names]
    if missing:
        raise _damaged(path, f"no channel {missing[0]}")
    indices = [stored_names.index(name) for name in names]
    check_size(path, spec.width, spec.height, path.stat().st_size)
    stored_type = str(spec.format)
    wanted = "float" if stored_type in _FLOATS else stored_type
    together = indices == list(range(indices[0], indices[0] + len(indices)))
    runs = [(indices[0], indices[-1] + 1)] if together else [(i, i + 1) for i in indices]
    read = [file.read_image(layer.part, 0, *run, wanted) for run in runs]
    error = _error_of(file)
    if error or any(pixels is None for pixels in read):
        raise _damaged(path, error)
    pixels = read[0] if together else np.concatenate(read, axis=2)
    if stored_type == "uint":
        pixels = (pixels / (2**32 - 1)).astype(np.float32)
    if header.kind == "exr":
        return _in_display_window(path, pixels, header, layer)
    if header.kind == "tiff" and _inverted(header, layer):
        top = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
        pixels = (top - pixels).astype(pixels.dtype)
    if header.kind == "hdr":
        pixels = pixels * np.array(radiance_scale(header), np.float32)
    return pixels


def _inverted(header: ImageHeader, layer: Layer) -> bool:
    """Whether white is zero and the library leaves it so: it inverts up to 8 bits itself."""
    page = header.pages[layer.part]
    return page.photometric == 0 and page.bits > 8


def _in_display_window(
    path: Path, pixels: NDArray[Any], header: ImageHeader, layer: Layer
) -> NDArray[Any]:
    """Crop or pad (with 0) a data window to the display window, which has a part of it."""
    display = header.parts[layer.part].display_window
    data = header.parts[layer.part].data_window
    if display == data:
        return pixels
    image = np.zeros((layer.height, layer.width, pixels.shape[2]), pixels.dtype)
    x0, y0 = max(display.left, data.left), max(display.top, data.top)
    x1, y1 = min(display.right, data.right) + 1, min(display.bottom, data.bottom) + 1
    if x0 >= x1 or y0 >= y1:
        raise CaptureError(
            f"{path}: expected pixels inside the display window {tuple(display)}, "
            f"received the data window {tuple(data)}, which lies outside of it; "
            "correct the windows"
        )
    image[y0 - display.top : y1 - display.top, x0 - display.left : x1 - display.left] = pixels[
        y0 - data.top : y1 - data.top, x0 - data.left : x1 - data.left
    ]
    return image


def _check_pixels(path: Path, header: ImageHeader, layer: Layer, spec: Any) -> None:
    """Demand pixels that are unsigned integers or floats of grey or RGB."""
    stored = str(spec.format)
    what = ""
    if header.kind == "exr" and header.parts[layer.part].deep:
        what = "deep pixels, which are lists of samples; flatten it"
    elif stored not in (*_FLOATS, *_INTEGERS):
        what = f"values of type {stored}; export unsigned integers or floats"
    elif header.kind == "exr" and stored == "uint":
        what = "integers, which are identifiers; export floats"
    elif header.kind == "tiff":
        page = header.pages[layer.part]
        if page.photometric not in (0, 1, 2, 3, 6):
            what = "colour that is neither grey nor RGB (CMYK, Lab or another); convert it"
        elif page.photometric == 0 and page.sample_format == 3:
            what = "floats of which white is zero; convert it"
    if what:
        raise CaptureError(f"{path}: expected a photograph in grey or RGB, received {what}")


def _colour_names(path: Path, spec: Any) -> tuple[str, ...]:
    names = tuple(spec.channelnames)
    if names[:3] == ("R", "G", "B"):
        return names[:3]
    if names[:1] in (("Y",), ("I",)):
        return names[:1]
    raise CaptureError(
        f"{path}: expected grey or RGB, received channels {', '.join(names[:20])}; convert it"
    )


def _alpha_name(spec: Any) -> str:
    return spec.channelnames[spec.alpha_channel] if spec.alpha_channel >= 0 else ""


def _profile(spec: Any) -> bytes:
    """The ICC profile of a file; empty where there is none."""
    profile = spec.getattribute("ICCProfile")
    return b"" if profile is None else np.asarray(profile, np.uint8).tobytes()[:LARGEST_PROFILE]


def _share(channel: NDArray[Any]) -> Float32:
    """Alpha in [0, 1]."""
    if channel.dtype.kind == "f":
        return np.clip(channel, 0, 1)
    return channel.astype(np.float32) / np.float32(np.iinfo(channel.dtype).max)


def raw_library() -> Any:
    """The module rawpy, or None where it is not installed."""
    try:
        return importlib.import_module("rawpy")
    except ImportError:
        return None


def raw_size(path: Path, header: ImageHeader) -> tuple[int, int]:
    """(width, height) of a camera raw file as it is developed.

    Raises
    ------
    CaptureError
        If it cannot be read or rawpy is not installed.
    """
    with _raw(path, header) as raw:
        return int(raw.sizes.width), int(raw.sizes.height)


def _developed(path: Path, header: ImageHeader) -> StoredImage:
    """A raw file, demosaiced: linear Rec.709, the camera's white balance, not brightened."""
    with _raw(path, header) as raw:
        check_size(path, raw.sizes.width, raw.sizes.height, path.stat().st_size)
        unknown = _unknown(raw)
        if unknown:
            raise CaptureError(
                f"{path}: expected a camera raw file that LibRaw knows, received one without "
                f"{unknown} ({header.raw}); convert it to a 16-bit TIFF"
            )
        pixels = raw.postprocess(
            gamma=(1, 1),
            no_auto_bright=True,
            use_camera_wb=True,
            output_bps=16,
            output_color=raw_library().ColorSpace.sRGB,
            user_flip=0,  # as stored
        )
        saturated = _saturated(raw, pixels.shape[:2])
    space = ColorSpace(Encoding(LINEAR))
    return StoredImage(pixels, None, True, False, lambda: space, saturated)


def _saturated(raw: Any, shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Pixels that saturated ones have a part in, which demosaicing spreads to neighbours."""
    values = raw.raw_image_visible
    if values.shape != shape:
        return None
    full = (values >= SATURATED_SHARE * raw.white_level).astype(np.uint8)
    spread: NDArray[np.uint8] = cv2.dilate(full, np.ones((5, 5), np.uint8))
    return spread > 0


def _unknown(raw: Any) -> str:
    """What LibRaw does not know and would make up; empty if it is nothing."""
    if raw.num_colors == 1:
        return ""
    if not raw.color_matrix.any() and not raw.rgb_xyz_matrix.any():
        return "the camera's primaries"
    if min(raw.camera_whitebalance[:3]) <= 0:
        return "the camera's white balance"
    return ""


@contextmanager
def _raw(path: Path, header: ImageHeader) -> Iterator[Any]:
    rawpy = raw_library()
    if rawpy is None:
        raise CaptureError(
            f"{path}: expected {READABLE}, received a camera raw file ({header.raw}); "
            f"{RAW_HINT}"
        )
    try:
        with rawpy.imread(utf8_name(path, CaptureError)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        raise CaptureError(
            f"{path}: expected a camera raw file ({header.raw}), received one that LibRaw "
            f"cannot read ({error}); convert it to a 16-bit TIFF"
        ) from error


def _damaged(path: Path, text: str) -> CaptureError:
    reason = " ".join(text.replace(str(path), "").split())[:300] or "it cannot be decoded"
    return CaptureError(
        f"{path}: expected {READABLE}, received a damaged, truncated or different file "
        f"({reason}); copy or export it again"
    )
