"""What an image file says before any pixel is decoded: kind, size, and statements on colour.

Headers are read here, not by a decoder's library: decoders take memory for what a header
claims (rows of an offset table, tiles, coefficients of a progressive JPEG) before anybody can
look at the claim. Every number is compared with a stated limit first.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from reflfield.capture.exr_headers import ExrPart, read_exr_parts
from reflfield.capture.tiff_headers import (
    ExifFacts,
    TiffPage,
    exif_facts,
    raw_evidence,
    read_tiff_pages,
    tiff_facts,
)
from reflfield.errors import CaptureError
from reflfield.util.files import check_regular

# A header that asks for more is damaged or hostile; the largest cameras have 151 million.
MAX_PIXELS = 160_000_000
# Above this many pixels a file must have a byte for every 64 of them: compressed photographs
# have more, a single colour that compresses to nothing has not.
PIXELS_UNASKED = 1 << 24
PIXELS_PER_BYTE = 64
# Data of an EXR beyond what its display window shows are read in vain.
MOST_OVERSCAN = 4
MOST_PNG_CHUNKS = 10_000
# Chunks of a PNG whose content is read here, and how much of it.
PNG_CHUNKS = {b"IHDR": 13, b"gAMA": 4, b"cHRM": 32, b"sRGB": 1, b"cICP": 4, b"eXIf": 1 << 16,
              b"iCCP": 1 << 23, b"acTL": 8}  # fmt: skip
MOST_JPEG_SEGMENTS = 10_000
LARGEST_RADIANCE_HEADER = 1 << 16

READABLE = "an EXR, PNG, JPEG, TIFF or Radiance HDR image"
# Content that is an image of a kind that is not read, and what it is called.
OTHER_KINDS = {
    b"GIF8": "a GIF image",
    b"BM": "a BMP image",
    b"8BPS": "a Photoshop file",
    b"\0\0\0\x0cjP  ": "a JPEG 2000 image",
    b"\xff\x4f\xff\x51": "a JPEG 2000 image",
    b"\0\0\0\x0cJXL ": "a JPEG XL image",
    b"\xff\x0a": "a JPEG XL image",
    b"RIFF": "a WebP image",
    b"SDPX": "a DPX image",
    b"XPDS": "a DPX image",
    b"PF\n": "a PFM image",
    b"Pf\n": "a PFM image",
    b"P5": "a PGM image",
    b"P6": "a PPM image",
}
# Camera raw files that are no TIFF.
RAW_STARTS = {
    b"FUJIFILMCCD-RAW": "Fujifilm RAF",
    b"FOVb": "Sigma X3F",
    b"\0MRM": "Minolta MRW",
    b"HEAPCCDR": "Canon CRW",
    b"II\x1a\0\0\0HEAPCCDR": "Canon CRW",
    b"IIRO": "Olympus ORF",
    b"IIRS": "Olympus ORF",
    b"MMOR": "Olympus ORF",
    b"IIU\0": "Panasonic RW2",
}
RAW_SUFFIXES = frozenset(
    f".{name}"
    for name in (
        *("3fr", "ari", "arw", "bay", "cr2", "cr3", "crw", "dcr", "dcs", "dng", "erf", "fff"),
        *("gpr", "iiq", "k25", "kdc", "mdc", "mef", "mos", "mrw", "nef", "nrw", "orf", "pef"),
        *("ptx", "r3d", "raf", "raw", "rw2", "rwl", "sr2", "srf", "srw", "x3f"),
    )
)


@dataclass(frozen=True)
class ImageHeader:
    """What a file says of its image.

    Parameters
    ----------
    kind : {"exr", "png", "jpeg", "tiff", "hdr", "raw"}
    width, height : int
        Pixels as stored; of an EXR the display window, of several parts or pages the first.
    orientation : int
        How a viewer would turn the image (Exif, 1 to 8); the pixels stay as they are.
    exposure : (seconds, f-number, ISO) tuple of float
        As Exif data say; 0 where they do not.
    alpha : bool
        Of a PNG or TIFF: whether there is an alpha channel.
    adobe_rgb : bool
        Of a JPEG: whether Exif data say Adobe RGB, as cameras do without a profile.
    chunks : dict of bytes to bytes
        Of a PNG: names of the chunks before the image, with the content of `PNG_CHUNKS`.
    lines : tuple of str
        Of a Radiance HDR: the lines of its header.
    parts : tuple of ExrPart
    pages : tuple of TiffPage
    raw : str
        What camera raw file it is.
    """

    kind: str
    width: int
    height: int
    orientation: int = 1
    exposure: tuple[float, float, float] = (0.0, 0.0, 0.0)
    alpha: bool = False
    adobe_rgb: bool = False
    chunks: dict[bytes, bytes] = field(default_factory=dict)
    lines: tuple[str, ...] = ()
    parts: tuple[ExrPart, ...] = ()
    pages: tuple[TiffPage, ...] = ()
    raw: str = ""


def read_header(path: Path) -> ImageHeader:
    """Read the header of an image file, told apart by content.

    Parameters
    ----------
    path : Path

    Returns
    -------
    ImageHeader
        Its size is within limits.

    Raises
    ------
    CaptureError
        If there is no such file, it is a folder, pipe or device, of another kind, damaged, or
        larger than `MAX_PIXELS`. The message names it.
    """
    n_bytes = check_regular(path, CaptureError)
    try:
        with path.open("rb") as file:
            start = file.read(32)
            header = _raw_header(path, start) or _reader_of(path, start)(path, file)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (struct.error, IndexError) as error:
        raise CaptureError(
            f"{path}: expected {READABLE}, received one that ends within its header; copy or "
            "export it again"
        ) from error
    if header.kind != "raw":
        check_size(path, header.width, header.height, n_bytes)
    return header


def check_size(path: Path, width: int, height: int, n_bytes: int) -> None:
    """Demand an image of a size that is worth decoding.

    Raises
    ------
    CaptureError
        If it has no pixel, more than `MAX_PIXELS`, or many more than a file of so few bytes
        holds.
    """
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise CaptureError(
            f"{path}: expected an image of 1 to {MAX_PIXELS:,} pixels, "
            f"received {width} x {height}"
        )
    if width * height > max(PIXELS_UNASKED, PIXELS_PER_BYTE * n_bytes):
        raise CaptureError(
            f"{path}: expected an image with at least one byte for {PIXELS_PER_BYTE} pixels, "
            f"received {width} x {height} pixels in {n_bytes:,} bytes; is it damaged?"
        )


def _raw_header(path: Path, start: bytes) -> ImageHeader | None:
    """The header of a camera raw file; None if it is none."""
    kind = next((name for text, name in RAW_STARTS.items() if start.startswith(text)), "")
    if start[4:12] == b"ftypcrx ":
        kind = "Canon CR3"
    elif start[:2] in (b"II", b"MM") and start[8:10] == b"CR":
        kind = "Canon CR2"
    elif path.suffix.lower() in RAW_SUFFIXES:
        kind = path.suffix[1:].upper()
    elif start[:4] in (b"II*\0", b"MM\0*"):
        kind = raw_evidence(path)
    if not kind:
        return None
    with path.open("rb") as file:
        facts = tiff_facts(path, file) if start[:2] in (b"II", b"MM") else ExifFacts()
    return ImageHeader("raw", 0, 0, exposure=facts.exposure, raw=kind)


def _reader_of(path: Path, start: bytes) -> Callable[[Path, IO[bytes]], ImageHeader]:
    readers: dict[bytes, Callable[[Path, IO[bytes]], ImageHeader]] = {
        b"\x76\x2f\x31\x01": _exr,
        b"\x89PNG\r\n\x1a\n": _png,
        b"\xff\xd8\xff": _jpeg,
        b"II*\0": _tiff,
        b"MM\0*": _tiff,
        b"II+\0": _tiff,
        b"MM\0+": _tiff,
        b"#?": _hdr,
    }
    for text, reader in readers.items():
        if start.startswith(text):
            return reader
    other = next((name for text, name in OTHER_KINDS.items() if start.startswith(text)), None)
    received = f"{other}; convert it" if other else f"a file that starts with {start[:4]!r}"
    raise CaptureError(f"{path}: expected {READABLE}, received {received}")


def _exr(path: Path, file: IO[bytes]) -> ImageHeader:
    parts = read_exr_parts(path, file)
    n_bytes = os.fstat(file.fileno()).st_size
    for part in parts:
        check_size(path, *part.data_window.size, n_bytes)
        check_size(path, *part.display_window.size, MAX_PIXELS)
        _check_overscan(path, part)
    width, height = parts[0].display_window.size
    return ImageHeader("exr", width, height, parts=parts)


def _check_overscan(path: Path, part: ExrPart) -> None:
    """Demand data that are not far larger than what is shown of them."""
    data, shown = (w * h for w, h in (part.data_window.size, part.display_window.size))
    if data > max(PIXELS_UNASKED, MOST_OVERSCAN * shown):
        raise CaptureError(
            f"{path}: expected a data window of at most {MOST_OVERSCAN} times the display "
            f"window, received {data:,} pixels for {shown:,}; crop it"
        )


def _tiff(path: Path, file: IO[bytes]) -> ImageHeader:
    pages = read_tiff_pages(path, file)
    for page in pages:
        check_size(path, page.tile_width, page.tile_height, MAX_PIXELS)
    first = next((page for page in pages if not page.reduced), pages[0])
    exposure = tiff_facts(path, file).exposure
    return ImageHeader(
        "tiff", first.width, first.height, first.orientation, exposure, first.alpha, pages=pages
    )


def _png(path: Path, file: IO[bytes]) -> ImageHeader:
    file.seek(8)
    chunks: dict[bytes, bytes] = {}
    for _ in range(MOST_PNG_CHUNKS):
        length, name = struct.unpack(">I4s", file.read(8))
        if name == b"IDAT":
            break
        kept = min(length, PNG_CHUNKS.get(name, 0))
        chunks[name] = file.read(kept)
        file.seek(length - kept + 4, os.SEEK_CUR)  # and the checksum
    width, height = struct.unpack(">II", chunks.get(b"IHDR", b"")[:8])
    n_pictures = int.from_bytes(chunks.get(b"acTL", b"")[:4], "big")
    if n_pictures > 1:
        raise CaptureError(
            f"{path}: expected one picture, received an animation of {n_pictures:,}; save the "
            "one that is meant as a PNG image of its own"
        )
    exif = exif_facts(path, chunks.get(b"eXIf", b""))
    colour_type = chunks[b"IHDR"][9]
    alpha = colour_type in (4, 6) or b"tRNS" in chunks
    return ImageHeader(
        "png", width, height, exif.orientation, exif.exposure, alpha, chunks=chunks
    )


def check_png(path: Path) -> None:
    """Demand that a PNG is whole, by its checksums.

    Of damaged ones the decoder prints a line on standard error, besides failing.

    Raises
    ------
    CaptureError
        If it ends early or a checksum differs.
    """
    with path.open("rb") as file:
        file.seek(8)
        name = b""
        while name != b"IEND":
            head = file.read(8)
            length, name = struct.unpack(">I4s", head.ljust(8, b"\0"))
            content = file.read(min(length, os.fstat(file.fileno()).st_size))
            stored = file.read(4)
            if stored != struct.pack(">I", zlib.crc32(content, zlib.crc32(name))):
                raise CaptureError(
                    f"{path}: expected a PNG image, received a damaged or truncated file (the "
                    f"checksum of {name!r} differs); copy or export it again"
                )


def _jpeg(path: Path, file: IO[bytes]) -> ImageHeader:
    """Width and height stand in the frame segment, behind others of any length."""
    file.seek(2)
    exif = ExifFacts()
    for _ in range(MOST_JPEG_SEGMENTS):
        fill, marker = struct.unpack("BB", file.read(2))
        while marker == 0xFF:  # fill bytes
            marker = file.read(1)[0]
        if fill != 0xFF or marker in (0xD9, 0xDA):
            break
        length = struct.unpack(">H", file.read(2))[0]
        if length < 2:  # it counts itself
            break
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            precision, height, width, channels = struct.unpack(">BHHB", file.read(6))
            if precision != 8 or channels not in (1, 3):
                raise CaptureError(
                    f"{path}: expected a JPEG of 8 bits, grey or RGB, received {precision} "
                    f"bits and {channels} channels; export it again"
                )
            return ImageHeader(
                "jpeg", width, height, exif.orientation, exif.exposure, adobe_rgb=exif.adobe_rgb
            )
        content = file.read(length - 2) if marker == 0xE1 else b""
        if content[:6] == b"Exif\0\0":
            exif = exif_facts(path, content[6:])
        file.seek(length - 2 - len(content), os.SEEK_CUR)
    raise CaptureError(
        f"{path}: expected a JPEG image, received one without a frame; is it whole?"
    )


def _hdr(path: Path, file: IO[bytes]) -> ImageHeader:
    file.seek(0)
    text = file.read(LARGEST_RADIANCE_HEADER).decode("latin-1")
    head, _, rest = text.partition("\n\n")
    size = rest.partition("\n")[0]
    numbers = re.fullmatch(r"-Y +(\d{1,9}) +\+X +(\d{1,9})\s*", size)
    if not numbers:
        raise CaptureError(
            f"{path}: expected a Radiance image with rows from the top left "
            f"(-Y height +X width), received {size[:40]!r}; convert it"
        )
    lines = tuple(line.strip() for line in head.split("\n")[1:])
    formats = {line.partition("=")[2].strip() for line in lines if line.startswith("FORMAT=")}
    if formats != {"32-bit_rle_rgbe"}:
        raise CaptureError(
            f"{path}: expected a Radiance image of FORMAT 32-bit_rle_rgbe, received "
            f"{', '.join(sorted(formats))[:40] or 'no FORMAT'}; convert it"
        )
    return ImageHeader("hdr", int(numbers[2]), int(numbers[1]), lines=lines)
