"""Materials whose frame, tint or kind varies over the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.materials.base import Array, Floats, Material
from capture_sim.materials.textures import Constant, Texture

WHITE = Constant((1.0,))
UNTURNED = Constant((0.0,))
BUMP_STEP = 1e-4  # of the texture's period: finite difference of the height


@dataclass(frozen=True)
class SpatiallyVarying(Material):
    """A material in a shading frame that varies over the surface.

    Parameters
    ----------
    base : Material
        Evaluated in the shading frame.
    tint : Texture
        Factor on the value of `base`, RGB in [0, 1].
    tangent_angle : Texture
        Turn of the tangent about the normal, radians, from tangent to binormal.
    normal_map : Texture, optional
        Normal in the surface frame (tangent, binormal, normal) as
        ``0.5 + 0.5 n`` in three linear channels.
    height : Texture, optional
        Bump map: normals tilt by the slope of this height over u and v.
    height_scale : float
        Slope per unit of height and unit of texture coordinate.

    Examples
    --------
    A quarter turn carries the tangent to the binormal:

    >>> from capture_sim.materials.analytic import Lambert
    >>> grey = Lambert(Constant((0.5,)))
    >>> turned = SpatiallyVarying(grey, tangent_angle=Constant((np.pi / 2,)))
    >>> turned.frame_change(np.zeros((1, 2))).round(12)[0, 0]
    array([0., 1., 0.])
    """

    base: Material
    tint: Texture = WHITE
    tangent_angle: Texture = UNTURNED
    normal_map: Texture | None = None
    height: Texture | None = None
    height_scale: float = 0.0

    def _reflect(self, views: Array, lights: Array, uv: Array) -> Array:
        return self.tint.rgb(uv) * self.base.evaluate(views, lights, uv)

    def evaluate_lights(
        self, views: Floats, lights: Floats, lit: NDArray[np.bool_], uv: Array
    ) -> Floats:
        """Values of the base, tinted; see `Material.evaluate_lights`."""
        values = self.base.evaluate_lights(views, lights, lit, uv)
        if self.tint.bounds != (1.0, 1.0):
            values *= self.tint.rgb(uv)[:, :, None].astype(values.dtype)
        return values

    def lobe(self, uv: Array) -> Array:
        """That of the base."""
        return self.base.lobe(uv)

    @property
    def precision(self) -> type[np.floating[Any]]:
        """That of the base."""
        return self.base.precision

    def frame_change(self, uv: Array) -> Array:
        """``shading_from_surface``, (n, 3, 3); see `Material.frame_change`."""
        normals = self._normals(uv)
        angles = self.tangent_angle.scalar(uv)
        zeros = np.zeros_like(angles)
        tangents = np.hstack([np.cos(angles), np.sin(angles), zeros])
        frames = frames_from(normals, tangents)
        return np.asarray(self.base.frame_change(uv) @ frames)

    def _normals(self, uv: Array) -> Array:
        """Shading normals in the surface frame; need not be unit."""
        normals = np.tile([0.0, 0.0, 1.0], (len(uv), 1))
        if self.normal_map is not None:
            normals = 2.0 * self.normal_map.rgb(uv) - 1.0
            # A normal on or below the surface would turn the frame inside out.
            normals[:, 2] = np.maximum(normals[:, 2], 1e-2)
        if self.height is not None:
            normals[:, :2] -= self._slopes(self.height, uv) * normals[:, 2:]
        return normals

    def _slopes(self, height: Texture, uv: Array) -> Array:
        steps = BUMP_STEP * np.eye(2)
        rises = [height.scalar(uv + step) - height.scalar(uv - step) for step in steps]
        return np.hstack(rises) * (self.height_scale / (2.0 * BUMP_STEP))

    def label(self, uv: Array) -> NDArray[np.int16]:
        """Labels of the base material."""
        return self.base.label(uv)

    @property
    def uses_uv(self) -> bool:
        """True if any map or the base varies over the surface."""
        maps = (self.tint, self.tangent_angle, self.normal_map, self.height)
        return self.base.uses_uv or any(t is not None and t.uses_uv for t in maps)


@dataclass(frozen=True)
class Mixed(Material):
    """Several materials, one at each point, chosen by a label texture.

    Parameters
    ----------
    materials : tuple of Material
        The materials that labels 0, 1, ... stand for.
    labels : Texture
        Rounded to the nearest label.
    """

    materials: tuple[Material, ...]
    labels: Texture

    def _reflect(self, views: Array, lights: Array, uv: Array) -> Array:
        labels, values = self.label(uv), np.zeros((len(uv), 3))
        for index, material in enumerate(self.materials):
            here = labels == index
            values[here] = material.evaluate(views[here], lights[here], uv[here])
        return values

    def evaluate_lights(
        self, views: Floats, lights: Floats, lit: NDArray[np.bool_], uv: Array
    ) -> Floats:
        """Values of the material at each point; see `Material.evaluate_lights`."""
        labels, values = self.label(uv), np.zeros_like(lights)
        for index, material in enumerate(self.materials):
            here = np.flatnonzero(labels == index)
            if len(here) == len(uv):
                return material.evaluate_lights(views, lights, lit, uv)
            if len(here):
                values[here] = material.evaluate_lights(
                    views[here], lights[here], lit[here], uv[here]
                )
        return values

    def lobe(self, uv: Array) -> Array:
        """That of the material at each point."""
        labels, lobes = self.label(uv), np.zeros((len(uv), 2))
        for index, material in enumerate(self.materials):
            lobes[labels == index] = material.lobe(uv[labels == index])
        return lobes

    @property
    def precision(self) -> type[np.floating[Any]]:
        """float64 if any of the materials needs it."""
        exact = any(material.precision is np.float64 for material in self.materials)
        return np.float64 if exact else np.float32

    def frame_change(self, uv: Array) -> Array:
        """``shading_from_surface`` of the material at each point, (n, 3, 3)."""
        labels, frames = self.label(uv), np.zeros((len(uv), 3, 3))
        for index, material in enumerate(self.materials):
            here = labels == index
            frames[here] = material.frame_change(uv[here])
        return frames

    def label(self, uv: Array) -> NDArray[np.int16]:
        """Index into `materials` of each point, (n,) int16."""
        rounded = np.rint(self.labels.scalar(uv)[:, 0])
        return np.clip(rounded, 0, len(self.materials) - 1).astype(np.int16)

    @property
    def uses_uv(self) -> bool:
        """True if the labels or any of the materials vary over the surface."""
        return self.labels.uses_uv or any(m.uses_uv for m in self.materials)


def frames_from(normals: Array, tangents: Array) -> Array:
    """Orthonormal right-handed frames with given normals, tangents as near as can be.

    Parameters
    ----------
    normals, tangents : (n, 3) float64
        Neither zero nor parallel to each other; need not be unit.

    Returns
    -------
    (n, 3, 3) float64
        Rows tangent, binormal, normal: ``local_from_world`` if both are in world
        coordinates.

    Examples
    --------
    >>> frames_from(np.array([[0.0, 0.0, 2.0]]), np.array([[3.0, 0.0, 1.0]]))[0]
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    n = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    t = tangents - np.sum(tangents * n, axis=1, keepdims=True) * n
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    return np.stack([t, np.cross(n, t), n], axis=1)
