"""The ``.btf`` container of the University of Bonn: a factorised table of apparent BRDFs.

Read and written are full-matrix factorisations, signatures ``!FMF06FC`` (without) and
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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import CaptureError
from reflfield.util.files import read_bytes, replacing
from reflfield.util.validation import check_shape

Floats = NDArray[np.float32]

PLAIN, ROTATED = b"!FMF06FC", b"!FMF06FCR"
# What other software writes, and is not read here: told apart to say so.
OTHERS = (b"!DFMF08FCR", b"!FMF12FCER", b"!PVF06FCR", b"!PVF06FC", b"!BDIF06R2!")
VERSION = 4
MOST_BYTES = 1 << 33
_DTYPES = {2: "<f2", 4: "<f4", 8: "<f8"}
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

    def entries(self, columns: NDArray[np.integer]) -> NDArray[np.floating]:
        """Apparent BRDFs of texels, (n, n_views, n_lights, n_channels)."""
        shape = (len(columns), len(self.views), len(self.lights), len(self.channels))
        return (self.sv[columns] @ self.u.T).reshape(shape)


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


class _Cursor:
    """Reads numbers off bytes; never beyond their end."""

    def __init__(self, content: bytes, path: Path) -> None:
        self.content, self.path, self.at = content, path, 0

    def take(self, n_bytes: int, what: str) -> bytes:
        """Next bytes."""
        left = len(self.content) - self.at
        if n_bytes > left:
            raise self.wrong(what, f"{n_bytes:,} bytes", f"{left:,}", "the file is cut off")
        self.at += n_bytes
        return self.content[self.at - n_bytes : self.at]

    def numbers(self, form: str, what: str) -> tuple[Any, ...]:
        """Numbers in the form of `struct`."""
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form), what))

    def array(self, dtype: str, shape: tuple[int, ...], what: str) -> NDArray[Any]:
        """Array; its size is compared with the bytes that are left before it is made."""
        count = int(np.prod([int(n) for n in shape], dtype=object))
        content = self.take(count * np.dtype(dtype).itemsize, what)
        return np.frombuffer(content, dtype).reshape(shape)

    def text(self, n_bytes: int, what: str) -> str:
        """Text up to its first zero."""
        return self.take(n_bytes, what).split(b"\0")[0].decode("utf-8", errors="replace")

    def wrong(self, what: str, wanted: str, received: str, remedy: str) -> CaptureError:
        """What to raise."""
        return CaptureError(
            f"{self.path}: {what}: expected {wanted}, received {received}; {remedy}"
        )


def read_btf(path: Path | str) -> BtfContainer:
    """Read a container.

    Parameters
    ----------
    path : Path or str

    Returns
    -------
    BtfContainer

    Raises
    ------
    CaptureError
        If the file is missing, of another kind, damaged or cut off.
    """
    file = Path(path)
    cursor = _Cursor(read_bytes(file, MOST_BYTES, CaptureError), file)
    is_rotated = _signature(cursor)
    about = _read_header(cursor)
    views, lights = _read_sampling(cursor)
    width, height = cursor.numbers("II", "size of the texture")
    rotations = None
    if is_rotated:
        (n,) = cursor.numbers("I", "number of rotations")
        if n != width * height:
            raise cursor.wrong("rotations", f"{width * height}", str(n), "write it again")
        rotations = cursor.array("<f4", (n, 3, 3), "rotations")
    matrices = _read_matrices(cursor, width * height, len(about["channels"]), views, lights)
    if cursor.at != len(cursor.content):
        left = len(cursor.content) - cursor.at
        raise cursor.wrong("end", "no more bytes", f"{left:,}", "write the file again")
    return BtfContainer(width, height, views, lights, *matrices, rotations, **about)


def _signature(cursor: _Cursor) -> bool:
    """Whether texels have rotations."""
    start = cursor.content[:16]
    for known in OTHERS:
        if start.startswith(known):
            raise cursor.wrong(
                "signature", f"{PLAIN.decode()} or {ROTATED.decode()}", known.decode(),
                "convert it to a full-matrix factorisation of that kind",
            )  # fmt: skip
    if not start.startswith(PLAIN):
        raise cursor.wrong("signature", PLAIN.decode(), repr(start[:10]), "it is no .btf file")
    is_rotated = start.startswith(ROTATED)
    cursor.at = len(ROTATED if is_rotated else PLAIN)
    return is_rotated


def _read_header(cursor: _Cursor) -> dict[str, Any]:
    begin = cursor.at
    size, version = cursor.numbers("II", "header")
    if not 1 <= version <= VERSION:
        raise cursor.wrong("version", f"1 to {VERSION}", str(version), "write an older one")
    about: dict[str, Any] = {
        name: cursor.text(_TEXT, name) for name in ("setup", "sensor", "source")
    }
    about["pixels_per_mm"], *scale = cursor.numbers("4f", "scale")
    about["rgb_scale"] = tuple(scale)
    about["cosine_included"] = version > 1 and bool(cursor.numbers("I", "cosine flag")[0])
    if version > 2:
        about["xml"] = cursor.text(cursor.numbers("I", "XML")[0], "XML")
    about["channels"] = ("R", "G", "B")
    if version > 3:
        about["channels"] = _channel_names(cursor)
    if cursor.at != begin + size:
        raise cursor.wrong("header", f"{size} bytes", str(cursor.at - begin), "it is damaged")
    return about


def _channel_names(cursor: _Cursor) -> tuple[str, ...]:
    (n,) = cursor.numbers("I", "channels")
    if not 1 <= n <= len(cursor.content):
        raise cursor.wrong("channels", "a few", str(n), "it is damaged")
    return tuple(cursor.text(cursor.numbers("I", "channel")[0], "channel") for _ in range(n))


def _read_sampling(cursor: _Cursor) -> tuple[Floats, Floats]:
    (n_views,) = cursor.numbers("I", "views")
    views: list[Floats] = []
    lights: Floats | None = None
    for number in range(n_views):
        views.append(cursor.array("<f4", (2,), "views"))
        (n_lights,) = cursor.numbers("I", "lights")
        own = cursor.array("<f4", (n_lights, 2), "lights")
        if lights is not None and not np.array_equal(own, lights):
            raise cursor.wrong(
                f"lights of view {number}", "those of the first", "others",
                "only the product of views and lights is read",
            )  # fmt: skip
        lights = own
    if lights is None:
        raise cursor.wrong("views", "one or more", "none", "it is damaged")
    return np.stack(views), lights


def _read_matrices(
    cursor: _Cursor, n_texels: int, n_channels: int, views: Floats, lights: Floats
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    k, width, same, rows, columns = cursor.numbers("IBIII", "components")
    wanted = (n_channels * len(views) * len(lights), n_texels)
    if width not in _DTYPES or k != same or (rows, columns) != wanted:
        raise cursor.wrong(
            "components", f"{wanted[0]} rows, {wanted[1]} columns of 2, 4 or 8 bytes",
            f"{rows}, {columns} of {width} ({k}, {same} components)", "it is damaged",
        )  # fmt: skip
    dtype = _DTYPES[width]
    values = cursor.array(dtype, (k,), "singular values")
    u = cursor.array(dtype, (rows, k), "u")
    return values, u, cursor.array(dtype, (columns, k), "sv")
