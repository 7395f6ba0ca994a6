"""One view of a field as a relightable image of relight and OpenLIME.

A folder with ``info.json``, ``plane_k.jpg`` and ``normals.jpg``: images under lights on an
octahedral grid (`type` "bilinear"), sRGB-encoded, as principal components of all pixels and
lights together (`colorspace` "mrgb"). ``normals.exr`` has the normals as they are.

References
----------
F. Ponchio, M. Corsini, R. Scopigno, "Relight: a compact and accurate RTI representation for
the web", Graphical Models 2019.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from reflfield.capture.cameras import ORTHOGRAPHIC, Camera, looking_at
from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_writing import write_exr
from reflfield.capture.lights import DirectionalLight
from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.geometry.mesh import unit_or_zero
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.renderer import Renderer, RenderOptions
from reflfield.render.turntable import OrbitOptions, orbit_cameras
from reflfield.util.files import filling
from reflfield.util.validation import unit_direction

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

# Lights along a side of the grid, principal components, and the most pixels along a side. The
# side is odd: light from the viewer, which viewers begin with, is one of the lights.
GRID_SIDE, N_PLANES, MOST_SIDE = 13, 27, 512
# Of JPEG. Planes are many, normals one image that is read as numbers.
_QUALITY, _NORMALS_QUALITY = 95, 100
_WHITE_PERCENTILE = 99.5
# Pixels that principal components are made from.
_MOST_PIXELS = 20_000
# A surface whose normals have a mean of this length is seen from where they point.
_FLAT = 0.5


@dataclass(frozen=True, eq=False)
class ImagePlanes:
    """Images under many lights as a mean and components, all quantised to bytes.

    Parameters
    ----------
    basis : (1 + n, n_lights, 3) uint8
        Mean, in 255ths, and components: ``(basis - 127) / range``.
    ranges, scale, bias : (n,) float64
        Coefficients are ``(plane / 255 - bias) * scale``.
    planes : (n_pixels, n) uint8
    """

    basis: NDArray[np.uint8]
    ranges: Doubles
    scale: Doubles
    bias: Doubles
    planes: NDArray[np.uint8]

    def decoded(self) -> Floats:
        """Images, (n_pixels, n_lights, 3), as a viewer shows them at the grid's lights."""
        coefficients = (self.planes / 255.0 - self.bias) * self.scale
        components = (self.basis[1:] - 127.0) / self.ranges[:, None, None]
        shown = np.tensordot(coefficients, components, 1) + self.basis[0] / 255.0
        return shown.astype(np.float32)


def grid_lights(side: int = GRID_SIDE) -> Doubles:
    """Directions of the grid's lights, (side * side, 3): x right, y up, z to the viewer.

    Node (i, j), j * side + i in the order, is where ``(x + y, y - x) / (|x| + |y| + |z|)`` is
    ``2 (i, j) / (side - 1) - 1``.

    Examples
    --------
    >>> grid_lights(3)[[4, 0]].tolist()
    [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    """
    axis = np.linspace(-1.0, 1.0, side)
    along, across = np.meshgrid(axis, axis)
    x, y = 0.5 * (along - across), 0.5 * (along + across)
    z = np.maximum(1.0 - np.abs(x) - np.abs(y), 0.0)
    return unit_or_zero(np.stack([x, y, z], axis=-1).reshape(-1, 3))


def write_rti(path: Path, field: ReflectanceField, view: ArrayLike | None = None) -> list[str]:
    """Write the folder.

    Parameters
    ----------
    path : Path
        Folder.
    field : ReflectanceField
        Of a known light.
    view : (3,) array_like, optional
        World direction to the viewer; by default straight above a flat field, else as in the
        first image of a turntable.

    Returns
    -------
    list of str
        What to know of the result.

    Raises
    ------
    InputError
        If the field's light is unknown, or the view is no direction.
    """
    if field.light_model == "unknown":
        raise InputError(
            "field: expected one of known lights, received one that was photographed in an "
            "unknown light: it cannot be lit anew"
        )
    surface = FieldSurface(field)
    camera = view_camera(surface, view)
    images, white = _images(field, camera)
    planes = image_planes(images.reshape(-1, *images.shape[2:]))
    normals = _normals(surface, camera)
    with filling(path) as partial:
        stored = _write_planes(partial, planes, (camera.height, camera.width))
        encoded = np.rint(127.5 * (normals + 1.0)).astype(np.uint8)
        _write_jpeg(partial / "normals.jpg", encoded, _NORMALS_QUALITY)
        write_exr(partial / "normals.exr", normals, ["normal.X", "normal.Y", "normal.Z"])
    shown = stored.decoded()
    off = shown - images.reshape(shown.shape)
    quality = -10.0 * np.log10(max(float(np.mean(off**2)), 1e-12))
    return [
        f"planes: {camera.width} x {camera.height} pixels, {len(planes.ranges)} components of "
        f"{GRID_SIDE**2} lights, {quality:.1f} dB against the field's images under them; "
        f"white is a radiance of {white:.4g} under an irradiance of pi"
    ]


def view_camera(surface: FieldSurface, view: ArrayLike | None = None) -> Camera:
    """Parallel projection of a field's surface whose pixels are as large as its texels."""
    mesh, up = surface.mesh, surface.field.up
    towards = _usual_view(surface) if view is None else unit_direction("view", view)
    if abs(towards @ up) > 0.999:
        up = np.array([0.0, 1.0, 0.0])
    centre = mesh.bounds.mean(axis=0)
    pose = looking_at(centre + towards * mesh.diagonal, centre, up)
    across = (mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, :2]
    low, size = across.min(axis=0), np.ptp(across, axis=0)
    per_metre = min(1.0 / surface.texel_width, MOST_SIDE / size.max())
    width, height = np.maximum(np.ceil(per_metre * size - 1e-3), 1).astype(int)
    cx, cy = 0.5 * np.array([width, height]) - per_metre * (low + 0.5 * size)
    return Camera(
        "view", ORTHOGRAPHIC, int(width), int(height), per_metre, per_metre, cx, cy, pose
    )


def _usual_view(surface: FieldSurface) -> Doubles:
    mesh = surface.mesh
    mean = mesh.face_areas @ mesh.face_normals / mesh.area
    if np.linalg.norm(mean) > _FLAT:
        return unit_direction("view", mean)
    x, y, z = surface.field.up.tolist()
    return -orbit_cameras(mesh.vertices, OrbitOptions(n_images=1, up=(x, y, z)))[0].forward


def _images(field: ReflectanceField, camera: Camera) -> tuple[Floats, float]:
    """Encoded images under the grid's lights, (height, width, n_lights, 3), and their white."""
    world_from_image = (camera.camera_from_world[:3, :3] * [[1.0], [-1.0], [-1.0]]).T
    lights = [DirectionalLight(world_from_image @ one, np.pi) for one in grid_lights()]
    made = Renderer(field, RenderOptions(samples_per_pixel=4)).render_each(camera, lights)
    images = np.stack([one.image for one in made], axis=2)
    brightest = images.max(axis=(2, 3))[made[0].coverage > 0]
    white = float(np.percentile(brightest, _WHITE_PERCENTILE)) if brightest.size else 1.0
    white = white or 1.0
    for image in images:  # row by row: the whole is large
        image[:] = encode_srgb(np.clip(image / white, 0.0, 1.0))
    return images, white


def image_planes(images: Floats, n_planes: int = N_PLANES) -> ImagePlanes:
    """Principal components of images.

    Parameters
    ----------
    images : (n_pixels, n_lights, 3) float32
        0 to 1.
    n_planes : int
        A multiple of three.
    """
    n_pixels, n_lights, _ = images.shape
    flat = images.reshape(n_pixels, -1)
    some = flat[:: -(-n_pixels // _MOST_PIXELS)].astype(np.float64)
    mean = np.rint(255.0 * some.mean(axis=0)).astype(np.uint8)
    off = some - mean / 255.0
    _, vectors = np.linalg.eigh(off.T @ off)
    components = vectors[:, ::-1][:, :n_planes].T
    ranges = 127.0 / np.maximum(np.abs(components).max(axis=1), 1e-9)
    stored = np.rint(components * ranges[:, None] + 127.0).astype(np.uint8)
    # The coefficients are those of the components as they are stored.
    back = np.linalg.pinv((stored - 127.0) / ranges[:, None])
    coefficients = (flat - (mean / 255.0).astype(np.float32)) @ back.astype(np.float32)
    low, high = (np.float64(f(coefficients, axis=0)) for f in (np.min, np.max))
    scale = np.maximum(high - low, 1e-6)
    planes = np.rint(255.0 * (coefficients - low) / scale).astype(np.uint8)
    basis = np.concatenate([mean[None], stored]).reshape(-1, n_lights, 3)
    return ImagePlanes(basis, ranges, scale, -low / scale, planes)


def _write_planes(folder: Path, planes: ImagePlanes, shape: tuple[int, int]) -> ImagePlanes:
    """Write ``info.json`` and the planes; returns them as a viewer reads them."""
    n_planes = len(planes.ranges)
    material = {
        "scale": planes.scale.tolist(),
        "bias": planes.bias.tolist(),
        "range": planes.ranges.tolist(),
    }
    info: dict[str, Any] = {
        "width": shape[1],
        "height": shape[0],
        "format": "jpg",
        "type": "bilinear",
        "colorspace": "mrgb",
        "nplanes": n_planes,
        "quality": _QUALITY,
        "resolution": GRID_SIDE,
        "materials": [material],
        "basis": planes.basis.ravel().tolist(),
    }
    (folder / "info.json").write_text(json.dumps(info), encoding="utf-8")
    read = []
    for number in range(n_planes // 3):
        image = planes.planes[:, 3 * number : 3 * number + 3].reshape(*shape, 3)
        read.append(_write_jpeg(folder / f"plane_{number}.jpg", image, _QUALITY))
    return replace(planes, planes=np.concatenate(read, axis=2).reshape(-1, n_planes))


def _write_jpeg(path: Path, image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """Write three channels, none at a loss for the others; returns them as they are read."""
    stream = BytesIO()
    # Coefficients and normals are no colours: as luminance and chroma, two of three channels
    # would be quantised more coarsely.
    Image.fromarray(np.ascontiguousarray(image)).save(
        stream, format="JPEG", quality=quality, subsampling=0, keep_rgb=True
    )
    path.write_bytes(stream.getvalue())
    return np.asarray(Image.open(stream))


def _normals(surface: FieldSurface, camera: Camera) -> Floats:
    """Normals of the texels in the image, x right, y up, z to the viewer; that where none."""
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([column, row], axis=-1).reshape(-1, 2).astype(np.float64) + 0.5
    hits = surface.first_hits(*surface.camera_rays(camera, pixels))
    entries = surface.footprints(hits, hits.ray)
    weights = entries.summed(np.ones(len(hits.ray)))
    world = surface.field.local_from_world[entries.texel, 2] * weights[:, None]
    total = np.zeros((len(pixels), 3))
    np.add.at(total, entries.pixel, world)
    normals = unit_or_zero(total @ camera.camera_from_world[:3, :3].T * [1.0, -1.0, -1.0])
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals.astype(np.float32).reshape(camera.height, camera.width, 3)
