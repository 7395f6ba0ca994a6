"""A field in memory whose texels have one colour each, on the surface of another field."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from reflfield.field.reflectance_field import ReflectanceField
from reflfield.sphere.hemisphere import softened_cosine
from reflfield.util.validation import check_shape

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TextureField(ReflectanceField):
    """Field of one colour per texel, the same from all sides; made by the functions below.

    It lives in memory only; no file holds one.

    Parameters
    ----------
    colours : (n_texels, 3) float32
        Not negative: what a texel sends back, 1/sr, without the light's cosine if there are
        `normals`.
    normals : (n_texels, 3) float32, optional
        Unit normals of a matt field; None if the colours do not depend on the light.
    """

    model: ClassVar[str] = "texture"
    colours: Floats = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    normals: Floats | None = None

    def decode(self) -> None:
        """Nothing is encoded but what all fields share."""

    @property
    def light_nodes(self) -> int:
        """Numbers that a sum over lights keeps of each texel and channel."""
        return 1

    @property
    def usual_root(self) -> float:
        """Root mean square of the transformed colours."""
        roots = self.colours.astype(np.float64) ** (1.0 / self.inverse_power)
        return float(np.sqrt(np.mean(np.square(roots))))

    @property
    def counts(self) -> dict[str, int]:
        """Sizes of the model, by name."""
        return {"texels": len(self.colours)}

    @property
    def parts(self) -> dict[str, NDArray[np.floating]]:
        """Parts of the model, by name."""
        return {"colours": self.colours}

    @property
    def decoded_bytes(self) -> int:
        """Memory of colours and normals."""
        return 24 * len(self.colours)

    def cosines(self, texels: NDArray[np.integer], lights: Floats) -> Floats:
        """Cosines (n, ...) of the light over texels (n,), for lights (n, ..., 3) or (m, 3).

        1 without `normals`.
        """
        if self.normals is None:
            return np.ones(lights.shape[:-1], np.float32)
        return softened_cosine(np.einsum("nd,n...d->n...", self.normals[texels], lights))


def apparent_texture(of: ReflectanceField, samples: NDArray[np.floating]) -> TextureField:
    """Field that shows given samples to all sides and under all lights.

    Parameters
    ----------
    of : ReflectanceField
        Whose surface and texels it has.
    samples : (n_texels, 3) float
        1/sr; radiance under an unknown light. Negative ones count as zero.

    Returns
    -------
    TextureField
        Without traced shadows: what there is of them is in the samples.

    Raises
    ------
    ShapeError
        If there is not one sample for each texel.
    """
    check_shape("samples", samples, (of.n_texels, 3))
    return TextureField(
        arrays=of.arrays,
        domain=of.domain,
        light_model=of.light_model,
        metadata=of.metadata,
        colours=np.maximum(samples, 0).astype(np.float32),
    )


def lambertian_texture(
    of: ReflectanceField, albedo: NDArray[np.floating], normals: NDArray[np.floating]
) -> TextureField:
    """Matt field with the shadows, and the light in them, of another.

    Parameters
    ----------
    of : ReflectanceField
        Whose surface, texels, shadows and indirect light it has.
    albedo : (n_texels, 3) float
        Over pi, 1/sr: the sample is this times the cosine of the light. Of a field of unknown
        light, the radiance.
    normals : (n_texels, 3) float
        Unit normals.

    Returns
    -------
    TextureField

    Raises
    ------
    ShapeError
        If a shape is wrong.
    """
    check_shape("normals", normals, (of.n_texels, 3))
    return replace(
        apparent_texture(of, albedo),
        visibility=of.visibility,
        normals=np.asarray(normals, np.float32) if of.light_model == "known" else None,
    )
