"""Compiled loops around rays: how Embree takes them, and depths of meshes without any.

A depth image takes a ray for each pixel, or a triangle for each pixel that it covers: where
straight lines stay straight the latter is several times as fast.
"""

from __future__ import annotations

import math
from typing import Any

import numba

# Pixel centres so near to a triangle's edge, in shares of its area, count as within: rounding
# must not open cracks between neighbours. Products of pixel coordinates below 1e4, of 53 bits,
# are off by less.
WITHIN = 1e-9


@numba.njit(cache=True, nogil=True)
def pack_rays(
    origins: Any, directions: Any, centre: Any, scale: float, rays: Any, skipped: Any
) -> None:
    """Rays (n, 6) in the scene's units; starts far before it are moved along, by `skipped`.

    See `RayScene._rays`.
    """
    for i in range(len(origins)):
        ahead = 0.0
        for d in range(3):
            ahead += (centre[d] - origins[i, d]) * directions[i, d]
        skip = max(ahead - 2.0 * scale, 0.0)
        skipped[i] = skip
        for d in range(3):
            start = origins[i, d] + skip * directions[i, d]
            rays[i, d] = (start - centre[d]) / scale
            rays[i, d + 3] = directions[i, d]


@numba.njit(cache=True, nogil=True)
def draw_nearest(
    vertices: Any, faces: Any, first_row: int, first_column: int, out: Any
) -> None:
    """Nearness of the nearest triangle at the centres of pixels.

    Parameters
    ----------
    vertices : (n, 3) float64
        Column, row, and what is largest of the nearest, which must be linear over a triangle
        in the image: the inverse depth in a perspective one.
    faces : (m, 3) int
    first_row, first_column : int
        Of the part of the image that is drawn.
    out : (height, width) float64
        Written where a triangle is nearer than what is there.
    """
    height, width = out.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, a_near = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        bx, by, cx, cy = vertices[b, 0], vertices[b, 1], vertices[c, 0], vertices[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not (area > 0.0 or area < 0.0):
            continue
        # Clipped before they become whole numbers: vertices may be far off the image.
        low, high = min(ay, by, cy) - first_row - 0.5, max(ay, by, cy) - first_row - 0.5
        top, bottom = math.ceil(max(low, 0.0)), math.floor(min(high, height - 1.0))
        low, high = min(ax, bx, cx) - first_column - 0.5, max(ax, bx, cx) - first_column - 0.5
        left, right = math.ceil(max(low, 0.0)), math.floor(min(high, width - 1.0))
        # Weights of b and c, and how they change along a row.
        b_step, c_step = (cy - ay) / area, (ay - by) / area
        b_slope, c_slope = vertices[b, 2] - a_near, vertices[c, 2] - a_near
        for row in range(int(top), int(bottom) + 1):
            y = row + (first_row + 0.5) - ay
            b_of_row, c_of_row = -y * (cx - ax) / area, y * (bx - ax) / area
            for column in range(int(left), int(right) + 1):
                x = column + (first_column + 0.5) - ax
                of_b, of_c = b_of_row + x * b_step, c_of_row + x * c_step
                if of_b >= -WITHIN and of_c >= -WITHIN and of_b + of_c <= 1.0 + WITHIN:
                    near = a_near + of_b * b_slope + of_c * c_slope
                    if near > out[row, column]:
                        out[row, column] = near
