r"""Means and basis functions of all clusters as one factored, quantised array.

Function f of cluster c is a table over view nodes, light nodes and channels. All of them share
factors over views, lights, channels and functions (a Tucker decomposition, by higher-order
SVD), and what is stored beside the factors is their core, nearly diagonal in energy:

.. math:: T_{f,v,l,c} = g_f \sum_{p,a,b,d} F_{fp}\, A_{va}\, B_{lb}\, D_{cd}\, K_{pabd}.

The gains :math:`1 / g_f` weigh each function by what the texels make of it, so that one
step for all of the core, and for the texels' coefficients, spends bits where they save most
(at high rate the slope of error over bits is the same for every number then: reverse
water-filling). Errors are fed back: the core is solved against the factors as they will be
read, the coefficients against the functions as they will be read, and each coefficient makes
up for the rounding of those before it (`lattice_codes`).

References
----------
L. De Lathauwer, B. De Moor, J. Vandewalle, "A multilinear singular value decomposition", SIAM
J. Matrix Anal. Appl. 21, 2000. L. Babai, "On Lovász' lattice reduction and the nearest lattice
point problem", Combinatorica 6, 1986.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.quantisation import smallest_codes

Floats = NDArray[np.float64]

FACTORS = ("function", "view", "light")
# Magnitudes below this share of a step above the next code are rounded down: zeros are cheap.
DEADZONE = 0.6
# A function that no texel uses still has this weight, and none more than the largest.
LARGEST_WEIGHT = 4096.0


def factor_table(table: NDArray[np.floating], weights: Floats, step: float) -> dict[str, Any]:
    """Factor and quantise the functions of all clusters.

    Parameters
    ----------
    table : (n_clusters, n_functions, n_view_nodes, n_light_nodes, 3) float
        The mean of each cluster, then its basis.
    weights : (n_clusters, n_functions) float64
        Root of the sum over texels of their squared factors for each function.
    step : float
        Quantisation step of a coefficient, in root mean square over the nodes.

    Returns
    -------
    dict of str to ndarray
        Arrays of `field.model.ARRAYS` that `unfactor_table` reads.

    Examples
    --------
    >>> table = np.ones((1, 1, 4, 9, 3))
    >>> arrays = factor_table(table, np.ones((1, 1)), 1e-3)
    >>> arrays["core"].shape, bool(abs(unfactor_table(arrays) - 1).max() < 1e-3)
    ((1, 1, 1, 3), True)
    """
    n_clusters, n_functions, n_views, n_lights, _ = table.shape
    gain = np.sqrt(n_views * n_lights * 3.0) / np.clip(weights, 1.0, LARGEST_WEIGHT)
    gain = gain.astype(np.float32)
    core = table.reshape(-1, n_views, n_lights, 3) / gain.reshape(-1, 1, 1, 1)
    core = core.astype(np.float64)
    colour = _axes(core, 3, 0.0)[0].astype(np.float32)
    core = core @ np.linalg.pinv(colour.astype(np.float64)).T
    arrays: dict[str, Any] = {"function_gain": gain, "colour_factor": colour}
    for axis, name in enumerate(FACTORS):
        codes, scale = _quantised_axes(*_axes(core, axis, step), step)
        core = _along(core, axis, np.linalg.pinv(codes * scale.astype(np.float64)))
        arrays[f"{name}_factor"], arrays[f"{name}_scale"] = codes, scale
    arrays["core"] = _rounded(core / step)
    arrays["core_scale"] = np.array([step], np.float32)
    _drop_empty(arrays)
    factor = arrays["function_factor"]
    arrays["function_factor"] = factor.reshape(n_clusters, n_functions, factor.shape[1])
    return {name: smallest_codes(array) for name, array in arrays.items()}


def unfactor_table(arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """Functions of all clusters, (n_clusters, n_functions, n_view_nodes, n_light_nodes, 3)."""
    core = arrays["core"].astype(np.float32) * arrays["core_scale"]
    core = core @ arrays["colour_factor"].T
    for axis, name in reversed(tuple(enumerate(FACTORS))):
        codes = arrays[f"{name}_factor"]
        factor = codes.reshape(-1, codes.shape[-1]) * arrays[f"{name}_scale"]
        core = _along(core, axis, factor.astype(np.float32))
    gain = arrays["function_gain"]
    return core.reshape(*gain.shape, *core.shape[1:]) * gain[:, :, None, None, None]


def _along(values: NDArray[Any], axis: int, matrix: NDArray[Any]) -> NDArray[Any]:
    """Apply a matrix along one axis."""
    return np.moveaxis(np.tensordot(matrix, values, axes=(1, axis)), 0, axis)


def _axes(core: Floats, axis: int, step: float) -> tuple[Floats, Floats]:
    """Principal directions along an axis and their energies, strongest first.

    Those whose whole energy is below half a step would have no code but zero.
    """
    unfolded = np.moveaxis(core, axis, 0).reshape(core.shape[axis], -1)
    energy, vectors = np.linalg.eigh(unfolded @ unfolded.T)
    energy, vectors = np.maximum(energy[::-1], 0.0), vectors[:, ::-1]
    n_kept = max(int(np.count_nonzero(energy >= (0.5 * step) ** 2)), 1)
    return vectors[:, :n_kept], energy[:n_kept]


def _quantised_axes(
    vectors: Floats, energy: Floats, step: float
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Codes whose error, times the energy that they carry, is that of the core."""
    scale = step / np.maximum(np.sqrt(energy), step)
    # No coarser than a quarter, so that directions stay apart.
    scale = np.minimum(scale, 0.25 / np.sqrt(len(vectors))).astype(np.float32)
    return np.rint(vectors / scale).astype(np.int32), scale


def _rounded(ratio: Floats) -> NDArray[np.int32]:
    """Nearest codes, towards zero in doubt."""
    magnitude = np.floor(np.abs(ratio) + (1.0 - DEADZONE))
    limit = float(np.iinfo(np.int32).max)
    return (np.sign(ratio) * np.minimum(magnitude, limit)).astype(np.int32)


def _drop_empty(arrays: dict[str, Any]) -> None:
    """Leave out directions of which the core holds nothing, one at least kept."""
    for axis, name in enumerate(FACTORS):
        others = tuple(i for i in range(4) if i != axis)
        used = np.any(arrays["core"] != 0, axis=others)
        used[0] = True
        arrays["core"] = np.compress(used, arrays["core"], axis=axis)
        arrays[f"{name}_factor"] = arrays[f"{name}_factor"][:, used]
        arrays[f"{name}_scale"] = arrays[f"{name}_scale"][used]
