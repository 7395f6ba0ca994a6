"""Files whose bytes depend on their contents alone."""

from __future__ import annotations

import errno
import io
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray
from PIL import Image

from capture_sim.objects import SurfaceMesh

_LARGEST_HALF = float(np.finfo(np.float16).max)
# File systems without fsync of folders or of files opened for reading say one of these.
_NO_FSYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.ENOSYS)
_EPOCH = (1980, 1, 1, 0, 0, 0)  # zip members carry a date; this is the earliest


def write_whole(path: Path, write: Callable[[Path, Any], None], values: Any) -> None:
    """Write a file under another name first: what has its name is whole, and on the disk.

    Parameters
    ----------
    path : Path
    write : callable
        Writes values to a path.
    values : object

    Raises
    ------
    OSError
        Names the file.
    """
    beginning = path.with_name(f".{path.name}")
    try:
        write(beginning, values)
        flush_to_disk(beginning)
    except OSError as failure:
        beginning.unlink(missing_ok=True)
        raise named_failure(failure, path) from failure
    beginning.replace(path)


def named_failure(failure: OSError, path: Path) -> OSError:
    """The same failure with the name of the file that was being written."""
    return OSError(failure.errno, failure.strerror or str(failure), str(path))


def flush_to_disk(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on the disk.

    Parameters
    ----------
    path : Path
    """
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


def write_exr(path: Path, radiance: NDArray[np.float32]) -> None:
    """Write linear radiance as half floats; as floats if it exceeds their range.

    Parameters
    ----------
    path : Path
    radiance : (h, w, 3) float32
    """
    fits = float(np.abs(radiance).max(initial=0.0)) <= _LARGEST_HALF
    _write_channels(path, "RGB", radiance.astype(np.float16 if fits else np.float32))


def write_rgba_exr(path: Path, pixels: NDArray[Any]) -> None:
    """Write radiance over black and alpha as they are.

    Parameters
    ----------
    path : Path
    pixels : (h, w, 4) float16 or float32
    """
    _write_channels(path, "RGBA", pixels)


def _write_channels(path: Path, names: str, pixels: NDArray[Any]) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with OpenEXR.File(header, {names: np.ascontiguousarray(pixels)}) as file:
            file.write(str(path))
    except RuntimeError as failure:  # with the system's words at the end
        codes = (code for code in errno.errorcode if os.strerror(code) in str(failure))
        code = next(codes, errno.EIO)
        raise OSError(code, os.strerror(code), str(path)) from failure


def write_png(path: Path, encoded: NDArray[np.uint8]) -> None:
    """Write an 8-bit image as it is.

    Parameters
    ----------
    path : Path
    encoded : (h, w), (h, w, 3) or (h, w, 4) uint8
        Grey or sRGB, with alpha that nothing is multiplied by.
    """
    Image.fromarray(encoded).save(path, format="PNG")


def write_silhouette(path: Path, coverage: NDArray[np.float32]) -> None:
    """Write coverage in [0, 1] as an 8-bit grey PNG, white = object.

    Parameters
    ----------
    path : Path
    coverage : (h, w) float32
    """
    write_png(path, np.rint(coverage * 255.0).astype(np.uint8))


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8.

    Parameters
    ----------
    path : Path
    text : str
    """
    path.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON types with the keys in their given order.

    Parameters
    ----------
    path : Path
    content : mapping
    """
    write_text(path, json.dumps(content, indent=1) + "\n")


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays as a compressed npz without pickles or dates.

    Parameters
    ----------
    path : Path
    arrays : mapping of str to array
        Of numbers or booleans.

    Raises
    ------
    ValueError
        If an array holds Python objects.
    """
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.asarray(array, order="C"), allow_pickle=False)
            member = zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH)
            member.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(member, buffer.getvalue(), compresslevel=4)


def write_ply(path: Path, mesh: SurfaceMesh) -> None:
    """Write a mesh with normals and texture coordinates as binary PLY.

    Parameters
    ----------
    path : Path
    mesh : SurfaceMesh
        Written as float32, metres.
    """
    names = ("x", "y", "z", "nx", "ny", "nz", "s", "t")
    vertices = np.hstack([mesh.vertices, mesh.normals, mesh.uv]).astype("<f4")
    faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    text = "\n".join(header) + "\n"
    path.write_bytes(text.encode("ascii") + vertices.tobytes() + faces.tobytes())
