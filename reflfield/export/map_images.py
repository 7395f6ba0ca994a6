r"""Fitted maps as the images that Blender's Principled BSDF and OpenPBR read, and their mesh.

Both have one roughness and one stretch of highlights, each by its own formula; what they are
made from are the two widths of the fit, :math:`\alpha_t` and :math:`\alpha_b`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import decode_srgb, encode_srgb
from reflfield.capture.image_writing import write_png
from reflfield.export.material_maps import MaterialMaps

Doubles = NDArray[np.float64]
Images = dict[str, NDArray[np.uint8]]

# Smallest ratio of the widths that Blender's anisotropy reaches.
_BLENDER_LEAST_RATIO = 0.1


def widths(maps: MaterialMaps) -> tuple[Doubles, Doubles]:
    """Widths of highlights along and across their stretch, (height, width) each."""
    across = np.maximum((maps.metallic_roughness[..., 1] / 255.0) ** 2, 1e-4)
    along = across + (1.0 - across) * (maps.anisotropy[..., 2] / 255.0) ** 2
    return along, across


def stretch_turns(maps: MaterialMaps) -> Doubles:
    """Stretch as turns about the normal from the tangent, counter-clockwise, 0 to 0.5."""
    x, y = np.moveaxis(maps.anisotropy[..., :2] / 127.5 - 1.0, -1, 0)
    y = np.where(maps.mirrored, -y, y)
    return np.mod(np.arctan2(y, x) / (2.0 * np.pi), 0.5)


def _bytes(values: Doubles) -> NDArray[np.uint8]:
    return np.rint(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)


def _common(maps: MaterialMaps) -> Images:
    return {
        "base_colour": maps.base_colour,
        "metallic": maps.metallic_roughness[..., 2],
        "normal": maps.normal,
        "rotation": _bytes(stretch_turns(maps)),
    }


def principled_images(maps: MaterialMaps) -> Images:
    r"""Images for Blender's Principled BSDF, version 4.

    There :math:`\alpha_{t,b} = r^2 a^{\mp 1}` with :math:`a^2 = 1 - 0.9\,\mathrm{anisotropic}`.
    """
    along, across = widths(maps)
    ratio = np.maximum(across / along, _BLENDER_LEAST_RATIO)
    return _common(maps) | {
        "roughness": _bytes((along * across) ** 0.25),
        "anisotropic": _bytes((1.0 - ratio) / (1.0 - _BLENDER_LEAST_RATIO)),
        "specular_tint": maps.specular[..., :3],
        "specular_level": maps.specular[..., 3],
    }


def openpbr_images(maps: MaterialMaps) -> Images:
    r"""Images for OpenPBR.

    There :math:`\alpha_b = (1 - \mathrm{anisotropy})\,\alpha_t` and
    :math:`r^4 = (\alpha_t^2 + \alpha_b^2) / 2`. Weight and colour of the specular reflection
    are of metals, too: where metal prevails they are white.
    """
    along, across = widths(maps)
    tint = np.asarray(decode_srgb(maps.specular[..., :3] / 255.0)) * maps.specular_factor
    f0 = tint * (maps.specular[..., 3:] / 255.0)
    is_metal = maps.metallic_roughness[..., 2:] > 127
    f0 = np.where(is_metal, 1.0, f0)
    weight = f0.max(axis=2)
    colour = f0 / np.maximum(weight, 1e-6)[..., None]
    return _common(maps) | {
        "roughness": _bytes(((along**2 + across**2) / 2.0) ** 0.25),
        "anisotropy": _bytes(1.0 - across / along),
        "specular_colour": _bytes(np.asarray(encode_srgb(colour))),
        "specular_weight": _bytes(weight / maps.specular_factor),
    }


def write_images(folder: Path, images: Images) -> None:
    """Write each image as a PNG file of its name."""
    for name, image in images.items():
        write_png(folder / f"{name}.png", np.ascontiguousarray(image))
