"""Values that vary over the surface: constants, images, procedural patterns.

Texture coordinates have v up; patterns repeat with period 1 in both. A texture
has one channel (roughness, angle, label) or three (linear RGB).
"""

from __future__ import annotations

import struct
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from capture_sim.errors import scene_error
from capture_sim.inputs import check_memory, check_regular
from capture_sim.tables import Table, TableReader, check_number, check_vector

Array = NDArray[np.float64]
LARGEST_IMAGE = 2**26  # pixels; a "small" texture that does not fill the memory
BYTES_PER_PIXEL = 12  # of 16-bit images while they are decoded


class Texture(ABC):
    """A function of texture coordinates with one or three channels."""

    uses_uv = True

    @abstractmethod
    def evaluate(self, uv: Array) -> Array:
        """Values at `uv` (n, 2) as (n, n_channels) float64."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest value that any channel takes."""

    @property
    @abstractmethod
    def n_channels(self) -> int:
        """1 or 3."""

    def rgb(self, uv: Array) -> Array:
        """Values as (n, 3); one channel stands for three equal ones."""
        return np.broadcast_to(self.evaluate(uv), (len(uv), 3))

    def scalar(self, uv: Array) -> Array:
        """Values as (n, 1); three channels are averaged."""
        values = self.evaluate(uv)
        return values if values.shape[1] == 1 else values.mean(axis=1, keepdims=True)


@dataclass(frozen=True)
class Constant(Texture):
    """The same value everywhere.

    Examples
    --------
    >>> Constant((0.25,)).rgb(np.zeros((1, 2)))
    array([[0.25, 0.25, 0.25]])
    """

    value: tuple[float, ...]
    uses_uv = False

    def evaluate(self, uv: Array) -> Array:
        """`value` for each of the n points."""
        return np.broadcast_to(np.array(self.value), (len(uv), len(self.value)))

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest channel of `value`."""
        return min(self.value), max(self.value)

    @property
    def n_channels(self) -> int:
        """Length of `value`."""
        return len(self.value)


@dataclass(frozen=True, eq=False)
class Image(Texture):
    """An image, bilinearly interpolated, repeated with period 1.

    Parameters
    ----------
    pixels : (h, w, n_channels) float64 or unsigned
        Linear values; row 0 is the top, at v = 1. With a table: numbers of its entries.
    table : (n,) float64, optional
        Linear values that pixels are numbers of, rising or falling.

    Examples
    --------
    >>> pixels = np.array([[[0.0]], [[1.0]]])  # white below black
    >>> Image(pixels).evaluate(np.array([[0.5, 0.25], [0.5, 0.5]])).ravel()
    array([1. , 0.5])
    """

    pixels: NDArray[Any]
    table: Array | None = None

    def evaluate(self, uv: Array) -> Array:
        """Bilinear values at `uv`."""
        height, width = self.pixels.shape[:2]
        column, row = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
        x, y = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
        fx, fy = (column - x)[:, None], (row - y)[:, None]
        left, right, top, bottom = x % width, (x + 1) % width, y % height, (y + 1) % height
        upper = self._values(top, left) * (1 - fx) + self._values(top, right) * fx
        lower = self._values(bottom, left) * (1 - fx) + self._values(bottom, right) * fx
        return upper * (1 - fy) + lower * fy

    def _values(self, row: NDArray[np.int64], column: NDArray[np.int64]) -> Array:
        stored = self.pixels[row, column]
        return stored if self.table is None else self.table[stored]

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest pixel value."""
        ends: list[Any] = [self.pixels.min(), self.pixels.max()]
        if self.table is not None:
            ends = [self.table[end] for end in ends]
        return float(min(ends)), float(max(ends))

    @property
    def n_channels(self) -> int:
        """Channels of the image."""
        return int(self.pixels.shape[2])


@dataclass(frozen=True)
class Pattern(Texture):
    """Blend of two textures by a procedural weight in [0, 1].

    Parameters
    ----------
    weight : function
        From (n, 2) coordinates to (n,) weights of `second`.
    first, second : Texture
        Values where the weight is 0 and 1.
    """

    weight: Callable[[Array], Array]
    first: Texture
    second: Texture

    def evaluate(self, uv: Array) -> Array:
        """``first + weight (second - first)``."""
        weight = self.weight(uv)[:, None]
        return (1.0 - weight) * self.first.evaluate(uv) + weight * self.second.evaluate(uv)

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of both textures together."""
        low_first, high_first = self.first.bounds
        low_second, high_second = self.second.bounds
        return min(low_first, low_second), max(high_first, high_second)

    @property
    def n_channels(self) -> int:
        """The larger number of channels of the two."""
        return max(self.first.n_channels, self.second.n_channels)


def checker(uv: Array, *, columns: int, rows: int) -> Array:
    """Weights of a checkerboard, 0 at the corner (0, 0).

    Examples
    --------
    >>> checker(np.array([[0.1, 0.1], [0.6, 0.1], [0.6, 0.6]]), columns=2, rows=2)
    array([0., 1., 0.])
    """
    cells = np.floor(uv[:, 0] * columns) + np.floor(uv[:, 1] * rows)
    return np.mod(cells, 2.0)


def stripes(uv: Array, *, columns: int, rows: int, softness: float) -> Array:
    """Weights of stripes: `columns` and `rows` full periods along u and v.

    `softness` 0 gives hard edges, 1 a cosine.

    Examples
    --------
    >>> stripes(np.array([[0.0, 0.0], [0.25, 0.0]]), columns=2, rows=0, softness=1.0)
    array([1., 0.])
    """
    wave = np.cos(2.0 * np.pi * (columns * uv[:, 0] + rows * uv[:, 1]))
    width = max(softness, 1e-9)  # hard edges are a very steep ramp
    return np.clip(0.5 + 0.5 * wave / width, 0.0, 1.0)


def bands(uv: Array, *, edges: Array) -> Array:
    """Weight 1 where v lies in one of the bands [low, high), else 0.

    Examples
    --------
    >>> bands(np.array([[0.0, 0.1], [0.0, 0.3]]), edges=np.array([[0.25, 0.5]]))
    array([0., 1.])
    """
    v = np.mod(uv[:, 1:], 1.0)
    return np.any((v >= edges[:, 0]) & (v < edges[:, 1]), axis=1).astype(np.float64)


def dots(uv: Array, *, columns: int, rows: int, radius: float) -> Array:
    """Weight 1 inside discs of `radius` cells on a grid of cells.

    Examples
    --------
    >>> dots(np.array([[0.25, 0.5], [0.0, 0.5]]), columns=2, rows=1, radius=0.3)
    array([1., 0.])
    """
    cell = np.mod(uv * [columns, rows], 1.0) - 0.5
    return (np.hypot(cell[:, 0], cell[:, 1]) < radius).astype(np.float64)


def meander(uv: Array, *, columns: int, rows: int) -> Array:
    """Weight 1 on the line of a Greek key, `columns` x `rows` motifs.

    Examples
    --------
    >>> meander(np.array([[0.5, 0.05], [0.5, 0.2]]), columns=1, rows=1)
    array([1., 0.])
    """
    cell = np.mod(uv * [columns, rows], 1.0)
    motif = np.array([[int(c) for c in line] for line in _GREEK_KEY])[::-1]
    side = len(motif)
    index = np.minimum((cell * side).astype(np.int64), side - 1)
    return motif[index[:, 1], index[:, 0]].astype(np.float64)


_GREEK_KEY = ("1111111", "1000001", "1011101", "1010101", "1010001", "1011111", "1000000")[::-1]


def noise(uv: Array, *, frequency: int, octaves: int, seed: int) -> Array:
    """Smooth value noise in [0, 1], periodic in u and v.

    Parameters
    ----------
    uv : (n, 2) float64
        Texture coordinates.
    frequency : int
        Lattice cells per unit of u and v in the first octave; doubled in each next.
    octaves : int
        Number of layers, each of half the amplitude of the one before.
    seed : int
        Chooses the lattice values.

    Returns
    -------
    (n,) float64

    Examples
    --------
    >>> bool(np.ptp(noise(np.array([[0.0, 0.3], [1.0, 0.3]]), frequency=4, octaves=2, seed=1))
    ...      < 1e-12)
    True
    """
    rng = np.random.default_rng(seed)
    total, weight_sum = np.zeros(len(uv)), 0.0
    for octave in range(octaves):
        side = frequency * 2**octave
        total += 0.5**octave * _lattice(uv * side, rng.random((side, side)))
        weight_sum += 0.5**octave
    return total / weight_sum


def _lattice(points: Array, values: Array) -> Array:
    """Periodic interpolation of lattice values with a quintic fade."""
    corner = np.floor(points).astype(np.int64)
    t = points - corner
    fx, fy = (t**3 * (t * (t * 6.0 - 15.0) + 10.0)).T
    side = len(values)
    x0, y0 = (corner % side).T
    x1, y1 = ((corner + 1) % side).T
    near = values[y0, x0] * (1 - fx) + values[y0, x1] * fx
    far = values[y1, x0] * (1 - fx) + values[y1, x1] * fx
    return near * (1 - fy) + far * fy


def make_texture(
    value: Any,
    what: str,
    *,
    low: float,
    high: float,
    folder: Path = Path(),
    encoding: str = "srgb",
) -> Texture:
    """Texture from a TOML value: a number, an RGB list, or a table.

    Parameters
    ----------
    value : float, list of 3 float, or table
        Tables have a ``type``: image, checker, stripes, bands, dots, meander, noise.
    what : str
        Name used in messages.
    low, high : float
        Range that every value must keep.
    folder : Path
        Folder that image paths are relative to.
    encoding : {"srgb", "linear"}
        How images are encoded unless their table says so.

    Returns
    -------
    Texture

    Raises
    ------
    SceneError
        For unknown types and keys, and values out of range.

    Examples
    --------
    >>> make_texture([0.1, 0.2, 0.3], "albedo", low=0, high=1)
    Constant(value=(0.1, 0.2, 0.3))
    """
    if isinstance(value, dict):
        texture = _texture_from_table(value, what, folder, encoding, (low, high))
    elif isinstance(value, list | tuple):
        texture = Constant(tuple(float(v) for v in check_vector(what, value, 3)))
    else:
        texture = Constant((check_number(what, value),))
    smallest, largest = texture.bounds
    if smallest < low or largest > high:
        received = f"{smallest:g}" if smallest < low else f"{largest:g}"
        raise scene_error(what, f"values in [{low:g}, {high:g}]", received)
    return texture


def _texture_from_table(
    table: Table, what: str, folder: Path, encoding: str, limits: tuple[float, float]
) -> Texture:
    reader = TableReader(what, table)
    kind = reader.choice("type", "", ["image", *_PATTERNS])
    if kind == "image":
        texture: Texture = _image(reader, folder, encoding)
    else:
        weight = _PATTERNS[kind](reader)
        values = reader.take("values", [0.0, 1.0])
        if not isinstance(values, list | tuple) or len(values) != 2:
            raise scene_error(reader.name("values"), "a list of two values", values)
        first, second = (
            make_texture(
                entry,
                f"{what}.values[{i}]",
                low=limits[0],
                high=limits[1],
                folder=folder,
                encoding=encoding,
            )
            for i, entry in enumerate(values)
        )
        texture = Pattern(weight, first, second)
    reader.finish()
    return texture


def _image(reader: TableReader, folder: Path, encoding: str) -> Image:
    path = reader.file("file", folder)
    encoding = reader.choice("encoding", encoding, ["srgb", "linear"])
    low, high = reader.vector("range", [0.0, 1.0], 2)
    stored = read_image(path)
    values = encoded_values(stored.dtype)
    if encoding == "srgb":
        values = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return Image(stored, low + (high - low) * values)


def encoded_values(dtype: np.dtype[Any]) -> Array:
    """Encoded values in [0, 1] that the numbers of 8- or 16-bit images stand for.

    Examples
    --------
    >>> encoded_values(np.dtype(np.uint8))[[0, 51, 255]]
    array([0. , 0.2, 1. ])
    """
    largest = int(np.iinfo(dtype).max)
    return np.arange(largest + 1, dtype=np.float64) / largest


@lru_cache(maxsize=16)
def _read_image(path: Path, written: tuple[int, int]) -> NDArray[Any]:
    """Image of a file that was written at that time, with that size."""
    del written
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if stored is None or stored.dtype not in (np.uint8, np.uint16):
        raise scene_error(str(path), "an 8- or 16-bit PNG, JPEG or TIFF", "something else")
    if stored.shape[0] * stored.shape[1] > LARGEST_IMAGE:
        raise scene_error(str(path), f"at most {LARGEST_IMAGE} pixels", str(stored.shape[:2]))
    turned = np.ascontiguousarray(stored[:, :, ::-1])
    turned.setflags(write=False)
    return turned


def read_image(path: Path) -> NDArray[Any]:
    """8- or 16-bit image as it is stored, (h, w, 3) uint8 or uint16 RGB.

    Parameters
    ----------
    path : Path
        PNG, JPEG or TIFF file.

    Raises
    ------
    SceneError
        If the file is no image, is too large, or holds other depths; nothing is decoded
        before its size is known.
    """
    check_regular(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large images; the limit here is smaller
            with PIL.Image.open(path) as image:
                width, height = image.size
    except PIL.Image.DecompressionBombError as error:
        raise scene_error(
            str(path), f"at most {LARGEST_IMAGE:,} pixels", "many more", "make it smaller"
        ) from error
    except (OSError, ValueError, SyntaxError, TypeError, OverflowError, struct.error) as error:
        raise scene_error(
            str(path), "an 8- or 16-bit PNG, JPEG or TIFF", "a damaged or different file"
        ) from error
    if width * height > LARGEST_IMAGE:
        raise scene_error(
            str(path),
            f"at most {LARGEST_IMAGE:,} pixels",
            f"{width} x {height}",
            "make it smaller",
        )
    check_memory(str(path), BYTES_PER_PIXEL * width * height)
    status = path.stat()
    return _read_image(path.resolve(), (status.st_mtime_ns, status.st_size))


def _checker(reader: TableReader) -> Callable[[Array], Array]:
    columns, rows = _cells(reader, 8, 8, low=1)
    return lambda uv: checker(uv, columns=columns, rows=rows)


def _stripes(reader: TableReader) -> Callable[[Array], Array]:
    columns, rows = _cells(reader, 8, 0, low=0)
    softness = reader.number("softness", 0.0, low=0.0, high=1.0)
    return lambda uv: stripes(uv, columns=columns, rows=rows, softness=softness)


def _bands(reader: TableReader) -> Callable[[Array], Array]:
    flat = reader.take("edges", [[0.4, 0.6]])
    pairs = flat if isinstance(flat, list | tuple) else []
    edges = np.array([check_vector(reader.name("edges"), pair, 2) for pair in pairs])
    if not len(edges):
        raise scene_error(reader.name("edges"), "a list of [low, high] pairs of v", flat)
    return lambda uv: bands(uv, edges=edges)


def _dots(reader: TableReader) -> Callable[[Array], Array]:
    columns, rows = _cells(reader, 8, 8, low=1)
    radius = reader.number("radius", 0.3, low=0.0, high=0.75)
    return lambda uv: dots(uv, columns=columns, rows=rows, radius=radius)


def _meander(reader: TableReader) -> Callable[[Array], Array]:
    columns, rows = _cells(reader, 16, 16, low=1)
    return lambda uv: meander(uv, columns=columns, rows=rows)


def _noise(reader: TableReader) -> Callable[[Array], Array]:
    frequency = reader.count("frequency", 8, high=256)
    octaves = reader.count("octaves", 3, high=4)
    seed = reader.count("seed", 0, low=0, high=2**31)
    return lambda uv: noise(uv, frequency=frequency, octaves=octaves, seed=seed)


def _cells(reader: TableReader, columns: int, rows: int, *, low: int) -> tuple[int, int]:
    columns = reader.count("columns", columns, low=low, high=4096)
    return columns, reader.count("rows", rows, low=low, high=4096)


_PATTERNS: dict[str, Callable[[TableReader], Callable[[Array], Array]]] = {
    "bands": _bands,
    "checker": _checker,
    "dots": _dots,
    "meander": _meander,
    "noise": _noise,
    "stripes": _stripes,
}
