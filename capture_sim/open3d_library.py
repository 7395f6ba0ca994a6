"""Open3D, imported when it is first used, also on a machine without libusb.

Open3D 0.20, the first with wheels for Python 3.13, links against libusb-1.0 for depth cameras
that nothing here uses. The wheel `libusb-package` ships that library; loaded first, with its
symbols global, it satisfies the import.

Only Open3D's compiled module is loaded. The package around it imports plotting, notebooks and
machine learning (pandas, scikit-learn, dash), which nothing here uses: 1.8 s of CPU time
instead of .4. Who imports the package afterwards gets the same module.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from capture_sim.errors import SceneError

LIBUSB = "libusb-1.0.so.0"
COMPILED = "open3d.cpu.pybind"


@cache
def load_open3d() -> Any:
    """Import Open3D's compiled module, after libusb where that is needed.

    Returns
    -------
    module
        `open3d.cpu.pybind`, or `open3d`, which has the same names.

    Raises
    ------
    SceneError
        If it cannot be imported; the message says what to install.
    """
    if sys.platform == "linux":
        _load_libusb()
    try:
        return sys.modules.get(COMPILED) or _load_compiled() or import_module("open3d")
    except ImportError as error:
        raise SceneError(
            f"open3d: expected to be importable, but {error}; install reflfield again with "
            "pip, or the library that is named with the system's package manager"
        ) from error


def _load_compiled() -> Any:
    """Load the compiled module alone; None where it is not in its usual place."""
    package = find_spec("open3d")
    if sys.platform == "win32" or package is None or package.origin is None:
        return None
    path = next(Path(package.origin).parent.glob("cpu/pybind*.so"), None)
    spec = path and spec_from_file_location(COMPILED, path)
    if not spec or spec.loader is None:
        return None
    # As the package does: a second OpenMP runtime in the process is no error.
    os.environ.setdefault("KMP_DUPLICATE_LIB_OK", "True")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[COMPILED] = module
    return module


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
    """Stands for the module that `load_open3d` returns."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # who looks what kind of thing this is, uses nothing of it
            raise AttributeError(name)
        return getattr(load_open3d(), name)


open3d: Any = _ImportedWhenUsed()
