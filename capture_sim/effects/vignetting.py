r"""Lenses that are darker towards the corners.

.. math:: V(r) = \cos^4\theta \,(1 + a_1 \rho^2 + a_2 \rho^4 + a_3 \rho^6)

with :math:`\theta` the angle of the pixel to the optical axis (natural vignetting; 0 for
orthographic cameras, which are telecentric) and :math:`\rho` the distance from the
principal point over half the diagonal of the image (what lens and filters cut off).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Photograph, Stage, Workload
from capture_sim.effects.bounds import camera_distances
from capture_sim.model import Scene, Table
from capture_sim.tables import bounded

NAME = "vignetting"
STAGE = Stage.OPTICS


@dataclass(frozen=True)
class Options:
    """Shape of the fall-off.

    Attributes
    ----------
    cos4 : bool
        True for natural vignetting.
    coefficients : tuple of float
        a1, a2, a3; up to three.
    """

    cos4: bool = True
    coefficients: tuple[float, ...] = bounded((-0.2, 0.0, 0.0), low=-1.0, high=1.0)


def needed(scene: Scene) -> Decision:
    """Bound the change by the loss at the farthest pixel that shows the object."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("lenses are even: no [effects.vignetting]", 0.0)
    loss = max(
        _loss(scene, camera, float(distance), options)
        for camera, distance in zip(scene.cameras, camera_distances(scene), strict=True)
    )
    reason = f"up to {100.0 * loss:.2g} % of the light is lost where the object is seen"
    return Decision(reason, scene.brightness.headroom * loss)


def _loss(scene: Scene, camera: Table, distance: float, options: Options) -> float:
    """Largest ``|1 - V|`` over the pixels whose rays can meet the object."""
    parallel = camera["model"] == "orthographic"
    near = 1.0 if parallel else max(distance - scene.mesh.radius, 1e-9)
    pose = np.asarray(camera["camera_from_world"], np.float64)
    middle = (pose[:2, :3] @ scene.mesh.centre + pose[:2, 3]) / (1.0 if parallel else distance)
    reach = camera["fl_x"] * (np.linalg.norm(middle) + scene.mesh.radius / near)
    column, row = np.meshgrid(np.arange(camera["w"]), np.arange(camera["h"]))
    radius = np.hypot(column + 0.5 - camera["cx"], row + 0.5 - camera["cy"])
    shown = radius <= reach
    return float(np.abs(1.0 - gain(camera, options))[shown].max(initial=0.0))


def cost(scene: Scene, work: Workload) -> Cost:
    """One product for each channel of each pixel."""
    del scene
    return Cost(operations=work.n_values)


def gain(camera: Table, options: Options) -> NDArray[np.float64]:
    """The factor V of each pixel.

    Parameters
    ----------
    camera : dict
        Camera of the native capture format.
    options : Options

    Returns
    -------
    (h, w) float64
        A factor that would be negative is 0.

    Examples
    --------
    A pixel at 45 degrees gets cos(45)^4 = 1/4:

    >>> camera = {"model": "opencv", "w": 21, "h": 1, "fl_x": 10, "fl_y": 10,
    ...           "cx": 10.5, "cy": 0.5}
    >>> gain(camera, Options(coefficients=(0.0,)))[0, [10, 20]].round(6)
    array([1.  , 0.25])
    """
    x = np.arange(camera["w"]) + 0.5 - camera["cx"]
    y = (np.arange(camera["h"]) + 0.5 - camera["cy"])[:, None]
    rho2 = (x**2 + y**2) / (0.25 * (camera["w"] ** 2 + camera["h"] ** 2))
    powers = zip(options.coefficients, (rho2, rho2**2, rho2**3), strict=False)
    factor = 1.0 + sum(a * power for a, power in powers)
    if options.cos4 and camera["model"] != "orthographic":
        factor = factor / (1.0 + (x / camera["fl_x"]) ** 2 + (y / camera["fl_y"]) ** 2) ** 2
    return np.asarray(np.maximum(factor, 0.0))


def apply(
    radiance: NDArray[np.float32], scene: Scene, photograph: Photograph
) -> NDArray[np.float32]:
    """Darken a photograph towards its corners.

    References
    ----------
    D. B. Goldman, "Vignette and exposure calibration and compensation", IEEE
    Transactions on Pattern Analysis and Machine Intelligence 32(12), 2010.
    """
    factor = gain(photograph.camera, scene.effects.get(Options))
    return radiance * factor[..., None].astype(np.float32)
