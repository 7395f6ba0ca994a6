"""A turntable: cameras on a circle around the object, images, animation, contact sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from reflfield.capture.cameras import OPENCV, Camera, looking_at
from reflfield.capture.image_writing import write_png
from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.render.exposure import ExposureMeter, encoded_picture
from reflfield.render.renderer import Lighting, Renderer, RenderOptions
from reflfield.util.files import replacing
from reflfield.util.progress import track
from reflfield.util.validation import unit_direction

Array = NDArray[np.float64]


# Least and most of each number.
RANGES: dict[str, tuple[float, float]] = {
    "n_images": (1, 3600),
    "size": (1, 16383),
    "elevation_deg": (-89, 89),
    "field_of_view_deg": (1, 150),
    "frames_per_second": (0.1, 1000),
}


@dataclass(frozen=True)
class OrbitOptions:
    """Where the turntable's cameras stand and what they deliver.

    Parameters
    ----------
    n_images : int
        Cameras on the full circle, 1 to 3600.
    up : (3,) tuple of float
        Axis of the turntable, world.
    elevation_deg : float
        Height of the cameras above the object's equator, degrees, between -89
        and 89.
    field_of_view_deg : float
        Angle of view, degrees; the distance follows, so that the bounding sphere fits.
    size : int
        Width and height of an image, pixels, 1 to 16383 (the largest of WebP).
    frames_per_second : float
        Speed of the animation, 0.1 to 1000.
    exposure : float, optional
        Factor before the sRGB encoding; by default that of an `ExposureMeter`.

    Raises
    ------
    InputError
        If a number is out of range.
    """

    n_images: int = 36
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    elevation_deg: float = 20.0
    field_of_view_deg: float = 30.0
    size: int = 400
    frames_per_second: float = 12.0
    exposure: float | None = None

    def __post_init__(self) -> None:
        for name, (least, most) in RANGES.items():
            if not least <= getattr(self, name) <= most:
                raise InputError(
                    f"{name}: expected {least} to {most}, received {getattr(self, name)}"
                )
        unit_direction("up", self.up)


@dataclass(frozen=True)
class Orbit:
    """Files of a turntable.

    Parameters
    ----------
    images : tuple of Path
        PNG of each camera.
    animation : Path
        Animated WebP.
    contact_sheet : Path
        PNG with all images side by side.
    exposure : float
        Factor before the sRGB encoding.
    """

    images: tuple[Path, ...]
    animation: Path
    contact_sheet: Path
    exposure: float


def orbit_cameras(positions: ArrayLike, options: OrbitOptions | None = None) -> list[Camera]:
    """Cameras on a circle around some points.

    Parameters
    ----------
    positions : (n, 3) array_like
        Points that must stay in view, such as the vertices of the base mesh.
    options : OrbitOptions, optional
        Where the cameras stand.

    Returns
    -------
    list of Camera
        The first looks along the horizontal world axis farthest from `up`; the
        others follow counter-clockwise seen from `up`.

    Examples
    --------
    >>> corners = np.array([[-1, -1, -1], [1, 1, 1]])
    >>> cameras = orbit_cameras(corners, OrbitOptions(n_images=4, elevation_deg=0))
    >>> [camera.centre.round(2).tolist() for camera in cameras[:2]]
    [[6.69, 0.0, 0.0], [0.0, 6.69, 0.0]]
    """
    options = options or OrbitOptions()
    points = np.asarray(positions, np.float64)
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = max(float(np.linalg.norm(points - centre, axis=1).max()), 1e-9)
    half_angle = math.radians(options.field_of_view_deg) / 2
    distance = radius / math.sin(half_angle)
    focal = 0.5 * options.size / math.tan(half_angle)
    return [
        Camera(
            f"orbit{i:03d}",
            OPENCV,
            options.size,
            options.size,
            focal,
            focal,
            options.size / 2,
            options.size / 2,
            looking_at(centre + distance * direction, centre, options.up),
        )
        for i, direction in enumerate(_circle(options))
    ]


def render_orbit(
    field: ReflectanceField,
    lights: Lighting,
    out_dir: Path | str,
    orbit: OrbitOptions | None = None,
    options: RenderOptions | None = None,
) -> Orbit:
    """Render a turntable and write its images, animation and contact sheet.

    Parameters
    ----------
    field : ReflectanceField
        What to show.
    lights : Light, EnvironmentMap, or a sequence of them
        Fixed in the world while the camera moves.
    out_dir : Path or str
        Folder to write to; made if absent.
    orbit : OrbitOptions, optional
        Where the cameras stand.
    options : RenderOptions, optional
        Samples, threads.

    Returns
    -------
    Orbit
        `orbit_000.png` and so on, `orbit.webp`, `contact_sheet.png`.

    Raises
    ------
    InputError
        As `Renderer`.
    """
    orbit = orbit or OrbitOptions()
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    renderer = Renderer(field, options)
    images, meter = [], ExposureMeter()
    cameras = orbit_cameras(field.positions, orbit)
    for camera in track(cameras, len(cameras), "turntable"):
        rendering = renderer.render(camera, lights)
        meter.add(rendering.image, rendering.coverage)
        # Half floats: a turntable of 100 images of 400 pixels stays under 100 MB.
        images.append(np.minimum(rendering.image, 65504.0).astype(np.float16))
    exposure = meter.exposure_or_one if orbit.exposure is None else orbit.exposure
    pictures = [encoded_picture(image, exposure) for image in images]
    files = [folder / f"orbit_{i:03d}.png" for i in range(len(pictures))]
    for path, picture in zip(files, pictures, strict=True):
        write_png(path, picture)
    write_animation(folder / "orbit.webp", pictures, orbit.frames_per_second)
    write_png(folder / "contact_sheet.png", contact_sheet(pictures))
    return Orbit(tuple(files), folder / "orbit.webp", folder / "contact_sheet.png", exposure)


def write_animation(
    path: Path | str, pictures: Sequence[NDArray[np.uint8]], frames_per_second: float
) -> None:
    """Write an animated WebP that repeats for ever.

    Parameters
    ----------
    path : Path or str
        Target; replaced only when the new file is complete.
    pictures : sequence of (h, w, 3) uint8
        Images of one size.
    frames_per_second : float
        Speed.
    """
    first, *others = (Image.fromarray(picture) for picture in pictures)
    with replacing(Path(path)) as temporary:
        first.save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=others,
            duration=round(1000 / frames_per_second),
            loop=0,
            quality=85,
        )


def contact_sheet(
    pictures: Sequence[NDArray[np.uint8]], largest_width: int = 1600
) -> NDArray[np.uint8]:
    """All images in rows of about equal width and height.

    Parameters
    ----------
    pictures : sequence of (h, w, 3) uint8
        Images of one size.
    largest_width : int
        Images are averaged down by a whole factor until the sheet is no wider.

    Returns
    -------
    (rows * h, columns * w, 3) uint8

    Examples
    --------
    >>> contact_sheet([np.zeros((20, 10, 3), np.uint8)] * 5).shape
    (40, 30, 3)
    """
    columns = math.ceil(math.sqrt(len(pictures)))
    rows = math.ceil(len(pictures) / columns)
    step = math.ceil(columns * pictures[0].shape[1] / largest_width)
    small = [np.asarray(Image.fromarray(picture).reduce(step)) for picture in pictures]
    height, width, _ = small[0].shape
    sheet = np.zeros((rows * height, columns * width, 3), np.uint8)
    for i, picture in enumerate(small):
        top, left = i // columns * height, i % columns * width
        sheet[top : top + height, left : left + width] = picture
    return sheet


def _circle(options: OrbitOptions) -> list[Array]:
    """Unit vectors from the object's centre to the cameras."""
    up = unit_direction("up", options.up)
    axis = np.eye(3)[np.argmin(np.abs(up))]
    ahead = axis - (axis @ up) * up
    ahead /= np.linalg.norm(ahead)
    left = np.cross(up, ahead)
    elevation = math.radians(options.elevation_deg)
    turns = 2 * np.pi * np.arange(options.n_images) / options.n_images
    return [
        math.cos(elevation) * (math.cos(turn) * ahead + math.sin(turn) * left)
        + math.sin(elevation) * up
        for turn in turns
    ]
