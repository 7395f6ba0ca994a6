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
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.sphere.hemisphere import softened_cosine_of
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

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)
_HALF_SCALE = np.float32(0.5 * (HALF_SIDE - 1))
_DIFFERENCE_SCALE = np.float32((N_DIFFERENCE - 1) / (np.pi / 2))
_LAYER = HALF_SIDE * HALF_SIDE
# What the compiler may do to sums; NaN, which marks values not measured, stays NaN.
FAST = {"reassoc", "contract", "arcp", "nsz"}


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
    """

    n_lobes: int | Literal["auto"] = "auto"
    image_steps: int = 2
    surface_from_normals: bool = True
    smoothness: float = 3e-4

    def __post_init__(self) -> None:
        check_ranges(self, {"image_steps": (0, 20), "smoothness": (1e-9, 1e3)})
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


# Kernel helpers are typed by numba; to mypy their scalars are Any.


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _cell(position: Any, n_nodes: int) -> Any:
    """Lower node and share of the upper one."""
    lower = min(max(int(position), 0), n_nodes - 2)
    return lower, min(max(position - np.float32(lower), _ZERO), _ONE)


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def half_taps(frame: Any, view: Any, light: Any) -> Any:
    """Where a pair of directions stands in the tables.

    Returns
    -------
    lobe taps : (int, float, float, float, int, float, float)
        First node and the shares along h_x, h_y and the difference angle; first node of the
        skew, share along its rings, and the cosine of twice the difference azimuth.
    diffuse taps : (int, float, float, float)
        First node and the shares along light, view and phase.
    cosine, spread : float
        s and V of the module's formula.
    """
    lx = frame[0, 0] * light[0] + frame[0, 1] * light[1] + frame[0, 2] * light[2]
    ly = frame[1, 0] * light[0] + frame[1, 1] * light[1] + frame[1, 2] * light[2]
    lz = frame[2, 0] * light[0] + frame[2, 1] * light[1] + frame[2, 2] * light[2]
    vx = frame[0, 0] * view[0] + frame[0, 1] * view[1] + frame[0, 2] * view[2]
    vy = frame[1, 0] * view[0] + frame[1, 1] * view[1] + frame[1, 2] * view[2]
    vz = frame[2, 0] * view[0] + frame[2, 1] * view[1] + frame[2, 2] * view[2]
    hx, hy, hz = lx + vx, ly + vy, lz + vz
    scale = _ONE / np.sqrt(hx * hx + hy * hy + hz * hz + np.float32(1e-12))
    hx, hy, hz = hx * scale, hy * scale, max(hz * scale, _ZERO)
    sine2 = hx * hx + hy * hy
    cos_difference = min(max(lx * hx + ly * hy + lz * hz, _ZERO), _ONE)
    radius = np.arcsinh(np.arccos(min(hz, _ONE)) / KNEE) / REACH
    across = radius / (np.sqrt(sine2) + np.float32(1e-12))
    column, fx = _cell((hx * across + _ONE) * _HALF_SCALE, HALF_SIDE)
    row, fy = _cell((hy * across + _ONE) * _HALF_SCALE, HALF_SIDE)
    layer, fd = _cell(np.arccos(cos_difference) * _DIFFERENCE_SCALE, N_DIFFERENCE)
    ring, fr = _cell(radius * np.float32(SKEW_RINGS - 1), SKEW_RINGS)
    # l_z - v_z is 2 sin(theta_h) sin(theta_d) cos(phi_d).
    sines2 = sine2 * (_ONE - cos_difference * cos_difference)
    turn = (lz - vz) * (lz - vz) / (np.float32(2.0) * sines2 + np.float32(1e-12)) - _ONE
    cos_light, cos_view = min(max(lz, _ZERO), _ONE), min(max(vz, LEAST_COSINE), _ONE)
    i, gl = _cell(cos_light * np.float32(N_LIGHT - 1), N_LIGHT)
    j, gv = _cell(cos_view * np.float32(N_VIEW - 1), N_VIEW)
    k, gp = _cell((_ONE - cos_difference) * np.float32(N_PHASE - 1), N_PHASE)
    raised = max(cos_light, LEAST_COSINE)
    return (
        (
            (layer * HALF_SIDE + row) * HALF_SIDE + column,
            fx,
            fy,
            fd,
            layer * SKEW_RINGS + ring,
            fr,
            min(turn, _ONE),
        ),
        ((k * N_VIEW + j) * N_LIGHT + i, gl, gv, gp),
        np.float32(softened_cosine_of(lz)),
        _ONE / (raised + cos_view - raised * cos_view),
    )


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def lobe_tap(m: int, taps: Any) -> Any:
    """Node and weight of corner m of 8 of `half_taps`' lobe taps."""
    first, fx, fy, fd, _, _, _ = taps
    weight = (fx if m & 1 else _ONE - fx) * (fy if m & 2 else _ONE - fy)
    weight *= fd if m & 4 else _ONE - fd
    return first + (m & 1) + ((m >> 1) & 1) * HALF_SIDE + (m >> 2) * _LAYER, weight


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def diffuse_tap(m: int, taps: Any) -> Any:
    """Node and weight of corner m of 8 of `half_taps`' diffuse taps."""
    first, gl, gv, gp = taps
    weight = (gl if m & 1 else _ONE - gl) * (gv if m & 2 else _ONE - gv)
    weight *= gp if m & 4 else _ONE - gp
    return first + (m & 1) + ((m >> 1) & 1) * N_LIGHT + (m >> 2) * (N_LIGHT * N_VIEW), weight


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def diffuse_value(table: Any, taps: Any) -> Any:
    """Diffuse table, interpolated."""
    total = _ZERO
    for m in range(8):
        node, weight = diffuse_tap(m, taps)
        total += weight * table[node]
    return total


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def skew_tap(m: int, taps: Any) -> Any:
    """Node and weight of corner m of 4 of `half_taps`' lobe taps in a skew."""
    _, _, _, fd, node, fr, _ = taps
    weight = (fr if m & 1 else _ONE - fr) * (fd if m & 2 else _ONE - fd)
    return node + (m & 1) + (m >> 1) * SKEW_RINGS, weight


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def skewed(skew: Any, taps: Any, c: int) -> Any:
    """What the difference azimuth makes of one channel of a lobe, as a factor."""
    total = _ZERO
    for m in range(4):
        node, weight = skew_tap(m, taps)
        total += weight * skew[node, c]
    return _ONE + total * taps[6]


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def lobe_values(lobes: Any, taps: Any, factor: Any, out: Any) -> None:
    """Lobes, interpolated and times a factor, into `out` (K, 3)."""
    nodes, skews = lobes
    out[:] = _ZERO
    for m in range(8):
        node, weight = lobe_tap(m, taps)
        weight *= factor
        for k in range(nodes.shape[0]):
            for c in range(3):
                out[k, c] += weight * nodes[k, node, c]
    for k in range(nodes.shape[0]):
        for c in range(3):
            out[k, c] *= skewed(skews[k], taps, c)


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def add_sample(
    frame: Any, view: Any, light: Any, diffuse: Any, weights: Any, tables: Any, out: Any
) -> None:
    """Sample of one texel for one pair of directions, added to `out` (3,)."""
    taps, diffuse_taps, cosine, spread = half_taps(frame, view, light)
    if cosine == _ZERO:
        return
    (nodes, skews), table = tables
    base = cosine * diffuse_value(table, diffuse_taps)
    for c in range(3):
        out[c] += base * diffuse[c]
    for k in range(nodes.shape[0]):
        red = green = blue = _ZERO
        for m in range(8):
            node, weight = lobe_tap(m, taps)
            red += weight * nodes[k, node, 0]
            green += weight * nodes[k, node, 1]
            blue += weight * nodes[k, node, 2]
        factor = cosine * spread * weights[k]
        out[0] += factor * red * skewed(skews[k], taps, 0)
        out[1] += factor * green * skewed(skews[k], taps, 1)
        out[2] += factor * blue * skewed(skews[k], taps, 2)


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def rotated(frame: Any, axis: int, angle: Any, out: Any) -> None:
    """Frame rotated about one of its own axes, into `out`."""
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    for d in range(3):
        out[axis, d] = frame[axis, d]
        out[i, d] = c * frame[i, d] - s * frame[j, d]
        out[j, d] = s * frame[i, d] + c * frame[j, d]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def evaluate_half_vector(
    frames: Floats,
    diffuse: Floats,
    weights: Floats,
    lobes: tuple[Floats, Floats],
    table: Floats,
    texels: NDArray[np.int32],
    views: Floats,
    lights: Floats,
    out: Floats,
) -> None:
    """Samples of texels, each for a pair of directions, added to `out` (n, 3)."""
    for i in range(len(texels)):
        t = texels[i]
        if t >= 0:
            add_sample(
                frames[t], views[i], lights[i], diffuse[t], weights[t], (lobes, table), out[i]
            )


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def sum_half_vector_lights(
    frames: Floats,
    diffuse: Floats,
    weights: Floats,
    lobes: tuple[Floats, Floats],
    table: Floats,
    texels: NDArray[np.int32],
    views: Floats,
    lights: Floats,
    irradiances: Floats,
    lit: NDArray[np.bool_],
    out: Floats,
) -> None:
    """Radiance of texels under lights that all share, added to `out` (n, 3)."""
    sample = np.zeros(3, np.float32)
    for i in range(len(texels)):
        t = texels[i]
        if t < 0:
            continue
        for j in range(len(lights)):
            if not lit[i % len(lit), j]:
                continue
            sample[:] = _ZERO
            add_sample(
                frames[t], views[i], lights[j], diffuse[t], weights[t], (lobes, table), sample
            )
            for c in range(3):
                out[i, c] += irradiances[j, c] * sample[c]
