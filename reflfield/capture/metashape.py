r"""Reader of the cameras that Metashape exports as XML (version 1.x and 2.x).

Camera axes are OpenCV's, and the centre of the first pixel is (0.5, 0.5). A camera's
``transform`` leads to its component, the component's (or else the chunk's) to the world, with
a scale. The lens model (Metashape's manual, appendix on camera models) is OpenCV's with ``p1``
and ``p2`` exchanged; ``cx`` and ``cy`` count from the centre of the image, and the horizontal
focal length is ``f + b1``. A fisheye has the same polynomial in the angle. Skew (``b2``),
``k4`` and ``p3``, ``p4`` of perspective lenses have no counterpart here and are refused unless
0. Covariances are not needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.calibrated_views import View, capture_of_views
from reflfield.capture.cameras import FISHEYE, OPENCV, Camera, not_rigid_because
from reflfield.capture.capture import Capture
from reflfield.capture.described_items import described_camera
from reflfield.capture.documents import (
    LARGEST_COORDINATE,
    parse_count,
    parse_number,
    read_text,
)
from reflfield.capture.view_folders import view_folders
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

Array = NDArray[np.float64]

# Elements of a file; each takes about a kilobyte of memory while it is read.
MOST_ELEMENTS = 1_000_000
_TERMS = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_WITHOUT_EFFECT = {"resolution", "covariance", "date"}


@dataclass(frozen=True)
class _Sensor:
    """Lens and sensor as calibrated."""

    label: str
    kind: str
    width: int
    height: int
    f: float
    terms: dict[str, float]

    def camera(self, camera_from_world: Array, what: str) -> Camera:
        """Camera of this lens at a place."""
        terms = self.terms
        # Of a frame k4 is 0, of a fisheye p1 and p2 are.
        names = ("k1", "k2", "p2", "p1", "k3", "k4")
        return described_camera(
            what,
            kind=self.kind,
            width=self.width,
            height=self.height,
            fl_x=self.f + terms["b1"],
            fl_y=self.f,
            cx=self.width / 2 + terms["cx"],
            cy=self.height / 2 + terms["cy"],
            camera_from_world=camera_from_world,
            distortion=tuple(terms[name] for name in names),
        )


def is_metashape(path: Path) -> bool:
    """Whether a file is cameras in XML, by how it begins."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        begin = file.read(4000).replace(b"\0", b"")  # of UTF-16, too
    return b"<document" in begin and b"<chunk" in begin


def read_metashape(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a capture from Metashape's cameras.

    Parameters
    ----------
    description : Path
        The XML file; photographs lie in ``images`` beside it or above it, under the labels of
        the cameras.
    follow_links : bool
        Whether symbolic links may lead out of the folder of the photographs and masks.

    Returns
    -------
    Capture
        Of the aligned, enabled cameras, under one constant, unknown light.

    Raises
    ------
    CaptureError
        If the file is no such XML, holds several chunks or cameras of a rig, or a lens has
        terms that are not supported.
    """
    chunk = _chunk(_parsed(description), description)
    sensors = {s.get("id", ""): s for s in chunk.iterfind("sensors/sensor")}
    lenses: dict[str, _Sensor] = {}
    views, unaligned = [], 0
    transforms = _world_transforms(chunk, description)
    for element in _cameras(chunk):
        what = f"{description}: camera {quoted(element.get('label', ''))}"
        if element.find("transform") is None and element.get("master_id") is None:
            unaligned += 1
            continue
        _check_single(element, what)
        id_ = element.get("sensor_id", "")
        if id_ not in lenses:
            lenses[id_] = _sensor(sensors.get(id_), f"{what}: sensor {quoted(id_)}")
        pose = _pose(element, transforms, what)
        views.append(View(_label(element, what), lenses[id_].camera(pose, what)))
    if not views:
        raise CaptureError(
            f"{description}: expected aligned cameras, received none; align the photographs "
            "and export the cameras again"
        )
    folders = view_folders(description, follow_links=follow_links)
    kinds = ", ".join(f"{quoted(lens.label)} ({lens.kind})" for lens in lenses.values())
    notes = [f"{description}: {unaligned} cameras are not aligned"] if unaligned else []
    return capture_of_views(
        views,
        folders,
        format="metashape",
        details=[
            f"Metashape's cameras {description}: {len(views)} cameras, sensors: {kinds}",
            f"photographs in {folders.root / folders.images}",
        ],
        notes=notes,
    )


def _parsed(description: Path) -> ElementTree.Element:
    """Root of the file; declared entities are refused, which could grow without bound."""
    text = read_text(description)
    if text.count("<") > 2 * MOST_ELEMENTS or "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CaptureError(
            f"{description}: expected XML of at most {MOST_ELEMENTS:,} elements without "
            "declarations of entities; export the cameras alone from Metashape"
        )
    declared = text.lstrip()
    if declared.startswith("<?xml"):  # of bytes that have been decoded already
        text = declared.partition("?>")[2]
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise CaptureError(f"{description}: expected XML, received {error}") from error


def _chunk(root: ElementTree.Element, description: Path) -> ElementTree.Element:
    """The one chunk that is enabled."""
    chunks = [c for c in root.iter("chunk") if c.get("enabled", "true") not in ("false", "0")]
    if root.tag != "document" or len(chunks) != 1:
        raise CaptureError(
            f"{description}: expected a document with one enabled chunk, received "
            f"{quoted(root.tag)} with {len(chunks)}; export the cameras of one chunk"
        )
    return chunks[0]


def _cameras(chunk: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """Enabled cameras, those in groups too."""
    for element in chunk.iterfind("cameras//camera"):
        if element.get("enabled", "true") not in ("false", "0"):
            yield element


def _check_single(element: ElementTree.Element, what: str) -> None:
    master = element.get("master_id")
    if master is not None and master != element.get("id"):
        raise CaptureError(
            f"{what}: expected a camera with a pose of its own, received one of a rig, of "
            f"camera {quoted(master)}; export the cameras without the rig's layout"
        )


def _label(element: ElementTree.Element, what: str) -> str:
    label = element.get("label", "")
    if not label:
        raise CaptureError(f"{what}: expected a label that names the photograph, received none")
    return label


def _sensor(element: ElementTree.Element | None, what: str) -> _Sensor:
    """Lens of a sensor that has an adjusted calibration."""
    calibrations = [] if element is None else element.findall("calibration")
    adjusted = [c for c in calibrations if c.get("class") == "adjusted"] or calibrations
    if element is None or len(adjusted) != 1:
        raise CaptureError(
            f"{what}: expected one adjusted calibration, received {len(adjusted)}; align the "
            "photographs and export the cameras again"
        )
    calibration = adjusted[0]
    if (shutter := element.findtext("rolling_shutter", "false")) not in ("false", "0"):
        raise CaptureError(
            f"{what}: rolling_shutter: expected false, received {quoted(shutter)}: only "
            "cameras at rest are supported; switch the compensation off and align again"
        )
    terms, size = _terms(calibration, what), calibration.find("resolution")
    sides = {} if size is None else size.attrib
    width, height = (parse_count(sides.get(side, "")) for side in ("width", "height"))
    if width is None or height is None:
        raise CaptureError(f"{what}: expected a resolution with width and height in pixels")
    return _Sensor(
        label=element.get("label", ""),
        kind=_kind(calibration, terms, what),
        width=width,
        height=height,
        f=terms.pop("f"),
        terms=terms,
    )


def _terms(calibration: ElementTree.Element, what: str) -> dict[str, float]:
    """Terms of the lens; those left out are 0."""
    terms = dict.fromkeys(_TERMS, 0.0)
    for child in calibration:
        if child.tag in _WITHOUT_EFFECT:
            continue
        value = parse_number((child.text or "").strip())
        if child.tag not in (*_TERMS, "f") or value is None:
            raise CaptureError(
                f"{what}: expected the terms f, {', '.join(_TERMS)} with numbers, received "
                f"{quoted(child.tag)} = {quoted((child.text or '')[:80])}, which is not "
                "supported; undistort the photographs first"
            )
        terms[child.tag] = value
    if "f" not in terms:
        raise CaptureError(f"{what}: expected a focal length f, received none")
    return terms


def _kind(calibration: ElementTree.Element, terms: dict[str, float], what: str) -> str:
    """Camera model of a calibration, without terms that it does not have here."""
    type_ = calibration.get("type", "frame")
    if type_ not in ("frame", "fisheye"):
        raise CaptureError(
            f"{what}: type: expected frame or fisheye, received {quoted(type_)}; export "
            "perspective photographs"
        )
    barred = ("b2", "k4", "p3", "p4") if type_ == "frame" else ("b2", "p1", "p2", "p3", "p4")
    for name in barred:
        if terms[name]:
            raise CaptureError(
                f"{what}: {name}: expected 0 of a {type_} lens, received {terms[name]}, which "
                "is not supported; align again without it, or undistort the photographs first"
            )
    return OPENCV if type_ == "frame" else FISHEYE


def _world_transforms(chunk: ElementTree.Element, description: Path) -> dict[str, Array]:
    """World from component by the component's id; "" is the chunk's, for all others.

    The file repeats the transform of the active component as the chunk's: one of them counts.
    """
    transforms = {"": _similarity(chunk.find("transform"), f"{description}: chunk")}
    for component in chunk.iterfind("components/component"):
        what = f"{description}: component {quoted(component.get('id', ''))}"
        if component.find("transform") is not None:
            transforms[component.get("id", "")] = _similarity(component.find("transform"), what)
    aligned = [c for c in _cameras(chunk) if c.find("transform") is not None]
    used = {camera.get("component_id", "") for camera in aligned}
    if len(used) > 1 and used - set(transforms):
        raise CaptureError(
            f"{description}: expected one component, or a transform of each, received cameras "
            f"of the components {quoted(sorted(used))}; align or merge them"
        )
    return transforms


def _similarity(element: ElementTree.Element | None, what: str) -> Array:
    """Rotation, translation and scale as one matrix (4, 4)."""
    matrix = np.eye(4)
    if element is None or len(element) == 0:
        return matrix
    rotation, translation, scale = (
        _numbers(element.findtext(name), count, f"{what}: {name}")
        for name, count in (("rotation", 9), ("translation", 3), ("scale", 1))
    )
    if rotation is not None:
        matrix[:3, :3] = rotation.reshape(3, 3)
        fault = not_rigid_because(matrix)
        if fault:
            raise CaptureError(f"{what}: rotation: expected a rotation, received {fault}")
    if scale is not None:
        if not scale[0] > 0:
            raise CaptureError(f"{what}: scale: expected more than 0, received {scale[0]}")
        matrix[:3, :3] *= scale[0]
    if translation is not None:
        matrix[:3, 3] = translation
    return matrix


def _numbers(text: str | None, count: int, what: str) -> Array | None:
    if text is None:
        return None
    numbers = [parse_number(word) for word in text.split()[: count + 1]]
    if len(numbers) != count or None in numbers:
        raise CaptureError(f"{what}: expected {count} numbers, received {quoted(text)}")
    array = np.array(numbers, dtype=np.float64)
    if np.abs(array).max() > LARGEST_COORDINATE:
        raise CaptureError(
            f"{what}: expected numbers of at most {LARGEST_COORDINATE:g}, received "
            f"{quoted(text)}"
        )
    return array


def _pose(element: ElementTree.Element, transforms: dict[str, Array], what: str) -> Array:
    """`camera_from_world` of a camera, its position scaled, its axes not."""
    numbers = _numbers(element.findtext("transform"), 16, f"{what}: transform")
    component_from_camera = np.eye(4) if numbers is None else numbers.reshape(4, 4)
    fault = not_rigid_because(component_from_camera)
    if fault:
        raise CaptureError(
            f"{what}: transform: expected a rotation and a translation, received {fault}"
        )
    world = transforms.get(element.get("component_id", ""), transforms[""])
    world_from_camera = world @ component_from_camera
    world_from_camera[:3, :3] /= np.cbrt(np.linalg.det(world[:3, :3]))
    return np.asarray(np.linalg.solve(world_from_camera, np.eye(4)), np.float64)
