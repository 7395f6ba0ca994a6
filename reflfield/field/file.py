"""The file of a reflectance field, `field.rfld`, version 6.

A ZIP archive of `header.json` and one member for each array of the model's schema
(`field.reflectance_field.SCHEMAS`), packed as `array_coding` describes. The header names
format, version and model and, for each array, its dtype, shape, filter, context bits and the
SHA-256 of its member. Earlier versions are read too: 5 knows no bounced light, 4 no skews of
lobes, 3 only clustered fields, and names no model. Time stamps are fixed, so equal fields give
equal bytes.

Opening reads the header alone; an array is read, and its checksum compared,
when it is first used. Nothing is unpickled, nothing is extracted to disk, and
no size is believed before it was compared with what the bytes hold.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import FieldFileError, InputError
from reflfield.field.array_coding import FILTERS, PackedArray, packed_array, unpack
from reflfield.field.array_schemas import SCHEMAS, Schema, check_arrays, node_side
from reflfield.field.half_vector import SKEW_NODES
from reflfield.field.reflectance_field import (
    ClusteredField,
    HalfVectorField,
    ReflectanceField,
    check_options,
)
from reflfield.field.stored_values import (
    LONGEST_AXIS,
    check_lengths,
    check_stored,
    memory_needed,
)
from reflfield.util.files import check_regular, replacing

FORMAT_NAME = "reflfield-field"
FORMAT_VERSION = 6
OLDEST_VERSION = 3

SKEWS, FIRST_WITH_SKEWS = "lobe_skews", 5
BOUNCE, FIRST_WITH_BOUNCE = "bounce_gain", 6

HEADER = "header.json"
MAX_HEADER_BYTES = 16 << 20

# Ten times what a large field takes while it is decoded (21 x 21 nodes for each direction, 16
# clusters of 10 components); `open_field` takes another limit.
MAX_BYTES = 4 << 30

# The oldest date a ZIP archive can hold.
FIXED_TIME = (1980, 1, 1, 0, 0, 0)


def schema_of(reflectance_field: ReflectanceField) -> Schema:
    """Arrays of a field's file, in their order."""
    return SCHEMAS[reflectance_field.model]


def write_field(path: Path | str, reflectance_field: ReflectanceField) -> None:
    """Write a field, atomically; equal fields give equal bytes.

    Parameters
    ----------
    path : Path or str
        Target. It is replaced only when the new file is complete and on disk.
    reflectance_field : ReflectanceField
        Field to write. Its metadata must be plain JSON values.

    Raises
    ------
    InputError
        If the metadata cannot be written as JSON.
    OSError
        If the target cannot be written.
    """
    with replacing(Path(path)) as partial, partial.open("w+b") as file:
        names = schema_of(reflectance_field)
        with ThreadPoolExecutor() as pool:
            packed = pool.map(lambda n: packed_array(n, reflectance_field.arrays[n]), names)
            members = dict(zip(names, packed, strict=True))
        _write_archive(file, reflectance_field, members)


class PackedSizes:
    """Sizes of files of fields that share arrays, each of which is packed once."""

    def __init__(self) -> None:
        self._packed: dict[tuple[str, bytes], PackedArray] = {}

    def of(self, reflectance_field: ReflectanceField) -> int:
        """Bytes of the file that `write_field` would write."""
        names = schema_of(reflectance_field)
        members = {n: self._array(n, reflectance_field.arrays[n]) for n in names}
        buffer = io.BytesIO()
        _write_archive(buffer, reflectance_field, members)
        return buffer.tell()

    def array_bytes(self, name: str, array: NDArray[Any]) -> int:
        """Bytes of one array in the file."""
        return len(self._array(name, array).content)

    def _array(self, name: str, array: NDArray[Any]) -> PackedArray:
        described = f"{array.dtype}{array.shape}".encode()
        key = (name, hashlib.sha256(described + array.tobytes()).digest())
        if key not in self._packed:
            self._packed[key] = packed_array(name, array)
        return self._packed[key]


def _write_archive(
    file: IO[bytes], reflectance_field: ReflectanceField, members: Mapping[str, PackedArray]
) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        _add(archive, HEADER, _header(reflectance_field, members), zipfile.ZIP_DEFLATED)
        for name, packed in members.items():
            _add(archive, member_name(name), packed.content)


def open_field(path: Path | str, *, max_bytes: int = MAX_BYTES) -> ReflectanceField:
    """Open a field; its arrays are read when they are first used.

    Parameters
    ----------
    path : Path or str
        A file that `write_field` made.
    max_bytes : int
        Refuse a field that would take more memory than this while it is read and decoded,
        by estimate.

    Returns
    -------
    ReflectanceField

    Raises
    ------
    FieldFileError
        If the file is missing, not a regular one, not a field, damaged, of a newer version,
        or declares sizes that its bytes do not bear out. A damaged array, or one with values
        that no field has, raises when it is first used.
    """
    path = Path(path)
    with _archive(path) as archive:
        header = _read_header(path, archive)
        infos = _members(path, archive, _stored_schema(header))
        declared = _declared(path, header)
        if any(
            infos[member_name(name)].compress_type != zipfile.ZIP_STORED for name in declared
        ):
            raise FieldFileError(f"{path}: expected stored members, received packed ones")
    shapes = {name: array.shape for name, array in declared.items()}
    total = memory_needed(shapes, {name: array.n_bytes for name, array in declared.items()})
    if total > max_bytes:
        raise FieldFileError(
            f"{path}: expected arrays of at most {max_bytes} bytes, the header declares "
            f"some that take {total:.0f}; raise `max_memory` if the file is to "
            "be trusted"
        )
    with _naming(path):
        return _field(header, StoredArrays(path, declared, _not_stored(header, shapes)))


@dataclass(frozen=True)
class DeclaredArray:
    """What the header says of one array."""

    dtype: str
    shape: tuple[int, ...]
    filter: str
    context_bits: int
    sha256: str

    @property
    def n_bytes(self) -> int:
        """Size in memory."""
        return prod(self.shape) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True, eq=False)
class StoredArrays(Mapping[str, NDArray[Any]]):
    """The arrays of a field file by name, each read when first asked for.

    Parameters
    ----------
    path : Path
        The file.
    declared : mapping of str to DeclaredArray
        What the header promised; what is read is held against it.
    """

    path: Path
    declared: Mapping[str, DeclaredArray]
    _read: dict[str, NDArray[Any]] = field(default_factory=dict)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._read:
            array = _read_array(self.path, name, self.declared[name])
            try:
                shapes = {other: declared.shape for other, declared in self.declared.items()}
                check_stored(name, array, shapes)
            except InputError as error:
                raise FieldFileError(f"{self.path}: {error}") from error
            self._read[name] = array
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.declared)

    def __len__(self) -> int:
        return len(self.declared)

    @property
    def stored_bytes(self) -> dict[str, int]:
        """Bytes of each array in the file, after packing."""
        with _archive(self.path) as archive:
            infos = _members(self.path, archive, self.declared)
        return {name: infos[member_name(name)].compress_size for name in self.declared}


def member_name(array: str) -> str:
    """Name of an array's member in the archive."""
    return f"{array}.bin"


def _header(reflectance_field: ReflectanceField, members: Mapping[str, PackedArray]) -> bytes:
    arrays = reflectance_field.arrays
    header = {
        "format": FORMAT_NAME,
        "version": FORMAT_VERSION,
        # Samples are radiance over facing irradiance: the cosine is in them.
        "cosine_included": True,
        "model": reflectance_field.model,
        "domain": reflectance_field.domain,
        "visibility": reflectance_field.visibility,
        "light_model": reflectance_field.light_model,
        "metadata": reflectance_field.metadata,
        "arrays": {
            name: {
                "dtype": arrays[name].dtype.name,
                "shape": list(arrays[name].shape),
                "filter": packed.filter,
                "context_bits": packed.context_bits,
                "sha256": hashlib.sha256(packed.content).hexdigest(),
            }
            for name, packed in members.items()
        },
    }
    try:
        return json.dumps(header, indent=1, sort_keys=True, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise InputError(
            f"metadata: expected plain JSON values, received something else ({error})"
        ) from error


def _add(
    archive: zipfile.ZipFile, name: str, content: bytes, method: int = zipfile.ZIP_STORED
) -> None:
    info = zipfile.ZipInfo(name, FIXED_TIME)
    info.compress_type = method
    info.create_system = 3  # Unix, wherever it is written
    info.external_attr = 0o644 << 16
    archive.writestr(info, content)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Turn whatever the readers raise into an error that names the file."""
    try:
        yield
    except FieldFileError:
        raise
    except (FileNotFoundError, PermissionError) as error:
        raise FieldFileError(f"{path}: cannot be read ({error.strerror})") from error
    except zipfile.BadZipFile as error:
        raise FieldFileError(
            f"{path}: expected a reflectance field (a ZIP archive), received another or a "
            f"truncated file ({error})"
        ) from error
    except (
        OSError,
        MemoryError,
        OverflowError,
        EOFError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        zlib.error,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise FieldFileError(
            f"{path}: damaged reflectance field ({error}); write it again"
        ) from error


@contextmanager
def _archive(path: Path) -> Iterator[zipfile.ZipFile]:
    if not os.path.lexists(path):
        raise FieldFileError(f"{path}: no such file")
    check_regular(path, FieldFileError)
    with _naming(path), zipfile.ZipFile(path) as archive:
        yield archive


def _members(
    path: Path, archive: zipfile.ZipFile, arrays: Iterable[str]
) -> dict[str, zipfile.ZipInfo]:
    """All members by name; exactly those of a field with these arrays, each once."""
    infos = archive.infolist()
    expected = sorted([HEADER, *map(member_name, arrays)])
    names = sorted(info.filename for info in infos)
    if names != expected:
        missing = sorted(set(expected) - set(names))
        surplus = sorted(set(names) - set(expected))
        twice = sorted({name for name in names if names.count(name) > 1})
        raise FieldFileError(
            f"{path}: expected the members of a reflectance field, missing: "
            f"{missing or 'none'}, not known: {surplus[:5] or 'none'}, there more than once: "
            f"{twice[:5] or 'none'}; copy or make it again"
        )
    return {info.filename: info for info in infos}


def _read_header(path: Path, archive: zipfile.ZipFile) -> dict[str, Any]:
    if HEADER not in archive.namelist():
        raise FieldFileError(
            f"{path}: expected a reflectance field, received a ZIP archive without {HEADER}"
        )
    size = archive.getinfo(HEADER).file_size
    if size > MAX_HEADER_BYTES:
        raise FieldFileError(
            f"{path}: {HEADER}: expected at most {MAX_HEADER_BYTES} bytes, received {size}"
        )
    header = json.loads(archive.read(HEADER), parse_constant=_no_number)
    if not isinstance(header, dict) or header.get("format") != FORMAT_NAME:
        raise FieldFileError(f"{path}: {HEADER}: expected format {FORMAT_NAME!r}")
    version = header.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise FieldFileError(f"{path}: version: expected a number, received {version!r:.100}")
    if version > FORMAT_VERSION:
        raise FieldFileError(
            f"{path}: written in version {version} of the format, this program reads up to "
            f"{FORMAT_VERSION}; install a newer reflfield"
        )
    if version < OLDEST_VERSION:
        raise FieldFileError(
            f"{path}: written in version {version} of the format, this program reads from "
            f"{OLDEST_VERSION} on; make the field again with `reflfield run`"
        )
    model = header.setdefault("model", "clustered") if version < 4 else header.get("model")
    if not isinstance(model, str) or model not in SCHEMAS:
        raise FieldFileError(
            f"{path}: model: expected one of {list(SCHEMAS)}, received {model!r:.100}; install "
            "a newer reflfield"
        )
    return header


def _declared(path: Path, header: Mapping[str, Any]) -> dict[str, DeclaredArray]:
    """The header's list of arrays, checked against the model's schema."""
    with _naming(path):
        declared = {
            str(name): DeclaredArray(
                str(entry["dtype"]),
                tuple(_length(n) for n in entry["shape"]),
                str(entry["filter"]),
                _length(entry["context_bits"]),
                str(entry["sha256"]),
            )
            for name, entry in header["arrays"].items()
        }
        types = {n: (a.dtype, a.shape) for n, a in declared.items()}
        shapes = {n: shape for n, (_, shape) in types.items()}
        absent = {n: (a.dtype.name, a.shape) for n, a in _not_stored(header, shapes).items()}
        check_lengths(check_arrays(types | absent, header["model"]), SCHEMAS[header["model"]])
        for name, array in declared.items():
            if array.filter not in FILTERS:
                raise ValueError(f"{name}: unknown filter {array.filter!r}")
        check_options(header["domain"], header["visibility"], header["light_model"])
    return declared


def _stored_schema(header: Mapping[str, Any]) -> list[str]:
    """Arrays that a file of this version holds."""
    first = {SKEWS: FIRST_WITH_SKEWS, BOUNCE: FIRST_WITH_BOUNCE}
    return [n for n in SCHEMAS[header["model"]] if header["version"] >= first.get(n, 0)]


def _not_stored(
    header: Mapping[str, Any], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[Any]]:
    """What a file of an earlier version lacks, by name: skews and bounced light, all zero."""
    n_lobes = min(shapes.get("lobe_scale", (1,))[:1] or (1,))
    skews = np.zeros((1, SKEW_NODES, 3), np.int8)
    zeros: dict[str, NDArray[Any]] = {
        SKEWS: np.broadcast_to(skews, (n_lobes, *skews.shape[1:])),
        BOUNCE: np.zeros(3, np.float32),
    }
    lacking = set(SCHEMAS[header["model"]]) - set(_stored_schema(header))
    return {name: zeros[name] for name in lacking}


def _length(value: Any) -> int:
    whole = isinstance(value, int) and not isinstance(value, bool)
    if not whole or not 0 <= value <= LONGEST_AXIS:
        raise ValueError(
            f"shape: expected numbers >= 0, at most {LONGEST_AXIS}, received {value!r:.100}"
        )
    return int(value)


def _no_number(name: str) -> None:
    raise ValueError(f"expected finite numbers, received {name}")


def _read_array(path: Path, name: str, declared: DeclaredArray) -> NDArray[Any]:
    with _archive(path) as archive:
        content = archive.read(member_name(name))
        if hashlib.sha256(content).hexdigest() != declared.sha256:
            raise FieldFileError(
                f"{path}: {name}: the checksum differs from the header's: the file is "
                "damaged or was replaced while open"
            )
        try:
            array = unpack(
                content,
                np.dtype(declared.dtype),
                declared.shape,
                declared.filter,
                declared.context_bits,
            )
        except ValueError as error:
            raise FieldFileError(f"{path}: {name}: {error}") from error
    array.setflags(write=False)
    return array


def _field(header: Mapping[str, Any], arrays: StoredArrays) -> ReflectanceField:
    metadata = header["metadata"]
    if not isinstance(metadata, dict):
        raise ValueError(f"metadata: expected a table, received {metadata!r:.100}")
    shared: dict[str, Any] = {
        "arrays": arrays,
        "domain": header["domain"],
        "visibility": header["visibility"],
        "light_model": header["light_model"],
        "metadata": metadata,
    }
    opened: ReflectanceField
    if header["model"] == HalfVectorField.model:
        opened = HalfVectorField(**shared)
    else:
        sides: dict[str, Any] = {
            f"{which}_side": node_side(
                f"{which}_factor", arrays.declared[f"{which}_factor"].shape[0]
            )
            for which in ("view", "light")
        }
        opened = ClusteredField(**shared, **sides)
    # What the metadata say of directions is used much later.
    _ = opened.up, opened.observed_lights
    return opened
