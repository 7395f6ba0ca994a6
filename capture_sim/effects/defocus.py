r"""Blur of what lies in front of and behind the plane of focus.

A thin lens of focal length :math:`f` and f-number `N`, focused at the distance
:math:`s`, shows a point at the distance `z` as a disc of diameter

.. math:: c = \frac{f^2}{N} \frac{|z - s|}{z\,(s - f)}

on the sensor. Light is scattered into discs, in layers of equal diameter; what a near
surface hides and what it lets through at its blurred rim are not told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Photograph, Stage, Workload
from capture_sim.effects.bounds import camera_distances
from capture_sim.model import Scene, Table
from capture_sim.tables import bounded

NAME = "defocus"
STAGE = Stage.OPTICS

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Diameters of the layers are this far apart, pixels.
LAYER = 0.5
# Points that stand for a disc.
_DISC_POINTS = 2048
# A blur wider than this part of the image is a mistake in the scene, not a photograph.
WIDEST = 0.25


@dataclass(frozen=True)
class Options:
    """Lens and sensor.

    Attributes
    ----------
    f_number : float
        Focal length over the diameter of the aperture.
    sensor_width : float
        Width of the sensor, metres; with the camera's focal length in pixels it
        gives that in metres.
    focus : float
        Distance of the plane of focus, metres; 0 for the object's centre.
    """

    f_number: float = bounded(5.6, low=0.1, high=1e4)
    sensor_width: float = bounded(0.0236, low=1e-6, high=10.0)
    focus: float = bounded(0.0, low=0.0)


def needed(scene: Scene) -> Decision:
    r"""Bound the change by the widest disc on the object.

    Of the light of a pixel, a disc of diameter `c` pixels carries at most
    :math:`8 c / (6\pi)` elsewhere (its mean displacement in x and in y).
    """
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("all distances are sharp: no [effects.defocus]", 0.0)
    widest = max(
        _widest(scene, camera, float(distance), options)
        for camera, distance in zip(scene.cameras, camera_distances(scene), strict=True)
    )
    carried = min(1.0, 8.0 * widest / (6.0 * np.pi))
    reason = f"discs of up to {widest:.2g} px on the object at f/{options.f_number:g}"
    return Decision(reason, scene.brightness.headroom * carried)


def _widest(scene: Scene, camera: Table, distance: float, options: Options) -> float:
    radius = scene.mesh.radius
    depths = np.array([max(distance - radius, 1e-3 * radius), distance + radius])
    return float(disc_diameter(camera, depths, options, scene).max())


def cost(scene: Scene, work: Workload) -> Cost:
    """One product for each pixel of the widest disc, channel and pixel."""
    options = scene.effects.get(Options)
    distances = camera_distances(scene)
    widest = _widest(scene, scene.cameras[0], float(distances[0]), options)
    layers = np.ceil(widest / LAYER) + 1.0
    return Cost(operations=int(3 * work.n_pixels * work.n_lights * layers * (widest + 2) ** 2))


def disc_diameter(camera: Table, depth: Array, options: Options, scene: Scene) -> Array:
    """Diameter of the disc that a point appears as.

    Parameters
    ----------
    camera : dict
        Camera of the native capture format; orthographic ones are always sharp.
    depth : (...) float
        Distance along the optical axis, metres.
    options : Options
    scene : Scene
        Gives the distance of the object's centre, the default focus.

    Returns
    -------
    (...) float64
        Pixels.
    """
    if camera["model"] == "orthographic":
        return np.zeros_like(depth)
    pose = np.asarray(camera["camera_from_world"], np.float64)
    centre = float(pose[2, :3] @ scene.mesh.centre + pose[2, 3])
    focus = options.focus or centre
    pitch = options.sensor_width / camera["w"]
    focal = min(camera["fl_x"] * pitch, 0.999 * focus)
    aperture = focal / options.f_number
    blur = aperture * focal / (focus - focal) * np.abs(depth - focus) / depth
    return np.asarray(np.minimum(blur / pitch, WIDEST * camera["w"]))


def disc_kernel(diameter: float) -> Float32:
    """Weights of a disc about a pixel, for images that are linear between pixels.

    Parameters
    ----------
    diameter : float
        Pixels.

    Returns
    -------
    (n, n) float32
        n odd; the sum is 1.

    Examples
    --------
    >>> disc_kernel(0.0)
    array([[1.]], dtype=float32)
    >>> kernel = disc_kernel(2.0)
    >>> kernel.shape, bool(abs(kernel.sum() - 1.0) < 1e-6)
    ((3, 3), True)
    """
    half = int(np.ceil(0.5 * diameter))
    index = np.arange(_DISC_POINTS) + 0.5
    radius = 0.5 * diameter * np.sqrt(index / _DISC_POINTS)
    turn = np.pi * (3.0 - np.sqrt(5.0)) * index  # sunflower: equal areas
    ticks = np.arange(-half, half + 1)
    x, y = (
        np.maximum(0.0, 1.0 - np.abs(offset[:, None] - ticks))
        for offset in (radius * np.cos(turn), radius * np.sin(turn))
    )
    kernel = y.T @ x
    return np.asarray(kernel / kernel.sum(), np.float32)


def apply(radiance: Float32, scene: Scene, photograph: Photograph) -> Float32:
    """Blur a photograph by the distance of what each pixel shows.

    Raises
    ------
    ValueError
        If the photograph has no depth.

    References
    ----------
    M. Potmesil and I. Chakravarty, "Synthetic image generation with a lens and aperture
    camera model", ACM Transactions on Graphics 1(2), 1982.
    """
    if photograph.depth is None:
        raise ValueError("photograph.depth: expected an image, received None")
    depth = np.where(photograph.depth > 0.0, photograph.depth, np.inf).astype(np.float64)
    finite = np.isfinite(depth)
    if not finite.any():
        return radiance
    diameter = np.zeros(depth.shape)
    options = scene.effects.get(Options)
    diameter[finite] = disc_diameter(photograph.camera, depth[finite], options, scene)
    return _scattered(radiance, diameter / LAYER)


def _scattered(radiance: Float32, layer: Array) -> Float32:
    """Sum of the layers, each blurred; a pixel's light is shared by its two nearest."""
    total = np.zeros_like(radiance)
    below = np.floor(layer)
    for level in range(int(below.max()) + 2):
        share = np.maximum(0.0, 1.0 - np.abs(layer - level)).astype(np.float32)
        if share.any():
            total += cv2.filter2D(
                radiance * share[..., None],
                cv2.CV_32F,
                disc_kernel(LAYER * level),
                borderType=cv2.BORDER_CONSTANT,
            )
    return total
