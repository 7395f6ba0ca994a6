"""The nearest photograph in view and light, carried over the surface to another camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.lights import DIRECTIONAL, POINT, SPOT, UNKNOWN, Light
from reflfield.errors import InputError
from reflfield.geometry.occlusion import VisibilityOptions, view_visibility
from reflfield.observations.image_projection import VALUE_KINDS, samples_of_photograph
from reflfield.render.camera_rays import FieldSurface

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Photographs that may be read for one image: the later ones fill what the nearest does not see.
MOST_PHOTOGRAPHS = 8
# A further photograph is read if it shows more than this share of the texels in view, or if
# nothing has been found yet.
LEAST_GAIN = 0.01
# Texels that are not in view are filled as far as texels in view blend with them, in texels.
REACH = 3.0
# The camera of an image sees a texel whenever it shows at all.
IN_VIEW = VisibilityOptions(grazing_cosine=0.0, edge_band=0.0)


@dataclass(frozen=True, eq=False)
class CarriedPhotograph:
    """The nearest photograph as texels show it.

    Parameters
    ----------
    samples : (n_texels, 3) float
        Radiance over irradiance, 1/sr; 0 of texels that are not near to any in view.
    name : str
        Of the nearest photograph.
    view_angle, light_angle : float
        Between the directions to the cameras and to the lights, radians.
    n_photographs : int
        That were read.
    share_filled : float
        Of the texels in view, those that none of them shows: they repeat the nearest one.
    """

    samples: NDArray[np.floating]
    name: str
    view_angle: float
    light_angle: float
    n_photographs: int
    share_filled: float


class NearestPhotographs:
    """Photographs of a field, ready to be carried over its surface.

    Parameters
    ----------
    surface : FieldSurface
        Of the field.
    capture : Capture
        Photographs that the field was made of.
    sees : callable, optional
        ``sees(view)``: (n_texels,) bool, True where a camera of the capture sees a texel well
        enough to sample its photograph. Found by rays by default.

    Raises
    ------
    InputError
        If there are no photographs, or a light has no direction.
    """

    def __init__(
        self,
        surface: FieldSurface,
        capture: Capture,
        sees: Callable[[int], Bools] | None = None,
    ) -> None:
        if not capture.photographs:
            raise InputError(f"{capture.name}: expected photographs, received none")
        self.surface = surface
        self.capture = capture
        self._sees = sees or self._traced
        self._traced_views: dict[int, Bools] = {}
        self._centre = surface.texels.position.mean(axis=0, keepdims=True)
        cameras, lights = (
            [p.camera for p in capture.photographs],
            [p.light for p in capture.photographs],
        )
        views = [camera.view_directions(self._centre)[0] for camera in capture.cameras]
        towards = [light_direction(light, self._centre) for light in capture.lights]
        self._views, self._lights = np.stack(views)[cameras], np.stack(towards)[lights]

    def angles(self, camera: Camera, light: Light) -> tuple[Array, Array]:
        """Angles (n_photographs,) of view and light to those of the photographs, radians.

        Seen from the centre of the object; an unknown light is that of all photographs.
        """
        view = camera.view_directions(self._centre)[0]
        towards = light_direction(light, self._centre)
        lights = angles_between(self._lights, towards)
        if light.kind == UNKNOWN or not self.capture.lights_known:
            lights = np.zeros_like(lights)
        return angles_between(self._views, view), lights

    def carried(
        self, camera: Camera, light: Light, but: str | None = None
    ) -> CarriedPhotograph:
        """The nearest photograph, as the texels that a camera sees show it.

        The nearest has the least sum of the squared angles between the directions to the two
        cameras and to the two lights. Its values are divided by the irradiance of its light
        and stay what they are otherwise: its shading, shadows and highlights come along. What
        its camera does not see well enough, or has not measured, is taken from the next
        nearest, of at most `MOST_PHOTOGRAPHS`; what none shows repeats the nearest texel.

        Parameters
        ----------
        camera : Camera
        light : Light
        but : str, optional
            Name of a photograph that does not count: the one that is predicted.

        Returns
        -------
        CarriedPhotograph

        Raises
        ------
        InputError
            If the light has no direction, or no photograph shows the object.
        """
        view_angles, light_angles = self.angles(camera, light)
        names = np.array([photograph.name for photograph in self.capture.photographs])
        order = np.argsort(view_angles**2 + light_angles**2, kind="stable")
        order = order[names[order] != but] if but is not None else order
        texels = self.surface.texels
        wanted = view_visibility(texels, self.surface.scene, camera, IN_VIEW)
        samples = np.full((len(texels), 3), np.nan, np.float32)
        missing, seen_enough = wanted.copy(), set()
        used: list[int] = []
        for index in order.tolist():
            view = self.capture.photographs[index].camera
            if view in seen_enough or len(used) == MOST_PHOTOGRAPHS:
                continue
            new = np.flatnonzero(self._sees(view) & missing)
            if len(new) <= (LEAST_GAIN * wanted.sum() if used else 0):
                seen_enough.add(view)  # what is missing becomes ever less
                continue
            samples[new] = self._completed(samples[new], index, new)
            missing[new] = np.isnan(samples[new]).any(axis=1)
            used.append(index)
        if np.isnan(samples).all(axis=0).any():
            raise InputError(f"{self.capture.name}: no photograph shows what the camera sees")
        samples[wanted] = filled_from_nearest(samples[wanted], texels.position[wanted])
        reach, first = REACH * self.surface.texel_width, used[0]
        return CarriedPhotograph(
            samples=filled_from_nearest(samples, texels.position, reach),
            name=str(names[first]),
            view_angle=float(view_angles[first]),
            light_angle=float(light_angles[first]),
            n_photographs=len(used),
            share_filled=float(missing.sum() / wanted.sum()),
        )

    def _completed(
        self, samples: NDArray[np.float32], index: int, texels: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Samples of some texels, with those of a photograph where they are missing."""
        positions = self.surface.texels.position[texels]
        values, kinds = samples_of_photograph(self.capture, index, positions)
        # Where a light does not shine, the photograph says nothing of another light.
        values[kinds == VALUE_KINDS.index("unlit")] = np.nan
        return np.where(np.isnan(samples), values, samples)

    def _traced(self, view: int) -> Bools:
        if view not in self._traced_views:
            self._traced_views[view] = view_visibility(
                self.surface.texels, self.surface.scene, self.capture.cameras[view]
            )
        return self._traced_views[view]


def light_direction(light: Light, centre: Array) -> Array:
    """Unit direction (3,) from the centre (1, 3) to a light; +Z of the world if unknown.

    Raises
    ------
    InputError
        If the light comes from several sides.
    """
    if light.kind not in (POINT, SPOT, DIRECTIONAL, UNKNOWN):
        raise InputError(
            f"light {light.id!r}: expected a single light, received kind {light.kind!r}, which "
            "has no direction that photographs could be near to"
        )
    return np.asarray(light.directions(centre)[0])


def angles_between(directions: Array, direction: Array) -> Array:
    """Angles (n,) between unit vectors (n, 3) and one (3,), radians.

    Examples
    --------
    >>> angles_between(np.array([[1.0, 0, 0], [0, 0, 1]]), np.array([0.0, 0, 1])).round(4)
    array([1.5708, 0.    ])
    """
    across = np.linalg.norm(np.cross(directions, direction), axis=1)
    return np.asarray(np.arctan2(across, directions @ direction))


def filled_from_nearest(
    values: NDArray[np.floating], positions: NDArray[np.floating], reach: float = np.inf
) -> NDArray[np.floating]:
    """Values of points, NaN replaced by the value of the nearest point that has one.

    Parameters
    ----------
    values : (n, k) float
        Each column is filled by itself.
    positions : (n, 3) float
    reach : float
        Points without a value that are farther than this from all that have one become 0.

    Returns
    -------
    (n, k) float

    Raises
    ------
    InputError
        If a column is NaN everywhere.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [9, 0, 0]])
    >>> values = np.array([[1.0], [np.nan], [3.0], [np.nan]])
    >>> filled_from_nearest(values, points).ravel()
    array([1., 1., 3., 3.])
    >>> filled_from_nearest(values, points, reach=2.0).ravel()
    array([1., 1., 3., 0.])
    """
    filled, unknown = np.nan_to_num(values, nan=0.0), np.isnan(values)
    if unknown.all(axis=0).any():
        raise InputError("values: expected at least one that is known, received none")
    nearest = np.zeros(0, np.intp)
    for k, missing in enumerate(unknown.T):
        if missing.any():
            # Most points lack all columns or none: one search does for all.
            if k == 0 or not np.array_equal(missing, unknown[:, k - 1]):
                tree = cKDTree(positions[~missing])
                nearest = tree.query(positions[missing], distance_upper_bound=reach)[1]
            known = np.append(values[~missing, k], 0.0)  # the last where none is near
            filled[missing, k] = known[nearest]
    return filled
