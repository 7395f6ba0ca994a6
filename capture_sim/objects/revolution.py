"""Surfaces of revolution and tubes: sphere, vase, handles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline

from capture_sim.errors import scene_error
from capture_sim.objects.mesh import (
    Array,
    SurfaceMesh,
    check_size,
    fan,
    grid_faces,
    joined,
    unit,
    without_slivers,
)
from capture_sim.tables import TableReader

# Control points (radius, height) of a vase of height 1: foot, belly, shoulder, neck, lip.
VASE_OUTSIDE = np.array(
    [
        [0.000, 0.000],
        [0.060, 0.000],
        [0.140, 0.000],
        [0.185, 0.000],
        [0.198, 0.016],
        [0.180, 0.036],
        [0.140, 0.050],
        [0.160, 0.090],
        [0.250, 0.190],
        [0.325, 0.340],
        [0.340, 0.490],
        [0.290, 0.640],
        [0.175, 0.730],
        [0.112, 0.800],
        [0.104, 0.870],
        [0.140, 0.935],
        [0.196, 0.968],
        [0.204, 0.986],
        [0.190, 1.000],
    ]
)
# A lid that closes the mouth in one gentle dome, so that a visual hull can hold it.
VASE_LID = np.array([[0.150, 1.002], [0.100, 1.020], [0.050, 1.026], [0.000, 1.026]])
# The inside of an open vase, down to its floor.
VASE_INSIDE = np.array(
    [
        [0.172, 0.986],
        [0.122, 0.925],
        [0.088, 0.870],
        [0.096, 0.800],
        [0.160, 0.715],
        [0.270, 0.620],
        [0.318, 0.490],
        [0.303, 0.350],
        [0.228, 0.205],
        [0.130, 0.090],
        [0.060, 0.070],
        [0.000, 0.070],
    ]
)
# The same of a bowl of radius 1: from the foot outside up to the lip, and down inside.
BOWL_OUTSIDE = np.array(
    [
        [0.00, 0.00],
        [0.15, 0.00],
        [0.40, 0.00],
        [0.62, 0.04],
        [0.85, 0.25],
        [0.97, 0.50],
        [1.00, 0.75],
        [0.985, 0.79],
    ]
)
BOWL_INSIDE = np.array(
    [
        [0.95, 0.79],
        [0.93, 0.75],
        [0.90, 0.52],
        [0.78, 0.31],
        [0.57, 0.12],
        [0.38, 0.08],
        [0.15, 0.08],
        [0.00, 0.08],
    ]
)
# Control points of a handle from shoulder to neck; both ends lie inside the body.
HANDLE = np.array(
    [
        [0.24, 0.56],
        [0.33, 0.58],
        [0.43, 0.66],
        [0.43, 0.80],
        [0.32, 0.92],
        [0.17, 0.90],
        [0.06, 0.88],
    ]
)
HANDLE_RADIUS = 0.022


def revolve(profile: Array, slopes: Array, around: int, name: str) -> SurfaceMesh:
    """Surface of revolution about +Z.

    Parameters
    ----------
    profile : (n, 2) float64
        Radius and height from the bottom to the top, outside to the right.
    slopes : (n, 2) float64
        Direction of the profile at each of its points.
    around : int
        Facets around the axis.
    name : str
        Name of the mesh.

    Returns
    -------
    SurfaceMesh
        u runs once around (a seam at the +X side), v along the profile by length.
        At the axis, tangents are kept per facet and normals follow the profile.

    Examples
    --------
    An open cylinder of height 1:

    >>> sides = np.array([[1.0, 0.0], [1.0, 1.0]])
    >>> up = np.array([[0.0, 1.0], [0.0, 1.0]])
    >>> revolve(sides, up, 4, "cylinder").normals[0]
    array([1., 0., 0.])
    """
    azimuth = np.linspace(0.0, 2.0 * np.pi, around + 1)
    c, s = np.cos(azimuth), np.sin(azimuth)
    c[-1], s[-1] = c[0], s[0]  # the seam closes exactly
    radius, height = profile[:, :1], profile[:, 1:]
    vertices = np.stack([radius * c, radius * s, height + 0.0 * c], axis=-1)
    across = unit(slopes)
    normal_out, normal_up = across[:, 1:], -across[:, :1]
    normals = np.stack([normal_out * c, normal_out * s, normal_up + 0.0 * c], axis=-1)
    tangents = np.stack(np.broadcast_arrays(-s, c, np.zeros_like(height)), axis=-1)
    steps = np.linalg.norm(np.diff(profile, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    u, v = np.meshgrid(azimuth / (2.0 * np.pi), length)
    flat = vertices.reshape(-1, 3)
    return SurfaceMesh(
        vertices=flat,
        faces=without_slivers(flat, grid_faces(len(profile), around + 1)),
        uv=np.stack([u.ravel(), v.ravel()], axis=1),
        normals=normals.reshape(-1, 3),
        tangents=tangents.reshape(-1, 3).copy(),
        name=name,
    )


def sphere(reader: TableReader, folder: Path) -> SurfaceMesh:
    """Sphere about the origin."""
    radius = reader.number("radius", 0.1, low=1e-6, high=1e3)
    around = reader.count("around", 192, low=8, high=4096)
    check_size("a sphere", around**2)
    angle = np.linspace(-np.pi / 2.0, np.pi / 2.0, around // 2 + 1)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    directions[[0, -1], 0] = 0.0  # exactly on the axis
    slopes = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    ball = revolve(radius * directions, slopes, around, "sphere")
    return SurfaceMesh(
        ball.vertices, ball.faces, ball.uv, ball.normals, ball.tangents, True, name="sphere"
    )


def vase(reader: TableReader, folder: Path) -> SurfaceMesh:
    """Vase, with or without handles, closed by a lid or open."""
    height = reader.number("height", 0.2, low=1e-4, high=1e3)
    n_handles = reader.count("handles", 0, low=0, high=2)
    is_open = reader.flag("open", False)
    around = reader.count("around", 192, low=8, high=4096)
    along = reader.count("along", 192, low=16, high=4096)
    if is_open and n_handles:
        raise scene_error(
            reader.name("open"),
            "false for a vase with handles",
            "true",
            "the handles would come through the wall; choose one",
        )
    check_size("a vase", 2 * around * along)
    corners = np.concatenate([VASE_OUTSIDE, VASE_INSIDE if is_open else VASE_LID])
    profile, slopes = smooth_curve(corners, along)
    body = revolve(height * profile, slopes, around, "vase")
    handles = [_handle(height, side, around // 4) for side in (1.0, -1.0)[:n_handles]]
    return joined([body, *handles], "vase")


def bowl(reader: TableReader, folder: Path) -> SurfaceMesh:
    """Open bowl with a rounded lip."""
    radius = reader.number("radius", 0.08, low=1e-4, high=1e3)
    around = reader.count("around", 192, low=8, high=4096)
    along = reader.count("along", 160, low=16, high=4096)
    check_size("a bowl", 2 * around * along)
    profile, slopes = smooth_curve(np.concatenate([BOWL_OUTSIDE, BOWL_INSIDE]), along)
    return revolve(radius * profile, slopes, around, "bowl")


def smooth_curve(control: Array, n_steps: int) -> tuple[Array, Array]:
    """Points and unit directions along a curve near control points.

    Parameters
    ----------
    control : (m, 2) float64
        At least 4 control points of a clamped uniform cubic B-spline: smooth to the
        second derivative, from the first to the last point, within their hull.
    n_steps : int
        Steps along the curve.

    Returns
    -------
    points, directions : (n_steps + 1, 2) float64

    Examples
    --------
    >>> line = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0], [0.0, 3.0]])
    >>> smooth_curve(line, 2)[0][:, 1]
    array([0. , 1.5, 3. ])
    """
    n_spans = len(control) - 3
    knots = np.concatenate([[0.0] * 3, np.arange(n_spans + 1.0), [float(n_spans)] * 3])
    curve = BSpline(knots, control, 3)
    places = np.linspace(0.0, n_spans, n_steps + 1)
    return np.asarray(curve(places)), unit(np.asarray(curve.derivative()(places)))


def _handle(height: float, side: float, around: int) -> SurfaceMesh:
    """Round tube on the +X or -X side of a vase."""
    points, slopes = smooth_curve(HANDLE * [side, 1.0], 64)
    spine, along = np.insert(height * points, 1, 0.0, axis=1), np.insert(slopes, 1, 0.0, axis=1)
    return sweep(spine, along, HANDLE_RADIUS * height, max(around, 12))


def sweep(spine: Array, along: Array, radius: float, around: int) -> SurfaceMesh:
    """Round tube about a curve in a plane that holds +Z and is orthogonal to +Y.

    Parameters
    ----------
    spine, along : (n, 3) float64
        Points of the curve and its unit directions, y = 0.
    radius : float
        Metres.
    around : int
        Facets around the tube.

    Returns
    -------
    SurfaceMesh
        u along the curve, v around it; both ends are closed by flat discs.

    Examples
    --------
    >>> straight = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    >>> tube = sweep(straight, np.array([[0.0, 0.0, 1.0]] * 2), 0.5, 16)
    >>> np.ptp(tube.vertices, axis=0)
    array([1., 1., 1.])
    """
    angle = np.linspace(0.0, 2.0 * np.pi, around + 1)
    sideways = np.array([0.0, 1.0, 0.0])
    outward = np.cross(sideways, along)
    rim = np.cos(angle)[:, None, None] * outward - np.sin(angle)[:, None, None] * sideways
    rim[-1] = rim[0]
    u, v = np.meshgrid(np.linspace(0.0, 1.0, len(spine)), angle / (2.0 * np.pi))
    tube = SurfaceMesh(
        vertices=(spine + radius * rim).reshape(-1, 3),
        faces=grid_faces(around + 1, len(spine)),
        uv=np.stack([u.ravel(), v.ravel()], axis=1),
        normals=rim.reshape(-1, 3).copy(),
        tangents=np.tile(along, (around + 1, 1)),
    )
    ends = [
        fan(spine[end] + radius * rim[:-1, end], sign * along[end], outward[end])
        for end, sign in ((0, -1.0), (-1, 1.0))
    ]
    return joined([tube, *ends], "tube")
