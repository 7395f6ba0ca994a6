"""Open3D, imported when it is first used, also on a machine without libusb.

Open3D 0.20, the first with wheels for Python 3.13, links against libusb-1.0 for depth cameras
that nothing here uses. The wheel `libusb-package` ships that library; loaded first, with its
symbols global, it satisfies the import. The import takes seconds, so it waits until rays are
traced.
"""

from __future__ import annotations

import ctypes
import sys
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from reflfield.errors import ReflfieldError

LIBUSB = "libusb-1.0.so.0"


@cache
def load_open3d() -> Any:
    """Import Open3D, after libusb where that is needed.

    Returns
    -------
    module
        `open3d`.

    Raises
    ------
    ReflfieldError
        If it cannot be imported; the message says what to install.
    """
    if sys.platform == "linux":
        _load_libusb()
    try:
        return import_module("open3d")
    except ImportError as error:
        raise ReflfieldError(
            f"open3d: expected to be importable, but {error}; install reflfield again with "
            "pip, or the library that is named with the system's package manager"
        ) from error


def _load_libusb() -> None:
    """Load the system's libusb, else the one of the wheel, else none."""
    try:
        ctypes.CDLL(LIBUSB, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        if find_spec("libusb_package") is not None:
            path = import_module("libusb_package").get_library_path()
            if path is not None:
                ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)


class _ImportedWhenUsed:
    """Stands for the module `open3d`."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # who looks what kind of thing this is, uses nothing of it
            raise AttributeError(name)
        return getattr(load_open3d(), name)


open3d: Any = _ImportedWhenUsed()
