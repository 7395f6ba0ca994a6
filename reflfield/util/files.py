"""Files that are read whole after a look at what they are, and written whole or not at all.

Input files are not trusted: only regular files are opened (a FIFO would wait for ever, a device
never end), sizes are compared with a limit before memory is taken, and nothing is unpickled.
"""

from __future__ import annotations

import errno
import io
import math
import os
import re
import shutil
import stat
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError

# What a file that is no regular one is called in messages.
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
# Characters of the header of one array in an npz file, which numpy evaluates as a literal.
LONGEST_ARRAY_HEADER = 10_000
# File systems without fsync of folders or of files opened for reading say one of these.
_NO_FSYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.ENOSYS)


def check_regular(path: Path, error: type[InputError] = InputError) -> int:
    """Demand a regular file, before it is opened; return its size in bytes.

    Parameters
    ----------
    path : Path
        Symbolic links are followed.
    error : type, optional
        What to raise.

    Raises
    ------
    InputError
        Of the type asked for, if the file is missing or a folder, pipe, device or socket.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as failure:
        reason = getattr(failure, "strerror", None) or failure
        raise error(f"{path}: cannot be read ({reason})") from failure
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for test, name in _KINDS if test(status.st_mode)), "something else")
        raise error(f"{path}: expected a file, received {kind}; name the file itself")
    return status.st_size


def utf8_name(path: Path, error: type[InputError] = InputError) -> str:
    r"""Name of a file for libraries that read and write by names in UTF-8.

    Where the locale has another encoding, Python holds the bytes of a name as halves of
    surrogate pairs.

    Raises
    ------
    InputError
        Of the type asked for, if the bytes of the name are no UTF-8.

    Examples
    --------
    >>> utf8_name(Path("vas\udcc3\udca9.exr"))
    'vas\xe9.exr'
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeError:
        raise error(
            f"{path}: expected a name in UTF-8, received one in another encoding; rename the "
            "file or the folders above it"
        ) from None


def read_bytes(path: Path, most_bytes: int, error: type[InputError] = InputError) -> bytes:
    """Bytes of a regular file of a bounded size.

    Parameters
    ----------
    path : Path
    most_bytes : int
        A larger file is refused unread.
    error : type, optional
        What to raise.

    Raises
    ------
    InputError
        Of the type asked for, naming the file.
    """
    size = check_regular(path, error)
    if size > most_bytes:
        raise error(
            f"{path}: expected at most {most_bytes:,} bytes, received {size:,}; "
            "is this the right file?"
        )
    try:
        with path.open("rb") as file:
            content = file.read(size + 1)
    except OSError as failure:
        raise error(f"{path}: cannot be read ({failure.strerror or failure})") from failure
    if len(content) > size:
        raise error(f"{path}: expected {size:,} bytes, but the file grows; is it in use?")
    return content


def load_array(
    path: Path, most_bytes: int, error: type[InputError] = InputError
) -> NDArray[Any]:
    """Array of an npy file, whose size is looked at before memory is taken.

    Parameters
    ----------
    path : Path
    most_bytes : int
        Of the array.
    error : type, optional
        What to raise.

    Returns
    -------
    ndarray
        Numbers, booleans or fixed-length text; never Python objects.

    Raises
    ------
    InputError
        Of the type asked for, naming the file, if it is no npy file, damaged, too large or
        holds pickled objects.
    """
    content = io.BytesIO(read_bytes(path, most_bytes + LONGEST_ARRAY_HEADER, error))
    try:
        shape, dtype = _array_header(content)
        claimed = dtype.itemsize * math.prod(shape)
        if claimed != len(content.getvalue()) - content.tell():
            raise ValueError(f"an array of {claimed:,} bytes in a file of another size")
        content.seek(0)
        array: NDArray[Any] = np.lib.format.read_array(
            content, allow_pickle=False, max_header_size=LONGEST_ARRAY_HEADER
        )
    except (OSError, ValueError, KeyError, EOFError, SyntaxError, TypeError, MemoryError,
            OverflowError, RecursionError) as failure:  # fmt: skip
        text = " ".join(str(failure).split()) or type(failure).__name__
        raise error(
            f"{path}: expected an array in an npy file, received a damaged, truncated or "
            f"different file ({text}); copy or make it again"
        ) from failure
    return array


def load_arrays(
    path: Path,
    most_bytes: int,
    error: type[InputError] = InputError,
    names: Collection[str] | None = None,
) -> dict[str, NDArray[Any]]:
    """Arrays of an npz file, whose sizes are looked at before memory is taken.

    Parameters
    ----------
    path : Path
    most_bytes : int
        Of all arrays together that are read, unpacked.
    error : type, optional
        What to raise.
    names : collection of str, optional
        Arrays to read, which must be there; None reads all.

    Returns
    -------
    dict of str to ndarray
        Numbers, booleans or fixed-length text; never Python objects.

    Raises
    ------
    InputError
        Of the type asked for, naming the file, if it is no npz file, damaged, too large or
        holds pickled objects.
    """
    check_regular(path, error)
    try:
        with zipfile.ZipFile(path) as archive:
            members = _members(archive, names)
            size = sum(member.file_size for member in members)
            if size > most_bytes:
                raise error(
                    f"{path}: expected arrays of at most {most_bytes:,} bytes, received "
                    f"{size:,}; is this the right file?"
                )
            return {
                member.filename.removesuffix(".npy"): _read_member(archive, member)
                for member in members
            }
    except error:
        raise
    # What zipfile and numpy raise on damaged files; zlib.error is none of the others.
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, NotImplementedError,
            SyntaxError, TypeError, MemoryError, OverflowError, zipfile.BadZipFile,
            zipfile.LargeZipFile, zlib.error) as failure:  # fmt: skip
        text = " ".join(str(failure).split()) or type(failure).__name__
        raise error(
            f"{path}: expected arrays in an npz file, received a damaged, truncated or "
            f"different file ({text}); copy or make it again"
        ) from failure


def _members(archive: zipfile.ZipFile, names: Collection[str] | None) -> list[zipfile.ZipInfo]:
    """The arrays of some names, or all."""
    members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
    if names is None:
        return members
    present = {member.filename.removesuffix(".npy") for member in members}
    if missing := sorted(set(names) - present):
        raise ValueError(f"without {', '.join(missing)}")
    return [m for m in members if m.filename.removesuffix(".npy") in names]


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, whose header must agree with the size of the member."""
    with archive.open(member) as file:
        shape, dtype = _array_header(file)
        claimed = dtype.itemsize
        for length in shape:
            claimed *= length
        if claimed > member.file_size:
            raise ValueError(f"{member.filename} claims {claimed:,} bytes that are not there")
    with archive.open(member) as file:
        array: NDArray[Any] = np.lib.format.read_array(
            file, allow_pickle=False, max_header_size=LONGEST_ARRAY_HEADER
        )
        if file.read(1):  # which also compares the checksum
            raise ValueError(f"{member.filename} goes on after its array")
    return array


def _array_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type that an npy file claims."""
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise ValueError(f"version {version} of the npy format")
    try:
        shape, _, dtype = read(file, max_header_size=LONGEST_ARRAY_HEADER)
    except tokenize.TokenError as failure:  # no error that callers expect of a file
        raise ValueError(f"header: {failure}") from failure
    if dtype.hasobject:
        raise ValueError("pickled objects, which are never read")
    return shape, dtype


def unfinished_name(path: Path) -> Path:
    """Name of a file in `replacing`, which a process that was killed may leave."""
    return path.with_name(f".{path.name}.partial")


@contextmanager
def replacing(path: Path, *, flushed: bool = True) -> Iterator[Path]:
    """Yield a temporary name that becomes `path` if the block succeeds, else vanishes.

    The name is always the same, so that what a killed run left of it is written over. The
    content is on the disk before the name is given: after a power failure `path` holds the
    earlier file or the new one. A file whose readers know damage by a checksum, and make it
    again, need not be `flushed`.
    """
    partial = unfinished_name(path)
    with naming(path):
        try:
            yield partial
            if flushed:
                flush_to_disk(partial)
            partial.replace(path)
            if flushed:
                flush_to_disk(path.parent)
        finally:
            partial.unlink(missing_ok=True)


# What NumPy says of a disk that is full, with no number of the system.
_NUMPY_CUT_OFF = re.compile(r"[0-9]+ requested and [0-9]+ written")


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Give a system's error inside the block that names no file the name of this one.

    Parameters
    ----------
    path : Path or str
        The file or folder that is written.

    Examples
    --------
    >>> with naming("results"):
    ...     raise OSError(errno.ENOSPC, "No space left on device")
    Traceback (most recent call last):
    OSError: [Errno 28] No space left on device: 'results'
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        if error.errno is None and _NUMPY_CUT_OFF.search(str(error)):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        error.strerror = error.strerror or str(error) or type(error).__name__
        error.filename = str(path)
        raise


@contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Yield a new folder whose files go to `folder` if the block succeeds, else vanish.

    After an error `folder` is as it was: absent, or with what it held. An error of the system
    that names no file, as of a full disk, names the folder.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=".", suffix=".partial", dir=folder))
    try:
        with naming(folder):
            yield partial
        for file in sorted(path for path in partial.rglob("*") if path.is_file()):
            target = folder / file.relative_to(partial)
            target.parent.mkdir(parents=True, exist_ok=True)
            flush_to_disk(file)
            file.replace(target)
        made = []
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        for path in made:
            if not any(path.iterdir()):
                path.rmdir()


def flush_to_disk(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on the disk."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:  # folders cannot be opened on Windows
        return
    try:
        os.fsync(handle)
    except OSError as failure:
        if failure.errno not in _NO_FSYNC:
            raise
    finally:
        os.close(handle)
