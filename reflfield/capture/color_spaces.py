"""Colour spaces that image files state: primaries, transfer curves, ICC profiles.

Everything is brought to linear values of the primaries of Rec.709 (sRGB) with white D65.
What cannot be honoured is refused, naming it; it is never ignored.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.encoding import SRGB, Encoding, decode_srgb
from reflfield.errors import InputError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# x and y of red, green, blue and white (ITU-R BT.709, BT.2020, SMPTE EG 432-1, Adobe RGB 1998).
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
P3_D65 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
ADOBE_GAMMA = 563 / 256
# Relative luminance of linear Rec.709, the primaries that all radiance is stored in.
LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)
# The same for images in single precision.
LUMINANCE = np.array(LUMINANCE_WEIGHTS, np.float32)
# Differences of chromaticities, and of what profiles say, that are rounding.
SAME_CHROMATICITY = 2e-3
SAME_MATRIX = 5e-3
SAME_CURVE = 3e-3
# White of the connection space of ICC profiles (D50).
ICC_WHITE = np.array([0.9642, 1.0, 0.8249])
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
LARGEST_PROFILE = 1 << 24
MOST_ICC_TAGS = 100


def luminance(radiance: ArrayLike) -> Float64:
    """Relative luminance of linear Rec.709 colours.

    Parameters
    ----------
    radiance : (..., 3) array_like
        Linear radiance.

    Returns
    -------
    (...) float64

    Examples
    --------
    >>> float(luminance([1.0, 0.0, 0.0]))
    0.2126
    """
    return np.asarray(radiance, dtype=np.float64) @ np.array(LUMINANCE_WEIGHTS)


@dataclass(frozen=True, eq=False)
class ColorSpace:
    """How stored colour becomes linear Rec.709.

    Parameters
    ----------
    encoding : Encoding
        The curve.
    matrix : (3, 3) float64 or None
        Linear Rec.709 from linear stored; None where the primaries are Rec.709's.
    """

    encoding: Encoding
    matrix: Float64 | None = None

    def linear(self, stored: Float32) -> Float32:
        """Linear Rec.709 of stored values, (h, w, 3) float32 both."""
        values = self.encoding.decode(stored)
        if self.matrix is None:
            return values
        return (values @ self.matrix.T.astype(np.float32)).astype(np.float32)


def rec709_from_primaries(chromaticities: tuple[float, ...]) -> Float64 | None:
    """Matrix from linear values of some primaries to Rec.709; None if they are Rec.709's.

    Parameters
    ----------
    chromaticities : 8 float
        x and y of red, green, blue and white. White is adapted to D65 (Bradford).

    Raises
    ------
    InputError
        If they span no colours.

    Examples
    --------
    White stays white:

    >>> rec709_from_primaries(P3_D65).sum(axis=1).round(6)
    array([1., 1., 1.])
    """
    if np.allclose(chromaticities, REC709, atol=SAME_CHROMATICITY):
        return None
    xyz = _xyz_from_primaries(chromaticities)
    adapted = _adaptation(_xyz(*chromaticities[6:]), _xyz(*REC709[6:])) @ xyz
    return np.asarray(np.linalg.solve(_xyz_from_primaries(REC709), adapted))


def space_of_profile(profile: bytes) -> ColorSpace:
    """The colour space that an ICC profile describes by a matrix and curves.

    Parameters
    ----------
    profile : bytes
        Of version 2 or 4; of grey or RGB.

    Returns
    -------
    ColorSpace

    Raises
    ------
    InputError
        If it describes colours otherwise (tables), is of another space, or is damaged. The
        message names the profile.
    """
    tags = _tags(profile)
    name = _description(tags)
    try:
        if profile[16:20] == b"GRAY" and b"kTRC" in tags:
            return ColorSpace(_encoding(_curve(tags[b"kTRC"])))
        if profile[16:20] != b"RGB " or profile[20:24] != b"XYZ " or b"A2B0" in tags:
            raise InputError(f"the ICC profile {name!r}, which is no matrix with curves")
        curves = [_curve(tags[tag]) for tag in (b"rTRC", b"gTRC", b"bTRC")]
        columns = [struct.unpack(">3i", tags[tag][8:20]) for tag in (b"rXYZ", b"gXYZ", b"bXYZ")]
    except (KeyError, struct.error) as error:
        raise InputError(f"the ICC profile {name!r}, which lacks or garbles {error}") from error
    if any(np.abs(curve - curves[0]).max() > SAME_CURVE for curve in curves[1:]):
        raise InputError(f"the ICC profile {name!r}, whose channels have different curves")
    d50 = np.array(columns, np.float64).T / 65536
    to_d50 = _adaptation(_xyz(*REC709[6:]), ICC_WHITE) @ _xyz_from_primaries(REC709)
    matrix = np.asarray(np.linalg.solve(to_d50, d50), np.float64)
    same = np.allclose(matrix, np.eye(3), atol=SAME_MATRIX)
    return ColorSpace(_encoding(curves[0]), None if same else matrix)


def _tags(profile: bytes) -> dict[bytes, bytes]:
    """Contents of a profile by signature."""
    if len(profile) < 132 or profile[36:40] != b"acsp":
        raise InputError("an ICC profile that is damaged")
    count = struct.unpack_from(">I", profile, 128)[0]
    if count > MOST_ICC_TAGS or 132 + 12 * count > len(profile):
        raise InputError("an ICC profile that is damaged")
    entries = struct.iter_unpack(">4sII", profile[132 : 132 + 12 * count])
    return {name: profile[offset : offset + size] for name, offset, size in entries}


def _description(tags: dict[bytes, bytes]) -> str:
    """Name of a profile: ASCII in version 2, UTF-16 in version 4."""
    content = tags.get(b"desc", b"")
    if content[:4] == b"mluc" and len(content) >= 28:
        size, offset = struct.unpack_from(">II", content, 20)
        return content[offset : offset + min(size, 200)].decode("utf-16-be", errors="replace")
    return content[12:212].split(b"\0")[0].decode("latin-1")


# Stored values at which curves are compared and tabulated.
_STEPS = np.linspace(0.0, 1.0, 1025)


def _curve(content: bytes) -> Float64:
    """Linear values at `_STEPS` of a ``curv`` or ``para`` tag."""
    if content[:4] == b"curv":
        (count,) = struct.unpack_from(">I", content, 8)
        if count == 0:
            return _STEPS.copy()
        points = np.frombuffer(content[12 : 12 + 2 * min(count, 65536)], ">u2")
        if len(points) != count:
            raise struct.error("curv")
        if count == 1:
            return _STEPS ** (points[0] / 256)
        return np.interp(_STEPS, np.linspace(0, 1, count), points / 65535)
    if content[:4] != b"para":
        raise struct.error("curves")
    (kind,) = struct.unpack_from(">H", content, 8)
    n_numbers = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}.get(kind, 8)
    numbers = np.frombuffer(content[12 : 12 + 4 * n_numbers], ">i4") / 65536
    if kind > 4 or len(numbers) != n_numbers:
        raise struct.error("para")
    return _parametric(kind, *numbers)


def _parametric(kind: int, g: float, *rest: float) -> Float64:
    """Values at `_STEPS` of a parametric curve (ICC.1:2022, table 68)."""
    a, b = rest[:2] if kind else (1.0, 0.0)
    with np.errstate(over="ignore", divide="ignore"):
        above = np.maximum(a * _STEPS + b, 0) ** g
    if not np.isfinite(above).all():
        raise InputError(f"an ICC profile whose curve is not finite (exponent {g:g})")
    if kind in (0, 1, 2):
        offset = rest[2] if kind == 2 else 0.0
        start = -b / a if kind and a else 0.0
        return np.where(start <= _STEPS, above + offset, offset)
    slope, start = rest[2], rest[3]
    e, f = rest[4:6] if kind == 4 else (0.0, 0.0)
    return np.where(start <= _STEPS, above + e, slope * _STEPS + f)


def _encoding(curve: Float64) -> Encoding:
    """The named encoding that a curve is, else its table."""
    if np.abs(curve - decode_srgb(_STEPS)).max() < SAME_CURVE:
        return Encoding(SRGB)
    if np.abs(curve - _STEPS).max() < 1e-4:
        return Encoding("linear")
    half = curve[len(_STEPS) // 2]
    gamma = float(np.log(half) / np.log(0.5)) if 0 < half < 1 else 1.0
    if np.abs(curve - _STEPS**gamma).max() < 1e-4:
        return Encoding("gamma", gamma=gamma)
    rising = np.r_[True, np.diff(np.maximum.accumulate(curve)) > 0]
    if rising.sum() < len(curve) // 2:
        raise InputError("an ICC profile whose curve does not rise")
    pairs = zip(_STEPS[rising].tolist(), curve[rising].tolist(), strict=True)
    return Encoding("table", pairs=tuple(pairs))


def _xyz(x: float, y: float) -> Float64:
    if not y > 0:
        raise InputError(f"chromaticities with y = {y}")
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _xyz_from_primaries(chromaticities: tuple[float, ...]) -> Float64:
    x, y = np.array(chromaticities, np.float64).reshape(4, 2).T
    primaries = np.stack([x, y, 1 - x - y])[:, :3]
    if not np.isfinite(chromaticities).all() or abs(np.linalg.det(primaries)) < 1e-6:
        raise InputError(f"chromaticities that span no colours, {chromaticities}")
    return primaries * np.linalg.solve(primaries, _xyz(float(x[3]), float(y[3])))


def _adaptation(source: Float64, target: Float64) -> Float64:
    """Bradford adaptation of XYZ under one white to another."""
    scale = np.diag((_BRADFORD @ target) / (_BRADFORD @ source))
    return np.asarray(np.linalg.solve(_BRADFORD, scale @ _BRADFORD))
