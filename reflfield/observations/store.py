"""Apparent BRDF samples of all texels on disk, written by photographs, read by texels.

A store is one zarr array of shape (n_texels, n_photographs, 3), half floats, in chunks of some
texels and some photographs, in a folder or in object storage. Photographs are ordered by view,
then light (`PhotographedPairs`). Chunks are written whole or not at all and carry a CRC-32C.
Which samples count follows from two small arrays beside it: the views and lights that each
texel sees. Of a sample that counts, a value that was not measured is NaN: the light has none of
that colour, or the pixel was saturated. What no writer has written is minus infinity, which no
sample is.

Stored is the sample over the array's `unit`, a power of two near the capture's own samples, so
that halves hold them whatever the units of radiance, intensity and length are.
"""

from __future__ import annotations

import atexit
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import zarr
import zarr.core.sync
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.storage import FsspecStore

from reflfield.errors import InputError
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.util.files import naming
from reflfield.util.validation import check_shape

Bools = NDArray[np.bool_]
# A folder, or the URL of one for fsspec, such as ``s3://bucket/name``.
Location: TypeAlias = Path | str

# Texels of a chunk: many enough that a chunk is about a megabyte, few enough to be
# resampled together.
LEAST_TEXELS_PER_CHUNK, MOST_TEXELS_PER_CHUNK = 256, 4096
CHUNK_BYTES = 1 << 20
# Texels whose samples are counted together: floats of all lights of more would not stay in the
# cache.
TEXELS_COUNTED = 8192
# Views of a chunk: those whose samples a writer holds together.
VIEWS_PER_CHUNK = 8
WRITER_BYTES = 128 << 20
# Samples of one view up to which they are written together: of a picture of twelve megapixels
# under many lights a few lights at a time.
MOST_VIEW_BYTES = 512 << 20
SAMPLE_BYTES = 6
# In a store: what the folders of samples are called, before the key of their stage.
SAMPLES_PREFIX = "samples-"
# What chunks hold that were never written.
UNWRITTEN = -np.inf
# Attributes of the array: what its numbers are in, and which share of those that cameras see is
# NaN.
UNIT, GAPS = "unit", "gaps"
# How long a process that ends waits for zarr's thread; zarr waits for 0.2 s, then raises.
ENDING_SECONDS = 10.0


@atexit.register
def _end_thread_of_zarr() -> None:
    """Let the thread of zarr's event loop end before zarr closes it, however busy the machine.

    Registered after zarr's own, it is called first; the loop closed while it runs is an
    exception at the end of a run that went well.
    """
    running, thread = zarr.core.sync.loop[0], zarr.core.sync.iothread[0]
    if running is not None and thread is not None:
        running.call_soon_threadsafe(running.stop)
        thread.join(ENDING_SECONDS)


def chunk_shape(n_texels: int, pairs: PhotographedPairs) -> tuple[int, int]:
    """Texels and photographs of a chunk; they follow from the counts, not from the memory.

    Of a full product of views and lights the photographs are those of whole views, or parts of
    one where its samples are more than `MOST_VIEW_BYTES`.

    Examples
    --------
    The paper's dome, a few photographs of a fine surface, and a light of its own for each:

    >>> chunk_shape(40_000, PhotographedPairs.product(151, 151))
    (256, 453)
    >>> chunk_shape(200_000, PhotographedPairs.product(16, 1))
    (4096, 8)
    >>> chunk_shape(40_000, PhotographedPairs.of_table(np.eye(240)))
    (4096, 8)
    >>> chunk_shape(12_000_000, PhotographedPairs.product(1, 64))
    (4096, 8)
    """
    n_views = max(len(np.unique(pairs.view)), 1)
    of_view = -(-len(pairs) // n_views)
    of_view = -(-of_view // -(-n_texels * of_view * SAMPLE_BYTES // MOST_VIEW_BYTES))
    fit = WRITER_BYTES // (n_texels * of_view * SAMPLE_BYTES)
    photographs = of_view * int(np.clip(fit, 1, min(VIEWS_PER_CHUNK, n_views)))
    fits = CHUNK_BYTES / (photographs * SAMPLE_BYTES)
    power_of_two = 2 ** int(np.log2(max(fits, 1.0)))
    texels = int(np.clip(power_of_two, LEAST_TEXELS_PER_CHUNK, MOST_TEXELS_PER_CHUNK))
    return min(texels, n_texels), min(photographs, len(pairs))


@dataclass(frozen=True, eq=False)
class Observed:
    """Which samples were measured.

    Parameters
    ----------
    views : (n_texels, n_views) bool
        True where the camera sees the texel.
    lights : (n_texels, n_lights) bool
        True where the light's sample counts: everywhere if shadows stay in the data,
        else where the light reaches the texel.
    pairs : PhotographedPairs
        Of those views and lights.
    """

    views: Bools
    lights: Bools
    pairs: PhotographedPairs

    def __post_init__(self) -> None:
        check_shape("views", self.views, (None, self.pairs.n_views))
        check_shape("lights", self.lights, (len(self.views), self.pairs.n_lights))

    def of_texels(self, texels: slice | NDArray[np.integer]) -> Bools:
        """(k, n_photographs) True where a sample of some texels was measured."""
        return self.pairs.both(self.views[texels], self.lights[texels])

    def part(self, texels: slice) -> Observed:
        """The same of some texels."""
        return Observed(self.views[texels], self.lights[texels], self.pairs)

    def counts(self) -> NDArray[np.float32]:
        """(n_texels, n_lights) samples measured under each light."""
        # Floats go through BLAS; the counts of views are exact in them.
        seen = self.views.astype(np.float32) @ self.pairs.table.astype(np.float32)
        return seen * self.lights

    def count(self) -> int:
        """Number of samples measured.

        Examples
        --------
        Two texels, two views, three lights; the second texel is seen from one view:

        >>> views = np.array([[True, True], [True, False]])
        >>> Observed(views, np.ones((2, 3), bool), PhotographedPairs.product(2, 3)).count()
        9
        """
        return int(sum(some.counts().sum(dtype=np.float64) for _, some in self._blocks()))

    def count_seen(self) -> int:
        """Number of samples whose camera sees the texel, lit or not.

        Examples
        --------
        >>> views, dark = np.array([[True, True], [True, False]]), np.zeros((2, 3), bool)
        >>> Observed(views, dark, PhotographedPairs.product(2, 3)).count_seen()
        9
        """
        return int(self.views.sum(axis=0) @ self.pairs.table.sum(axis=1))

    def counted(self) -> Bools:
        """(n_texels, n_lights) True where a camera sees the texel under a light that counts."""
        counted = np.zeros((len(self.views), self.pairs.n_lights), np.bool_)
        for part, some in self._blocks():
            counted[part] = some.counts() > 0
        return counted

    def _blocks(self) -> Iterator[tuple[slice, Observed]]:
        """Some texels at a time: counts of all are eight times as large as what they count."""
        for first in range(0, len(self.views), TEXELS_COUNTED):
            texels = slice(first, first + TEXELS_COUNTED)
            yield texels, self.part(texels)


@dataclass(frozen=True, eq=False)
class ObservationStore:
    """Samples on disk with what is observed of them.

    Parameters
    ----------
    location : Path or str
        Of the zarr array.
    observed : Observed
        What counts; kept in memory, one byte per texel and direction.
    """

    location: Location
    observed: Observed

    @cached_property
    def samples(self) -> zarr.Array:
        """(n_texels, n_photographs, 3) float16 on disk; opened once."""
        return open_samples(self.location, mode="r")

    @cached_property
    def unit(self) -> float:
        """What the stored numbers are in, 1/sr; a power of two."""
        return float(self.samples.attrs.get(UNIT, 1.0))

    @cached_property
    def gaps(self) -> float:
        """Share of the values seen by cameras that was not measured, and is NaN.

        Of samples that are not finished it is not known: 1.
        """
        return float(self.samples.attrs.get(GAPS, 1.0))

    @property
    def has_gaps(self) -> bool:
        """Whether some values of samples that count were not measured, and are NaN."""
        return self.gaps > 0

    @property
    def n_texels(self) -> int:
        """Number of texels."""
        return len(self.observed.views)

    @property
    def texels_per_chunk(self) -> int:
        """Texels that are best read together, from multiples of their number."""
        return int(self.samples.chunks[0])

    def read(self, texels: slice | NDArray[np.integer]) -> NDArray[np.float16]:
        """Samples (k, n_photographs, 3) of some texels, over `unit`; NaN: not measured.

        Parameters
        ----------
        texels : slice or (k,) int
            In any order, with repeats; ascending ones read each chunk once.

        Raises
        ------
        InputError
            If a chunk is missing or damaged.
        """
        return checked_read(self.location, self.samples, texels)

    def raw_bytes(self) -> int:
        """Size of all samples as half floats."""
        return int(np.prod(self.samples.shape)) * 2


def checked_read(
    location: Location, array: zarr.Array, rows: slice | NDArray[np.integer]
) -> NDArray[np.float16]:
    """Rows of an array of halves, (k, ...).

    A chunk that is missing reads as `UNWRITTEN`, which is looked for in its first entries.

    Raises
    ------
    InputError
        If a chunk is missing or damaged.
    """
    try:
        samples = array[rows] if isinstance(rows, slice) else _some_rows(array, rows)
    except ValueError as error:
        raise InputError(
            f"{location}: expected chunks that agree with their checksums, found one that "
            f"does not ({error}); compute the stage again with `from_stage='observations'`"
        ) from error
    samples = np.asarray(samples)
    first = (slice(None), *(slice(None, None, step) for step in array.chunks[1:]))
    if np.isneginf(samples[first]).any():
        raise InputError(
            f"{location}: expected all chunks, found some missing; compute the stage again "
            "with `from_stage='observations'`"
        )
    return samples


def _some_rows(array: zarr.Array, rows: NDArray[np.integer]) -> NDArray[np.float16]:
    """Rows in any order, chunk by chunk.

    Of ascending ones whole parts of a chunk are read, and the rows taken from them here: zarr
    would pick them in its one thread, which all others wait for.
    """
    rows = np.asarray(rows)
    if not len(rows) or (np.diff(rows) < 0).any():
        return np.asarray(array.oindex[rows])
    samples = np.zeros((len(rows), *array.shape[1:]), np.float16)
    _, first = np.unique(rows // array.chunks[0], return_index=True)
    ends = [*first[1:].tolist(), len(rows)]
    for begin, end in zip(first.tolist(), ends, strict=True):
        low, high = int(rows[begin]), int(rows[end - 1]) + 1
        part = np.asarray(array[low:high])
        samples[begin:end] = part[rows[begin:end] - low]
    return samples


def opened(location: Location) -> str | FsspecStore:
    """What zarr opens for a location; local files are always written by rename.

    Raises
    ------
    InputError
        If there is no file system for the URL.
    """
    text = str(location)
    if "://" not in text or text.startswith("file://"):
        return text.removeprefix("file://")
    try:
        return FsspecStore.from_url(text)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{text}: expected a URL that fsspec can open, but {error}; install what it "
            "names, or use a folder"
        ) from error


def check_place(store: str, *, capture: Path, out: Path) -> None:
    """Demand a place for samples where nothing else is, before anything is written.

    Parameters
    ----------
    store : str
        Folder, or URL for fsspec.
    capture, out : Path
        Folders of the photographs and of the results.

    Raises
    ------
    InputError
        If it is empty, the root of a file system, the home folder, that of the capture or
        the results, or a folder that holds anything but samples.
    """
    if "://" in store and not store.startswith("file://"):
        if not store.partition("://")[2].strip("/ "):
            raise InputError(f"store: expected a place, such as {store}/name, received {store}")
        return
    text = store.removeprefix("file://")
    if not text.strip():
        raise InputError(f"store: expected a folder or a URL, received {store!r}")
    reason = _other_use(Path(text).resolve(), capture.resolve(), out.resolve())
    if reason:
        raise InputError(
            f"store: expected a new or empty folder, or one that holds samples alone, "
            f"received {text}, {reason}; name another, such as {Path(text) / 'samples'}"
        )


def _other_use(place: Path, capture: Path, out: Path) -> str:
    """What else a folder is for; empty if nothing."""
    if place.parent == place:
        return "the root of the file system"
    if place == Path.home().resolve():
        return "the home folder"
    if place == capture or capture in place.parents:
        return "which is in the capture's folder"
    if place == out or out / "stages" in (place, *place.parents):
        return "the folder of the results"
    if not place.exists():
        return ""
    if not place.is_dir():
        return "which is no folder"
    names = sorted(entry.name for entry in place.iterdir())
    others = [n for n in names if not n.startswith((SAMPLES_PREFIX, ".")) and n != "lost+found"]
    return f"which holds {others[0]!r}" if others else ""


def place_of(store: str, key: str) -> str:
    """Where a store keeps the samples of a stage's key: a folder is named from the root.

    Examples
    --------
    >>> place_of("s3://bucket/run/", "0123456789abcdef" * 4)
    's3://bucket/run/samples-0123456789abcdef'
    """
    place = store if "://" in store else str(Path(store).resolve())
    return f"{place.rstrip('/')}/{SAMPLES_PREFIX}{key[:16]}"


def create_samples(
    location: Location, n_texels: int, pairs: PhotographedPairs, unit: float = 1.0
) -> zarr.Array:
    """Create an array of samples, or open the one that an interrupted run began.

    Nothing that is there is ever replaced: what cannot be opened is an error.

    Parameters
    ----------
    location : Path or str
    n_texels : int
    pairs : PhotographedPairs
        One for each photograph.
    unit : float
        What the numbers are in, 1/sr.

    Returns
    -------
    zarr.Array
        (n_texels, n_photographs, 3) float16. Chunks never written count as missing.

    Raises
    ------
    InputError
        If a count is zero, or something else is there.
    OSError
        If the system cannot say what is there, or cannot write.
    """
    for name, count in (("texels", n_texels), ("photographs", len(pairs))):
        if count < 1:
            raise InputError(f"{name}: expected at least one, received {count}")
    shape, chunks = (n_texels, len(pairs), 3), (*chunk_shape(n_texels, pairs), 3)
    try:
        stored = _opened_array(location, "r+")
    except FileNotFoundError:
        return _created(location, shape, chunks, unit)
    if (stored.shape, stored.chunks, str(stored.dtype)) != (shape, chunks, "float16"):
        raise InputError(
            f"{location}: expected float16 samples of shape {shape} in chunks {chunks}, "
            f"found {stored.dtype} of shape {stored.shape} in chunks {stored.chunks}; remove "
            "it, or use another place"
        )
    if stored.attrs.get(UNIT) != unit:
        raise InputError(
            f"{location}: expected samples in units of {unit}, found {stored.attrs.get(UNIT)}; "
            "remove it, or use another place"
        )
    return stored


def _created(
    location: Location, shape: tuple[int, ...], chunks: tuple[int, ...], unit: float
) -> zarr.Array:
    with naming(str(location)):
        return zarr.create_array(
            opened(location),
            shape=shape,
            chunks=chunks,
            dtype="float16",
            fill_value=UNWRITTEN,
            attributes={UNIT: unit},
            compressors=[BloscCodec(cname="lz4", clevel=1, shuffle="shuffle", typesize=2),
                         Crc32cCodec()],
            config={"write_empty_chunks": True},
            overwrite=False,
        )  # fmt: skip


def note_gaps(location: Location, share: float) -> None:
    """Note with finished samples which share of the values seen was not measured."""
    with naming(str(location)):
        open_samples(location).attrs[GAPS] = share


def open_samples(location: Location, mode: Literal["r", "r+"] = "r+") -> zarr.Array:
    """Array of samples that was created before.

    Raises
    ------
    InputError
        If it is gone, or its description is damaged.
    OSError
        If the system cannot open it.
    """
    try:
        return _opened_array(location, mode)
    except FileNotFoundError as error:
        raise InputError(
            f"{location}: expected samples, found none; compute the stage again with "
            "`from_stage='observations'`"
        ) from error


def _opened_array(location: Location, mode: Literal["r", "r+"]) -> zarr.Array:
    """What is there; FileNotFoundError if nothing is."""
    store = opened(location)
    try:
        # No chunk is empty: whether it is, takes long to find out.
        with naming(str(location)), zarr.config.set({"array.write_empty_chunks": True}):
            return zarr.open_array(store, mode=mode)
    except OSError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{location}: expected samples, found a damaged description of them ({error}); "
            "remove the folder, then compute the stage again with `from_stage='observations'`"
        ) from error


def is_written(array: zarr.Array, part: tuple[slice, ...]) -> bool:
    """Whether the chunks of a part are all there and agree with their checksums."""
    try:
        samples = np.asarray(array[part])
    except ValueError:
        return False
    first = tuple(slice(None, None, step) for step in array.chunks)
    return not np.isneginf(samples[first]).any()
