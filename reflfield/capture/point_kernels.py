"""Compiled loops over points: their directions to cameras and lights, and their pixels."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def unit_towards(points: Any, places: Any, are_points: Any, least: float, out: Any) -> None:
    """`capture.directions.directions_towards`; `out` is (n, n_targets, 3)."""
    for i in range(len(points)):
        for j in range(len(places)):
            x, y, z = places[j, 0], places[j, 1], places[j, 2]
            if are_points[j]:
                x, y, z = x - points[i, 0], y - points[i, 1], z - points[i, 2]
                length = max(math.sqrt(x * x + y * y + z * z), least)
                x, y, z = x / length, y / length, z / length
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = x, y, z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def irradiance_of_points(
    points: Any, places: Any, intensities: Any, fall_off: Any, least: float, out: Any
) -> None:
    """Irradiance (n, n_lights, 3) of surfaces that face point lights, or constant ones.

    Those that do not fall off with the distance, 1/d^2, have their intensity everywhere.
    """
    for i in range(len(points)):
        for j in range(len(places)):
            share = 1.0
            if fall_off[j]:
                x, y, z = (
                    places[j, 0] - points[i, 0],
                    places[j, 1] - points[i, 1],
                    places[j, 2] - points[i, 2],
                )
                share = 1.0 / max(x * x + y * y + z * z, least * least)
            for c in range(3):
                out[i, j, c] = share * intensities[j, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project_straight(points: Any, pose: Any, matrix: Any, pixels: Any, depth: Any) -> None:
    """Pixels of points in a perspective camera that keeps lines straight.

    Parameters
    ----------
    points : (n, 3) float64
    pose : (4, 4) float64
        Camera from world.
    matrix : (3, 3) float64
        Of the intrinsics.
    pixels : (n, 2) float64
        NaN at or behind the camera.
    depth : (n,) float64
    """
    for i in range(len(points)):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
        y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
        z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
        depth[i] = z
        if z > 0.0:
            # A point almost in the camera's own plane overflows to inf: it is off the image.
            x, y = x / z, y / z
            pixels[i, 0] = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]
            pixels[i, 1] = matrix[1, 1] * y + matrix[1, 2]
        else:
            pixels[i, 0] = pixels[i, 1] = np.nan
