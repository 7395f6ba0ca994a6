"""How the hull agrees with the silhouettes that it was carved by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.geometry.explanations import compared_pixels, overlap, silhouette_of
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.ray_scene import RayScene
from reflfield.util.blas_threads import thread_pool

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Agreement:
    """How a mesh agrees with silhouettes.

    Parameters
    ----------
    overlap : (n_views,) float64
        Intersection over union.
    missing : (n_views,) float64
        Share of each silhouette that the mesh does not cover.
    lost : list of (rows, columns) bool
        Compared pixels of each silhouette that the mesh does not cover.
    """

    overlap: Array
    missing: Array
    lost: list[NDArray[np.bool_]]


def agreement_of(
    mesh: Mesh,
    cameras: Sequence[Camera],
    silhouettes: Sequence[NDArray[np.floating]],
    workers: int,
) -> Agreement:
    """How a mesh agrees with silhouettes, at some pixels of each.

    Parameters
    ----------
    mesh : Mesh
    cameras : sequence of Camera
    silhouettes : sequence of (height, width) float
        Coverage in [0, 1].
    workers : int
        Threads; the answer does not depend on their number.

    Returns
    -------
    Agreement
    """
    scene = RayScene(mesh, threads=1)

    def agree(number: int) -> tuple[float, float, NDArray[np.bool_]]:
        some, _, _ = compared_pixels(cameras[number])
        shown = np.asarray(silhouettes[number])[some, some] >= 0.5
        hit = silhouette_of(scene, cameras[number])
        lost = shown & ~hit
        return overlap(shown, hit), lost.sum() / max(shown.sum(), 1), lost

    with thread_pool(workers) as pool:
        overlaps, missing, lost = zip(*pool.map(agree, range(len(cameras))), strict=True)
    return Agreement(np.array(overlaps), np.array(missing), list(lost))
