r"""Poses of all cameras corrected together so that outlines agree (bundle adjustment).

Minimised over a rotation :math:`\omega_v` and a shift :math:`t_v` of each camera, in its own
axes, is

.. math:: \sum_{pairs} \rho(g^2 / \sigma^2)
          + \sum_v (\omega_v / \sigma_\omega)^2 + (t_v / \sigma_t)^2,

where the gaps :math:`g` of the touching planes are those of `tangent_planes`, in pixels, and
:math:`\rho` is the soft L1 loss. Outlines say nothing of a motion or a scaling of all cameras
together: the last terms keep it at zero, and each camera where nothing contradicts it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix, identity, vstack
from scipy.spatial.transform import Rotation

from reflfield.calibration.tangent_planes import TangentPlanes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Standard deviation of gaps, pixels, that is assumed first, and the least and the largest that
# is taken over from what is then left; and gaps, in those, from which on the loss grows no
# faster than the gap.
USUAL_PX, LEAST_PX, LARGEST_PX = 0.2, 0.05, 2.0
LINEAR_FROM = 3.0
# Expected errors of poses: of rotations, radians, and of positions as a share of the distance
# to the object.
EXPECTED_ROTATION, EXPECTED_SHIFT = np.radians(0.5), 0.004
_STEP = 1e-4  # of the parameters, in expected errors, for derivatives
_MOST_STEPS = 60


@dataclass(frozen=True, eq=False)
class PoseAdjustment:
    """Corrected poses.

    Parameters
    ----------
    camera_from_world : (n_views, 4, 4) float64
    rotations, shifts : (n_views, 3) float64
        Rotation vectors, radians, and translations that were applied in camera axes.
    rms_before, rms_after : float
        Root mean square gap of the touching planes, pixels.
    """

    camera_from_world: Array
    rotations: Array
    shifts: Array
    rms_before: float
    rms_after: float


def adjust_poses(
    planes: TangentPlanes, camera_from_world: Array, distances: Array
) -> PoseAdjustment:
    """Correct the poses of all cameras.

    Parameters
    ----------
    planes : TangentPlanes
    camera_from_world : (n_views, 4, 4) float64
        As described.
    distances : (n_views,) float64
        To the object, in the unit of the poses.

    Notes
    -----
    A pair depends on the poses of its two views alone: derivatives of all pairs by one
    parameter of all first, or all second, views come of one evaluation; the Jacobian has
    twelve numbers a row. Time and memory grow linearly with the pairs.
    """
    problem = _Problem(planes, camera_from_world, distances, USUAL_PX)
    start = np.zeros(6 * len(camera_from_world))
    parameters = problem.solved_from(start)
    left = np.abs(problem.telling_gaps(parameters))
    sigma = float(np.clip(1.4826 * np.median(left), LEAST_PX, LARGEST_PX))
    parameters = replace(problem, sigma=sigma).solved_from(parameters)
    rotations, shifts = problem.corrections(parameters)
    before, after = (problem.telling_gaps(p) for p in (start, parameters))
    return PoseAdjustment(
        problem.poses(parameters),
        rotations,
        shifts,
        float(np.sqrt(np.square(before).mean())),
        float(np.sqrt(np.square(after).mean())),
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """Residuals and derivatives by all parameters, (6 n_views,), in expected errors."""

    planes: TangentPlanes
    described: Array
    distances: Array
    sigma: float

    def solved_from(self, start: Array) -> Array:
        """Parameters of the least sum, from a start."""
        solution = least_squares(
            self.residuals,
            start,
            jac=self.jacobian,
            method="trf",
            tr_solver="lsmr",
            loss="soft_l1",
            f_scale=LINEAR_FROM,
            max_nfev=_MOST_STEPS,
        )
        parameters: Array = solution.x
        return parameters

    def corrections(self, parameters: Array) -> tuple[Array, Array]:
        by_view = parameters.reshape(-1, 6)
        shifts = EXPECTED_SHIFT * self.distances[:, None] * by_view[:, 3:]
        return EXPECTED_ROTATION * by_view[:, :3], shifts

    def poses(self, parameters: Array) -> Array:
        rotations, shifts = self.corrections(parameters)
        correction = np.tile(np.eye(4), (len(shifts), 1, 1))
        correction[:, :3, :3] = Rotation.from_rotvec(rotations).as_matrix()
        correction[:, :3, 3] = shifts
        poses: Array = correction @ self.described
        return poses

    def _gaps(self, of_first: Array, of_second: Array) -> Array:
        planes = self.planes
        first = self.poses(of_first)[planes.first]
        return planes.gaps(first, self.poses(of_second)[planes.second]).ravel()

    def residuals(self, parameters: Array) -> Array:
        return np.concatenate([self._gaps(parameters, parameters) / self.sigma, parameters])

    def telling_gaps(self, parameters: Array) -> Array:
        """Gaps of the planes that tell something, pixels."""
        return self._gaps(parameters, parameters)[self.planes.weight.ravel() > 0]

    def jacobian(self, parameters: Array) -> csr_matrix:
        here = self._gaps(parameters, parameters)
        rows = np.arange(len(here))
        parts: list[tuple[Array, Indices, Indices]] = []
        for number in range(6):
            moved = parameters.copy()
            moved[number::6] += _STEP
            for views, pair in (
                (self.planes.first, (moved, parameters)),
                (self.planes.second, (parameters, moved)),
            ):
                slope = (self._gaps(*pair) - here) / (_STEP * self.sigma)
                parts.append((slope, rows, np.repeat(6 * views + number, 2)))
        slopes, row, column = (np.concatenate(some) for some in zip(*parts, strict=True))
        shape = (len(here), len(parameters))
        of_gaps = csr_matrix((slopes, (row, column)), shape=shape)
        return vstack([of_gaps, identity(len(parameters))]).tocsr()
