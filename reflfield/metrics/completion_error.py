"""Error of the samples filled in, against the true apparent BRDFs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError, ShapeError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CompletionError:
    r"""Relative error :math:`\|x - t\| / \|t\|` of completed samples.

    Attributes
    ----------
    unobserved, observed : float
        Over entries that were filled in, and over those that were measured;
        nan if there is none.
    unobserved_cube_root, observed_cube_root : float
        The same after the cube root, in which dark samples count too.
    n_unobserved, n_observed : int
        Entries of either kind.
    """

    unobserved: float
    observed: float
    unobserved_cube_root: float
    observed_cube_root: float
    n_unobserved: int
    n_observed: int


def completion_error(
    completed: ArrayLike, true: ArrayLike, observed: ArrayLike
) -> CompletionError:
    """Error of filled-in samples against the true apparent BRDFs.

    Parameters
    ----------
    completed, true : (...) array_like
        Linear samples on the same directions. Entries whose truth is not finite
        are left out.
    observed : (...) array_like of bool
        True where the sample was measured. May lack trailing axes (colour).

    Returns
    -------
    CompletionError

    Raises
    ------
    ShapeError
        If the shapes do not agree.
    InputError
        If a completed entry is not finite although its truth is.

    Examples
    --------
    The one unobserved entry is 1 instead of 2:

    >>> e = completion_error([[4.0, 1.0]], [[4.0, 2.0]], [[True, False]])
    >>> e.unobserved, e.observed
    (0.5, 0.0)
    """
    filled, truth = (np.asarray(a, dtype=np.float64) for a in (completed, true))
    seen = np.asarray(observed, dtype=bool)
    if filled.shape != truth.shape or filled.shape[: seen.ndim] != seen.shape:
        raise ShapeError(
            f"completed, true, observed: expected one shape, received {filled.shape}, "
            f"{truth.shape}, {seen.shape}"
        )
    seen = np.broadcast_to(
        seen.reshape(seen.shape + (1,) * (filled.ndim - seen.ndim)),
        filled.shape,
    )
    known = np.isfinite(truth)
    if not np.isfinite(filled[known]).all():
        raise InputError("completed: expected finite samples, received NaN or infinity")
    hidden, measured = known & ~seen, known & seen
    return CompletionError(
        unobserved=_relative_error(filled[hidden], truth[hidden]),
        observed=_relative_error(filled[measured], truth[measured]),
        unobserved_cube_root=_relative_error(np.cbrt(filled[hidden]), np.cbrt(truth[hidden])),
        observed_cube_root=_relative_error(np.cbrt(filled[measured]), np.cbrt(truth[measured])),
        n_unobserved=int(hidden.sum()),
        n_observed=int(measured.sum()),
    )


def _relative_error(filled: Array, truth: Array) -> float:
    size = float(np.linalg.norm(truth))
    return float(np.linalg.norm(filled - truth)) / size if size > 0.0 else math.nan
