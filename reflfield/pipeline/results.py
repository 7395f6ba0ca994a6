"""What the stages of a run have left on disk, as later stages read it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.field.build import BaseSurface
from reflfield.field.indirect_light import IndirectLight
from reflfield.geometry.mesh import Mesh, read_ply
from reflfield.geometry.texels import TexelTable, texel_table
from reflfield.geometry.uv_atlas import Atlas
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.store import Location, ObservationStore, Observed
from reflfield.observations.stored_shade import StoredShade
from reflfield.observations.texel_reading import TexelReader
from reflfield.pipeline.cache import RESTARTABLE
from reflfield.pipeline.clipped_values import MEASURED, stored_measured
from reflfield.pipeline.context import Context
from reflfield.pipeline.view_store import (
    EDGES,
    SILHOUETTES,
    StoredSilhouettes,
    stored_view,
    unpacked_mask,
)
from reflfield.util.files import load_arrays

T = TypeVar("T")
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]

# What the stage "left_out_views" writes.
LEFT_OUT_ERRORS = "errors.npz"
SHADE = "shade.npz"
# In the folder of the observations: the samples, or the name of the place where they are.
SAMPLES, ELSEWHERE = RESTARTABLE[0], "samples.location"


def cached(*stages: str) -> Callable[[Callable[[Context], T]], Callable[[Context], T]]:
    """Keep in the context's cache what a function reads of the results of some stages."""

    def decorated(read: Callable[[Context], T]) -> Callable[[Context], T]:
        @wraps(read)
        def reading(context: Context) -> T:
            records = [context.stages.record(context.stage_of(stage)) for stage in stages]
            keys = tuple("" if record is None else record.key for record in records)
            return context.cache.get(read.__name__, keys, partial(read, context))

        return reading

    return decorated


def file(context: Context, stage: str, name: str) -> Path:
    """Path of a file that a stage has written, on the surface of the context."""
    return context.stages.root / context.stage_of(stage) / name


def field_file(context: Context, stage: str = "compression") -> Path:
    """Path of the field that a stage has written."""
    return file(context, stage, "field.rfld")


def arrays(context: Context, stage: str, name: str) -> dict[str, NDArray[Any]]:
    """Arrays that a stage has written.

    Raises
    ------
    InputError
        If the file is damaged, or holds more than the memory.
    """
    return load_arrays(file(context, stage, name), context.resources.max_memory)


def silhouettes(context: Context) -> StoredSilhouettes:
    """Coverage of every training view, each read when it is asked for."""
    path = file(context, "silhouettes", SILHOUETTES)
    return StoredSilhouettes(path, context.training.cameras)


@cached("hull")
def hull_mesh(context: Context) -> Mesh:
    """The visual hull; of a flat object, the image plane."""
    return read_ply(file(context, "hull", "hull.ply"))


@cached("hull", "hollows")
def base_mesh(context: Context) -> Mesh:
    """Base surface: the hull, or what is left of it where hollows were carved."""
    carved = file(context, "hollows", "carved.ply")
    ran = context.stages.record("hollows") is not None
    return read_ply(carved) if ran and carved.is_file() else hull_mesh(context)


@cached("surface_mesh")
def surface_mesh(context: Context) -> Mesh:
    """Base surface moved to the fitted normals."""
    return read_ply(file(context, "surface", "surface.ply"))


@cached("atlas")
def atlas(context: Context) -> Atlas:
    """Base surface with texture coordinates."""
    stored = arrays(context, "atlas", "atlas.npz")
    height, width = (int(n) for n in stored.pop("size"))
    return Atlas(**stored, height=height, width=width)


@cached("atlas")
def texels(context: Context) -> TexelTable:
    """Position, base frame and area of each texel."""
    return texel_table(atlas(context))


def base_surface(context: Context) -> BaseSurface:
    """Mesh, atlas and texels of the base surface, as a field holds them."""
    stored = atlas(context)
    return BaseSurface(
        positions=stored.positions,
        faces=stored.faces,
        uv=stored.uv,
        texel_of_pixel=texels(context).texel_of_pixel,
    )


@cached("visibility")
def view_visible(context: Context) -> Bools:
    """(n_texels, n_views) True where the camera sees the texel."""
    return _unpacked(context, "views", context.training.n_views)


@cached("visibility")
def light_visible(context: Context) -> Bools:
    """(n_texels, n_lights) True where the light reaches the texel."""
    return _unpacked(context, "lights", context.training.n_lights)


def _unpacked(context: Context, name: str, n: int) -> Bools:
    """What the stage "visibility" has found, from eight in a byte."""
    bits = arrays(context, "visibility", "visibility.npz")[name]
    return np.unpackbits(bits, axis=1, count=n).astype(np.bool_)


def depth_edges(context: Context, view: int) -> Bools:
    """(height, width) True at the pixels of a training view beside a depth discontinuity."""
    path, camera = file(context, "visibility", EDGES), context.training.cameras[view]
    return unpacked_mask(stored_view(path, view, camera), camera)


def texels_in_view(context: Context) -> Indices:
    """Texels that some camera sees."""
    return np.flatnonzero(view_visible(context).any(axis=1))


@cached("visibility")
def observed(context: Context) -> Observed:
    """Which samples count: seen by the camera, and lit where shadows are factored out."""
    lights = light_visible(context)
    if context.visibility_kind != "factored":
        lights = np.broadcast_to(np.True_, lights.shape)
    return Observed(view_visible(context), lights, PhotographedPairs.of(context.training))


@cached("visibility")
def sampled(context: Context) -> Bools:
    """(n_texels, n_lights) True where a camera sees the texel under a light that counts."""
    return observed(context).counted()


def samples_location(context: Context) -> Location:
    """Where the samples of all texels are: in their stage's folder, or in a store."""
    elsewhere = file(context, "observations", ELSEWHERE)
    if elsewhere.is_file():
        return elsewhere.read_text()
    return file(context, "observations", SAMPLES)


@cached("atlas", "visibility", "observations")
def base_reader(context: Context) -> TexelReader:
    """Reader of the samples in the base frames."""
    return TexelReader(
        store=ObservationStore(samples_location(context), observed(context)),
        capture=context.training,
        positions=texels(context).position,
        local_from_world=texels(context).local_from_world,
        sides=context.grid_sides,
        options=context.options.resampling,
    )


def left_out_errors(context: Context) -> dict[str, NDArray[Any]] | None:
    """Errors on views left out, `errors` by the number of lobes and `nearest`; None without."""
    if context.stages.record("left_out_views") is None:
        return None
    return arrays(context, "left_out_views", LEFT_OUT_ERRORS)


@cached("visibility", "observations")
def measured_texels(context: Context) -> Indices:
    """Texels with at least one sample of which something was measured, ascending."""
    measured = stored_measured(arrays(context, "observations", MEASURED))
    return np.flatnonzero((sampled(context) & measured).any(axis=1))


def random_texels(context: Context, most: int) -> Indices:
    """At most so many measured texels, drawn at random, ascending.

    Raises
    ------
    InputError
        If there are none.
    """
    measured = measured_texels(context)
    if not len(measured):
        raise InputError(
            "capture: expected texels that a camera sees under a light, found none; check "
            "the calibration and the positions of the lights"
        )
    if len(measured) <= most:
        return measured
    rng = np.random.default_rng(context.options.seed)
    return np.sort(rng.choice(measured, most, replace=False))


def indirect_light(context: Context) -> IndirectLight | None:
    """What texels show in traced shadows, if anything."""
    if not context.fits_indirect_light:
        return None
    stored = arrays(context, "indirect", "indirect.npz")
    return IndirectLight(stored["functions"], stored["coefficients"])


def shade(context: Context) -> StoredShade:
    """What texels show in traced shadows, where they do."""
    stored: dict[str, Any] = arrays(context, "indirect", SHADE)
    unit = float(stored.pop("unit"))
    return StoredShade(
        **stored, unit=unit, lights=context.training.lights, positions=texels(context).position
    )
