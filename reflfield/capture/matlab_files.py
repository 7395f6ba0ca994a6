"""Arrays of MATLAB's files, whose sizes are looked at before memory is taken."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.documents import LARGEST_COORDINATE
from reflfield.errors import CaptureError
from reflfield.util.files import check_regular
from reflfield.util.late_import import LateImport
from reflfield.util.quoting import quoted

matlab: Any = LateImport("scipy.io")

MAX_FILE_BYTES = 1 << 24
MAX_VALUES = 1 << 22


def read_matlab(
    path: Path, shapes: Mapping[str, tuple[int | None, ...]]
) -> dict[str, NDArray[np.float64]]:
    """Arrays of a MATLAB file of version 4 to 7.

    Parameters
    ----------
    path : Path
    shapes : dict of str to tuple
        Names of the arrays that are wanted and their shapes; None stands for any length.

    Returns
    -------
    dict of str to float64 array
        Those that are there.

    Raises
    ------
    CaptureError
        If the file is damaged, too large, of another version, or an array is no such one.
    """
    size = check_regular(path, CaptureError)
    if size > MAX_FILE_BYTES:
        raise CaptureError(
            f"{path}: expected at most {MAX_FILE_BYTES:,} bytes, received {size:,}; is this "
            "the right file?"
        )
    try:
        with _doubts_as_errors():
            stated = {name: shape for name, shape, _ in matlab.whosmat(str(path))}
            wanted = [name for name in shapes if name in stated]
            for name in wanted:
                _check_shape(path, name, stated[name], shapes[name])
            loaded = matlab.loadmat(str(path), variable_names=wanted) if wanted else {}
    except CaptureError:
        raise
    # What SciPy raises on damaged files.
    except (matlab.matlab.MatReadError, OSError, ValueError, TypeError, KeyError, IndexError,
            EOFError, MemoryError, OverflowError, NotImplementedError, AttributeError,
            AssertionError, struct.error, zlib.error, UserWarning,
            RuntimeWarning) as error:  # fmt: skip
        text = " ".join(str(error).split()) or type(error).__name__
        raise CaptureError(
            f"{path}: expected a MATLAB file of version 4 to 7, received a damaged or "
            f"different file ({text[:200]}); save it anew with `save -v7`"
        ) from error
    return {name: _array(path, name, loaded[name]) for name in wanted}


@contextmanager
def _doubts_as_errors() -> Iterator[None]:
    """SciPy goes on with a warning where what it returns may be wrong."""
    with warnings.catch_warnings():
        for category in (UserWarning, RuntimeWarning):
            warnings.simplefilter("error", category)
        yield


def _check_shape(
    path: Path, name: str, received: tuple[int, ...], wanted: tuple[int | None, ...]
) -> None:
    fits = len(received) == len(wanted) and all(
        length in (None, have) for have, length in zip(received, wanted, strict=True)
    )
    if not fits or np.prod([float(n) for n in received]) > MAX_VALUES:
        shape = " x ".join("n" if length is None else str(length) for length in wanted)
        raise CaptureError(
            f"{path}: {name}: expected an array of {shape} numbers, received {received}"
        )


def _array(path: Path, name: str, value: Any) -> NDArray[np.float64]:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise CaptureError(
            f"{path}: {name}: expected an array of numbers, received {quoted(value)}"
        )
    array = value.astype(np.float64)
    if not (np.abs(array) <= LARGEST_COORDINATE).all():  # False for NaN
        raise CaptureError(
            f"{path}: {name}: expected finite numbers of at most {LARGEST_COORDINATE:g}"
        )
    return array
