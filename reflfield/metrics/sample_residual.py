"""How far a finished field is from the samples that it was made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.color_spaces import LUMINANCE
from reflfield.capture.encoding import encode_srgb
from reflfield.capture.lights import facing_irradiance
from reflfield.errors import InputError
from reflfield.field.evaluation import evaluate
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.metrics.image_errors import psnr
from reflfield.observations.texel_reading import TexelReader

Floats = NDArray[np.float32]

# Enough for two digits of the error; more only take time.
MOST_SAMPLES = 500_000
BLOCK_BYTES = 64 << 20


@dataclass(frozen=True)
class SampleError:
    r"""Relative error :math:`\|x - y\| / \|y\|` of a field on its samples.

    Parameters
    ----------
    linear, cube_root : float
        Of the samples, and of their cube roots, in which dark samples count too.
    psnr_ldr : float
        Of the radiance that the samples stand for, sRGB-coded after one exposure, as
        photographs are compared, dB.
    n_texels, n_samples : int
        Measured on.
    """

    linear: float
    cube_root: float
    psnr_ldr: float
    n_texels: int
    n_samples: int


def sample_error(
    field: ReflectanceField,
    reader: TexelReader,
    texels: NDArray[np.intp],
    most_samples: int = MOST_SAMPLES,
) -> SampleError:
    """Error of a field on the observed samples of texels, as stored: quantised.

    Parameters
    ----------
    field : ReflectanceField
    reader : TexelReader
        Of the samples that it was made of; its frames do not matter.
    texels : (k,) int
        Texels with samples, ascending. Evenly thinned to about `most_samples` samples.
    most_samples : int

    Returns
    -------
    SampleError

    Raises
    ------
    InputError
        If there is no texel.
    """
    if not len(texels):
        raise InputError("texels: expected texels with samples, received none")
    each = reader.store.observed.count() / len(texels)
    n = int(np.clip(most_samples // max(each, 1.0), 1, len(texels)))
    chosen = texels[np.linspace(0, len(texels) - 1, n).astype(np.intp)]
    step = max(1, BLOCK_BYTES // reader.sample_bytes_per_texel)
    blocks = [chosen[first : first + step] for first in range(0, n, step)]
    parts = [_radiances(field, reader, block) for block in blocks]
    measured, predicted, irradiance = (
        np.concatenate(part) for part in zip(*parts, strict=True)
    )
    values = ~np.isnan(measured)
    pair = predicted[values], measured[values]
    return SampleError(
        linear=_relative(*pair),
        cube_root=_relative(*(np.cbrt(value) for value in pair)),
        psnr_ldr=_psnr_ldr(predicted * irradiance, measured * irradiance),
        n_texels=n,
        n_samples=int(np.count_nonzero(values.any(axis=1))),
    )


def _radiances(
    field: ReflectanceField, reader: TexelReader, texels: NDArray[np.intp]
) -> tuple[Floats, Floats, Floats]:
    """Observed samples of some texels, the field's, and the irradiance they are over.

    Values that were not measured are NaN.
    """
    measured = reader.measured(texels)
    t, photograph = np.nonzero(measured.seen)
    i, j = measured.pairs.view[photograph], measured.pairs.light[photograph]
    irradiance = facing_irradiance(reader.capture.lights, reader.positions[texels])
    return (
        measured.samples[t, photograph].astype(np.float32) * np.float32(measured.unit),
        evaluate(field, texels[t], measured.views[t, i], measured.lights[t, j]),
        irradiance[t, j],
    )


def _relative(predicted: Floats, measured: Floats) -> float:
    rest = np.sum(np.square(predicted - measured, dtype=np.float64))
    size = np.sum(np.square(measured, dtype=np.float64))
    return float(np.sqrt(rest / max(float(size), 1e-300)))


def _psnr_ldr(predicted: Floats, measured: Floats) -> float:
    white = float(np.percentile(np.nan_to_num(measured) @ LUMINANCE, 99.5))
    exposure = 1.0 / white if white > 0 else 1.0
    known = ~np.isnan(measured)
    shown = [
        encode_srgb(np.clip(exposure * values[known], 0.0, 1.0))
        for values in (measured, predicted)
    ]
    return psnr(*shown)
