"""How far a finished field is from the samples that it was made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.field.evaluation import evaluate
from reflfield.field.model import ReflectanceField
from reflfield.observations.reading import TexelReader

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
    n_texels, n_samples : int
        Measured on.
    """

    linear: float
    cube_root: float
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
    total = np.sum([_squares(field, reader, block) for block in blocks], axis=0)
    linear, cube_root = np.sqrt(total[:2] / np.maximum(total[2:4], 1e-300))
    return SampleError(float(linear), float(cube_root), n, int(total[4]))


def _squares(
    field: ReflectanceField, reader: TexelReader, texels: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Squared errors (linear, cube root), squared samples likewise, count of samples."""
    found = reader.measured(texels)
    seen = found.view_seen[:, :, None] & found.light_seen[:, None] & found.pairs
    t, i, j = np.nonzero(seen)
    measured = found.samples[t, i, j].astype(np.float64)
    predicted = evaluate(field, texels[t], found.views[t, i], found.lights[t, j])
    sums = []
    for a, b in ((predicted, measured), (np.cbrt(predicted), np.cbrt(measured))):
        sums.append((np.sum((a - b) ** 2), np.sum(b**2)))
    (rest, size), (rest_root, size_root) = sums
    return np.array([rest, rest_root, size, size_root, len(t)])
