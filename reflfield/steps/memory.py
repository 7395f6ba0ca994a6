"""What a run needs of memory at least, asked before anything is computed."""

from __future__ import annotations

from reflfield.config import Resources, gigabytes
from reflfield.errors import InputError
from reflfield.observations.store import SAMPLE_BYTES, chunk_shape
from reflfield.steps.columns import COLUMNS_AT_ONCE
from reflfield.steps.job import Job

# Libraries, compiled kernels and the code itself, measured.
BASE_BYTES = 512 << 20
# A photograph while it is read: as stored, as float32, the copy that is sampled.
PHOTOGRAPH_COPIES = 3
# Position, frames, area, quaternions: what is kept of a texel besides the arrays below.
TEXEL_BYTES = 256
# Columns of a block while they are inferred: resampled, by rows, clean, residual, weighted.
COLUMN_COPIES = 6
# A writer's samples, while they are cut into chunks and encoded.
WRITER_COPIES = 2
# Largest share of a texture that charts cover.
LARGEST_USE = 0.8


def least_memory(job: Job) -> int:
    """Bytes that the run holds at the same time however small its blocks are.

    Silhouettes of all views and one photograph, or what is kept of every texel with the
    samples of one view under all lights, whichever is more; and one block of each thread, or
    the columns of one, whichever is more.
    """
    training = job.training
    pixels = [camera.width * camera.height for camera in training.cameras]
    views = 5 * sum(pixels) + 12 * PHOTOGRAPH_COPIES * max(pixels)
    rank = max(job.options.completion.rank, job.options.compression.rank)
    each = TEXEL_BYTES + training.n_views + 7 * training.n_lights + 12 * rank
    blocks = job.resources.workers * job.resources.block_bytes
    columns = columns_bytes(job.sides[0] ** 2 * job.sides[1] ** 2)
    return BASE_BYTES + max(views, most_texels(job) * each) + max(blocks, columns)


def most_texels(job: Job) -> int:
    """Upper bound on the texels of the run, known before there is a surface."""
    if job.is_plane:
        camera = job.capture.cameras[0]
        return camera.width * camera.height
    side = job.options.atlas.resolution or job.options.texture.largest
    return int(LARGEST_USE * side**2)


def check_memory(job: Job) -> None:
    """Refuse a ceiling that cannot be met.

    Raises
    ------
    InputError
        Naming what would suffice.
    """
    least, given = least_memory(job), job.resources.max_memory
    if least > given:
        raise InputError(
            f"--max-memory: expected at least {gigabytes(least + (1 << 26))} for "
            f"{job.training.n_views} views, {job.training.n_lights} lights and up to "
            f"{most_texels(job)} texels, received {gigabytes(given)}; raise it, or lower "
            "texture.largest"
        )


def columns_bytes(n_pairs: int) -> int:
    """Memory of one block of columns while their coefficients are inferred."""
    return COLUMN_COPIES * COLUMNS_AT_ONCE * 12 * n_pairs


def columns_at_once(resources: Resources, n_pairs: int) -> int:
    """Threads that may each infer coefficients of a block of columns at a time."""
    return int(max(1, (resources.max_memory - BASE_BYTES) // (2 * columns_bytes(n_pairs))))


def writers_at_once(job: Job) -> int:
    """Threads that may each hold the samples of a few views, and photographs, at a time."""
    n_texels, n_views, n_lights = (len(job.texels), job.training.n_views, job.training.n_lights)
    views = chunk_shape(n_texels, n_views, n_lights)[1]
    each = views * n_texels * n_lights * SAMPLE_BYTES + job.resources.block_bytes
    free = job.resources.max_memory - BASE_BYTES - n_texels * TEXEL_BYTES
    return int(max(1, free // (WRITER_COPIES * each)))
