"""Hostile, damaged and huge image files: one message, no memory, no noise; and full disks."""

import os
import resource
import struct
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from reflfield.capture.image_files import image_size, read_coverage, read_image
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.errors import CaptureError
from tests.capture.exr_files import MAGIC, MULTIPART, attribute, header, write_parts
from tests.capture.tiff_files import strips_of, tags_of, write_tiff

FLOAT, SMALL = 2, (0, 0, 7, 5)
MOST_SECONDS, MOST_BYTES = 2, 100 << 20


def exr_of(path, *headers, flags=2, tail=bytes(1000)):
    path.write_bytes(MAGIC + struct.pack("<I", flags) + b"".join(headers) + tail)


def wide(path):
    exr_of(path, header([(c, FLOAT, 1) for c in "RGB"], (0, 0, 2**30, 2**30)))


def tall(path):
    exr_of(path, header([(c, FLOAT, 1) for c in "RGB"], (0, 0, 0, 2**30), SMALL))


def shown_far_larger(path):
    exr_of(path, header([(c, FLOAT, 1) for c in "RGB"], SMALL, (0, 0, 2**30, 2**30)))


def far_larger_than_shown(path):
    channels = [(c, FLOAT, 1) for c in "RGB"]
    exr_of(path, header(channels, (0, 0, 11999, 11999), SMALL), tail=bytes(3_000_000))


def upside_down(path):
    exr_of(path, header([(c, FLOAT, 1) for c in "RGB"], (5, 5, 0, 0)))


def channels_by_the_thousand(path):
    exr_of(path, header([(f"c{i:06d}", FLOAT, 1) for i in range(100_000)], SMALL))


def parts_by_the_thousand(path):
    more = [attribute("type", "string", b"scanlineimage"),
            attribute("chunkCount", "int", struct.pack("<i", 6))]  # fmt: skip
    part = [
        header([("R", FLOAT, 1)], SMALL, None, attribute("name", "string", b"%d" % i), *more)
        for i in range(5000)
    ]
    exr_of(path, *part, b"\0", flags=2 | MULTIPART)


def huge_attribute(path):
    exr_of(path, b"channels\0chlist\0" + struct.pack("<i", 2**31 - 1))


def png_bomb(path):
    """12,000 x 12,000 pixels of black in 0.4 MB."""
    content = cv2.imencode(".png", np.zeros((12_000, 12_000), np.uint8))[1].tobytes()
    path.write_bytes(content)


def png_of_billions(path):
    content = bytearray(cv2.imencode(".png", np.zeros((2, 2), np.uint8))[1].tobytes())
    content[16:24] = struct.pack(">II", 2**31 - 1, 2**31 - 1)
    path.write_bytes(content)


def jpeg_of_65500(path):
    content = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    start = content.index(b"\xff\xc0")
    content[start + 5 : start + 9] = struct.pack(">HH", 65500, 65500)
    path.write_bytes(content)


def jpeg_with_a_segment_of_no_length(path):
    """A segment of Exif data whose length, which counts itself, is 0."""
    content = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    path.write_bytes(content[:2] + b"\xff\xe1\0\0Exif\0\0" + content[2:])


def tiff_with(**more):
    def write(path):
        pixels = np.zeros((4, 4, 3), np.uint8)
        tags = tags_of(pixels, photometric=2) | {
            int(name[1:]): value for name, value in more.items()
        }
        write_tiff(path, [(tags, strips_of(pixels))])

    return write


def tiff_in_a_circle(path):
    tiff_with()(path)
    content = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", content, 4)
    content[-4:] = struct.pack("<I", start)
    path.write_bytes(content)


def hdr_of_billions(path):
    path.write_bytes(
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 99999999 +X 99999999\n" + bytes(99)
    )


HOSTILE = [
    wide, tall, shown_far_larger, far_larger_than_shown, upside_down, channels_by_the_thousand,
    parts_by_the_thousand, huge_attribute, png_bomb, png_of_billions, jpeg_of_65500,
    jpeg_with_a_segment_of_no_length,
    tiff_with(t256=(4, [2**31]), t257=(4, [2**31])), tiff_with(t277=(3, [60_000])),
    tiff_with(t322=(4, [2**20]), t323=(4, [2**20])), tiff_in_a_circle, hdr_of_billions,
]  # fmt: skip


def test_claims_are_refused_before_memory_is_taken(tmp_path, run_python):
    """In a process of its own, whose memory and time are looked at."""
    for number, make in enumerate(HOSTILE):
        make(tmp_path / f"{number}.img")
    code = f"""
import resource, time
from pathlib import Path
from reflfield.capture.image_files import read_image
from reflfield.errors import CaptureError
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
for number in range({len(HOSTILE)}):
    before, started = peak(), time.process_time()
    try:
        read_image(Path({str(tmp_path)!r}) / f"{{number}}.img")
    except CaptureError as error:
        print(peak() - before, time.process_time() - started, error)
"""
    lines = run_python(code).splitlines()
    assert len(lines) == len(HOSTILE)
    for number, line in enumerate(lines):
        memory, seconds, text = line.split(maxsplit=2)
        assert int(memory) < MOST_BYTES, text
        assert float(seconds) < MOST_SECONDS, text
        assert f"{number}.img: expected" in text


@pytest.mark.parametrize("reader", [read_image, read_coverage, image_size])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_file_is_not_opened(tmp_path, reader, kind):
    path = tmp_path / "x.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    with pytest.raises(CaptureError, match=rf"x\.png: expected a file.*{kind}"):
        reader(path)


def test_damage_is_one_error_and_nothing_is_printed(tmp_path, rng, capfd):
    """Bytes changed at random in files of each kind: read or refused, and never printed."""
    noise = rng.integers(0, 65536, size=(20, 30, 3)).astype(np.uint16)
    write_exr(tmp_path / "a.exr", noise.astype(np.float32))
    write_png(tmp_path / "a.png", noise)
    cv2.imwrite(str(tmp_path / "a.jpg"), (noise >> 8).astype(np.uint8))
    cv2.imwrite(str(tmp_path / "a.hdr"), noise.astype(np.float32))
    write_tiff(tmp_path / "a.tif", [(tags_of(noise, photometric=2), strips_of(noise))])
    write_parts(tmp_path / "b.exr", {"rgba": dict.fromkeys("RGB", noise[..., 0] / 9)})
    messages = []
    for path in sorted(tmp_path.iterdir()):
        content = np.frombuffer(path.read_bytes(), np.uint8)
        for _ in range(60):
            changed = content.copy()
            places = rng.integers(0, min(len(changed), 400), size=3)
            changed[places] = rng.integers(0, 256, size=3)
            path.write_bytes(changed.tobytes())
            try:
                read_image(path)
            except CaptureError as error:
                messages.append((path, str(error)))
    assert len(messages) > 100
    assert all(str(path) in text and "\n" not in text for path, text in messages)
    assert capfd.readouterr() == ("", "")


def test_many_threads_read_the_same_and_leave_standard_output_alone(tmp_path, rng):
    paths = [tmp_path / f"{i}.{kind}" for i in range(4) for kind in ("exr", "png")]
    for path in paths:
        values = rng.integers(0, 65536, size=(40, 50, 3)).astype(np.uint16)
        if path.suffix == ".exr":
            write_exr(path, values.astype(np.float32))
        else:
            write_png(path, values)
    alone = [read_image(path) for path in paths]
    before = sys.stdout
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(read_image, paths * 30))
    assert sys.stdout is before
    for i, image in enumerate(together):
        np.testing.assert_array_equal(image, alone[i % len(paths)])


@pytest.fixture
def little_room():
    """Files may not grow beyond 20 kB, as on a disk that is full."""
    import signal

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("suffix", ["exr", "png"])
def test_a_full_disk_is_one_error_that_names_the_file(
    tmp_path, rng, capfd, little_room, suffix
):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"earlier")
    noise = rng.integers(0, 65536, size=(200, 200, 3)).astype(np.uint16)
    write = write_exr if suffix == "exr" else write_png
    with pytest.raises(OSError, match=rf"a\.{suffix}") as caught:
        write(path, noise.astype(np.float32) if suffix == "exr" else noise)
    assert caught.value.filename == str(path)
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"earlier"
    assert capfd.readouterr() == ("", "")
