r"""Light that goes from lit parts of a field's surface to others, traced through the field.

From each texel rays leave over its hemisphere, distributed as the cosine; where one meets the
surface from the front it ends at the nearest texel. They are traced once, into a sparse matrix
G of shares of rays. Under a light, the radiance R of texels, and what comes back from texel x,
are

.. math:: b_x = \rho_x (G R)_x, \quad
          R_y = f(y, n_y, l) E_l(y) \text{ where the light reaches } y, \text{ else } b_y,

f the field's samples along the normal, E the irradiance of a facing surface, :math:`\rho` the
albedo of a texel, the field's samples over all lights. So surfaces are taken to send light
evenly into all directions, as matt ones do: along the direction of each ray a field is asked
for what no camera or light has shown of a hollow, and errs more. The rounds in which light in
shadows goes on are few, as each loses most of it.

References
----------
C. Goral, K. Torrance, D. Greenberg, B. Battaile, "Modeling the interaction of light between
diffuse surfaces", SIGGRAPH 1984.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.lights import Light
from reflfield.field.evaluation import evaluate
from reflfield.field.texel_taps import texel_taps
from reflfield.render.camera_rays import FieldSurface
from reflfield.util.blas_threads import thread_pool
from reflfield.util.late_import import LateImport

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Of pictures only those with bounced light need it.
sparse = LateImport("scipy.sparse")

Floats = NDArray[np.float32]
Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Rays of a texel, and lights that its albedo is the mean over; along each of two axes.
RAYS_ALONG, LIGHTS_ALONG = 8, 8
# Times that light goes on from a surface in shadow, the first included.
ROUNDS = 4
# Largest albedo: what a texel shows along its normal may be a highlight.
LARGEST_ALBEDO = 0.99
# Texels whose rays are traced together.
TEXELS_AT_ONCE = 4096


def cosine_directions(offsets: Array) -> Array:
    """Directions (n, k * k, 3) about z, one in each of k x k cells of equal share.

    Parameters
    ----------
    offsets : (n, k * k, 2) float64
        Places in the cells, 0 to 1.

    Examples
    --------
    Their mean is that of the cosine, two thirds along z:

    >>> middle = np.full((1, 64, 2), 0.5)
    >>> float(cosine_directions(middle)[0].mean(axis=0)[2].round(2))
    0.67
    """
    side = round(offsets.shape[1] ** 0.5)
    ring, sector = np.divmod(np.arange(side * side), side)
    squared = (ring + offsets[..., 0]) / side
    azimuth = 2 * np.pi * (sector + offsets[..., 1]) / side
    radius = np.sqrt(squared)
    x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
    return np.stack([x, y, np.sqrt(1.0 - squared)], axis=-1)


class BouncedLight:
    """What lit texels of a field send to others.

    Parameters
    ----------
    surface : FieldSurface
        Of the field, whose arrays are decoded.
    workers : int
        Threads; results do not depend on their number.
    """

    def __init__(self, surface: FieldSurface, workers: int = 1) -> None:
        self.surface, self.field, self.workers = surface, surface.field, max(workers, 1)
        self._texels = np.arange(self.field.n_texels, dtype=np.int32)
        self._normals = np.ascontiguousarray(self.field.local_from_world[:, 2], np.float32)

    @cached_property
    def shares(self) -> csr_array:
        """(n_texels, n_texels) float32: share of each texel's rays that ends at each other."""
        n, _ = self.field.n_texels, self.surface.texel_points  # before threads could each do it
        blocks = [
            np.arange(first, min(first + TEXELS_AT_ONCE, n))
            for first in range(0, n, TEXELS_AT_ONCE)
        ]
        with thread_pool(self.workers) as pool:
            parts = list(pool.map(self._traced, blocks))
        rows, columns = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        share = np.full(len(rows), 1.0 / RAYS_ALONG**2, np.float32)
        matrix: csr_array = sparse.csr_array((share, (rows, columns)), shape=(n, n))
        matrix.sum_duplicates()
        return matrix

    def _traced(self, texels: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Texels (k,) of all rays that end at one, and where they end (k,)."""
        positions, normals = (array[texels] for array in self.surface.texel_points)
        frames = self.surface.texels.local_from_world[texels].astype(np.float64)
        rng = np.random.default_rng(int(texels[0]))
        local = cosine_directions(rng.random((len(texels), RAYS_ALONG**2, 2)))
        directions = np.einsum("nji,nkj->nki", frames, local)
        origins = positions + self.surface.lift * normals
        row, ray = np.nonzero(np.einsum("nkd,nd->nk", directions, normals) > 0)
        hits = self.surface.first_hits(origins[row], directions[row, ray])
        ends, weights = texel_taps(self.field, hits.uv, np.zeros(len(hits.ray)))
        nearest = ends[np.arange(len(ends)), weights.argmax(axis=1)]
        used = hits.front & (nearest >= 0)
        return texels[row[hits.ray[used]]], nearest[used].astype(np.intp)

    @cached_property
    def albedo(self) -> Floats:
        """(n_texels, 3) share of the light of a whole sky that comes back along the normal."""
        middle = np.full((1, LIGHTS_ALONG**2, 2), 0.5)
        frames = self.field.local_from_world.astype(np.float32)
        total = np.zeros((len(frames), 3))
        for local in cosine_directions(middle)[0].astype(np.float32):
            towards = np.einsum("nij,i->nj", frames, local)
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            total += evaluate(self.field, self._texels, self._normals, towards) / local[2]
        return np.minimum(np.pi * total / LIGHTS_ALONG**2, LARGEST_ALBEDO).astype(np.float32)

    def lit(self, light: Light) -> Bools:
        """(n_texels,) True where a light reaches a texel."""
        positions, normals = self.surface.texel_points
        return self.surface.reached_by_light(
            positions, normals, light.directions(positions), light.distances(positions)
        )

    def under(self, light: Light, lit: Bools | None = None) -> Floats:
        """Bounced light of all texels as samples, (n_texels, 3), 1/sr.

        Parameters
        ----------
        light : Light
            Not an environment.
        lit : (n_texels,) bool, optional
            Where it reaches a texel; traced by default.
        """
        positions = self.surface.texel_points[0]
        irradiance = light.irradiance(positions)
        reached = self.lit(light) if lit is None else lit
        towards = light.directions(positions).astype(np.float32)
        direct = self._direct(towards) * irradiance.astype(np.float32)
        bounced = self.between(direct[:, None], reached[:, None])[:, 0]
        known = irradiance > 0
        return np.where(known, bounced / np.where(known, irradiance, 1.0), 0).astype(np.float32)

    def of_distant(self, directions: Floats, lit: Bools) -> Floats:
        """Bounced light of all texels under distant lights, (n_texels, m, 3), 1/sr.

        Parameters
        ----------
        directions : (m, 3) float32
            Unit vectors to the lights.
        lit : (n_texels, m) bool
        """
        one = np.ones((len(self._texels), 1), np.float32)
        parts = [self._direct(one * direction) for direction in directions]
        return self.between(np.stack(parts, axis=1), lit)

    def _direct(self, towards: Floats) -> Floats:
        """Samples of all texels along their normals, under lights of their own."""
        return np.asarray(evaluate(self.field, self._texels, self._normals, towards))

    def between(self, direct: Floats, lit: Bools) -> Floats:
        """What comes back from texels of what lit ones send, (n_texels, m, 3).

        Parameters
        ----------
        direct : (n_texels, m, 3) float32
            Radiance of a texel that a light reaches.
        lit : (n_texels, m) bool
        """
        n, m, _ = direct.shape
        albedo, reached = self.albedo[:, None], lit[..., None]
        bounced = np.zeros_like(direct)
        for _ in range(ROUNDS):
            sent = np.where(reached, direct, bounced).reshape(n, 3 * m)
            bounced = albedo * (self.shares @ sent).reshape(n, m, 3)
        return bounced
