"""What a run needs of memory at least, asked before anything is computed."""

from __future__ import annotations

from dataclasses import replace

from reflfield.capture.capture import Capture
from reflfield.capture.image_files import image_size
from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.metrics.image_errors import PIXELS_AT_ONCE
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.store import (
    SAMPLE_BYTES,
    chunk_shape,
)
from reflfield.options import Resources, gigabytes
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.pipeline.texel_columns import COLUMNS_AT_ONCE
from reflfield.render.renderer import RenderOptions

# Libraries, compiled kernels and the code itself, measured.
BASE_BYTES = 512 << 20
# A pixel of a photograph while it is read: as stored, as float32, what of it was measured, and
# the copy that is sampled or shown.
PHOTOGRAPH_BYTES = 48
# A pixel of a held-out photograph while it is compared, with a baseline's image beside the
# field's, and shown in the report; and of the strip that is measured, besides.
HELD_OUT_BYTES, STRIP_BYTES = 50, 500
# What compiling the kernels of a first run leaves in memory, before photographs are compared.
COMPILED_BYTES = 400 << 20
# A pixel of a silhouette while it is made from photographs.
SILHOUETTE_BYTES = 80
# A pixel of the signed distance to an outline.
DISTANCE_BYTES = 4
# Position, frames, area, quaternions: what is kept of a texel besides the arrays below.
TEXEL_BYTES = 256
# Columns of a block while they are inferred: resampled, by rows, clean, residual, weighted.
COLUMN_COPIES = 6
# A writer's samples, while they are cut into chunks and encoded.
WRITER_COPIES = 2
# Largest share of a texture that charts cover.
LARGEST_USE = 0.8


def least_memory(context: Context) -> int:
    """Bytes that the run holds at the same time however small its blocks are.

    Of every view which of its pixels are covered, what is made of the largest image, and the
    samples that are written together; or what is kept of every texel with the samples of one
    view under all lights, and one block of each thread or the columns of one: whichever is
    more.
    """
    training = context.training
    pixels = [camera.width * camera.height for camera in training.cameras]
    held = [camera.width * camera.height for camera in context.held_out.cameras]
    made = any(path is None for path in training.silhouettes)
    largest = max(
        max(PHOTOGRAPH_BYTES, SILHOUETTE_BYTES * made) * max(pixels),
        compared_bytes(max(held, default=0)),
    )
    texels = most_texels(context)
    samples = writer_bytes(texels, PhotographedPairs.of(training))
    images = sum(pixels) // 8 + largest + texels * TEXEL_BYTES + WRITER_COPIES * samples
    rank = max(context.options.completion.rank, context.options.compression.rank)
    each = TEXEL_BYTES + training.n_views + 7 * training.n_lights + 12 * rank
    blocks = context.resources.workers * context.resources.block_bytes
    columns = columns_bytes(context.grid_sides[0] ** 2 * context.grid_sides[1] ** 2)
    return BASE_BYTES + max(images, texels * each + max(blocks, columns))


def compared_bytes(pixels: int) -> int:
    """Memory of a held-out photograph while it is compared, with the kernels compiled by then.

    Examples
    --------
    >>> compared_bytes(0)
    0
    """
    strip = STRIP_BYTES * min(pixels, PIXELS_AT_ONCE)
    return HELD_OUT_BYTES * pixels + strip + COMPILED_BYTES if pixels else 0


def keeps_distances(context: Context) -> bool:
    """Whether the distances to the outlines of all views may stay in memory."""
    pixels = sum(camera.width * camera.height for camera in context.training.cameras)
    return DISTANCE_BYTES * pixels <= context.resources.max_memory // 8


def silhouettes_at_once(context: Context) -> int:
    """Threads that may each make a silhouette at a time."""
    most = max(camera.width * camera.height for camera in context.training.cameras)
    return int(max(1, (context.resources.max_memory - BASE_BYTES) // (SILHOUETTE_BYTES * most)))


def most_texels(context: Context) -> int:
    """Upper bound on the texels of the run, known before there is a surface."""
    if context.is_plane:
        camera = context.capture.cameras[0]
        return camera.width * camera.height
    side = context.options.atlas.resolution or context.options.texture.largest
    return int(LARGEST_USE * side**2)


def check_memory(context: Context) -> None:
    """Refuse a ceiling that cannot be met.

    Raises
    ------
    InputError
        Naming what would suffice.
    """
    least, allowed = least_memory(context), context.resources.max_memory
    if least > allowed:
        raise InputError(
            f"max_memory: expected at least {gigabytes(least + (1 << 26))} for "
            f"{context.training.n_views} views, {context.training.n_lights} lights and up to "
            f"{most_texels(context)} texels, received {gigabytes(allowed)}; raise it, or lower "
            "texture.largest"
        )


def columns_bytes(n_pairs: int) -> int:
    """Memory of one block of columns while their coefficients are inferred."""
    return COLUMN_COPIES * COLUMNS_AT_ONCE * 12 * n_pairs


def columns_at_once(resources: Resources, n_pairs: int) -> int:
    """Threads that may each infer coefficients of a block of columns at a time."""
    return int(max(1, (resources.max_memory - BASE_BYTES) // (2 * columns_bytes(n_pairs))))


def working_bytes(context: Context) -> int:
    """Memory that a fit may fill, besides libraries, kernels and a photograph that is read.

    A sixteenth of the ceiling at least: with less it would take for ever.
    """
    pixels = max(camera.width * camera.height for camera in context.training.cameras)
    held = BASE_BYTES + COMPILED_BYTES + PHOTOGRAPH_BYTES * pixels
    ceiling = context.resources.max_memory
    return max(ceiling - held, ceiling // 16)


def writer_bytes(n_texels: int, pairs: PhotographedPairs) -> int:
    """Samples of the photographs that are written together."""
    return chunk_shape(n_texels, pairs)[1] * n_texels * SAMPLE_BYTES


def readers_at_once(context: Context) -> int:
    """Threads that may each read a photograph at a time while a fit holds what it is fitted to.

    One has its place; half of the working memory is free for others, until there are
    derivatives.
    """
    pixels = max(camera.width * camera.height for camera in context.training.cameras)
    return 1 + int(working_bytes(context) // (2 * PHOTOGRAPH_BYTES * pixels))


def writers_at_once(context: Context) -> int:
    """Threads that may each hold the samples of a few views, and photographs, at a time."""
    n_texels = len(results.texels(context))
    samples = writer_bytes(n_texels, PhotographedPairs.of(context.training))
    pixels = max(camera.width * camera.height for camera in context.training.cameras)
    photographs = max(WRITER_COPIES * context.resources.block_bytes, PHOTOGRAPH_BYTES * pixels)
    free = context.resources.max_memory - BASE_BYTES - n_texels * TEXEL_BYTES
    return int(max(1, free // (WRITER_COPIES * samples + photographs)))


# --- images outside of a run ---------------------------------------------------------------

# A pixel of an image while it is rendered and written: radiance, coverage, both, a copy.
IMAGE_BYTES = 64
# A pixel of a photograph beside it: as stored, linear, what of it is measured; the image
# read again, silhouette and masks.
COMPARED_BYTES = 24
# A pixel of a turntable's image, all of which are kept: half floats, encoded, animated.
TURNTABLE_BYTES = 13
# A pixel of an environment map while it is read.
MAP_BYTES = 28
# Texel of a field that is rendered, besides its components: frame, point, normal, owner.
RENDERED_TEXEL_BYTES = 160
# Of a field that is compared: point, frame and triangle of the texel, what the baselines show.
BASELINE_TEXEL_BYTES = 300


def field_bytes(field: ReflectanceField, n_directions: int) -> int:
    """Memory of a field, decoded for rendering, with its shadows under so many directions."""
    texel = RENDERED_TEXEL_BYTES + n_directions // 8
    return field.decoded_bytes + field.n_texels * texel


def check_image_memory(
    field: ReflectanceField,
    resources: Resources,
    options: RenderOptions,
    *,
    pixels: int,
    pixel_bytes: int = IMAGE_BYTES,
    texel_bytes: int = 0,
    kept_pixels: int = 0,
    map_pixels: int = 0,
) -> RenderOptions:
    """Return options with which images stay below a ceiling of memory; they look the same.

    Parameters
    ----------
    field : ReflectanceField
    resources : Resources
    options : RenderOptions
    pixels : int
        Of the largest image.
    pixel_bytes : int
        Memory of one of them.
    texel_bytes : int
        Of each texel, besides what rendering takes.
    kept_pixels : int
        Of all images of a turntable.
    map_pixels : int
        Of the largest environment map.

    Returns
    -------
    RenderOptions
        With blocks that all threads together can work on.

    Raises
    ------
    InputError
        If the ceiling cannot be met, naming what would suffice.
    """
    fitting = within_memory(options, resources)
    blocks = fitting.workers * fitting.block_pixels * RAY_BYTES * options.samples_per_pixel
    images = pixels * pixel_bytes + kept_pixels * TURNTABLE_BYTES
    directions = options.environment_directions if map_pixels else 0
    least = BASE_BYTES + field_bytes(field, directions) + map_pixels * MAP_BYTES
    least += blocks + images + texel_bytes * field.n_texels
    if least > resources.max_memory:
        in_all = f" and {kept_pixels} in all" if kept_pixels else ""
        received = gigabytes(resources.max_memory)
        raise InputError(
            f"max_memory: expected at least {gigabytes(least + (1 << 26))} for images of "
            f"{pixels} pixels{in_all}, received {received}; raise it, or make the images, "
            "their number or the map smaller"
        )
    return fitting


def check_relighting_memory(
    field: ReflectanceField,
    capture: Capture,
    options: RenderOptions,
    resources: Resources,
    *,
    compared: bool = False,
) -> RenderOptions:
    """`check_image_memory` of the largest photograph and map of a capture."""
    maps = [s.file for light in capture.lights for s in light.sources if s.file is not None]
    sizes = [image_size(path) for path in maps]
    return check_image_memory(
        field,
        resources,
        options,
        pixels=max((c.width * c.height for c in capture.cameras), default=0),
        pixel_bytes=IMAGE_BYTES + compared * COMPARED_BYTES,
        texel_bytes=compared * BASELINE_TEXEL_BYTES,
        map_pixels=max((width * height for width, height in sizes), default=0),
    )


# Memory of one ray through a pixel: hits, footprints of up to twelve texels, radiance.
RAY_BYTES = 4096


def within_memory(options: RenderOptions, resources: Resources) -> RenderOptions:
    """Blocks of pixels that all threads together can work on; the images stay the same."""
    each = RAY_BYTES * options.samples_per_pixel
    workers = options.workers or resources.workers
    fits = max(4 * resources.block_bytes // (workers * each), 64)
    return replace(options, workers=workers, block_pixels=min(options.block_pixels, fits))
