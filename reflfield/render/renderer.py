"""Images of a reflectance field from any camera under any light.

An image is made by blocks of pixels: rays through a regular grid inside each
pixel, first hits on the base mesh, the bilinear texels of each hit, and the samples of
those texels towards camera and light. Lights near enough to be points, far ones
and spots are evaluated exactly; environment maps as a set of directional lights
shared by all texels. Where the field was fitted without shadows
(``visibility == "factored"``) they are traced, and hits in shadow show the indirect light of
their texels, with what lit parts of the surface send there (`render.bounced_light`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.lights import ENVIRONMENT, UNKNOWN, Light
from reflfield.errors import InputError
from reflfield.field.evaluation import evaluate, sum_lights
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.options import MOST_WORKERS, available_cores
from reflfield.render.bounced_light import BouncedLight
from reflfield.render.camera_rays import (
    FieldSurface,
    SurfaceHits,
    pixel_window,
    subpixel_offsets,
)
from reflfield.render.distant_lights import DistantLights
from reflfield.render.environment_map import EnvironmentMap
from reflfield.render.footprints import Footprints
from reflfield.util.blas_threads import thread_pool
from reflfield.util.validation import check_ranges

Array = NDArray[np.float64]
Lighting = Light | EnvironmentMap | Sequence[Light | EnvironmentMap]

# Light nodes times texels of one environment sum: 3 floats each, 48 MB at most.
_NODES_AT_ONCE = 1 << 22


# Shadow rays of an environment that are traced together: 80 MB.
_SHADOW_RAYS_AT_ONCE = 1 << 18

# Lights whose bounced light is worked out together under an environment, and that are kept
# after an image.
_BOUNCES_AT_ONCE, _BOUNCES_KEPT = 16, 64

# Least and most of each option.
RANGES: dict[str, tuple[float, float]] = {
    "samples_per_pixel": (1, 4096),
    "environment_directions": (1, 16384),
    "block_pixels": (1, 1 << 20),
    "workers": (0, MOST_WORKERS),
    "ray_offset": (0.0, 0.1),
}


@dataclass(frozen=True)
class RenderOptions:
    """How images are made.

    Parameters
    ----------
    samples_per_pixel : int
        Rays through a pixel, a square number from 1 to 4096: a regular grid, the same in
        every pixel, so nothing is random.
    environment_directions : int
        Directional lights that stand for an environment map, 1 to 16384.
    block_pixels : int
        Pixels worked on together by one thread, 1 to 1048576. Memory grows with it; the
        image does not depend on it.
    workers : int
        Threads, at most 1024; 0 takes one for each processor core. The image does not
        depend on it.
    ray_offset : float
        Height at which shadow rays start, in diagonals of the mesh, 0 to 0.1.

    Raises
    ------
    InputError
        If a number is out of range.
    """

    samples_per_pixel: int = 16
    environment_directions: int = 512
    block_pixels: int = 4096
    workers: int = 0
    ray_offset: float = 2e-4

    def __post_init__(self) -> None:
        check_ranges(self, RANGES)
        if isqrt(self.samples_per_pixel) ** 2 != self.samples_per_pixel:
            raise InputError(
                f"samples_per_pixel: expected a square number, "
                f"received {self.samples_per_pixel}; take 1, 4, 9, 16, ..."
            )

    @property
    def n_threads(self) -> int:
        """Threads to run."""
        return self.workers or available_cores()


@dataclass(frozen=True, eq=False)
class Rendering:
    """An image of the object alone.

    Parameters
    ----------
    image : (height, width, 3) float32
        Linear radiance times coverage: the object over black.
    coverage : (height, width) float32
        Share of each pixel that the base mesh covers.
    """

    image: NDArray[np.float32]
    coverage: NDArray[np.float32]


def render(
    field: ReflectanceField,
    camera: Camera,
    lights: Lighting,
    options: RenderOptions | None = None,
) -> Rendering:
    """Make one image; for several, a `Renderer` shares what they have in common.

    Parameters
    ----------
    field : ReflectanceField
        What to show.
    camera : Camera
        From where.
    lights : Light, EnvironmentMap, or a sequence of them
        Under which lights; they add up.
    options : RenderOptions, optional
        Samples, threads.

    Returns
    -------
    Rendering

    Raises
    ------
    InputError
        If a light is unknown but the field's lights were known.
    """
    return Renderer(field, options).render(camera, lights)


class Renderer:
    """Makes images of one field.

    Parameters
    ----------
    field : ReflectanceField
        What to show. Its tables are decoded once, here.
    options : RenderOptions, optional
        Samples, threads.

    Notes
    -----
    A field of unknown lighting shows that lighting, whatever lights are given:
    nothing is known of how it answers to others.
    """

    def __init__(self, field: ReflectanceField, options: RenderOptions | None = None) -> None:
        self.field = field
        self.options = options or RenderOptions()
        # Blocks have threads of their own: their rays are traced by the thread that asks.
        self.surface = FieldSurface(field, 1, self.options.ray_offset)
        self._environments: dict[object, EnvironmentLighting] = {}
        # Decoded here, before threads could each do it.
        field.decode()
        traced = field.visibility == "factored" and field.indirect.is_traced
        self._bounced = BouncedLight(self.surface, self.options.n_threads) if traced else None
        # With their lights, so that these are not replaced by others of the same identity.
        self._bounces: dict[int, tuple[Light, NDArray[np.float32]]] = {}

    def render(self, camera: Camera, lights: Lighting) -> Rendering:
        """Make one image.

        Parameters
        ----------
        camera : Camera
            From where.
        lights : Light, EnvironmentMap, or a sequence of them
            Under which lights.

        Returns
        -------
        Rendering

        Raises
        ------
        InputError
            If a light is unknown but the field's lights were known.
        """
        images, coverage = self._images(camera, [self._sources(lights)])
        return Rendering(images[0], coverage)

    def render_each(self, camera: Camera, lights: Sequence[Light]) -> list[Rendering]:
        """Make one image for each light; rays are traced once for all.

        Parameters
        ----------
        camera : Camera
        lights : sequence of Light

        Returns
        -------
        list of Rendering
            They share their coverage.

        Raises
        ------
        InputError
            If a light is unknown but the field's lights were known.
        """
        images, coverage = self._images(camera, [self._sources(light) for light in lights])
        return [Rendering(image, coverage) for image in images]

    def _images(
        self, camera: Camera, groups: Sequence[Sequence[Light | EnvironmentLighting]]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Image under each group of lights, and their coverage."""
        self._trace_bounces([s for group in groups for s in group if isinstance(s, Light)])
        images = np.zeros((len(groups), camera.height, camera.width, 3), np.float32)
        coverage = np.zeros((camera.height, camera.width), np.float32)
        blocks = _blocks(pixel_window(camera, self.surface.mesh), self.options.block_pixels)
        with thread_pool(self.options.n_threads) as pool:
            done = pool.map(lambda block: self._block(camera, groups, *block), blocks)
            for (row, column), (radiance, covered) in zip(blocks, done, strict=True):
                images[:, row, column] = radiance
                coverage[row, column] = covered
        return images, coverage

    def _trace_bounces(self, lights: Sequence[Light]) -> None:
        """Work out the bounced light of all texels under some lights."""
        if self._bounced is None:
            return
        new = {id(light): light for light in lights if id(light) not in self._bounces}
        needed = {id(light) for light in lights}
        old = [key for key in self._bounces if key not in needed]
        for key in old[: max(len(old) + len(needed) - _BOUNCES_KEPT, 0)]:
            del self._bounces[key]
        bounced = self._bounced
        _ = (bounced.shares, bounced.albedo)
        with thread_pool(self.options.n_threads) as pool:
            for light, values in zip(
                new.values(), pool.map(bounced.under, new.values()), strict=True
            ):
                self._bounces[id(light)] = light, values

    def _sources(self, lights: Lighting) -> list[Light | EnvironmentLighting]:
        all_lights = [lights] if isinstance(lights, Light | EnvironmentMap) else list(lights)
        if self.field.light_model == "unknown":
            return [Light("of the field", UNKNOWN)] if all_lights else []
        # A frame may name several lights at once: they are one light of the capture.
        singles = [
            single
            for light in all_lights
            for single in (light.sources if isinstance(light, Light) else (light,))
        ]
        return [self._source(single) for single in singles]

    def _source(self, light: Light | EnvironmentMap) -> Light | EnvironmentLighting:
        if isinstance(light, Light) and light.kind == UNKNOWN:
            raise InputError(
                f"light {light.id!r}: expected a known light for a field of known lights, "
                "received an unknown one; state its position or direction"
            )
        if isinstance(light, Light) and light.kind != ENVIRONMENT:
            return light
        # A map of a capture is named by its file and frame, a map in memory by itself.
        key: object = light
        if isinstance(light, Light):
            frame = tuple(light.world_from_environment.ravel().tolist())
            key = (light.file, light.convention, frame)
        if key not in self._environments:
            opened = EnvironmentMap.of_light(light) if isinstance(light, Light) else light
            if opened.world_from_environment is None:
                opened = opened.turned_to(self.field.up)
            quantised = opened.quantise(self.options.environment_directions)
            self._environments[key] = EnvironmentLighting(
                self.surface, quantised, self._bounced, self.options.n_threads
            )
        return self._environments[key]

    def _block(
        self,
        camera: Camera,
        groups: Sequence[Sequence[Light | EnvironmentLighting]],
        row: NDArray[np.int64],
        column: NDArray[np.int64],
    ) -> tuple[Array, Array]:
        """Radiance (n_groups, n, 3) and coverage (n,) of some pixels."""
        offsets = subpixel_offsets(self.options.samples_per_pixel)
        pixels = np.stack([column, row], axis=1)[:, None, :] + offsets
        rays = self.surface.camera_rays(camera, pixels.reshape(-1, 2))
        hits = self.surface.first_hits(*rays)
        pixel = hits.ray // len(offsets)
        covered = np.bincount(pixel, minlength=len(row)) / len(offsets)
        transition = self.surface.transitions(camera, hits, len(offsets))
        entries = self.surface.footprints(hits, pixel, transition)
        total = np.zeros((len(groups), len(row), 3))
        for image, source in (
            (i, source) for i, group in enumerate(groups) for source in group
        ):
            radiance = self._radiance(camera, source, hits, entries)
            for channel in range(3):
                total[image, :, channel] += np.bincount(
                    entries.pixel, radiance[:, channel], minlength=len(row)
                )
        return total / len(offsets), covered

    def _radiance(
        self,
        camera: Camera,
        source: Light | EnvironmentLighting,
        hits: SurfaceHits,
        entries: Footprints,
    ) -> Array:
        """Radiance of each entry times the number of samples that see it, (n, 3)."""
        if isinstance(source, EnvironmentLighting):
            every_hit = entries.summed(np.ones(len(hits.ray)))
            return source.radiance(camera, entries.texel) * every_hit[:, None]
        samples = evaluate(
            self.field,
            entries.texel,
            camera.view_directions(entries.position),
            source.directions(entries.position),
        )
        lit = self._lit(source, hits)
        total = samples * entries.summed(lit)[:, None]
        indirect = self.field.indirect
        if not (indirect.is_black or lit.all()):
            power, towards = self.field.inverse_power, source.directions(entries.position)
            in_shadow = entries.summed(~lit)[:, None]
            bounced = None
            if self._bounced is not None:
                bounced = self._bounces[id(source)][1][entries.texel]
            shown = indirect.towards(entries.texel, towards, power, bounced)
            total += in_shadow * shown
        return total * source.irradiance(entries.position)

    def _lit(self, light: Light, hits: SurfaceHits) -> NDArray[np.bool_]:
        """True for hits that the light reaches; all of them where shadows are in the field."""
        if self.field.visibility == "kept" or light.kind == UNKNOWN:
            return np.ones(len(hits.ray), np.bool_)
        return self.surface.reached_by_light(
            hits.position,
            hits.face_normal,
            light.directions(hits.position),
            light.distances(hits.position),
        )


class EnvironmentLighting:
    """Distant lights on a field, with the shadows of its texels where they are traced.

    Parameters
    ----------
    surface : FieldSurface
        Mesh and texels.
    lights : DistantLights
        Shared by all texels.
    bounced : BouncedLight, optional
        Of the field, where it is a part of what texels show in shadows.
    workers : int
        Threads.

    Notes
    -----
    Radiance is worked out for whole texels, at the texel's own point, and not
    for each sample: under so many lights it changes little within a texel. Shadows do
    not depend on the camera; once traced they are kept, one bit for each texel and light. With
    bounced light all of them are traced at once, and so is what texels show in them.
    """

    def __init__(
        self,
        surface: FieldSurface,
        lights: DistantLights,
        bounced: BouncedLight | None = None,
        workers: int = 1,
    ) -> None:
        self._surface = surface
        self._lights = lights
        n_texels = surface.field.n_texels
        self._traced = np.zeros(n_texels, np.bool_)
        self._lit_bits = np.zeros((0, 0), np.uint8)
        self._factored = surface.field.visibility == "factored"
        self._positions, self._normals = surface.texel_points
        if self._factored:
            self._lit_bits = np.zeros((n_texels, -(-len(lights) // 8)), np.uint8)
        self._in_shadows = None if bounced is None else self._indirect(bounced, workers)

    def _indirect(self, bounced: BouncedLight, workers: int) -> Array:
        """Radiance (n_texels, 3) of all texels from the lights that do not reach them."""
        field, directions = self._surface.field, self._lights.directions
        texels = np.arange(field.n_texels, dtype=np.int32)
        _ = (bounced.shares, bounced.albedo)

        def under(first: int) -> Array:
            part = slice(first, first + _BOUNCES_AT_ONCE)
            lit = self._lit(texels, part)
            shown = field.indirect.under(
                texels,
                directions[part],
                field.inverse_power,
                bounced.of_distant(directions[part].astype(np.float32), lit),
            )
            powers = self._lights.irradiances[part]
            return np.einsum("nmc,mc,nm->nc", shown, powers, ~lit, optimize=True)

        with thread_pool(workers) as pool:
            list(pool.map(self._lit, np.array_split(texels, max(1, 4 * workers))))
            parts = pool.map(under, range(0, len(directions), _BOUNCES_AT_ONCE))
            return np.asarray(sum(parts, start=np.zeros((len(texels), 3))))

    def radiance(self, camera: Camera, texels: NDArray[np.int32]) -> Array:
        """Radiance of texels towards the camera, (n, 3) float64."""
        distinct, where = np.unique(texels, return_inverse=True)
        result = np.zeros((len(distinct), 3))
        field = self._surface.field
        step = max(_NODES_AT_ONCE // max(field.light_nodes, len(self._lights)), 1)
        for first in range(0, len(distinct), step):
            block = distinct[first : first + step]
            result[first : first + step] = sum_lights(
                field,
                block,
                camera.view_directions(self._positions[block]),
                self._lights.directions,
                self._lights.irradiances,
                self._lit(block) if self._factored else None,
                indirect=self._in_shadows is None,
            )
        if self._in_shadows is not None:
            result += self._in_shadows[distinct]
        return result[where]

    def _lit(self, texels: NDArray[np.int32], lights: slice = slice(None)) -> NDArray[np.bool_]:
        """(n, n_lights) bool: True where a light reaches a texel; of all or some lights."""
        missing = texels[~self._traced[texels]]
        at_once = max(_SHADOW_RAYS_AT_ONCE // len(self._lights), 1)
        for first in range(0, len(missing), at_once):
            self._trace(missing[first : first + at_once])
        bits = np.unpackbits(self._lit_bits[texels], axis=1, count=len(self._lights))
        return bits[:, lights].astype(np.bool_)

    def _trace(self, texels: NDArray[np.int32]) -> None:
        """Trace and keep; two threads that trace the same texel write the same bits."""
        n, m = len(texels), len(self._lights)
        reached = self._surface.reached_by_light(
            np.repeat(self._positions[texels], m, axis=0),
            np.repeat(self._normals[texels], m, axis=0),
            np.tile(self._lights.directions, (n, 1)),
        )
        self._lit_bits[texels] = np.packbits(reached.reshape(n, m), axis=1)
        self._traced[texels] = True


def _blocks(
    window: tuple[int, int, int, int], block_pixels: int
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Rows and columns of the window's pixels, by square tiles of about `block_pixels`.

    Tiles rather than rows: neighbouring pixels share texels.
    """
    first_row, end_row, first_column, end_column = window
    side = max(int(block_pixels**0.5), 1)
    return [
        _tile(
            range(row, min(row + side, end_row)), range(column, min(column + side, end_column))
        )
        for row in range(first_row, end_row, side)
        for column in range(first_column, end_column, side)
    ]


def _tile(
    rows: Iterable[int], columns: Iterable[int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    row, column = np.meshgrid(
        np.array(list(rows), np.int64), np.array(list(columns), np.int64), indexing="ij"
    )
    return row.ravel(), column.ravel()
