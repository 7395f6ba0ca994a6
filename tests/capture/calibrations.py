"""Cameras around a point, and small files of the programs that calibrate cameras."""

import struct

import numpy as np

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.image_writing import write_png

WIDTH, HEIGHT = 16, 12


def ring(n_views=5, **lens):
    """Cameras on a ring above the origin."""
    angles = 2 * np.pi * np.arange(n_views) / n_views
    places = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.ones(n_views)], axis=1)
    lens = {"fl_x": 30.0, "fl_y": 31.0, "cx": 8.5, "cy": 5.5, "kind": "opencv", **lens}
    return [
        Camera(
            id=f"v{i:03d}",
            width=WIDTH,
            height=HEIGHT,
            camera_from_world=looking_at(place, [0, 0, 0], [0, 0, 1]),
            **lens,
        )
        for i, place in enumerate(places)
    ]


def write_photographs(folder, names, size=(HEIGHT, WIDTH)):
    """Grey photographs, each of another grey."""
    for i, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.full((*size, 3), 60 + i, np.uint8))


def quaternion(rotation):
    """(w, x, y, z) of a rotation whose trace is not -1, by Shepperd's method."""
    k = np.array([np.trace(rotation), *np.diag(rotation)])
    i = int(np.argmax(k))
    r = rotation
    skew = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    if i == 0:
        q = np.array([1 + k[0], *skew])
    else:
        a, b, c = i - 1, i % 3, (i + 1) % 3
        q = np.zeros(4)
        q[0] = skew[a]
        q[1 + a] = 1 + 2 * r[a, a] - k[0]
        q[1 + b] = r[a, b] + r[b, a]
        q[1 + c] = r[a, c] + r[c, a]
    return q / np.linalg.norm(q)


def colmap_text(folder, cameras, names, model="PINHOLE", parameters=None):
    """A text model: one lens for all, `cameras` and their photographs' `names`."""
    folder.mkdir(parents=True, exist_ok=True)
    lens = parameters or (cameras[0].fl_x, cameras[0].fl_y, cameras[0].cx, cameras[0].cy)
    numbers = " ".join(repr(float(number)) for number in lens)
    (folder / "cameras.txt").write_text(
        f"# Camera list\n1 {model} {cameras[0].width} {cameras[0].height} {numbers}\n"
    )
    lines = ["# Image list with two lines of data per image:"]
    for i, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        pose = [*quaternion(camera.rotation), *camera.camera_from_world[:3, 3]]
        lines.append(" ".join([str(i + 1), *(repr(float(n)) for n in pose), "1", name]))
        lines.append("1.5 2.5 -1 3.5 4.5 7" if i % 2 else "")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("# no points\n")
    return folder


def colmap_binary(folder, cameras, names, model=1, parameters=None):
    """The same as bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    lens = parameters or (cameras[0].fl_x, cameras[0].fl_y, cameras[0].cx, cameras[0].cy)
    size = cameras[0].width, cameras[0].height
    head = struct.pack("<QIiQQ", 1, 1, model, *size)
    (folder / "cameras.bin").write_bytes(head + struct.pack(f"<{len(lens)}d", *lens))
    content = struct.pack("<Q", len(cameras))
    for i, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        pose = [*quaternion(camera.rotation), *camera.camera_from_world[:3, 3]]
        content += struct.pack("<I7dI", i + 1, *pose, 1) + name.encode() + b"\0"
        content += struct.pack("<Q", i) + struct.pack("<ddq", 1.5, 2.5, -1) * i
    (folder / "images.bin").write_bytes(content)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    return folder


def assert_same_cameras(received, expected, tolerance=1e-9):
    """Demand cameras of the same numbers, in the same order."""
    assert len(received) == len(expected)
    for camera, wanted in zip(received, expected, strict=True):
        assert (camera.kind, camera.width, camera.height) == (
            wanted.kind,
            wanted.width,
            wanted.height,
        )
        for name in ("fl_x", "fl_y", "cx", "cy", "distortion", "camera_from_world"):
            np.testing.assert_allclose(
                getattr(camera, name), getattr(wanted, name), rtol=0, atol=tolerance
            )
