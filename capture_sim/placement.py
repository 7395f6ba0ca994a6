"""Nothing of the dome stands inside the object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from capture_sim.errors import scene_error
from capture_sim.model import Table
from capture_sim.objects import SurfaceMesh
from capture_sim.rays import world_from_camera

Array = NDArray[np.float64]


def check_outside(mesh: SurfaceMesh, cameras: Sequence[Table], lights: Sequence[Table]) -> None:
    """Refuse cameras and lamps that stand inside the object.

    Parameters
    ----------
    mesh : SurfaceMesh
    cameras, lights : sequence of dict
        In the native capture format. Directional lights are at infinity; telecentric
        cameras see what lies before their plane and are checked all the same.

    Raises
    ------
    SceneError
        Names the first one.
    """
    near = [light for light in lights if light["type"] != "directional"]
    for what, items, positions in (
        ("cameras", cameras, [world_from_camera(camera)[:3, 3] for camera in cameras]),
        ("lights", near, [light["position"] for light in near]),
    ):
        inside = np.flatnonzero(is_inside(mesh, np.array(positions, float).reshape(-1, 3)))
        if len(inside):
            first = int(inside[0])
            raise scene_error(
                f"{what} ({items[first]['id']})",
                "a position outside the object",
                f"{np.round(positions[first], 6).tolist()} m, inside {mesh.name}",
                f"change {what}.distance or {what}.target",
            )


def is_inside(mesh: SurfaceMesh, points: Array) -> NDArray[np.bool_]:
    """Tell whether points lie inside a surface, by its winding number.

    Parameters
    ----------
    mesh : SurfaceMesh
        Holes do no harm: the winding number falls off gradually there.
    points : (n, 3) float
        World, metres.

    Returns
    -------
    (n,) bool
        True where the surface surrounds the point more than by half.

    References
    ----------
    A. Jacobson, L. Kavan and O. Sorkine-Hornung, "Robust inside-outside segmentation using
    generalized winding numbers", ACM Transactions on Graphics 32(4), 2013.

    Examples
    --------
    >>> from capture_sim.objects import make_object
    >>> ball = make_object({"preset": "sphere", "radius": 1.0, "around": 16})
    >>> is_inside(ball, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    array([ True, False])
    """
    inside = np.zeros(len(points), dtype=bool)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    close = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    inside[close] = [winding_number(mesh, point) > 0.5 for point in points[close]]
    return inside


def winding_number(mesh: SurfaceMesh, point: Array) -> float:
    r"""Solid angle under which a point sees the surface from behind, over :math:`4\pi`.

    Parameters
    ----------
    mesh : SurfaceMesh
    point : (3,) float

    Returns
    -------
    float
        1 inside a closed surface, 0 outside.

    References
    ----------
    A. van Oosterom and J. Strackee, "The solid angle of a plane triangle", IEEE
    Transactions on Biomedical Engineering 30(2), 1983.
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - point, 1, 0)
    length_a, length_b, length_c = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    triple = np.einsum("nc,nc->n", a, np.cross(b, c))
    denominator = (
        length_a * length_b * length_c
        + np.einsum("nc,nc->n", a, b) * length_c
        + np.einsum("nc,nc->n", b, c) * length_a
        + np.einsum("nc,nc->n", c, a) * length_b
    )
    return float(2.0 * np.arctan2(triple, denominator).sum() / (4.0 * np.pi))
