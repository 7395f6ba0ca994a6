"""A sensor whose pixels see one colour each, and the interpolation of the others.

The mosaic is RGGB; missing colours are interpolated linearly with gradient correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.model import Scene
from capture_sim.tables import one_of

NAME = "bayer"
STAGE = Stage.SENSOR

Float32 = NDArray[np.float32]

# H. S. Malvar, L. He and R. Cutler, 2004, figure 2; eighths.
_GREEN_AT_OTHERS = np.array(
    [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]],
    np.float32,
) / np.float32(8.0)
_ALONG_ROW = np.array(
    [
        [0, 0, 0.5, 0, 0],
        [0, -1, 0, -1, 0],
        [-1, 4, 5, 4, -1],
        [0, -1, 0, -1, 0],
        [0, 0, 0.5, 0, 0],
    ],
    np.float32,
) / np.float32(8.0)
_ALONG_COLUMN = np.ascontiguousarray(_ALONG_ROW.T)
_ACROSS = np.array(
    [
        [0, 0, -1.5, 0, 0],
        [0, 2, 0, 2, 0],
        [-1.5, 0, 6, 0, -1.5],
        [0, 2, 0, 2, 0],
        [0, 0, -1.5, 0, 0],
    ],
    np.float32,
) / np.float32(8.0)


@dataclass(frozen=True)
class Options:
    """Kind of interpolation.

    Attributes
    ----------
    demosaicing : str
        ``"malvar"``, or ``"bilinear"``: the mean of the nearest pixels of a colour.
    """

    demosaicing: str = one_of("malvar", "bilinear")


def needed(scene: Scene) -> Decision:
    """Tell whether the sensor has a mosaic; interpolation may miss an edge altogether."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("pixels see all colours: no [effects.bayer]", 0.0)
    reason = f"two of three values are interpolated ({options.demosaicing})"
    return Decision(reason, scene.brightness.headroom)


def cost(scene: Scene, work: Workload) -> Cost:
    """Four filters of 13 taps for each pixel."""
    del scene
    return Cost(operations=4 * 13 * work.n_pixels * work.n_lights)


def mosaic(values: Float32) -> Float32:
    """What the pixels of the sensor see: red and green in even rows, green and blue in odd.

    Parameters
    ----------
    values : (h, w, 3) float32

    Returns
    -------
    (h, w) float32

    Examples
    --------
    >>> mosaic(np.broadcast_to(np.float32([1, 2, 3]), (2, 2, 3)))
    array([[1., 2.],
           [2., 3.]], dtype=float32)
    """
    seen = values[..., 1].copy()
    seen[::2, ::2] = values[::2, ::2, 0]
    seen[1::2, 1::2] = values[1::2, 1::2, 2]
    return seen


def apply(seen: Float32, scene: Scene) -> Float32:
    """Interpolate the colours that each pixel does not see.

    Parameters
    ----------
    seen : (h, w) float32
        From `mosaic`.
    scene : Scene
        Gives the kind of interpolation.

    Returns
    -------
    (h, w, 3) float32

    References
    ----------
    H. S. Malvar, L. He and R. Cutler, "High-quality linear interpolation for demosaicing
    of Bayer-patterned color images", ICASSP 2004.
    """
    if scene.effects.get(Options).demosaicing == "bilinear":
        return bilinear(seen)
    return malvar(seen)


def malvar(seen: Float32) -> Float32:
    """Linear interpolation corrected by the gradient of the colour that is seen.

    Parameters
    ----------
    seen : (h, w) float32

    Returns
    -------
    (h, w, 3) float32

    Examples
    --------
    What is constant or linear in the image is reproduced:

    >>> ramp = np.repeat(np.arange(8, dtype=np.float32)[None, :, None], 8, 0).repeat(3, 2)
    >>> bool(np.allclose(malvar(mosaic(ramp))[2:-2, 2:-2], ramp[2:-2, 2:-2]))
    True
    """
    green, row, column, across = (
        _filtered(seen, kernel)
        for kernel in (_GREEN_AT_OTHERS, _ALONG_ROW, _ALONG_COLUMN, _ACROSS)
    )
    image = np.stack([seen, seen, seen], axis=2)
    image[::2, ::2, 1], image[1::2, 1::2, 1] = green[::2, ::2], green[1::2, 1::2]
    # Red stands beside green in even rows and above it in odd ones; blue the other way.
    image[::2, 1::2, 0], image[1::2, ::2, 0] = row[::2, 1::2], column[1::2, ::2]
    image[1::2, ::2, 2], image[::2, 1::2, 2] = row[1::2, ::2], column[::2, 1::2]
    image[1::2, 1::2, 0], image[::2, ::2, 2] = across[1::2, 1::2], across[::2, ::2]
    return image


def bilinear(seen: Float32) -> Float32:
    """Mean of the nearest pixels that see a colour.

    Parameters
    ----------
    seen : (h, w) float32

    Returns
    -------
    (h, w, 3) float32
    """
    planes = np.zeros((*seen.shape, 3), np.float32)
    planes[::2, ::2, 0] = seen[::2, ::2]
    planes[::2, 1::2, 1], planes[1::2, ::2, 1] = seen[::2, 1::2], seen[1::2, ::2]
    planes[1::2, 1::2, 2] = seen[1::2, 1::2]
    corner = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], np.float32) / np.float32(4.0)
    cross = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], np.float32) / np.float32(4.0)
    filtered = [
        _filtered(planes[..., c], kernel) for c, kernel in enumerate((corner, cross, corner))
    ]
    return np.stack(filtered, axis=2)


def _filtered(seen: Float32, kernel: Float32) -> Float32:
    # Reflection about the border pixel keeps the mosaic's order of colours.
    image = np.ascontiguousarray(seen)
    return np.asarray(
        cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT_101)
    )
