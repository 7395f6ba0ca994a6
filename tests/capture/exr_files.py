"""Uncompressed OpenEXR files written by hand: subsampled channels, wild headers, parts."""

import struct

import numpy as np

MAGIC = b"\x76\x2f\x31\x01"
MULTIPART = 0x1000


def attribute(name, kind, value):
    return f"{name}\0{kind}\0".encode() + struct.pack("<I", len(value)) + value


def header(channels, data_window, display_window=None, *more):
    """Attributes of one part; channels are (name, pixel type, sampling), 1 half, 2 float."""
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<4i", kind, 0, step, step)
        for name, kind, step in channels
    )
    windows = (data_window, display_window or data_window)
    attributes = [
        attribute("channels", "chlist", listed + b"\0"),
        attribute("compression", "compression", b"\0"),
        attribute("dataWindow", "box2i", struct.pack("<4i", *windows[0])),
        attribute("displayWindow", "box2i", struct.pack("<4i", *windows[1])),
        attribute("lineOrder", "lineOrder", b"\0"),
        attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
        attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        attribute("screenWindowWidth", "float", struct.pack("<f", 1)),
        *more,
    ]
    return b"".join(attributes) + b"\0"


def write_exr_by_hand(path, channels, *more):
    """Write one part of float channels: name to (array, sampling), in any order."""
    sampled = sorted(channels.items())
    height, width = next(array.shape for array, step in channels.values() if step == 1)
    kinds = [(name, 2, step) for name, (_, step) in sampled]
    head = (
        MAGIC + struct.pack("<I", 2) + header(kinds, (0, 0, width - 1, height - 1), None, *more)
    )
    lines = []
    for y in range(height):
        data = b"".join(
            array[y // step].astype("<f4").tobytes()
            for _, (array, step) in sampled
            if y % step == 0
        )
        lines.append(struct.pack("<ii", y, len(data)) + data)
    starts = len(head) + 8 * height + np.cumsum([0, *map(len, lines[:-1])])
    path.write_bytes(head + starts.astype("<u8").tobytes() + b"".join(lines))


def write_layers(path, channels):
    """Write one part of float channels, name to (h, w) array."""
    write_exr_by_hand(path, {name: (array, 1) for name, array in channels.items()})


def write_parts(path, parts):
    """Write several parts: name to (name of channel to (h, w) array), uncompressed."""
    heads, bodies = [], []
    for number, (name, channels) in enumerate(parts.items()):
        arrays = [array for _, array in sorted(channels.items())]
        height, width = arrays[0].shape
        kinds = [(channel, 2, 1) for channel in sorted(channels)]
        more = [
            attribute("name", "string", name.encode()),
            attribute("type", "string", b"scanlineimage"),
            attribute("chunkCount", "int", struct.pack("<i", height)),
        ]
        heads.append(header(kinds, (0, 0, width - 1, height - 1), None, *more))
        rows = [b"".join(a[y].astype("<f4").tobytes() for a in arrays) for y in range(height)]
        bodies.append(
            [struct.pack("<iii", number, y, len(row)) + row for y, row in enumerate(rows)]
        )
    head = MAGIC + struct.pack("<I", 2 | MULTIPART) + b"".join(heads) + b"\0"
    place = len(head) + 8 * sum(map(len, bodies))
    tables = b""
    for body in bodies:
        for chunk in body:
            tables += struct.pack("<Q", place)
            place += len(chunk)
    path.write_bytes(head + tables + b"".join(chunk for body in bodies for chunk in body))
