"""TIFF files written by hand, so that every kind exists without a library that has opinions."""

import struct

import numpy as np

SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 10: 8, 16: 8}
LETTERS = {1: "B", 3: "H", 4: "I", 5: "I", 10: "i", 16: "Q"}


def tags_of(pixels, *, photometric, planar=False, bits=None, **more):
    """Tags of an uncompressed image, (h, w, n); further tags by number as ``t338=(3, [2])``."""
    height, width, n = pixels.shape
    kind = {"u": 1, "i": 2, "f": 3}[pixels.dtype.kind]
    tags = {
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [bits or 8 * pixels.dtype.itemsize] * n),
        259: (3, [1]),
        262: (3, [photometric]),
        277: (3, [n]),
        278: (4, [height]),
        284: (3, [2 if planar else 1]),
        339: (3, [kind] * n),
    }
    return tags | {int(name[1:]): value for name, value in more.items()}


def write_tiff(path, pages, *, order="<", big=False):
    """Write pages of (tags, list of strips); a page's tag 330 may be a list of pages."""
    out = bytearray(b"II" if order == "<" else b"MM")
    out += struct.pack(order + ("HHHQ" if big else "HI"), *((43, 8, 0, 0) if big else (42, 0)))
    place = len(out) - (8 if big else 4)
    for tags, strips in pages:
        place = _append(out, place, dict(tags), strips, order, big)
    path.write_bytes(bytes(out))


def _append(out, place, tags, strips, order, big):
    """Append a directory, name it at `place`; where the next one is named."""
    offset = "Q" if big else "I"
    children = tags.pop(330, None)
    if children:
        starts = []
        for child_tags, child_strips in children:
            slot = len(out)
            out += b"\0" * (8 if big else 4)
            _append(out, slot, dict(child_tags), child_strips, order, big)
            starts.append(struct.unpack_from(order + offset, out, slot)[0])
        tags[330] = (16 if big else 4, starts)
    wide = 16 if big else 4
    starts = []
    for strip in strips:
        out += b"\0" * (len(out) % 2)
        starts.append(len(out))
        out += strip
    tags[273], tags[279] = (wide, starts), (wide, [len(strip) for strip in strips])
    entries = []
    for tag, (kind, values) in sorted(tags.items()):
        count = len(values) // (2 if kind in (5, 10) else 1)
        data = (
            bytes(values) if kind in (1, 2, 7)
            else struct.pack(f"{order}{len(values)}{LETTERS[kind]}", *values)
        )  # fmt: skip
        room = 8 if big else 4
        if len(data) > room:
            out += b"\0" * (len(out) % 2)
            value = struct.pack(order + offset, len(out))
            out += data
        else:
            value = data.ljust(room, b"\0")
        entries.append(struct.pack(order + "HH" + offset, tag, kind, count) + value)
    out += b"\0" * (len(out) % 2)
    struct.pack_into(order + offset, out, place, len(out))
    out += struct.pack(order + ("Q" if big else "H"), len(entries)) + b"".join(entries)
    out += b"\0" * (8 if big else 4)
    return len(out) - (8 if big else 4)


def strips_of(pixels, *, order="<", planar=False):
    """One strip, or one of each channel."""
    stored = pixels.astype(pixels.dtype.newbyteorder(order))
    channels = np.moveaxis(stored, 2, 0) if planar else [stored]
    return [np.ascontiguousarray(channel).tobytes() for channel in channels]
