"""Binary descriptions, read in order; counts are compared with the file's size first."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.paths import LONGEST_PATH
from reflfield.errors import CaptureError
from reflfield.util.files import check_regular


def opened(path: Path) -> IO[bytes]:
    """A regular file, open for reading.

    Raises
    ------
    CaptureError
        If it is none, or cannot be read.
    """
    check_regular(path, CaptureError)
    try:
        return path.open("rb")
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error})") from error


class BinaryFile:
    """A little-endian file.

    Parameters
    ----------
    file : binary file
        At its beginning.
    path : Path
        Named in messages.

    Raises
    ------
    CaptureError
        From every method, if the file holds less than is asked for.
    """

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self.file, self.path = file, path
        self.left = check_regular(path, CaptureError)

    def numbers(self, layout: str) -> tuple[Any, ...]:
        """Numbers of a `struct` layout."""
        return struct.unpack(f"<{layout}", self.bytes(struct.calcsize(f"<{layout}")))

    def array(self, dtype: str, *shape: int) -> NDArray[Any]:
        """Array of a little-endian type."""
        n_bytes = np.dtype(dtype).itemsize
        for length in shape:  # as whole numbers, which do not overflow
            n_bytes *= int(length)
        return np.frombuffer(self.bytes(n_bytes), dtype).reshape(shape)

    def bytes(self, n_bytes: int) -> bytes:
        """The next bytes."""
        self._demand(n_bytes)
        content = self.file.read(n_bytes)
        self.left -= n_bytes
        if len(content) != n_bytes:
            raise CaptureError(f"{self.path}: the file shrinks while it is read; is it in use?")
        return content

    def skip(self, n_bytes: int) -> None:
        """Leave out bytes."""
        self._demand(n_bytes)
        self.file.seek(n_bytes, 1)
        self.left -= n_bytes

    def count(
        self, what: str, least_bytes: int, most: int | None = None, layout: str = "Q"
    ) -> int:
        """A number of things of which each takes some bytes at least."""
        n: int = self.numbers(layout)[0]
        if n * least_bytes > self.left or (most is not None and n > most):
            raise CaptureError(
                f"{self.path}: expected at most {most or self.left // least_bytes:,} {what}, "
                f"received a count of {n:,}; the file is damaged, truncated or of another kind"
            )
        return n

    def text(self) -> str:
        """Text up to a zero byte."""
        content = bytearray()
        while (byte := self.bytes(1)) != b"\0":
            content += byte
            if len(content) > LONGEST_PATH:
                raise CaptureError(
                    f"{self.path}: expected names of at most {LONGEST_PATH} bytes, received a "
                    "longer one; the file is damaged or of another kind"
                )
        return content.decode("utf-8", errors="replace")

    def end(self) -> None:
        """Refuse what goes on."""
        if self.left:
            raise CaptureError(
                f"{self.path}: expected the end of the file, received {self.left:,} more "
                "bytes; is it of another program or version?"
            )

    def _demand(self, n_bytes: int) -> None:
        if n_bytes > self.left:
            raise CaptureError(
                f"{self.path}: expected {n_bytes:,} more bytes, received {self.left:,}: the "
                "file is truncated; copy it again"
            )
