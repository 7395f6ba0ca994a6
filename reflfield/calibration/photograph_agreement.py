"""How much photographs from several views differ on a surface: a test of poses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.color_spaces import LUMINANCE
from reflfield.checking.photograph_statistics import PhotographSet, reduced
from reflfield.checking.shading_fit import nanmedian
from reflfield.checking.surface_samples import SurfaceSamples, sample_surface
from reflfield.geometry.mesh import Mesh

Float32 = NDArray[np.float32]

# Pixels of the longer side of photographs that are compared, and views under one light that
# are enough.
LONGEST_SIDE, FEWEST_VIEWS = 1024, 5
# Luminance that counts as dark, as a share of a photograph's largest.
DARK = 1e-3


def photographs_differ(capture: Capture, mesh: Mesh) -> float:
    """Median difference of the logarithms of luminance of points, from view to view.

    Of photographs of one light, where enough views have one, with a gain for each. Where poses
    are wrong, the same point shows other details in each view.

    Parameters
    ----------
    capture : Capture
    mesh : Mesh
        The hull with the poses of the capture.

    Returns
    -------
    float
        0 where no point is seen by two views.

    Raises
    ------
    CaptureError
        If a photograph cannot be read.
    """
    unlit = replace(capture, lights=(), photographs=())
    nothing_read = PhotographSet({}, {}, {})
    samples = sample_surface(unlit, mesh, nothing_read, range(capture.n_views))
    logs = np.array([_logs(capture, samples, i) for i in _compared(capture)])
    if not logs.size:
        return 0.0
    logs[:, np.isfinite(logs).sum(axis=0) < 2] = np.nan
    for _ in range(3):
        logs -= np.nan_to_num(nanmedian(logs - nanmedian(logs, axis=0), axis=1))[:, None]
    differences = np.abs(logs - nanmedian(logs, axis=0))
    known = np.isfinite(differences)
    return float(np.median(differences[known])) if known.any() else 0.0


def _compared(capture: Capture) -> list[int]:
    """A photograph of each view, all of one light where enough views have that."""
    index = capture.photograph_index
    if not index.size:
        return []
    usual = index[:, (index >= 0).sum(axis=0).argmax()]
    if (usual >= 0).sum() >= min(FEWEST_VIEWS, capture.n_views):
        return [int(i) for i in usual if i >= 0]
    return [int(row[row >= 0][0]) for row in index if (row >= 0).any()]


def _logs(capture: Capture, samples: SurfaceSamples, index: int) -> NDArray[np.float64]:
    """Logarithms (n,) of the luminance of points in a photograph; NaN where not seen."""
    view = capture.photographs[index].camera
    bright = reduced(capture.read_photograph(index) @ LUMINANCE, LONGEST_SIDE)
    size = np.array(bright.shape[1::-1], np.float32)
    x, y = (np.clip(samples.places[view], -1, 2) * size - np.float32(0.5)).T
    values = cv2.remap(
        np.ascontiguousarray(bright, np.float32), x.copy(), y.copy(), cv2.INTER_LINEAR
    ).ravel()
    shown = samples.seen[view] & (values > DARK * bright.max())
    return np.where(shown, np.log(np.maximum(values, 1e-30)), np.nan).astype(np.float64)
