"""What image files say of their colour: PNG chunks, profiles, chromaticities, HDR lines."""

from __future__ import annotations

import math
import struct
import zlib
from functools import lru_cache
from pathlib import Path

from reflfield.capture.color_spaces import (
    ADOBE_GAMMA,
    ADOBE_RGB,
    LARGEST_PROFILE,
    P3_D65,
    REC709,
    REC2020,
    ColorSpace,
    rec709_from_primaries,
    space_of_profile,
)
from reflfield.capture.encoding import GAMMA_RANGE, LINEAR, SRGB, Encoding
from reflfield.capture.image_headers import ImageHeader
from reflfield.errors import CaptureError, InputError

# Of cICP (ITU-T H.273): primaries, and transfer functions that are honoured.
CICP_PRIMARIES = {1: REC709, 2: REC709, 9: REC2020, 12: P3_D65}
CICP_CURVES = {
    4: Encoding("gamma", gamma=2.2),
    5: Encoding("gamma", gamma=2.8),
    8: Encoding(LINEAR),
    13: Encoding(SRGB),
}
# Bytes of the chunks of a PNG that hold numbers.
_SIZES = {b"cICP": 4, b"gAMA": 4, b"cHRM": 32}


def stated_space(
    path: Path,
    header: ImageHeader,
    part: int,
    *,
    profile: bytes,
    is_float: bool,
) -> ColorSpace:
    """The colour space that a file states; sRGB for integers and linear for floats by default.

    Parameters
    ----------
    path : Path
        Named in messages.
    header : ImageHeader
    part : int
        Part or page that is read.
    profile : bytes
        The ICC profile of a JPEG or TIFF, or nothing.
    is_float : bool
        Whether the file holds floats.

    Returns
    -------
    ColorSpace

    Raises
    ------
    CaptureError
        If a statement cannot be honoured. The message names it and the remedy.
    """
    try:
        if header.kind == "exr":
            return _primaries(LINEAR, header.parts[part].chromaticities)
        if header.kind == "hdr":
            return _radiance_space(header.lines)
        if header.kind == "png":
            return _png_space(header.chunks)
        if profile:
            return _profile_space(profile)
        if header.adobe_rgb:
            return ColorSpace(
                Encoding("gamma", gamma=ADOBE_GAMMA), rec709_from_primaries(ADOBE_RGB)
            )
        page = header.pages[part] if header.pages else None
        if page and page.transfer:
            raise InputError("a TIFF with a transfer function of its own")
        return _primaries(LINEAR if is_float else SRGB, page.chromaticities if page else None)
    except InputError as error:
        raise CaptureError(
            f"{path}: expected colour that is understood, received {error}; convert the file "
            "to sRGB or linear Rec.709, or say how it is encoded (`encoding`), which replaces "
            "what the file says"
        ) from error


def radiance_scale(header: ImageHeader) -> tuple[float, ...]:
    """Radiance of the stored value 1 in red, green and blue of a Radiance file.

    The reciprocal of the exposures and colour corrections that it says were applied.
    """
    applied = [1.0, 1.0, 1.0]
    for line in header.lines:
        name, _, value = line.partition("=")
        if name in ("EXPOSURE", "COLORCORR"):
            factors = [_number(word) for word in value.split()]
            factors = factors * 3 if name == "EXPOSURE" else factors
            if len(factors) != 3:
                return (math.nan,) * 3
            applied = [a * factor for a, factor in zip(applied, factors, strict=True)]
    return tuple(1.0 / a if a > 0 else math.nan for a in applied)


@lru_cache(maxsize=16)
def _primaries(curve: str, chromaticities: tuple[float, ...] | None) -> ColorSpace:
    matrix = rec709_from_primaries(chromaticities) if chromaticities else None
    return ColorSpace(Encoding(curve), matrix)


@lru_cache(maxsize=16)
def _profile_space(profile: bytes) -> ColorSpace:
    return space_of_profile(profile)


def _png_space(chunks: dict[bytes, bytes]) -> ColorSpace:
    """What comes first in the order of PNG (third edition): cICP, iCCP, sRGB, gAMA, cHRM."""
    for name, n_bytes in _SIZES.items():
        if len(chunks.get(name, bytes(n_bytes))) != n_bytes:
            raise InputError(f"a chunk {name.decode()} that is not {n_bytes} bytes long")
    if b"cICP" in chunks:
        return _cicp_space(chunks[b"cICP"])
    if b"iCCP" in chunks:
        return _profile_space(_png_profile(chunks[b"iCCP"]))
    if b"sRGB" in chunks:
        return ColorSpace(Encoding(SRGB))
    encoding = Encoding(SRGB)
    if b"gAMA" in chunks:
        exponent = struct.unpack(">I", chunks[b"gAMA"])[0] / 100_000
        encoding = _power(1 / exponent if exponent else math.nan)
    matrix = None
    if b"cHRM" in chunks:
        white_first = [n / 100_000 for n in struct.unpack(">8I", chunks[b"cHRM"])]
        matrix = rec709_from_primaries((*white_first[2:], *white_first[:2]))
    return ColorSpace(encoding, matrix)


def _png_profile(content: bytes) -> bytes:
    """The profile in an iCCP chunk: a name, a zero, the method 0, and the packed profile."""
    packed = content[content.find(b"\0") + 2 :]
    try:
        return zlib.decompressobj().decompress(packed, LARGEST_PROFILE)
    except zlib.error as error:
        raise InputError("an ICC profile that is damaged") from error


def _power(gamma: float) -> Encoding:
    if not GAMMA_RANGE[0] <= gamma <= GAMMA_RANGE[1]:
        raise InputError(f"a gamma of {gamma:g}")
    return Encoding(LINEAR) if abs(gamma - 1) < 1e-4 else Encoding("gamma", gamma=gamma)


def _cicp_space(content: bytes) -> ColorSpace:
    primaries, transfer, matrix, full_range = content
    if primaries not in CICP_PRIMARIES or transfer not in CICP_CURVES or matrix != 0:
        raise InputError(
            f"coding-independent code points (cICP) of primaries {primaries}, transfer "
            f"{transfer} and matrix {matrix}"
        )
    if full_range != 1:
        raise InputError("values of narrow range (cICP)")
    return ColorSpace(CICP_CURVES[transfer], rec709_from_primaries(CICP_PRIMARIES[primaries]))


def _radiance_space(lines: tuple[str, ...]) -> ColorSpace:
    values = dict(line.partition("=")[::2] for line in lines if "=" in line)
    if abs(_number(values.get("GAMMA", "1")) - 1) > 1e-3:
        raise InputError(f"a Radiance file of GAMMA {values['GAMMA'][:40]!r}")
    words = values.get("PRIMARIES", "").split()
    chromaticities = tuple(_number(word) for word in words)
    if chromaticities and len(chromaticities) != 8:
        raise InputError(f"a Radiance file of PRIMARIES {' '.join(words)[:80]!r}")
    return _primaries(LINEAR, chromaticities)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
