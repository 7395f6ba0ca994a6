r"""EM imputation below the horizon: what lies there is unseen, not dark.

Coefficients of samples are formed as if the functions were zero below the base
horizon. A tilted texel is cut there although its reflectance goes on, which draws
the correlation back towards the base frame by about a tenth of the tilt. So what is unseen
is taken from the target, alternating with the rotations (expectation maximisation with the
unseen part as the hidden data): with the expected function :math:`p = s\,\Delta(R)\,c` and U
the operator from a function to the coefficients of its samples above the horizon,

.. math:: a' = a + p - (U_v \otimes U_l)\, p, \qquad
    s = \frac{\langle a, (U_v \otimes U_l)\,\Delta(R)\,c\rangle}
             {\lVert (U_v \otimes U_l)\,\Delta(R)\,c \rVert^2}.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.expectation_maximisation import (
    TargetFit,
    ascend_near,
    mean_targets,
    mean_weights,
)
from reflfield.alignment.rotation_search import SearchOptions, SearchResult, map_blocks
from reflfield.sphere.coupling import Coupled, couple, join_coupled, rotate_coupled, uncouple
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.wigner import rotation_blocks

BLOCK = 256
# One step a round: the imputed part moves on meanwhile.
ASCENT_STEPS = 1
# Texels whose frames rotated less than this in one round have converged, radians.
CONVERGED = np.deg2rad(0.05)
# Functions whose imputed part is held at once: 64 MB at a band limit of 8.
FUNCTIONS_AT_ONCE = 4096


@dataclass(frozen=True, eq=False)
class Horizon:
    """Operators from a function to the coefficients of its samples above the base horizon.

    Parameters
    ----------
    view, light : (band_limit**2, band_limit**2) float32
    """

    view: NDArray[np.float32]
    light: NDArray[np.float32]

    @classmethod
    def of(cls, projector: Projector) -> Horizon:
        """Operators of a projector's directions."""
        view, light = projector.round_trips()
        return cls(view.astype(np.float32), light.astype(np.float32))

    def seen(self, coupled: Coupled) -> Coupled:
        """Coefficients that the samples of some functions above the horizon would have."""
        coefficients = uncouple(coupled)
        n, n_view, n_light = coefficients.shape
        half = coefficients.reshape(-1, n_light) @ self.light.T.astype(coupled.dtype)
        view = self.view.astype(coupled.dtype)
        return couple(np.matmul(view, half.reshape(n, n_view, n_light)))

    def imputed(
        self, source: Coupled, target: Coupled, rotations: NDArray[np.float64]
    ) -> Coupled:
        """Functions with their unseen part imputed from one target.

        Parameters
        ----------
        source : Coupled
            n functions, formed from samples above the horizon.
        target : Coupled
            One function.
        rotations : (n, 3, 3) float64
            `base_from_local`.

        Returns
        -------
        Coupled
        """
        expected = rotate_coupled(
            target, rotation_blocks(rotations, target.n_degrees, str(target.dtype))
        )
        seen = self.seen(expected)
        power, product = np.zeros(len(source)), np.zeros(len(source))
        for a, b in zip(source.blocks, seen.blocks, strict=True):
            power += np.einsum("nij,nij->n", b, b)
            product += np.einsum("nij,nij->n", a, b)
        # A negative brightness would impute the target's opposite.
        scale = np.maximum(product, 0.0) / np.where(power > 0, power, 1.0)
        factors = scale.astype(source.dtype)[:, None, None]
        parts = zip(source.blocks, expected.blocks, seen.blocks, strict=True)
        return Coupled(source.band_limits, tuple(a + factors * (e - s) for a, e, s in parts))


def impute_and_ascend(
    source: Coupled,
    targets: Coupled,
    matches: SearchResult,
    horizon: Horizon,
    rounds: int,
    options: SearchOptions,
) -> SearchResult:
    """Rotations and scores of functions imputed below the horizon; labels stay.

    Parameters
    ----------
    source : Coupled
        n functions.
    targets : Coupled
        One per cluster.
    matches : SearchResult
        Where to begin.
    horizon : Horizon
    rounds : int
        Of imputation and ascent at most; a function stops when its frame has converged.
    options : SearchOptions

    Returns
    -------
    SearchResult
        Margins as before.
    """
    rotations, score = matches.rotations.copy(), matches.score.copy()
    alive = np.flatnonzero(matches.score > 0)
    for first in range(0, len(alive), FUNCTIONS_AT_ONCE):
        moving = alive[first : first + FUNCTIONS_AT_ONCE]
        for _ in range(rounds):
            now = replace(
                matches,
                rotations=rotations[moving],
                score=score[moving],
                cluster=matches.cluster[moving],
            )
            imputed = _imputed(source[moving], targets, now, horizon, options)
            moved = ascend_near(imputed, targets, now, ASCENT_STEPS, options)
            rotations[moving], score[moving] = moved.rotations, moved.score
            chord = np.linalg.norm(moved.rotations - now.rotations, axis=(1, 2))
            moving = moving[chord > np.sqrt(2.0) * CONVERGED]
            if len(moving) == 0:
                break
    return replace(matches, rotations=rotations, score=score)


def impute_targets(
    source: Coupled,
    fit: TargetFit,
    horizon: Horizon,
    rounds: int,
    options: SearchOptions,
) -> TargetFit:
    """Targets as means of the imputed functions, alternating with the rotations.

    Parameters
    ----------
    source : Coupled
        The functions that `fit` was made from.
    fit : TargetFit
    horizon : Horizon
    rounds : int
        At most; ends when the correlation of the imputed functions falls.
    options : SearchOptions

    Returns
    -------
    TargetFit
    """
    weights = mean_weights(source.norms())
    history = list(fit.history)
    targets, matches = fit.targets, fit.matches
    for _ in range(rounds):
        imputed = _imputed(source, targets, matches, horizon, options)
        moved = ascend_near(imputed, targets, matches, ASCENT_STEPS, options)
        score = float(weights @ moved.score / max(weights.sum(), 1e-300))
        if history and score < history[-1]:
            break
        history.append(score)
        matches = moved
        targets = mean_targets(imputed, weights, matches, len(targets))
    return TargetFit(targets, matches, np.array(history))


def _imputed(
    source: Coupled,
    targets: Coupled,
    matches: SearchResult,
    horizon: Horizon,
    options: SearchOptions,
) -> Coupled:
    """Unit functions, each imputed from its cluster's target."""

    def block(rows: slice) -> Coupled:
        part, label = source[rows], matches.cluster[rows]
        blocks = tuple(b.copy() for b in part.blocks)
        for k in np.unique(label):
            mine = np.flatnonzero(label == k)
            rotations = matches.rotations[rows][mine]
            imputed = horizon.imputed(part[mine], targets[k : k + 1], rotations).units()
            for b, e in zip(blocks, imputed.blocks, strict=True):
                b[mine] = e
        return Coupled(source.band_limits, blocks)

    return join_coupled(map_blocks(block, len(source), BLOCK, options["n_threads"]))
