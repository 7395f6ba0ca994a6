"""How far two images are apart, pixel by pixel."""

from __future__ import annotations

import math
from collections.abc import Iterator

import flip_evaluator
import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.metrics import structural_similarity

Image = NDArray[np.float64]

# A 0.7 m wide screen of 3840 pixels seen from 0.7 m, FLIP's own default.
PIXELS_PER_DEGREE = 0.7 * (3840 / 0.7) * math.pi / 180
# Equal images have no error and an infinite PSNR, which JSON cannot hold and
# no mean survives. 100 dB is an error of 1e-5 of the peak, below half floats.
PSNR_CAP_DB = 100.0
# skimage's default window; smaller only for images that it does not fit into.
SSIM_WINDOW_PX = 7
# Pixels of an image that are looked at together; a measure takes 500 bytes of each.
PIXELS_AT_ONCE = 1 << 19
# Rows beside a strip that its measures look at: FLIP's filters reach 10 pixels.
HALO_PX = 32


def strips(height: int, width: int) -> Iterator[tuple[slice, slice, slice]]:
    """Cut an image into strips with some rows beside them, so that memory is bounded.

    Yields
    ------
    own, wide, inner : slice
        Rows of the strip; those with the rows beside it; and the strip's own among these.

    Examples
    --------
    >>> list(strips(10, 10))
    [(slice(0, 10, None), slice(0, 10, None), slice(0, 10, None))]
    """
    n_rows = max(HALO_PX, PIXELS_AT_ONCE // max(width, 1))
    for first in range(0, height, n_rows):
        end = min(first + n_rows, height)
        low, high = max(first - HALO_PX, 0), min(end + HALO_PX, height)
        yield slice(first, end), slice(low, high), slice(first - low, end - low)


def psnr(reference: ArrayLike, test: ArrayLike) -> float:
    r"""Peak signal-to-noise ratio for peak 1, :math:`-10 \log_{10} \mathrm{MSE}`, dB.

    At most `PSNR_CAP_DB`, which equal images get.

    Examples
    --------
    >>> psnr([0.5, 0.5], [0.6, 0.4])
    20.0
    >>> psnr([0.5], [0.5])
    100.0
    """
    difference = np.asarray(test, dtype=np.float64) - np.asarray(reference, dtype=np.float64)
    return psnr_of_mean_square(float(np.mean(difference**2)))


def psnr_of_mean_square(mean_square: float) -> float:
    """`psnr` of images whose squared differences have this mean, dB.

    Examples
    --------
    >>> psnr_of_mean_square(0.01)
    20.0
    """
    if mean_square <= 10.0 ** (-PSNR_CAP_DB / 10.0):
        return PSNR_CAP_DB
    return -10.0 * math.log10(mean_square)


def ssim_map(reference: Image, test: Image) -> Image:
    """Structural similarity around each pixel, mean over channels.

    Parameters
    ----------
    reference, test : (h, w, 3) float64
        Displayed values in [0, 1].

    Returns
    -------
    (h, w) float64
        1 where equal.

    References
    ----------
    .. [1] Z. Wang, A. Bovik, H. Sheikh, E. Simoncelli, "Image quality
       assessment: from error visibility to structural similarity", IEEE
       Transactions on Image Processing 13(4), 2004.
    """
    # At least 5: smaller images have no object pixels.
    fitting = min(SSIM_WINDOW_PX, *reference.shape[:2])
    window = fitting if fitting % 2 else fitting - 1
    _, similarity = structural_similarity(
        reference, test, win_size=window, data_range=1.0, channel_axis=-1, full=True
    )
    return np.asarray(similarity, dtype=np.float64).mean(axis=-1)


def flip_map(reference: Image, test: Image) -> NDArray[np.float32]:
    """LDR-FLIP error of each pixel, at `PIXELS_PER_DEGREE`.

    Parameters
    ----------
    reference, test : (h, w, 3) float64
        Displayed (sRGB encoded) values in [0, 1].

    Returns
    -------
    (h, w) float32
        0 (not distinguishable) to 1.

    References
    ----------
    .. [1] P. Andersson et al., "FLIP: A Difference Evaluator for Alternating
       Images", Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020.
    """
    error, _, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(reference, dtype=np.float32),
        np.ascontiguousarray(test, dtype=np.float32),
        "LDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={"ppd": PIXELS_PER_DEGREE},
    )
    return np.asarray(error, dtype=np.float32)[..., 0]
