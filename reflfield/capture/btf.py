"""The ``.btf`` container of the University of Bonn: apparent BRDFs, plain or factorised.

Read are full-matrix factorisations (``!FMF06FC``, ``!FMF06FCR``, ``!FMF12FCER``), decorrelated
ones (``!DFMF08FCR``, of UBO2014) and uncompressed tables (``!BDIF06R2!``). The layout is that
of btflib and pysmtb, the Bonn group's own readers: entry (channel, light, view) of texel (x, y)
is row ``channel + n_channels * (light + n_lights * view)`` of column ``x + width * y``, y = 0
at the top. Values are not clamped. A rotation of a texel has the rows tangent, binormal and
normal: it turns directions of the sample into those of the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.binary_files import BinaryFile, opened
from reflfield.capture.rectified_samples import directions_of_angles
from reflfield.errors import CaptureError
from reflfield.util.late_import import LateImport
from reflfield.util.quoting import quoted
from reflfield.util.validation import not_a_rotation_because

spatial: Any = LateImport("scipy.spatial")

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

SUFFIX = ".btf"
# Longest first: one begins another.
SIGNATURES = {
    b"!DFMF08FCR": "DFMF", b"!FMF12FCER": "FMF12", b"!FMF06FCR": "FMF", b"!FMF06FC": "FMF",
    b"!BDIF06R2!": "BDI", b"!PVF06FCR": "", b"!PVF06FC": "",
}  # fmt: skip
# Texels, views and lights of the largest published samples: 512 x 512, 151 x 151.
MOST_TEXELS, MOST_DIRECTIONS, MOST_COMPONENTS = 1 << 24, 1 << 12, 1 << 12
NEWEST_VERSION = 4  # of the common header
EPSILON = 1e-5  # added before the logarithm
_NUMBERS = {2: "<f2", 4: "<f4", 8: "<f8"}
_RGB_FROM_YUV = np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]])
# Texels that are interpolated at a time: nine entries of each are held.
_BLOCK = 2048


def _from_log_yuv(stored: Array) -> Array:
    """RGB of log Y, U, V."""
    luma = np.exp(stored[..., 0]) - EPSILON
    return np.stack([luma, stored[..., 1], stored[..., 2]], axis=-1) @ _RGB_FROM_YUV.T


def _from_log_yuv_ratios(stored: Array) -> Array:
    """RGB of log Y, U / Y, V / Y."""
    luma = np.exp(stored[..., 0]) - EPSILON
    yuv = np.stack([luma, stored[..., 1] * luma, stored[..., 2] * luma], axis=-1)
    return yuv @ _RGB_FROM_YUV.T


# Linear RGB of what is stored, by the number of the colour model.
_COLOUR_MODELS: dict[int, Callable[[Array], Array]] = {
    0: lambda stored: stored,
    1: lambda stored: stored @ _RGB_FROM_YUV.T,
    9: _from_log_yuv,
    11: _from_log_yuv_ratios,
    12: lambda stored: np.exp(stored) - EPSILON,
}


@dataclass(frozen=True, eq=False)
class Btf:
    """A table of apparent BRDFs.

    Parameters
    ----------
    width, height : int
        Texels.
    views, lights : (n, 3) float64
        Unit directions; all views have the same lights.
    cosine_included : bool
        Whether values contain the light's cosine.
    factors : tuple of (u, v)
        One pair, u (channels * lights * views, K) and v (texels, K), or one for each channel;
        of a plain table u is None and v (texels, channels * lights * views).
    to_rgb : callable
        From stored to linear RGB.
    rotations : (texels, 3, 3) float64 or None
        Rows tangent, binormal and normal.
    """

    width: int
    height: int
    views: Array
    lights: Array
    cosine_included: bool
    factors: tuple[tuple[NDArray[Any] | None, NDArray[Any]], ...]
    to_rgb: Callable[[Array], Array] = field(repr=False)
    rotations: Array | None = None

    def image(self, view: int, light: int) -> Float32:
        """Radiance of the sample under irradiance 1, (height, width, 3) float32.

        Along directions `view` and `light` of the sampling, in the frame of the sample: where
        texels have rotations, values between those of the table are interpolated, linearly
        over triangles of stereographic coordinates. Texels that a direction lies below have
        the value 0.

        Raises
        ------
        CaptureError
            If a value is beyond single precision.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            if self.rotations is None:
                values = self._as_sampled(view, light)
            else:
                values = self._turned(self.views[view], self.lights[light])
            image = values.reshape(self.height, self.width, 3).astype(np.float32)
        if not np.isfinite(image).all():
            raise CaptureError(
                f"view {view}, light {light}: expected values within single precision, "
                "received larger ones; the container is damaged"
            )
        return image

    def _as_sampled(self, view: int, light: int) -> Array:
        """Values of all texels along two directions of the sampling."""
        columns = np.arange(self.width * self.height)
        pairs = np.full((len(columns), 1), view), np.full((len(columns), 1), light)
        values = self._entries(columns, *pairs)[:, 0, 0]
        return values if self.cosine_included else values * self.lights[light, 2]

    def _turned(self, view: Array, light: Array) -> Array:
        """Values along directions of the sample, of texels with rotations."""
        rotations = np.asarray(self.rotations)
        values = np.zeros((len(rotations), 3))
        grids = _Interpolation(self.views), _Interpolation(self.lights)
        for first in range(0, len(rotations), _BLOCK):
            turned = rotations[first : first + _BLOCK]
            own_view, own_light = turned @ view, turned @ light
            (v, by_view), (l_, by_light) = grids[0](own_view), grids[1](own_light)
            columns = first + np.arange(len(turned))
            entries = self._entries(columns, v, l_)
            mean = np.einsum("ni,nj,nijc->nc", by_view, by_light, entries)
            if not self.cosine_included:
                mean *= own_light[:, 2:]
            above = (own_view[:, 2] > 0) & (own_light[:, 2] > 0)
            values[first : first + _BLOCK] = np.where(above[:, None], mean, 0)
        return values

    def _entries(
        self, columns: NDArray[np.intp], views: NDArray[np.intp], lights: NDArray[np.intp]
    ) -> Array:
        """Linear RGB of texels (n,) for views (n, a) and lights (n, b), (n, a, b, 3)."""
        pair = lights[:, None, :] + len(self.lights) * views[:, :, None]
        n_channels = 3 if len(self.factors) == 1 else 1
        parts = []
        for u, v in self.factors:
            rows = n_channels * pair[..., None] + np.arange(n_channels)
            if u is None:
                parts.append(v[columns[:, None, None, None], rows].astype(np.float64))
            elif (rows == rows[:1]).all():  # the same entries of all texels
                same = u[rows[0].ravel()].astype(np.float64)
                parts.append((v[columns].astype(np.float64) @ same.T).reshape(rows.shape))
            else:
                own = u[rows].astype(np.float64)
                parts.append(np.einsum("nabck,nk->nabc", own, v[columns]))
        return self.to_rgb(np.concatenate(parts, axis=-1))


class _Interpolation:
    """Weights of sampled directions: linear in the triangles of stereographic coordinates."""

    def __init__(self, directions: Array) -> None:
        self.points = _stereographic(directions)
        try:
            self.triangles = spatial.Delaunay(self.points) if len(directions) > 3 else None
        except spatial.QhullError:  # directions in a line
            self.triangles = None

    def __call__(self, directions: Array) -> tuple[NDArray[np.intp], Array]:
        """Three indices and weights for each direction; beyond all triangles the nearest."""
        wanted = _stereographic(directions)
        nearest = spatial.cKDTree(self.points).query(wanted)[1]
        indices = np.repeat(nearest[:, None], 3, axis=1)
        weights = np.tile([1.0, 0.0, 0.0], (len(wanted), 1))
        if self.triangles is not None:
            triangle = self.triangles.find_simplex(wanted)
            inside = triangle >= 0
            transform = self.triangles.transform[triangle[inside]]
            two = np.einsum("nij,nj->ni", transform[:, :2], wanted[inside] - transform[:, 2])
            indices[inside] = self.triangles.simplices[triangle[inside]]
            weights[inside] = np.column_stack([two, 1 - two.sum(axis=1)])
        return indices, weights


def _stereographic(directions: Array) -> Array:
    return directions[:, :2] / np.maximum(1 + directions[:, 2:], 1e-6)


def read_btf(path: Path | str) -> Btf:
    """Read a ``.btf`` container.

    Parameters
    ----------
    path : Path or str

    Returns
    -------
    Btf

    Raises
    ------
    CaptureError
        If the file is damaged, or of a kind that is not supported: per-view factorisations,
        compressed tables, tables with missing texels, spectral or other colour models.
    """
    path = Path(path)
    with opened(path) as file:
        data = BinaryFile(file, path)
        kind, rotated = _kind(data)
        cosine_included, n_channels = _header(data)
        views, lights = _sampling(data)
        width, height = data.numbers("II")
        n_texels = width * height
        if not 1 <= n_texels <= MOST_TEXELS:
            raise CaptureError(
                f"{path}: expected 1 to {MOST_TEXELS:,} texels, received {width} x {height}"
            )
        rows = len(views) * len(lights)
        rotations = _rotations(data, n_texels) if rotated else None
        to_rgb = _COLOUR_MODELS[0]
        if kind == "BDI":
            table, rotations = _table(data, n_channels * rows, (width, height))
            factors: list[tuple[NDArray[Any] | None, NDArray[Any]]] = [(None, table)]
        elif kind == "DFMF":
            to_rgb = _colour_model(data)
            factors = [_factors(data, rows, n_texels) for _ in range(n_channels)]
        else:
            if kind == "FMF12":
                to_rgb = _reduction(data)
            data.numbers("I")
            factors = [_factors(data, n_channels * rows, n_texels)]
        data.end()
    return Btf(
        *(width, height, views, lights, cosine_included, tuple(factors), to_rgb, rotations)
    )


def _kind(data: BinaryFile) -> tuple[str, bool]:
    """Kind of a container, and whether rotations follow the size."""
    start = data.file.read(10)
    signature = next((known for known in SIGNATURES if start.startswith(known)), None)
    kind = SIGNATURES.get(signature or b"", "")
    if signature is None or not kind:
        known = ", ".join(s.decode() for s, name in SIGNATURES.items() if name)
        raise CaptureError(
            f"{data.path}: expected a BTF container ({known}), received one that begins with "
            f"{quoted(start.decode('latin-1'))}"
        )
    data.file.seek(len(signature))
    data.left -= len(signature)
    return kind, kind != "BDI" and signature.endswith(b"R")


def _header(data: BinaryFile) -> tuple[bool, int]:
    """Whether the cosine is included, and the number of channels."""
    size, version = data.numbers("II")
    before = data.left + 8
    data.skip(3 * 80)
    data.numbers("f")
    scale = data.array("<f4", 3)
    if not (np.isfinite(scale).all() and (scale == scale[0]).all()):
        raise CaptureError(
            f"{data.path}: expected one scale of all channels, received {scale.tolist()}, "
            "which is not supported"
        )
    if not 1 <= version <= NEWEST_VERSION:
        raise CaptureError(
            f"{data.path}: expected a header of version 1 to {NEWEST_VERSION}, received "
            f"{version}"
        )
    cosine = bool(data.numbers("I")[0]) if version > 1 else False
    if version > 2:
        data.skip(data.count("bytes of XML", 1, layout="I"))
    n_channels = 3
    if version > 3:
        n_channels = data.count("channels", 4, layout="I")
        for _ in range(n_channels):
            data.skip(data.count("bytes of a name", 1, layout="I"))
    if before - data.left != size or n_channels != 3:
        raise CaptureError(
            f"{data.path}: expected a header of {size} bytes and three channels, received "
            f"{before - data.left} and {n_channels}; spectral tables are not supported"
        )
    return cosine, n_channels


def _sampling(data: BinaryFile) -> tuple[Array, Array]:
    """Directions of views and lights, the same lights for all views."""
    n_views = data.count("views", 12, MOST_DIRECTIONS, layout="I")
    views, lights = [], []
    for _ in range(n_views):
        views.append(data.array("<f4", 1, 2))
        n_lights = data.count("lights", 8, MOST_DIRECTIONS, layout="I")
        lights.append(data.array("<f4", n_lights, 2))
        if not np.array_equal(lights[-1], lights[0]):
            raise CaptureError(
                f"{data.path}: expected the same lights for all views, which is all that is "
                "supported, received others"
            )
    angles = np.concatenate([*views, *lights[:1]]) if views else np.zeros((0, 2))
    if len(angles) <= n_views or not np.isfinite(angles).all():
        raise CaptureError(f"{data.path}: expected finite angles of views and lights")
    directions = directions_of_angles(angles)
    return directions[:n_views], directions[n_views:]


def _rotations(data: BinaryFile, n_texels: int) -> Array | None:
    """Rotations of the texels, or none."""
    n = data.count("rotations", 36, MOST_TEXELS, layout="I")
    rotations = data.array("<f4", n, 3, 3).astype(np.float64)
    if n == 0:
        return None
    fault = not_a_rotation_because(rotations[0]) if n else ""
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3))
    if n != n_texels or fault or not (off < 1e-2).all():  # False for NaN
        raise CaptureError(
            f"{data.path}: expected a rotation for each of {n_texels} texels, received {n}"
            f"{f', {fault}' if fault else ''}"
        )
    return rotations


def _factors(data: BinaryFile, rows: int, columns: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """One factorisation: u, and v with the singular values."""
    size = data.numbers("B")[0]
    n, *shape = data.numbers("III")
    if size not in _NUMBERS or shape != [rows, columns] or not 1 <= n <= MOST_COMPONENTS:
        raise CaptureError(
            f"{data.path}: expected a factorisation of {rows} x {columns} in numbers of 2, 4 "
            f"or 8 bytes, received {shape[0]} x {shape[1]} of {n} components in {size}"
        )
    dtype = _NUMBERS[size]
    data.skip(n * np.dtype(dtype).itemsize)
    u, v = data.array(dtype, rows, n), data.array(dtype, columns, n)
    if not (np.isfinite(u).all() and np.isfinite(v).all()):
        raise CaptureError(f"{data.path}: expected finite values, received NaN or infinity")
    return u, v


def _colour_model(data: BinaryFile) -> Callable[[Array], Array]:
    _, model = data.numbers("Ii")
    mean, transform = data.array("<f4", 3), data.array("<f4", 3, 3)
    # A file may leave them at 0 where its model has no use for them.
    neutral = not mean.any() and (not transform.any() or np.array_equal(transform, np.eye(3)))
    if model not in _COLOUR_MODELS or not neutral:
        raise CaptureError(
            f"{data.path}: expected a colour model among {sorted(_COLOUR_MODELS)} without mean "
            f"and transformation, received {model} with {mean.tolist()} and "
            f"{transform.tolist()}, which is not supported"
        )
    return _COLOUR_MODELS[model]


def _reduction(data: BinaryFile) -> Callable[[Array], Array]:
    """Header of FMF12: reduction of the dynamic range; a height map is left out."""
    version = data.numbers("B")[0]
    method = data.numbers("I")[0] if version >= 1 else 0
    if version >= 2:
        width, height = data.numbers("II")
        data.skip(2 * width * height)
    if version > 2 or method not in (0, 1):
        raise CaptureError(
            f"{data.path}: expected a header of version 0 to 2 with reduction 0 or 1 (log), "
            f"received {version} and {method}"
        )
    return _COLOUR_MODELS[12 if method else 0]


def _table(
    data: BinaryFile, rows: int, size: tuple[int, int]
) -> tuple[NDArray[Any], Array | None]:
    """Uncompressed table (texels, rows) and rotations."""
    n_texels = size[0] * size[1]
    lines, compression = data.numbers("IB")
    if compression not in (0, 2) or not lines:
        raise CaptureError(
            f"{data.path}: expected an uncompressed table, received compression {compression} "
            f"and chunks of {lines} lines; unpack it with btflib"
        )
    if not data.array("u1", n_texels).all():
        raise CaptureError(
            f"{data.path}: expected a table of all texels, received one with missing texels, "
            "which is not supported"
        )
    rotations = _rotations(data, n_texels)
    if data.left < 2 * rows * n_texels:
        raise CaptureError(
            f"{data.path}: expected {2 * rows * n_texels:,} more bytes, received "
            f"{data.left:,}: the file is truncated; copy it again"
        )
    parts, n = [], 0
    while n < n_texels:
        n_bytes = data.count("bytes of a chunk", 1, layout="I")
        if n_bytes % (2 * rows) or not n_bytes:
            raise CaptureError(
                f"{data.path}: expected chunks of whole texels of {2 * rows} bytes, received "
                f"{n_bytes:,} bytes"
            )
        parts.append(data.array("<f2", n_bytes // (2 * rows), rows))
        n += len(parts[-1])
    table = np.concatenate(parts)
    if len(table) != n_texels or not np.isfinite(table).all():
        raise CaptureError(f"{data.path}: expected {n_texels} texels of finite values")
    return table, rotations
