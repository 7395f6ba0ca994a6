"""A capture: which camera photographed the object under which light, and the files."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.digest_text import camera_text, correction_pieces, light_text
from reflfield.capture.image_files import ImageReading, read_coverage, stores_alpha
from reflfield.capture.lights import UNKNOWN, Light
from reflfield.capture.names import check_unique
from reflfield.capture.photographs import Photograph
from reflfield.capture.segmentation import silhouette_from_photographs
from reflfield.errors import CaptureError
from reflfield.util.file_digests import file_digest

HULL = "hull"
PLANE = "plane"
# Lights beyond these add nothing to the mean that a silhouette is made from.
SILHOUETTE_SAMPLE = 32

# SHA-256 of a file; the type is that of an error to raise.
FileDigest: TypeAlias = Callable[[Path, type[CaptureError]], bytes]
DIGEST_PARTS = ("cameras", "lights", "silhouettes", "photographs")


@dataclass(frozen=True, eq=False)
class Capture:
    """Photographs of one object with the cameras and lights they were taken with.

    Parameters
    ----------
    name : str
        Shown in reports.
    root : Path
        Folder of the description file; every file lies inside it.
    cameras, lights : tuple
        What the photographs' indices refer to.
    photographs : tuple of Photograph
        At most one per pair of camera and light in a capture; frames to relight may repeat.
    base_geometry : {"hull", "plane"}
        Whether the base surface comes from silhouettes or is the image plane of one view.
    silhouettes : tuple of Path or None, optional
        One per camera; None where it is to be made from the photographs.
    up : (3,) array_like, optional
        World direction that is up for previews.
    format : str
        Name of the reader.
    description : Path, optional
        The file that was read.
    notes : tuple of str, optional
        What a user should know of how it was read.
    details : tuple of str, optional
        How it was read, for those who ask.

    Raises
    ------
    CaptureError
        If ids or (camera, light) pairs repeat, or an index is out of range.
    """

    name: str
    root: Path
    cameras: tuple[Camera, ...]
    lights: tuple[Light, ...]
    photographs: tuple[Photograph, ...]
    base_geometry: str = HULL
    silhouettes: tuple[Path | None, ...] = ()
    up: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    format: str = "native"
    description: Path | None = None
    notes: tuple[str, ...] = ()
    details: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.silhouettes:
            object.__setattr__(self, "silhouettes", (None,) * len(self.cameras))
        if self.base_geometry not in (HULL, PLANE):
            raise CaptureError(
                f"{self.name}: base_geometry: expected 'hull' or 'plane', "
                f"received {self.base_geometry!r}"
            )
        where = f"{self.description}: " if self.description else ""
        check_unique(f"{where}cameras", [c.id for c in self.cameras])
        check_unique(f"{where}lights", [light.id for light in self.lights])
        for photograph in self.photographs:
            _check_indices(photograph, self.n_views, self.n_lights)

    @property
    def n_views(self) -> int:
        """Number of cameras."""
        return len(self.cameras)

    @property
    def n_lights(self) -> int:
        """Number of lighting conditions."""
        return len(self.lights)

    @property
    def lights_known(self) -> bool:
        """Whether the direction of every light was measured."""
        return all(light.kind != UNKNOWN for light in self.lights)

    @property
    def lights_known_in_part(self) -> bool:
        """Whether some lights were measured and others not."""
        return len({light.known for light in self.lights}) > 1

    @property
    def test_split(self) -> NDArray[np.intp]:
        """Indices of the photographs that the capture's maker keeps for comparison."""
        return np.flatnonzero([photograph.is_test for photograph in self.photographs])

    @cached_property
    def photograph_index(self) -> NDArray[np.int64]:
        """(n_views, n_lights) index into `photographs`, -1 where there is none.

        Of several photographs of one pair (frames), the first.
        """
        index = np.full((self.n_views, self.n_lights), -1, dtype=np.int64)
        for i in reversed(range(len(self.photographs))):
            photograph = self.photographs[i]
            index[photograph.camera, photograph.light] = i
        return index

    def read_photograph(self, index: int) -> NDArray[np.float32]:
        """Linear radiance of photograph `index`, (h, w, 3) float32.

        Raises
        ------
        CaptureError
            If a file is missing, damaged, not finite, or not of its camera's size.
        """
        photograph = self.photographs[index]
        image = photograph.read()
        camera = self.cameras[photograph.camera]
        check_matches(photograph.path, camera, image.shape[1], image.shape[0])
        return image

    def read_kinds(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Linear radiance of photograph `index`, and which of its values were measured.

        Parameters
        ----------
        index : int
            Index into `photographs`.

        Returns
        -------
        radiance : (h, w, 3) float32
            As `read_photograph`; finite where nothing was measured, too.
        kinds : (h, w, 3) uint8
            Of `capture.clipping`. Of bracketed exposures one that measures is enough.

        Raises
        ------
        CaptureError
            As `read_photograph`.
        """
        photograph = self.photographs[index]
        image, kinds = photograph.read_kinds()
        camera = self.cameras[photograph.camera]
        check_matches(photograph.path, camera, image.shape[1], image.shape[0])
        return image, kinds

    def read_silhouette(self, view: int) -> NDArray[np.float32]:
        """Coverage of view `view` in [0, 1], (h, w) float32.

        Read where a file is given; else the alpha of the view's photographs, where they have
        one that is not opaque (pixel by pixel the median over at most `SILHOUETTE_SAMPLE` of
        them, so that one bad matte does no harm); else the whole image where the base geometry
        is the image plane; else made from the view's photographs (`capture.silhouettes`).

        Raises
        ------
        CaptureError
            If the file cannot be used, or no object is found.
        """
        camera, path = self.cameras[view], self.silhouettes[view]
        coverage = read_coverage(path) if path is not None else self.read_alpha(view)
        if coverage is None and self.base_geometry == PLANE:
            return np.ones((camera.height, camera.width), dtype=np.float32)
        if coverage is None:
            return _made_silhouette(self, view)
        what = path if path is not None else f"alpha of the photographs of {camera.id!r}"
        check_matches(what, camera, coverage.shape[1], coverage.shape[0])
        if not (coverage > 0.5).any():
            raise CaptureError(
                f"{what}: empty silhouette: no pixel of view {camera.id!r} is covered, the "
                f"largest value is {round(255 * float(coverage.max()))} of 255; "
                "white must mean object"
            )
        return coverage

    def read_alpha(self, view: int) -> NDArray[np.float32] | None:
        """Combined alpha of the photographs of a view, (h, w) float32; None if there is none.

        Photographs without alpha, and those that are opaque everywhere, are left out.
        """
        alphas = [self.photographs[i].read_alpha() for i in self._with_alpha(view)]
        shown = [alpha for alpha in alphas if alpha is not None]
        return np.median(shown, axis=0).astype(np.float32) if shown else None

    def silhouette_origin(self, view: int) -> str:
        """Where `read_silhouette` has it from: "file", "alpha", "image" or "photographs"."""
        if self.silhouettes[view] is not None:
            return "file"
        if any(self.photographs[i].read_alpha() is not None for i in self._with_alpha(view)):
            return "alpha"
        return "image" if self.base_geometry == PLANE else "photographs"

    def _with_alpha(self, view: int) -> list[int]:
        """Photographs of a view that are asked for their alpha, evenly spread."""
        return [
            i
            for i in _sampled(self, view)
            if stores_alpha(self.photographs[i].path, self.photographs[i].exposures[0].reading)
        ]

    def read_as(self, reading: ImageReading) -> Capture:
        """The same capture, its photographs read in another way.

        Parameters
        ----------
        reading : ImageReading
            What it says holds for all photographs; what it leaves open stays as it is.
        """
        stated = {name: value for name, value in vars(reading).items() if value is not None}
        if not stated:
            return self
        return replace(
            self,
            photographs=tuple(
                replace(
                    photograph,
                    exposures=tuple(
                        replace(e, reading=replace(e.reading, **stated))
                        for e in photograph.exposures
                    ),
                    dark=photograph.dark and photograph.dark.read_as(stated),
                )
                for photograph in self.photographs
            ),
        )

    def subset(
        self, views: ArrayLike | None = None, lights: ArrayLike | None = None
    ) -> Capture:
        """The capture of some views and lights, in the order given.

        Parameters
        ----------
        views, lights : (n,) array_like of int, optional
            Indices to keep; None keeps all. Photographs of others are removed.
        """
        keep_views = _indices("views", views, self.n_views)
        keep_lights = _indices("lights", lights, self.n_lights)
        new_view = {old: new for new, old in enumerate(keep_views)}
        new_light = {old: new for new, old in enumerate(keep_lights)}
        kept = tuple(
            replace(p, camera=new_view[p.camera], light=new_light[p.light])
            for p in self.photographs
            if p.camera in new_view and p.light in new_light
        )
        return replace(
            self,
            cameras=tuple(self.cameras[i] for i in keep_views),
            lights=tuple(self.lights[i] for i in keep_lights),
            silhouettes=tuple(self.silhouettes[i] for i in keep_views),
            photographs=kept,
        )

    def digest(
        self, parts: Iterable[str] = DIGEST_PARTS, of_file: FileDigest = file_digest
    ) -> str:
        """SHA-256 of what the capture says and what its files hold.

        Parameters
        ----------
        parts : iterable of {"cameras", "lights", "silhouettes", "photographs"}
            What to include. Where no silhouette file is given, the photographs it is made
            from stand in for it.
        of_file : callable, optional
            ``of_file(path, error)``: SHA-256 of a file, which may know it already.

        Returns
        -------
        str
            64 hexadecimal digits; times and folder names do not enter.
        """
        wanted = tuple(parts)
        unknown = set(wanted) - set(DIGEST_PARTS)
        if unknown:
            raise CaptureError(f"digest: expected parts {DIGEST_PARTS}, received {unknown}")
        total = hashlib.sha256(f"{self.base_geometry} {self.up.tolist()}".encode())
        for part in DIGEST_PARTS:
            if part in wanted:
                total.update(part.encode())
                for piece in self._described(part, of_file):
                    total.update(piece)
        return total.hexdigest()

    def _described(self, part: str, of_file: FileDigest) -> Iterator[bytes]:
        """Bytes that stand for one part of the capture."""
        if part == "cameras":
            yield from (camera_text(c).encode() for c in self.cameras)
        elif part == "lights":
            yield from (light_text(light).encode() for light in self.lights)
            yield from (
                of_file(light.file, CaptureError) for light in self.lights if light.file
            )
        elif part == "silhouettes":
            for view, path in enumerate(self.silhouettes):
                if path is not None:
                    yield of_file(path, CaptureError)
                else:
                    yield from self._silhouette_sources(view, of_file)
        else:
            for photograph in self.photographs:
                yield f"{photograph.name} {photograph.camera} {photograph.light}".encode()
                for exposure in photograph.exposures:
                    yield f"{exposure.seconds} {exposure.reading}".encode()
                    yield of_file(exposure.path, CaptureError)
                yield from correction_pieces(photograph, of_file)

    def _silhouette_sources(self, view: int, of_file: FileDigest) -> Iterator[bytes]:
        """Bytes that stand for the photographs that a silhouette is made from."""
        of_view = [i for i, p in enumerate(self.photographs) if p.camera == view]
        for i in self._with_alpha(view) if self.base_geometry == PLANE else of_view:
            for exposure in self.photographs[i].exposures:
                yield str(exposure.reading).encode() + of_file(exposure.path, CaptureError)
            yield from correction_pieces(self.photographs[i], of_file)


def usual_base_geometry(n_views: int) -> str:
    """Base geometry where a description does not say: one view knows no shape.

    Examples
    --------
    >>> usual_base_geometry(1), usual_base_geometry(16)
    ('plane', 'hull')
    """
    return PLANE if n_views == 1 else HULL


def _made_silhouette(capture: Capture, view: int) -> NDArray[np.float32]:
    return silhouette_from_photographs(
        (capture.read_photograph(i) for i in _sampled(capture, view)),
        name=f"view {capture.cameras[view].id!r}",
    )


def _sampled(capture: Capture, view: int) -> list[int]:
    """At most `SILHOUETTE_SAMPLE` photographs of a view, evenly spread."""
    indices = [i for i, p in enumerate(capture.photographs) if p.camera == view]
    step = -(-len(indices) // SILHOUETTE_SAMPLE) or 1
    return indices[::step]


def _check_indices(photograph: Photograph, n_views: int, n_lights: int) -> None:
    inside = 0 <= photograph.camera < n_views and 0 <= photograph.light < n_lights
    if not inside:
        raise CaptureError(
            f"photograph {photograph.name!r}: expected camera < {n_views} and "
            f"light < {n_lights}, received {photograph.camera} and {photograph.light}"
        )


def check_matches(path: Path | str, camera: Camera, width: int, height: int) -> None:
    """Demand an image of the size that its camera has.

    Raises
    ------
    CaptureError
        Naming the file and both sizes.
    """
    if (width, height) != (camera.width, camera.height):
        raise CaptureError(
            f"{path}: image size: expected {camera.width} x {camera.height} pixels as camera "
            f"{camera.id!r} says, received {width} x {height}"
        )


def _indices(name: str, indices: ArrayLike | None, count: int) -> list[int]:
    if indices is None:
        return list(range(count))
    array = np.atleast_1d(np.asarray(indices))
    if array.dtype == bool:
        array = np.flatnonzero(array)
    if array.size and not (array.min() >= 0 and array.max() < count):
        raise CaptureError(f"{name}: expected indices in 0 .. {count - 1}, received {array}")
    return [int(i) for i in array]
