"""Run xatlas in a process of its own: ``python -m reflfield.geometry.xatlas_worker IN OUT``.

xatlas can crash, or hang, and cannot be interrupted; a process can. It is bounded by work and
memory, not by time: neither changes with the load of the machine. Arrays travel in .npz files
without pickle:

* IN: ``positions`` (n, 3) float32, ``normals`` (n, 3) float32, ``faces`` (m, 3) uint32,
  ``resolution`` and ``padding`` int, ``max_cost`` float. The mesh has total area 1.
* OUT: ``source_vertex`` (k,) uint32 vertex of IN, ``faces`` (m, 3) uint32, ``chart`` (m,)
  int32 (-1: in no chart), ``uv`` (k, 2) float32 in texels; or ``refused`` alone, the reason
  why the mesh cannot be unwrapped.
"""

from __future__ import annotations

import sys
from contextlib import suppress

import numpy as np
import xatlas
from numpy.typing import NDArray

try:
    import resource
except ModuleNotFoundError:  # not on Windows
    resource = None  # type: ignore[assignment]

# Share of the texture that charts fill; packing reached .50 at 256 texels on hulls.
_EXPECTED_FILL = 0.5

# A packing is good enough between this share of the wanted side and the whole of it.
_SMALLEST_SIDE = 0.98
_LARGEST_NUMBER_OF_PACKINGS = 12

# Charts times texels up to which every place of the texture is tried for each chart (6 s of
# one core for 42 charts in 1024 x 1024 texels); beyond, places drawn with a fixed seed.
_MOST_PLACES = 64_000_000

# Address space of the process, bytes. 80,000 triangles take .35 GB of memory.
_MOST_MEMORY = 8 << 30

# Charts that are expected before they are counted.
_EXPECTED_CHARTS = 64


class ChartsDoNotFitError(Exception):
    """The texture is too small for the charts, whatever their scale."""


def unwrap(
    positions: NDArray[np.float32],
    normals: NDArray[np.float32],
    faces: NDArray[np.uint32],
    *,
    resolution: int,
    padding: int,
    max_cost: float,
) -> dict[str, NDArray[np.generic]]:
    """Cut a mesh into charts and pack them as large as they fit; see OUT above."""
    scale = resolution * float(np.sqrt(_EXPECTED_FILL))
    atlas = xatlas.Atlas()
    atlas.add_mesh(positions, faces, normals)
    options = xatlas.ChartOptions()
    options.max_cost = max_cost
    atlas.generate(options, _pack_options(scale, padding, _EXPECTED_CHARTS, resolution))
    source_vertex, new_faces, uv = atlas[0]
    chart = np.full(len(faces), -1, dtype=np.int32)
    for number in range(atlas.get_mesh_chart_count(0)):
        chart[np.asarray(atlas.get_mesh_chart(0, number).faces, dtype=np.int64)] = number
    size = max(atlas.width, atlas.height)
    # From here on one unit of UV is the root of the mesh's area, whatever the packing.
    unit_uv = uv * (np.array([atlas.width, atlas.height]) / scale)
    charted = chart >= 0
    corners = _fitted(
        unit_uv, new_faces[charted], chart[charted], scale, size, resolution, padding
    )
    texels = np.zeros((len(unit_uv), 2), dtype=np.float32)
    texels[new_faces[charted]] = corners
    return {"source_vertex": source_vertex, "faces": new_faces, "chart": chart, "uv": texels}


def _fitted(
    uv: NDArray[np.float32],
    faces: NDArray[np.uint32],
    chart: NDArray[np.int32],
    scale: float,
    size: int,
    resolution: int,
    padding: int,
) -> NDArray[np.float32]:
    """Pack charts at the largest scale found whose side is at most `resolution` texels.

    xatlas honours a scale, not a resolution. The side grows with the scale, in jumps;
    secant steps, kept between a scale that fits and one that does not, end soon.
    """
    best, fits, too_large = None, 0.0, np.inf
    n_charts = int(chart.max(initial=0)) + 1
    for _ in range(_LARGEST_NUMBER_OF_PACKINGS):
        # The padding does not grow with the scale, so steps are cautious.
        scale *= (resolution - padding) / size
        if not fits < scale < too_large:
            scale = 0.5 * (fits + too_large) if np.isfinite(too_large) else 1.02 * fits
        pack = _pack_options(scale, padding, n_charts, resolution)
        corners, size = _packed(uv, faces, chart, pack)
        if size > resolution:
            too_large = scale
            continue
        best, fits = corners, scale
        if size >= _SMALLEST_SIDE * resolution:
            break
    if best is None:
        raise ChartsDoNotFitError(
            f"{n_charts} charts do not fit into {resolution} x {resolution} texels with "
            f"padding {padding}"
        )
    return best


def _packed(
    uv: NDArray[np.float32],
    faces: NDArray[np.uint32],
    chart: NDArray[np.int32],
    pack: xatlas.PackOptions,
) -> tuple[NDArray[np.float32], int]:
    """UV in texels of the corners of each face, (m, 3, 2), and the larger side."""
    # A fresh atlas each time: a second `generate` on one atlas does not return.
    atlas = xatlas.Atlas()
    # Chart numbers as materials keep charts that touch apart.
    atlas.add_uv_mesh(uv.astype(np.float32), faces, chart.astype(np.uint32)[:, None])
    atlas.generate(xatlas.ChartOptions(), pack)
    _, corners, fresh = atlas[0]
    size = np.array([atlas.width, atlas.height], dtype=np.float32)
    return fresh[corners] * size, int(size.max())


def _pack_options(
    scale: float, padding: int, n_charts: int, resolution: int
) -> xatlas.PackOptions:
    pack = xatlas.PackOptions()
    pack.padding = padding
    pack.texels_per_unit = scale
    pack.resolution = 0  # one page, as large as needed
    # The texel table fills its own gutter; trying every place packs denser.
    pack.bilinear = False
    pack.bruteForce = n_charts * resolution**2 <= _MOST_PLACES
    return pack


def bound_memory() -> None:
    """Have the system refuse this process more than `_MOST_MEMORY`, where it can."""
    if resource is not None:
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))


def main(source: str, target: str) -> None:
    """Read IN, unwrap, write OUT."""
    bound_memory()
    with np.load(source, allow_pickle=False) as job:
        try:
            result = unwrap(
                job["positions"],
                job["normals"],
                job["faces"],
                resolution=int(job["resolution"]),
                padding=int(job["padding"]),
                max_cost=float(job["max_cost"]),
            )
        except ChartsDoNotFitError as error:
            result = {"refused": np.array(str(error))}
    np.savez(target, allow_pickle=False, **result)


if __name__ == "__main__":
    main(*sys.argv[1:])
