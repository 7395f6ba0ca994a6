r"""Fit of mean, basis and coefficients to the samples themselves.

Aligned texels of one cluster see one reflectance from many directions. Instead of
resampling each texel and fitting the result, the model

.. math:: u_{tij} = \sum_{n \in T_i} \sum_{m \in T_j} a_{in} b_{jm}
          \Big( M_{nm} + \sum_k c_{tk} B_{k,nm} \Big)

is fitted to all samples u (transformed) of all texels at once: T and a, b are the taps and
weights of a sample's view and light. Mean M and basis B of every cluster follow by
conjugate gradients on the regularised normal equations, coefficients c by a small solve
per texel with a Gaussian prior; the two alternate.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.field.basis import BasisProblem
from reflfield.field.clustered_model import ClusteredModel, normalised
from reflfield.field.coefficients import solve_coefficients
from reflfield.observations.texel_samples import TransformedSamples
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import report
from reflfield.util.validation import check_ranges

Reader = Callable[[NDArray[np.intp]], TransformedSamples]

# Largest values of options; beyond them a run takes days, or no machine holds the tables.
MOST = {"rounds": 1000, "iterations": 10_000, "max_bytes": 1 << 40, "grid_refinement": 16}


@dataclass(frozen=True)
class SampleFitOptions:
    """Effort and regularisation of the fit to the samples.

    Parameters
    ----------
    rounds : int
        Alternations of basis and coefficients.
    iterations : int
        Conjugate gradient steps of each basis solve.
    smoothness : float
        Weight of squared differences between neighbouring nodes against one sample at
        each node.
    frame_spread_deg : float
        Standard deviation about each axis that the aligned frames are taken to have: half
        way through the rounds they are improved against the model, held by that much.
        0 keeps them.
    grid_refinement : float
        Intervals between nodes in the second half of the rounds over those of the grid of the
        resampling (`field.clustered_model`). 1 keeps that grid.
    max_bytes : int
        Samples of the texels that shape the basis are held in memory up to this size;
        coefficients are found for all texels, block by block.
    """

    rounds: int = 4
    iterations: int = 12
    smoothness: float = 0.05
    frame_spread_deg: float = 1.0
    grid_refinement: float = 4 / 3
    max_bytes: int = 192 << 20

    def __post_init__(self) -> None:
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                raise InputError(
                    f"{name}: expected at least 1 and at most {most}, "
                    f"received {getattr(self, name)}"
                )
        check_ranges(self, {"smoothness": (0, 1e6), "frame_spread_deg": (0, 180)})

    def halves(self) -> tuple[SampleFitOptions, SampleFitOptions]:
        """Rounds before and after the frames are improved, one at least of each.

        Examples
        --------
        >>> [half.rounds for half in SampleFitOptions(rounds=5).halves()]
        [2, 3]
        """
        first = max(1, self.rounds // 2)
        return replace(self, rounds=first), replace(self, rounds=max(1, self.rounds - first))


def fit_basis(
    read: Reader,
    initial: ClusteredModel,
    observed: NDArray[np.intp],
    bytes_per_texel: int,
    options: SampleFitOptions,
    *,
    workers: int = 1,
    seed: int = 0,
) -> ClusteredModel:
    """Fit mean and basis to the samples of as many texels as fit in memory.

    Parameters
    ----------
    read : callable
        From texel indices to their `TransformedSamples` in the aligned frames.
    initial : ClusteredModel
        Clusters, coefficients, mean and basis to start from (grid fit).
    observed : (k,) int
        Texels that have samples.
    bytes_per_texel : int
        Memory that `read` needs for one texel.
    options : SampleFitOptions
    workers : int
        Threads; the result does not depend on it.
    seed : int
        Chooses the texels that shape the basis.

    Returns
    -------
    ClusteredModel
        With `residuals` of every round. Coefficients of texels that did not shape the basis
        are the initial ones; `solve_coefficients` finds them.

    Raises
    ------
    InputError
        If no texel is observed.
    """
    if not len(observed):
        raise InputError("observed: expected texels with samples, received none")
    n_chosen = int(np.clip(options.max_bytes // bytes_per_texel, 256, len(observed)))
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.choice(observed, min(n_chosen, len(observed)), replace=False))
    with thread_pool(workers) as pool:
        return _alternate(read(chosen), initial, chosen, options, pool)


def _alternate(
    samples: TransformedSamples,
    model: ClusteredModel,
    chosen: NDArray[np.intp],
    options: SampleFitOptions,
    pool: ThreadPoolExecutor,
) -> ClusteredModel:
    """Alternate between basis and coefficients of the chosen texels."""
    cluster = model.cluster[chosen]
    for done in range(options.rounds):
        report("fitting the basis to the samples", done, options.rounds)
        problem = BasisProblem(
            samples, cluster, model.coefficients[chosen], options.smoothness, pool
        )
        model = replace(model, table=problem.solve(model.table, options.iterations))
        solved, squares = solve_coefficients(samples, cluster, model, pool)
        noise = float(squares[:, 0].sum() / max(squares[:, 1].sum(), 1e-30))
        coefficients = model.coefficients.copy()
        coefficients[chosen] = solved
        model = replace(
            model,
            coefficients=coefficients,
            residuals=(*model.residuals, float(np.sqrt(noise))),
        )
        model = normalised(model, noise, chosen)
    report("fitting the basis to the samples", options.rounds, options.rounds)
    return model
