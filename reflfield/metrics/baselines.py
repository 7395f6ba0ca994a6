"""What trivial methods get on the photographs that a field is compared with.

A PSNR means little by itself. The baselines know what the field knows of the capture: its
surface, cameras and lights, and the photographs that it was made of; they lack its model of
reflectance.

* `BLACK`: nothing at all.
* `NEAREST`: the nearest photograph in view and light, carried over the surface
  (`reflfield.render.nearest_photographs`).
* `MEAN`: the mean texture, matt: the albedo of each texel under the photograph's light, with
  the field's shadows and the field's light in them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.lights import Light
from reflfield.errors import InputError
from reflfield.field.evaluation import evaluate
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.field.texture_field import apparent_texture, lambertian_texture
from reflfield.metrics.image_metrics import Comparison, ImageMetrics, ImagePair, measure_image
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.nearest_photographs import CarriedPhotograph, NearestPhotographs
from reflfield.render.renderer import Renderer, RenderOptions
from reflfield.sphere.hemisphere import softened_cosine

Floats = NDArray[np.float32]

BLACK, NEAREST, MEAN = "black", "nearest_photograph", "mean_texture"
BASELINES = (BLACK, NEAREST, MEAN)
DEFINITIONS: Mapping[str, str] = {
    BLACK: "an image that is black everywhere",
    NEAREST: "of the photographs that made the field the one with the least sum of squared "
    "angles of view and light, seen from the object's centre; its values over the irradiance "
    "of its light, carried over the field's surface; what its camera does not see is taken "
    "from the next nearest",
    MEAN: "matt: the mean sample of each texel over the mean cosine of its lights, under the "
    "photograph's light, with the field's surface, shadows and light in shadows",
}

# Pairs of directions that the mean of a field is taken over, and texels at a time.
DIRECTIONS_OF_MEAN, TEXELS_AT_ONCE = 24, 1 << 14
# Least mean cosine that an albedo is divided by.
LEAST_MEAN_COSINE = 0.05


class Baselines:
    """Makes baseline images of photographs.

    Parameters
    ----------
    field : ReflectanceField
    surface : FieldSurface
        Of the field.
    albedo : (n_texels, 3) float
        Over pi, 1/sr; see `albedo_of_means` and `albedo_of_field`.
    nearest : NearestPhotographs or str
        Of the photographs that made the field; or why there are none at hand.
    options : RenderOptions, optional
        As of the field.

    Attributes
    ----------
    missing : dict
        Baselines that cannot be made, and why.
    """

    def __init__(
        self,
        field: ReflectanceField,
        surface: FieldSurface,
        albedo: NDArray[np.floating],
        nearest: NearestPhotographs | str,
        options: RenderOptions | None = None,
    ) -> None:
        self.missing = {NEAREST: nearest} if isinstance(nearest, str) else {}
        self._nearest = None if isinstance(nearest, str) else nearest
        self._field, self._options = field, options
        matt = lambertian_texture(field, albedo, surface.texels.normal)
        self._mean = Renderer(matt, options)

    def nearest_to(self, camera: Camera, light: Light, name: str) -> CarriedPhotograph | None:
        """The nearest photograph to one with a name, which is never its own nearest one.

        Parameters
        ----------
        camera : Camera
        light : Light
        name : str

        Returns
        -------
        CarriedPhotograph or None
            None where there are no photographs, or the light has no direction; from then on
            the nearest photograph is among the `missing`.
        """
        if self._nearest is None or self.missing:
            return None
        try:
            return self._nearest.carried(camera, light, but=name)
        except InputError as error:
            self.missing[NEAREST] = str(error)
            return None

    def images(
        self, camera: Camera, light: Light, nearest: CarriedPhotograph | None
    ) -> Iterator[tuple[str, Floats]]:
        """Name and image (h, w, 3), linear radiance, of each baseline in turn."""
        yield BLACK, np.zeros((camera.height, camera.width, 3), np.float32)
        if nearest is not None:
            texture = apparent_texture(self._field, nearest.samples)
            yield NEAREST, Renderer(texture, self._options).render(camera, light).image
        yield MEAN, self._mean.render(camera, light).image


class BaselineScores:
    """Metrics of the baselines over photographs that are added one by one.

    Parameters
    ----------
    exposure : float
        Of the comparison of the field.
    """

    def __init__(self, exposure: float) -> None:
        self.exposure = exposure
        self._images: dict[str, list[ImageMetrics]] = {name: [] for name in BASELINES}
        self._nearest: list[dict[str, Any]] = []

    def add_nearest(self, name: str, nearest: CarriedPhotograph) -> None:
        """Note which photograph is nearest to one with a name."""
        self._nearest.append(
            {
                "name": name,
                "photograph": nearest.name,
                "view_degrees": float(np.degrees(nearest.view_angle)),
                "light_degrees": float(np.degrees(nearest.light_angle)),
                "photographs_read": nearest.n_photographs,
                "share_of_texels_filled": nearest.share_filled,
            }
        )

    def add(self, pair: ImagePair, baseline: str, image: Floats) -> None:
        """Measure a baseline of a photograph, as the field's image of it is measured."""
        measured = measure_image(replace(pair, relit=image), self.exposure)
        self._images[baseline].append(measured)

    def extend(self, later: BaselineScores) -> None:
        """Add the scores of further photographs."""
        self._nearest += later._nearest
        for name, images in later._images.items():
            self._images[name] += images

    def to_dict(self, missing: Mapping[str, str]) -> dict[str, Any]:
        """What ``metrics.json`` says: metrics of each baseline, and why one is missing."""
        return {
            **{name: self._described(name) for name in BASELINES if name not in missing},
            "missing": dict(missing),
            "definitions": dict(DEFINITIONS),
        }

    def _described(self, name: str) -> dict[str, Any]:
        images = self._images[name]
        described = {
            "mean": Comparison(tuple(images), self.exposure).mean,
            "images": [image.to_dict() for image in images],
        }
        return described | ({"nearest": self._nearest} if name == NEAREST else {})


def albedo_of_means(
    means: NDArray[np.floating], mean_cosines: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Albedo over pi whose matt samples have given means.

    Parameters
    ----------
    means : (n_texels, 3) float
        Mean sample of each texel, 1/sr; NaN where there is none.
    mean_cosines : (n_texels, 3) float
        Mean cosine of the lights of the same samples.

    Returns
    -------
    (n_texels, 3) float

    Examples
    --------
    >>> albedo_of_means(np.full((1, 3), 0.1), np.full((1, 3), 0.5))
    array([[0.2, 0.2, 0.2]])
    """
    return means / np.maximum(mean_cosines, LEAST_MEAN_COSINE)


def albedo_of_field(field: ReflectanceField, surface: FieldSurface) -> Floats:
    """Albedo over pi with the mean of what a field shows, where no samples are at hand.

    The mean is over pairs of view and light spread over the hemisphere of each texel.

    Parameters
    ----------
    field : ReflectanceField
    surface : FieldSurface
        Of the field.

    Returns
    -------
    (n_texels, 3) float32
    """
    local = spread_over_hemisphere(DIRECTIONS_OF_MEAN)
    known = field.light_model == "known"
    cosines = softened_cosine(local[:, 2]) if known else np.ones(len(local))
    albedo = np.zeros((field.n_texels, 3), np.float32)
    for first in range(0, field.n_texels, TEXELS_AT_ONCE):
        texels = np.arange(first, min(first + TEXELS_AT_ONCE, field.n_texels), dtype=np.int32)
        total = np.zeros((len(texels), 3))
        for light, view in zip(local, local[::-1], strict=True):
            frames = surface.texels.local_from_world[texels].astype(np.float64)
            views, lights = (np.einsum("nij,i->nj", frames, d) for d in (view, light))
            total += evaluate(field, texels, views, lights)
        albedo[texels] = total / cosines.sum()
    return albedo


def spread_over_hemisphere(count: int) -> NDArray[np.float64]:
    """Unit directions (count, 3) of a golden spiral, each for the same solid angle.

    Examples
    --------
    >>> spread_over_hemisphere(4)[:, 2]
    array([0.875, 0.625, 0.375, 0.125])
    """
    index = np.arange(count) + 0.5
    height = 1.0 - index / count
    radius, azimuth = np.sqrt(1.0 - height**2), np.pi * (1 + 5**0.5) * index
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
