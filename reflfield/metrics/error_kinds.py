"""Where the error of an image lies: its pixels by kind.

Kinds, in the order in which they are asked for; a pixel is of the first that applies:

1. silhouette: within `EDGE_PX` of the outline of the object, or of a discontinuity of the
   surface's depth; or missed by the surface;
2. shadow edge: within `SHADOW_PX` of the border of a traced shadow, where the light stands
   above the horizon on both sides;
3. highlight: the photograph, or the image, is brighter than the mean texture under the same
   light, by the factor `HIGHLIGHT_FACTOR` and by `HIGHLIGHT_LEVEL` of white;
4. texture edge: beside a pixel whose albedo differs by `TEXTURE_CONTRAST` of the brighter one;
5. grazing: seen under a cosine below `GRAZING_COSINE`;
6. shadow: the light does not reach it;
7. rest.

Depth, shadows, albedo and normals are those of the field's surface at the centres of pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion

from reflfield.capture.cameras import Camera
from reflfield.capture.color_spaces import luminance
from reflfield.capture.lights import DIRECTIONAL, POINT, SPOT, Light
from reflfield.field.texel_taps import texel_taps
from reflfield.geometry.mesh import unit_or_zero
from reflfield.geometry.occlusion import VisibilityOptions, depth_edges
from reflfield.metrics.image_errors import psnr_of_mean_square, strips
from reflfield.metrics.image_metrics import ImagePair, without_backdrop
from reflfield.render.camera_rays import FieldSurface, SurfaceHits
from reflfield.render.exposure import COVERAGE_OF_OBJECT, display

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Kinds = NDArray[np.uint8]

KINDS = (
    "silhouette",
    "shadow edge",
    "highlight",
    "texture edge",
    "grazing",
    "shadow",
    "rest",
)
SILHOUETTE, SHADOW_EDGE, HIGHLIGHT, TEXTURE_EDGE, GRAZING, SHADOW, REST = range(len(KINDS))
# What a pixel is that is not measured.
NO_KIND = 255

# Distances in pixels. Those of the object's outline that are nearer than 2 are not measured.
EDGE_PX, SHADOW_PX = 4.0, 2
# Cosine of the light over the smooth normal: below, shading fades out without an edge.
LEAST_SHADOW_COSINE = 0.1
HIGHLIGHT_FACTOR, HIGHLIGHT_LEVEL = 1.5, 0.1
TEXTURE_CONTRAST = 0.2
# Cosine of 73 degrees.
GRAZING_COSINE = 0.3

DEFINITIONS: Mapping[str, str] = {
    "silhouette": f"within {EDGE_PX:g} pixels of the object's outline or of a discontinuity of "
    "depth, or missed by the surface",
    "shadow edge": f"within {SHADOW_PX} pixels of the border of a traced shadow",
    "highlight": f"photograph or image more than {HIGHLIGHT_FACTOR:g} times as bright as the "
    f"mean texture, and by {HIGHLIGHT_LEVEL:g} of white",
    "texture edge": f"albedo differs by {TEXTURE_CONTRAST:.0%} from a neighbouring pixel's",
    "grazing": f"cosine of view and normal below {GRAZING_COSINE:g}",
    "shadow": "the light does not reach it",
    "rest": "none of these",
    "precedence": "a pixel is of the first kind that applies, in this order",
    "error": "squared, of the LDR images, summed over pixels of the object and channels",
}


@dataclass(frozen=True, eq=False)
class KindErrors:
    """Pixels and squared errors by kind, summed over images.

    Parameters
    ----------
    pixels : (n_kinds,) int64
    squares : (n_kinds,) float64
        Of the LDR images, all channels together.
    """

    pixels: NDArray[np.int64]
    squares: Floats

    @staticmethod
    def none() -> KindErrors:
        """Of no image."""
        return KindErrors(np.zeros(len(KINDS), np.int64), np.zeros(len(KINDS)))

    def __add__(self, other: KindErrors) -> KindErrors:
        return KindErrors(self.pixels + other.pixels, self.squares + other.squares)

    def to_dict(self) -> dict[str, Any]:
        """What ``metrics.json`` says: shares of pixels and of squared error, PSNR of a kind.

        Examples
        --------
        >>> errors = KindErrors(np.array([1, 0, 0, 0, 0, 0, 3]), np.eye(7)[0] * 0.03)
        >>> errors.to_dict()["silhouette"]
        {'share_of_pixels': 0.25, 'share_of_squared_error': 1.0, 'psnr_ldr': 20.0}
        """
        n, total = max(int(self.pixels.sum()), 1), float(self.squares.sum())
        return {
            name: {
                "share_of_pixels": int(count) / n,
                "share_of_squared_error": float(square) / total if total > 0 else 0.0,
                "psnr_ldr": psnr_of_mean_square(square / (3 * count)) if count else None,
            }
            for name, count, square in zip(KINDS, self.pixels, self.squares, strict=True)
        }


@dataclass(frozen=True, eq=False)
class SurfaceGuides:
    """What the surface says of some rows and columns of an image.

    Parameters
    ----------
    hit : (h, w) bool
        True where the ray through the centre meets the surface from outside.
    lit : (h, w) bool
        True where the light reaches the hit.
    light_cosine, view_cosine : (h, w) float64
        Over the smooth normal; 0 without a hit. The light's is 1 where it has no direction.
    albedo : (h, w) float64
        Luminance.
    """

    hit: Bools
    lit: Bools
    light_cosine: Floats
    view_cosine: Floats
    albedo: Floats


class KindFinder:
    """Says of what kind the pixels of images of one field are.

    Parameters
    ----------
    surface : FieldSurface
    albedo : (n_texels, 3) float
        Of each texel, in any unit.
    """

    def __init__(self, surface: FieldSurface, albedo: NDArray[np.floating]) -> None:
        self._surface = surface
        self._albedo = luminance(np.asarray(albedo, np.float64))
        self._edges: tuple[Camera | None, Bools] = (None, np.zeros((0, 0), np.bool_))

    def kinds(
        self,
        pair: ImagePair,
        camera: Camera,
        light: Light,
        mean_texture: NDArray[np.floating],
        exposure: float,
    ) -> Kinds:
        """Kind of each pixel that is measured, `NO_KIND` elsewhere.

        Parameters
        ----------
        pair : ImagePair
        camera : Camera
        light : Light
        mean_texture : (h, w, 3) float
            Linear radiance of the mean texture for this camera and light.
        exposure : float
            Of the comparison.

        Returns
        -------
        (h, w) uint8
            Place in `KINDS`.
        """
        counted, kind = pair.counted, np.full(pair.counted.shape, NO_KIND, np.uint8)
        near_outline = self._near_outline(pair, camera)
        columns = _columns(counted)
        for own, wide, inner in strips(*counted.shape):
            here = counted[own]
            if not here.any():
                continue
            guides = self.guides(camera, light, wide, columns)
            bright = _is_highlight(pair, mean_texture, exposure, (own, columns))
            inner_guides = _guided_kinds(guides, bright, near_outline[own, columns], inner)
            kind[own, columns] = np.where(here[:, columns], inner_guides, NO_KIND)
        return kind

    def guides(
        self, camera: Camera, light: Light, rows: slice, columns: slice
    ) -> SurfaceGuides:
        """What the surface says of a part of an image."""
        row, column = np.mgrid[rows, columns]
        pixels = np.stack([column.ravel(), row.ravel()], axis=1) + 0.5
        hits = self._surface.first_hits(*self._surface.camera_rays(camera, pixels))
        front = hits.ray[hits.front]
        texels, weights = texel_taps(self._surface.field, hits.uv)
        blended = np.einsum("nkd,nk->nd", self._surface.texels.normal[texels], weights)
        normals = unit_or_zero(blended.astype(np.float64))
        albedo = np.einsum("nk,nk->n", self._albedo[texels], weights)
        seen = np.einsum("nd,nd->n", normals, camera.view_directions(hits.position))
        lit, cosine = self._light_on(hits, normals, light)

        def laid_out(values: NDArray[Any]) -> NDArray[Any]:
            image = np.zeros(len(pixels), values.dtype)
            image[front] = values[hits.front]
            return image.reshape(row.shape)

        return SurfaceGuides(
            hit=laid_out(hits.front),
            lit=laid_out(lit),
            light_cosine=laid_out(cosine),
            view_cosine=laid_out(seen),
            albedo=laid_out(albedo),
        )

    def _near_outline(self, pair: ImagePair, camera: Camera) -> Bools:
        """True within `EDGE_PX` of the outline or of a discontinuity of depth."""
        if self._edges[0] is not camera:
            near = VisibilityOptions(edge_band=EDGE_PX)
            self._edges = camera, depth_edges(self._surface.scene, camera, near)
        covered = np.asarray(pair.silhouette) >= COVERAGE_OF_OBJECT
        # The object may go on beyond the border of the image, which is no outline.
        inner = binary_erosion(covered, _disk(EDGE_PX + 0.5), border_value=1)
        return np.asarray(self._edges[1] | ~inner)

    def _light_on(
        self, hits: SurfaceHits, normals: Floats, light: Light
    ) -> tuple[Bools, Floats]:
        """Whether a light reaches hits, and its cosine; all are lit without a direction."""
        if light.kind not in (POINT, SPOT, DIRECTIONAL):
            return np.ones(len(hits.ray), np.bool_), np.ones(len(hits.ray))
        towards, distances = light.directions(hits.position), light.distances(hits.position)
        cosine = np.einsum("nd,nd->n", normals, towards)
        lit = self._surface.reached_by_light(
            hits.position, hits.face_normal, towards, distances
        )
        return lit, cosine


def _disk(radius: float) -> Bools:
    """Pixels whose centres are no farther than so many from that of the middle one."""
    reach = int(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(y**2 + x**2 <= radius**2)


def _columns(counted: Bools) -> slice:
    """Columns that are looked at: those with a pixel that counts, and some beside them."""
    used = np.flatnonzero(counted.any(axis=0))
    if not len(used):
        return slice(0, 0)
    margin = SHADOW_PX + 1
    end = min(int(used[-1]) + 1 + margin, counted.shape[1])
    return slice(max(int(used[0]) - margin, 0), end)


def _is_highlight(
    pair: ImagePair,
    mean_texture: NDArray[np.floating],
    exposure: float,
    part: tuple[slice, slice],
) -> Bools:
    """True where photograph or image is brighter than the mean texture."""
    shown = np.fmax(*(luminance(np.asarray(x)[part]) for x in (pair.photograph, pair.relit)))
    matt = luminance(np.asarray(mean_texture)[part])
    above: Bools = (shown > HIGHLIGHT_FACTOR * matt) & (
        exposure * (shown - matt) > HIGHLIGHT_LEVEL
    )
    return above


def _guided_kinds(
    guides: SurfaceGuides, bright: Bools, near_outline: Bools, inner: slice
) -> Kinds:
    """Kinds of the inner rows of a strip: the last kind first, so that the first prevails."""
    kinds = np.full(bright.shape, REST, np.uint8)
    kinds[~guides.lit[inner]] = SHADOW
    kinds[guides.view_cosine[inner] < GRAZING_COSINE] = GRAZING
    kinds[texture_edges(guides)[inner]] = TEXTURE_EDGE
    kinds[bright] = HIGHLIGHT
    kinds[shadow_edges(guides)[inner]] = SHADOW_EDGE
    kinds[near_outline | ~guides.hit[inner]] = SILHOUETTE
    return kinds


def shadow_edges(guides: SurfaceGuides) -> Bools:
    """Pixels within `SHADOW_PX` of the border of a shadow, (h, w) bool."""
    clear = guides.hit & (guides.light_cosine > LEAST_SHADOW_COSINE)
    beside = beside_differences(
        lambda a, b: (guides.lit[a] != guides.lit[b]) & clear[a] & clear[b], clear.shape
    )
    return np.asarray(binary_dilation(beside, iterations=SHADOW_PX - 1))


def texture_edges(guides: SurfaceGuides) -> Bools:
    """Pixels beside one of another albedo, (h, w) bool."""
    albedo = guides.albedo

    def differ(a: tuple[slice, slice], b: tuple[slice, slice]) -> Bools:
        brighter = np.maximum(albedo[a], albedo[b])
        contrast = np.abs(albedo[a] - albedo[b]) > TEXTURE_CONTRAST * brighter
        return np.asarray(contrast & guides.hit[a] & guides.hit[b])

    return beside_differences(differ, albedo.shape)


def beside_differences(differ: Any, shape: tuple[int, ...]) -> Bools:
    """True at both pixels of all pairs of neighbours that differ, (h, w) bool.

    Parameters
    ----------
    differ : callable
        Takes the parts of the image that hold the first and the second of each pair.
    shape : (int, int)
        Of the image.

    Examples
    --------
    >>> row = np.array([[0, 0, 1, 1]])
    >>> beside_differences(lambda a, b: row[a] != row[b], row.shape)
    array([[False,  True,  True, False]])
    """
    beside = np.zeros(shape, np.bool_)
    whole, first, second = slice(None), slice(None, -1), slice(1, None)
    for a, b in (((whole, first), (whole, second)), ((first, whole), (second, whole))):
        different = differ(a, b)
        beside[a] |= different
        beside[b] |= different
    return beside


def errors_by_kind(pair: ImagePair, kinds: Kinds, exposure: float) -> KindErrors:
    """Squared errors of an image, by the kinds of its pixels.

    Parameters
    ----------
    pair : ImagePair
    kinds : (h, w) uint8
        As `KindFinder.kinds` finds them.
    exposure : float
        Of the comparison.

    Returns
    -------
    KindErrors
    """
    total = KindErrors.none()
    for own, _, _ in strips(*kinds.shape):
        here = kinds[own]
        measured = here != NO_KIND
        if measured.any():
            first, second = (
                display(image[measured], exposure) for image in without_backdrop(pair, own)
            )
            squares = ((second - first) ** 2).sum(axis=1)
            total += KindErrors(
                np.bincount(here[measured], minlength=len(KINDS)).astype(np.int64),
                np.bincount(here[measured], squares, len(KINDS)).astype(np.float64),
            )
    return total
