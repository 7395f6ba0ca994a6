"""A capture as a COLMAP model in text: one image for each photograph, lights in lights.csv."""

from __future__ import annotations

from pathlib import Path

from scipy.spatial.transform import Rotation

from reflfield.capture.cameras import FISHEYE, Camera
from reflfield.capture.capture import Capture
from reflfield.capture.image_writing import write_png
from reflfield.capture.light_table import FILE_NAME as TABLE
from reflfield.capture.lights import DIRECTIONAL, POINT
from reflfield.capture.transforms_writing import check_target
from reflfield.capture.view_folders import IMAGES, MASKS
from reflfield.capture.written_files import WrittenFiles, first_reading, refuse_light
from reflfield.errors import InputError

MODEL = "sparse/0"
TARGET = "a COLMAP model"
_COLUMNS = {POINT: "x,y,z", DIRECTIONAL: "dx,dy,dz"}


def colmap_description(capture: Capture, files: WrittenFiles) -> None:
    """Write ``sparse/0``, ``images``, ``masks`` and ``lights.csv``.

    Photographs of one camera become images of one pose.

    Raises
    ------
    InputError
        If a camera is orthographic, a light neither a point nor distant nor unknown, or the
        photographs are read otherwise than their files say.
    """
    check_target(capture, TARGET)
    lights = _table(capture)
    for photograph in capture.photographs:
        reading = vars(first_reading(photograph, TARGET))
        stated = [name for name, value in reading.items() if value is not None]
        if stated:
            raise InputError(
                f"photograph {photograph.name!r}: expected files that say how they are "
                f"encoded, since {TARGET} cannot, received {', '.join(stated)} stated beside "
                "them; write it with `to='native'`"
            )
    names = [own[0] for own in files.photographs(capture, IMAGES)]
    within = [Path(name).relative_to(IMAGES).as_posix() for name in names]
    lenses: dict[str, int] = {}
    images = []
    for i, (photograph, name) in enumerate(zip(capture.photographs, within, strict=True)):
        camera = capture.cameras[photograph.camera]
        lens = lenses.setdefault(_lens(camera), len(lenses) + 1)
        images.append(f"{i + 1} {_pose(camera)} {lens} {name}\n\n")
    cameras = "".join(f"{id_} {line}\n" for line, id_ in lenses.items())
    files.text(f"{MODEL}/cameras.txt", f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n{cameras}")
    head = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D\n"
    files.text(f"{MODEL}/images.txt", head + "".join(images))
    files.text(f"{MODEL}/points3D.txt", "# none\n")
    if lights:
        rows = "".join(
            f"{name},{lights[photograph.light]}\n"
            for name, photograph in zip(within, capture.photographs, strict=True)
        )
        files.text(TABLE, f"name,{_COLUMNS[capture.lights[0].kind]},r,g,b\n{rows}")
    _write_masks(capture, within, files)


def _table(capture: Capture) -> list[str]:
    """Values of each light in ``lights.csv``; none where lights are unknown."""
    if not any(light.known for light in capture.lights):
        return []
    kinds = {light.kind for light in capture.lights}
    for light in capture.lights:
        if light.kind not in _COLUMNS or len(kinds) > 1 or not light.falls_off:
            raise refuse_light(light, TARGET)
    return [
        ",".join(
            repr(float(number))
            for number in (
                *(light.position if light.kind == POINT else light.direction),
                *light.intensity,
            )
        )
        for light in capture.lights
    ]


def _lens(camera: Camera) -> str:
    """Camera model, size and parameters of a line of ``cameras.txt``."""
    k1, k2, p1, p2, k3, k4, *others = camera.distortion
    model: str
    terms: tuple[float, ...]
    inner = (camera.fl_x, camera.fl_y, camera.cx, camera.cy)
    if camera.kind == FISHEYE:
        model, terms = "OPENCV_FISHEYE", (k1, k2, k3, k4)
    elif not any(camera.distortion):
        model, terms = "PINHOLE", ()
    elif not any((k3, k4, *others)):
        model, terms = "OPENCV", (k1, k2, p1, p2)
    else:
        model, terms = "FULL_OPENCV", camera.distortion
    numbers = " ".join(repr(float(number)) for number in (*inner, *terms))
    return f"{model} {camera.width} {camera.height} {numbers}"


def _pose(camera: Camera) -> str:
    x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
    numbers = (w, x, y, z, *camera.camera_from_world[:3, 3])
    return " ".join(repr(float(number)) for number in numbers)


def _write_masks(capture: Capture, names: list[str], files: WrittenFiles) -> None:
    """A PNG for each photograph of a camera with a silhouette, as COLMAP names it."""
    for photograph, name in zip(capture.photographs, names, strict=True):
        path = capture.silhouettes[photograph.camera]
        if path is None:
            continue
        if path.suffix.lower() == ".png":
            files.add(path, f"{MASKS}/{name}")
            continue
        coverage = capture.read_silhouette(photograph.camera)
        target = files.path(f"{MASKS}/{name}.png")
        write_png(target, (coverage * 65535 + 0.5).astype("uint16"))
