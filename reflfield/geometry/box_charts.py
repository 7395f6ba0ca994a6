"""Simple charts: the surface seen along the six main directions, packed on shelves.

The fallback where xatlas fails: always fast, always disjoint, but with many seams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import GeometryError
from reflfield.geometry.mesh import Mesh
from reflfield.util.late_import import LateImport

sparse: Any = LateImport("scipy.sparse")
csgraph: Any = LateImport("scipy.sparse.csgraph")

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Rounds in which a face joins the side that most of its neighbours are on.
_SMOOTHING_ROUNDS = 4

# Faces may follow their neighbours to a side that they face by at least this cosine.
_LEAST_COSINE = 0.2

# Right-handed axes (right, up) for charts seen from +x, -x, +y, -y, +z, -z.
_NORMALS = np.kron(np.eye(3), [[1.0], [-1.0]])
_RIGHT = np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0]], float)
_UP = np.cross(_NORMALS, _RIGHT)


@dataclass(frozen=True, eq=False)
class Charts:
    """Charts laid out in a square texture.

    Parameters
    ----------
    source_vertex : (k,) int64
        Vertex of the mesh that each new vertex copies.
    faces : (m, 3) int64
        New vertices of each face.
    chart : (m,) int64
        Chart of each face.
    uv : (k, 2) float64
        In [0, 1].
    """

    source_vertex: Integers
    faces: Integers
    chart: Integers
    uv: Array


def box_charts(mesh: Mesh, resolution: int, padding: int) -> Charts:
    """Charts of connected faces that look the same main way, disjoint in the texture.

    Parameters
    ----------
    mesh : Mesh
    resolution : int
        Side of the texture, texels.
    padding : int
        Texels kept free around each chart.

    Returns
    -------
    Charts

    Raises
    ------
    GeometryError
        If the charts do not fit.

    Examples
    --------
    >>> tetrahedron = Mesh(
    ...     [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    ...     [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> box_charts(tetrahedron, 64, 2).chart.max() + 1
    np.int64(4)
    """
    side = _sides(mesh)
    chart = _connected(mesh, side)
    while True:
        chart, split = _split_overlaps(mesh, side, chart)
        if not split:
            break
    return _packed(mesh, side, chart, resolution, padding)


def _sides(mesh: Mesh) -> Integers:
    """Main direction (0 .. 5) of each face, smoothed over neighbours."""
    cosine = mesh.face_normals @ _NORMALS.T
    side = np.argmax(cosine, axis=1)
    neighbours = _face_graph(mesh)
    for _ in range(_SMOOTHING_ROUNDS):
        # A face's own direction counts as one more neighbour.
        votes = neighbours @ np.eye(6)[side] + cosine
        side = np.argmax(np.where(cosine >= _LEAST_COSINE, votes, cosine - 9.0), axis=1)
    return side


def _face_graph(mesh: Mesh) -> Any:
    """Symmetric (m, m) matrix: 1 where two faces share an edge."""
    ends = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends = np.sort(ends, axis=1)
    edge = np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1)
    face = np.repeat(np.arange(len(mesh.faces)), 3)
    uses = sparse.coo_array((np.ones(len(face)), (face, edge))).tocsr()
    shared = (uses @ uses.T).tocsr()
    shared.setdiag(0.0)
    return sparse.csr_array((shared > 0).astype(np.float64))


def _connected(mesh: Mesh, label: Integers) -> Integers:
    """Number of the edge-connected region of equal label of each face."""
    graph = _face_graph(mesh).tocoo()
    same = label[graph.row] == label[graph.col]
    kept = sparse.coo_array(
        (np.ones(int(same.sum())), (graph.row[same], graph.col[same])), shape=graph.shape
    )
    return csgraph.connected_components(kept, directed=False)[1].astype(np.int64)


def _projected(mesh: Mesh, side: Integers) -> tuple[Array, Array]:
    """Corners of the faces in the plane of their side, (m, 3, 2), and their depth (m,)."""
    corners = mesh.corners - mesh.bounds.mean(axis=0)
    flat = np.stack(
        [
            np.einsum("fkd,fd->fk", corners, _RIGHT[side]),
            np.einsum("fkd,fd->fk", corners, _UP[side]),
        ],
        axis=-1,
    )
    return flat, np.einsum("fkd,fd->f", corners, _NORMALS[side]) / 3.0


def _split_overlaps(mesh: Mesh, side: Integers, chart: Integers) -> tuple[Integers, bool]:
    """Halve, by depth, charts in which one part lies over another.

    A chart overlaps itself if the centre of a face lies inside another of its faces.
    """
    flat, depth = _projected(mesh, side)
    overlapping = np.unique(chart[_covered_centres(flat, chart)])
    if not len(overlapping):
        return chart, False
    label = 2 * chart
    for number in overlapping:
        faces = np.flatnonzero(chart == number)
        order = faces[np.argsort(depth[faces], kind="stable")]
        label[order[len(order) // 2 :]] += 1
    return _connected(mesh, label), True


def _covered_centres(flat: Array, chart: Integers) -> Integers:
    """Faces whose centre lies inside another face of the same chart."""
    centres = flat.mean(axis=1)
    low, high = flat.min(axis=1), flat.max(axis=1)
    cell = max(float(np.median((high - low).max(axis=1))), float((high - low).max()) / 64.0)
    pairs = _pairs_in_cells(centres, low, high, chart, cell)
    face, other = pairs[pairs[:, 0] != pairs[:, 1]].T
    edges = np.roll(flat[other], -1, axis=1) - flat[other]
    offset = centres[face][:, None] - flat[other]
    inside = (edges[..., 0] * offset[..., 1] - edges[..., 1] * offset[..., 0] > 0.0).all(axis=1)
    return face[inside]


def _pairs_in_cells(
    centres: Array, low: Array, high: Array, chart: Integers, cell: float
) -> Integers:
    """Pairs (face, other) of one chart whose centre and box fall into the same cell."""
    first = np.floor(low / cell).astype(np.int64)
    size = np.floor(high / cell).astype(np.int64) - first + 1
    counts = size.prod(axis=1)
    other = np.repeat(np.arange(len(low)), counts)
    step = np.arange(len(other)) - np.repeat(np.cumsum(counts) - counts, counts)
    row, col = np.divmod(step, size[other, 0])
    boxes = np.column_stack([chart[other], first[other] + np.column_stack([col, row])])
    points = np.column_stack([chart, np.floor(centres / cell).astype(np.int64)])
    keys = np.unique(np.concatenate([boxes, points]), axis=0, return_inverse=True)[1].ravel()
    n_keys = int(keys.max()) + 1
    ones = np.ones(len(keys), dtype=np.int8)
    in_box = sparse.coo_array(
        (ones[: len(boxes)], (keys[: len(boxes)], other)), shape=(n_keys, len(low))
    ).tocsr()
    at_point = sparse.coo_array(
        (ones[len(boxes) :], (np.arange(len(low)), keys[len(boxes) :])),
        shape=(len(low), n_keys),
    ).tocsr()
    return np.stack((at_point @ in_box).nonzero(), axis=1)


def _packed(
    mesh: Mesh, side: Integers, chart: Integers, resolution: int, padding: int
) -> Charts:
    """Lay the charts out at the largest common scale at which they fit."""
    flat, _ = _projected(mesh, side)
    n_charts = int(chart.max()) + 1
    low, high = np.full((n_charts, 2), np.inf), np.full((n_charts, 2), -np.inf)
    np.minimum.at(low, chart, flat.min(axis=1))
    np.maximum.at(high, chart, flat.max(axis=1))
    scale, corner = _largest_layout(high - low, resolution, padding)
    # New vertices: one for each pair of chart and old vertex.
    keys = chart[:, None] * len(mesh.vertices) + mesh.faces
    unique, first, faces = np.unique(keys, return_index=True, return_inverse=True)
    own = unique // len(mesh.vertices)
    position = flat.reshape(-1, 2)[first]
    texels = (position - low[own]) * scale + corner[own] + padding
    return Charts(
        source_vertex=unique % len(mesh.vertices),
        faces=faces.reshape(-1, 3).astype(np.int64),
        chart=chart,
        uv=texels / resolution,
    )


def _largest_layout(sizes: Array, resolution: int, padding: int) -> tuple[float, Array]:
    """Largest texels per metre at which boxes of these sizes fit, and their corners."""
    fits, corner = 0.0, None
    too_large = resolution / float(sizes.max())
    for _ in range(20):
        scale = 0.5 * (fits + too_large)
        tried = _shelves(sizes * scale + 2 * padding, resolution)
        if tried is None:
            too_large = scale
        else:
            fits, corner = scale, tried
    if corner is None:
        raise GeometryError(
            f"atlas: expected charts that fit, received {len(sizes)} charts for a texture of "
            f"{resolution} texels; raise atlas.resolution or smooth the mesh more"
        )
    return fits, corner


def _shelves(sizes: Array, resolution: int) -> Array | None:
    """Lower left corners of boxes placed in rows, tallest first; None if they do not fit."""
    sizes = np.ceil(sizes)
    corner = np.zeros_like(sizes)
    x = y = height = 0.0
    for box in np.lexsort((np.arange(len(sizes)), -sizes[:, 1])):
        if x + sizes[box, 0] > resolution:
            x, y, height = 0.0, y + height, 0.0
        height = max(height, sizes[box, 1])
        if x + sizes[box, 0] > resolution or y + height > resolution:
            return None
        corner[box] = x, y
        x += sizes[box, 0]
    return corner
