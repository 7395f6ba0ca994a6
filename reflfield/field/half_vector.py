r"""Reflectance by functions of the half vector, which all texels share.

The sample of texel x for view v and light l in its frame, with h their half vector and
:math:`\theta_d` the angle between h and l, is

.. math:: f_c = s(n \cdot l) \Big( a_c(x)\, B(n \cdot l, n \cdot v, 1 - \cos\theta_d)
          + V \sum_k S_k(x)\, T_{k,c}(h, \theta_d)
          \big(1 + K_{k,c}(\theta_h, \theta_d) \cos 2\phi_d\big) \Big),

* s the cosine of the light, rounded at the horizon (`sphere.hemisphere.softened_cosine`);
* a the diffuse colour and S the weights of the lobes, all non-negative, of the texel;
* B a table of 6 x 6 x 4 nodes with mean 1, T tables of 33 x 33 nodes of h and 6 of
  :math:`\theta_d` for each colour channel, all multilinear;
* K a table of 6 rings of :math:`\theta_h` and 6 nodes of :math:`\theta_d`, 0 where one of them
  is 0: how the lobe depends on the difference azimuth :math:`\phi_d` between the planes of h
  and n and of h and l, on which two directions differ that have one h and one
  :math:`\theta_d`. Measured paints and foils need it: without it their highlights are a fifth
  too dark, with it the error of a table of a single such BRDF falls to a third.
* V = 1 / (l + v - l v) with the cosines l and v of light and view, at least .05: it flattens
  the tables and is no model of anything.

The nodes of h stand on a square; its radius is asinh(theta_h / 4 degrees), 1 at 90 degrees, its
direction that of (h_x, h_y), so that rings lie close together where highlights are narrow.

References
----------
S. Rusinkiewicz, "A new change of variables for efficient BRDF representation", EGWR 1998.
J. Lawrence et al., "Inverse shade trees for non-parametric material representation and
editing", SIGGRAPH 2006.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from reflfield.util.validation import check_ranges, check_shape

Floats = NDArray[np.float32]

# Nodes of a lobe: along each axis of the half vector's square, and of the difference angle.
HALF_SIDE, N_DIFFERENCE = 33, 6
LOBE_NODES = N_DIFFERENCE * HALF_SIDE * HALF_SIDE
# Nodes of the diffuse table: cosines of light and view, and 1 - cos(difference angle).
N_LIGHT, N_VIEW, N_PHASE = 6, 6, 4
DIFFUSE_NODES = N_PHASE * N_VIEW * N_LIGHT
# Nodes of a lobe's skew: rings of the half vector's angle for each difference angle. Its bound
# keeps samples above zero.
SKEW_RINGS, LARGEST_SKEW = 6, np.float32(0.95)
SKEW_NODES = N_DIFFERENCE * SKEW_RINGS
# Of the codes in which skews are stored.
SKEW_STEP = np.float32(1 / 127)
# Where the radius changes from linear to logarithmic, radians.
KNEE = np.float32(np.radians(4.0))
REACH = np.float32(np.arcsinh(np.pi / 2 / np.radians(4.0)))
# Least cosine that the visibility factor and the diffuse table are read at.
LEAST_COSINE = np.float32(0.05)


@dataclass(frozen=True)
class HalfVectorOptions:
    """How the half-vector model is fitted.

    Parameters
    ----------
    n_lobes : int or "auto"
        Functions of the half vector that all texels share, 1 to 4; "auto": the fewest that
        show samples of views left out as well as more would.
    image_steps : int
        Gauss-Newton steps on the photographs themselves, where a pixel is the weighted sum of
        the texels under it; 0 keeps the fit to the texels' samples.
    surface_from_normals : bool
        Move the hull so that it has the normals that are fitted to the photographs, and fit
        again on the new surface. Needs steps on the photographs.
    smoothness : float
        Of the lobes, relative to what the samples weigh.
    photographs : int
        Of dense domes only some of the lights make the field, spread evenly over their
        directions, so that about so many photographs do: a texel has some ten numbers and is
        seen by thousands. Not fewer than 32 lights; 0 takes all photographs.
    """

    n_lobes: int | Literal["auto"] = "auto"
    image_steps: int = 2
    surface_from_normals: bool = True
    smoothness: float = 3e-4
    photographs: int = 6000

    def __post_init__(self) -> None:
        check_ranges(
            self,
            {"image_steps": (0, 20), "smoothness": (1e-9, 1e3), "photographs": (0, 1 << 30)},
        )
        if self.n_lobes != "auto":
            check_ranges(self, {"n_lobes": (1, 4)})

    @property
    def moves_surface(self) -> bool:
        """Whether a surface is made from normals: those of the photographs, not of samples."""
        return self.surface_from_normals and self.image_steps > 0


@dataclass(frozen=True, eq=False)
class HalfVectorModel:
    """Frames and coefficients of texels, with the tables that they share.

    Parameters
    ----------
    frames : (n_texels, 3, 3) float32
        Local from world.
    diffuse : (n_texels, 3) float32
        Diffuse colour, 1/sr, not negative.
    weights : (n_texels, K) float32
        Of the lobes, not negative.
    lobes : (K, LOBE_NODES, 3) float32
        1/sr, not negative; nodes in the order (difference angle, h_y, h_x).
    skews : (K, SKEW_NODES, 3) float32
        Between -1 and 1; nodes in the order (difference angle, ring).
    diffuse_table : (DIFFUSE_NODES,) float32
        Mean 1; nodes in the order (phase, view, light).
    """

    frames: Floats
    diffuse: Floats
    weights: Floats
    lobes: Floats
    skews: Floats
    diffuse_table: Floats

    def __post_init__(self) -> None:
        n, k = len(self.frames), len(self.lobes)
        check_shape("frames", self.frames, (n, 3, 3))
        check_shape("diffuse", self.diffuse, (n, 3))
        check_shape("weights", self.weights, (n, k))
        check_shape("lobes", self.lobes, (k, LOBE_NODES, 3))
        check_shape("skews", self.skews, (k, SKEW_NODES, 3))
        check_shape("diffuse_table", self.diffuse_table, (DIFFUSE_NODES,))

    @property
    def n_texels(self) -> int:
        """Number of texels."""
        return len(self.frames)

    @property
    def n_lobes(self) -> int:
        """Number of lobes."""
        return len(self.lobes)

    @property
    def arrays(self) -> tuple[Floats, Floats, Floats, tuple[Floats, Floats], Floats]:
        """All arrays, as kernels take them."""
        lobes = (self.lobes, self.skews)
        return self.frames, self.diffuse, self.weights, lobes, self.diffuse_table


def half_angles() -> NDArray[np.float64]:
    """Angle between half vector and normal at the nodes of a layer, radians, (side, side).

    Examples
    --------
    >>> np.degrees(half_angles()[16, 16:19]).round(2).tolist()
    [0.0, 0.96, 1.98]
    """
    axis = np.linspace(-1.0, 1.0, HALF_SIDE)
    radius = np.hypot(axis[:, None], axis)
    return np.minimum(float(KNEE) * np.sinh(radius * float(REACH)), np.pi / 2)
