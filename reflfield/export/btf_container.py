"""The ``.btf`` container of the University of Bonn: a factorised table of apparent BRDFs.

`capture.btf` reads it, and others of its kind.

Written are full-matrix factorisations, signatures ``!FMF06FC`` (without) and
``!FMF06FCR`` (with a rotation for each texel), version 4 of the header. Entry (channel, light,
view) of texel (x, y) is ``u[row] @ sv[column]`` with ``row = channel + n_channels * (light +
n_lights * view)`` and ``column = x + width * y``, where y = 0 is the top of the texture. The
rows of a rotation are tangent, binormal and normal of the texel in the frame of the sample
(x along u, y up the texture, z off the surface); directions are turned into it.

All numbers are little-endian. After the signature: ``u32`` bytes of the header from here on,
``u32`` version, three texts of 80 bytes (set-up, sensor, light), ``f32`` pixels per millimetre,
three ``f32`` scales, ``u32`` 1 if entries contain the light's cosine, a text (``u32`` length)
of XML, ``u32`` channels and a text each; then ``u32`` views and for each ``f32`` theta, phi,
``u32`` lights and their theta, phi; ``u32`` width, height; for ``R`` ``u32`` rotations and
their ``f32`` 3 x 3; ``u32`` components, ``u8`` bytes of a number, ``u32`` components, rows,
columns; the singular values, u and sv.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.util.files import replacing
from reflfield.util.validation import check_shape

Floats = NDArray[np.float32]

PLAIN, ROTATED = b"!FMF06FC", b"!FMF06FCR"
VERSION = 4
_TEXT = 80


@dataclass(frozen=True, eq=False)
class BtfContainer:
    """Contents of a ``.btf`` file.

    Parameters
    ----------
    width, height : int
        Of the texture, texels.
    views, lights : (n, 2) float32
        Angle from the normal and azimuth, radians; all views have the same lights.
    singular_values : (K,) float
    u : (n_channels * n_lights * n_views, K) float
        Half, single or double precision, that of all three.
    sv : (width * height, K) float
    rotations : (width * height, 3, 3) float32, optional
        Rows tangent, binormal and normal of each texel.
    cosine_included : bool
        Whether entries contain the light's cosine.
    channels : tuple of str
    setup, sensor, source : str
        Of the measurement, at most 80 bytes each.
    pixels_per_mm : float
    rgb_scale : (3,) tuple of float
    xml : str
    """

    width: int
    height: int
    views: Floats
    lights: Floats
    singular_values: NDArray[np.floating]
    u: NDArray[np.floating]
    sv: NDArray[np.floating]
    rotations: Floats | None = None
    cosine_included: bool = True
    channels: tuple[str, ...] = ("R", "G", "B")
    setup: str = ""
    sensor: str = ""
    source: str = ""
    pixels_per_mm: float = 0.0
    rgb_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    xml: str = ""

    def __post_init__(self) -> None:
        k, n_texels = len(self.singular_values), self.width * self.height
        check_shape("views", self.views, (None, 2))
        check_shape("lights", self.lights, (None, 2))
        rows = len(self.channels) * len(self.views) * len(self.lights)
        check_shape("u", self.u, (rows, k))
        check_shape("sv", self.sv, (n_texels, k))
        if self.rotations is not None:
            check_shape("rotations", self.rotations, (n_texels, 3, 3))


def angles_of(directions: NDArray[np.floating]) -> Floats:
    """Angle from the normal and azimuth of unit vectors, (n, 2) radians.

    Examples
    --------
    >>> angles_of(np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])).round(2).tolist()
    [[0.0, 0.0], [1.5700000524520874, -1.5700000524520874]]
    """
    x, y, z = directions.T
    return np.stack([np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)], axis=1).astype("f4")


def directions_of(angles: NDArray[np.floating]) -> NDArray[np.float64]:
    """Unit vectors of angles from the normal and azimuths, (n, 3)."""
    theta, phi = np.asarray(angles, np.float64).T
    ring = np.sin(theta)
    return np.stack([ring * np.cos(phi), ring * np.sin(phi), np.cos(theta)], axis=1)


def write_btf(path: Path | str, container: BtfContainer) -> None:
    """Write a container; the file appears when it is whole."""
    c = container
    dtype = np.dtype(f"<f{c.u.dtype.itemsize}")
    size = struct.pack("<II", c.width, c.height)
    parts = [ROTATED if c.rotations is not None else PLAIN, _header(c), _sampling(c), size]
    if c.rotations is not None:
        rotations = c.rotations.astype("<f4").tobytes()
        parts += [struct.pack("<I", len(c.rotations)), rotations]
    k = len(c.singular_values)
    parts.append(struct.pack("<IBIII", k, dtype.itemsize, k, len(c.u), len(c.sv)))
    parts += [a.astype(dtype).tobytes() for a in (c.singular_values, c.u, c.sv)]
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as partial, partial.open("wb") as file:
        file.writelines(parts)


def _header(c: BtfContainer) -> bytes:
    names = (c.setup, c.sensor, c.source)
    fixed = [struct.pack("<I", VERSION)]
    fixed += [name.encode()[:_TEXT].ljust(_TEXT, b"\0") for name in names]
    fixed.append(struct.pack("<4fI", c.pixels_per_mm, *c.rgb_scale, c.cosine_included))
    fixed.append(_counted(c.xml))
    fixed += [struct.pack("<I", len(c.channels)), *map(_counted, c.channels)]
    content = b"".join(fixed)
    return struct.pack("<I", len(content) + 4) + content


def _counted(text: str) -> bytes:
    encoded = text.encode()
    return struct.pack("<I", len(encoded)) + encoded


def _sampling(c: BtfContainer) -> bytes:
    lights = struct.pack("<I", len(c.lights)) + c.lights.astype("<f4").tobytes()
    views = [view.astype("<f4").tobytes() + lights for view in c.views]
    return struct.pack("<I", len(views)) + b"".join(views)
