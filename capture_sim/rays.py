"""Camera rays, first hits and occlusion on the true mesh.

Cameras are the native capture format's dictionaries: OpenCV axes (+X right,
+Y down, +Z forward), the centre of the top-left pixel at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from capture_sim.objects import SurfaceMesh
from capture_sim.open3d_library import open3d as o3d

Array = NDArray[np.float64]
CameraDict = Mapping[str, Any]

# Temporaries of a ray and its hit.
BYTES_PER_RAY = 200
# Undistortion is a fixed-point iteration; 1e-12 of the focal length is far below float32 rays.
_LENS_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4")
_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)


def world_from_camera(camera: CameraDict) -> Array:
    """Invert the rigid transform `camera_from_world`.

    Parameters
    ----------
    camera : dict
        Camera of the native capture format.

    Returns
    -------
    (4, 4) float64
        OpenCV axes to world.

    Examples
    --------
    >>> moved = np.eye(4)
    >>> moved[:3, 3] = [0.0, 0.0, 2.0]
    >>> world_from_camera({"camera_from_world": moved.tolist()})[:3, 3]
    array([ 0.,  0., -2.])
    """
    camera_from_world = np.asarray(camera["camera_from_world"], dtype=np.float64)
    rotation = camera_from_world[:3, :3].T
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = -rotation @ camera_from_world[:3, 3]
    return result


def camera_rays(camera: CameraDict, pixels: Array) -> tuple[Array, Array]:
    """World rays through points of the image.

    Parameters
    ----------
    camera : dict
        Camera of the native capture format, `opencv` or `orthographic`
        (then `fl_x` and `fl_y` are pixels per metre).
    pixels : (n, 2) float
        Columns x, y in pixels; (0.5, 0.5) is the centre of the top-left pixel.

    Returns
    -------
    origins, directions : (n, 3) float64
        Metres; unit vectors that point away from the camera.

    Examples
    --------
    >>> camera = {"id": "v0", "model": "opencv", "fl_x": 100, "fl_y": 100, "cx": 8, "cy": 8,
    ...           "camera_from_world": np.eye(4).tolist()}
    >>> camera_rays(camera, np.array([[8.0, 8.0]]))[1]
    array([[0., 0., 1.]])
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    focal = np.array([camera["fl_x"], camera["fl_y"]], dtype=np.float64)
    plane = _undistorted(camera, (pixels - [camera["cx"], camera["cy"]]) / focal)
    world = world_from_camera(camera)
    origins, directions = np.zeros((2, len(plane), 3))
    parallel = camera["model"] == "orthographic"
    _fill_rays(plane, np.ascontiguousarray(world[:3]), parallel, origins, directions)
    return origins, directions


@numba.njit(cache=True, nogil=True)
def _fill_rays(
    plane: Array, world: Array, parallel: bool, origins: Array, directions: Array
) -> None:
    """Rays through points (n, 2) of the plane z = 1, carried into the world."""
    for n in range(len(plane)):
        x, y = plane[n, 0], plane[n, 1]
        slanted = 0.0 if parallel else 1.0
        length = np.sqrt(slanted * (x * x + y * y) + 1.0)
        for c in range(3):
            across = world[c, 0] * x + world[c, 1] * y
            directions[n, c] = (slanted * across + world[c, 2]) / length
            origins[n, c] = world[c, 3] + (1.0 - slanted) * across


def _undistorted(camera: CameraDict, plane: Array) -> Array:
    """Remove the lens distortion from normalised image coordinates (n, 2)."""
    # With eight terms OpenCV's k4 is the first of the denominator, as in the capture format.
    terms = np.array([camera.get(key, 0.0) for key in _LENS_TERMS] + [0.0, 0.0])
    if not terms.any() or len(plane) == 0:
        return plane
    straight = cv2.undistortPoints(
        plane[:, None], np.eye(3), terms, None, None, None, criteria=_UNDISTORT
    )
    return np.asarray(straight, dtype=np.float64).reshape(-1, 2)


def towards_camera(camera: CameraDict, points: Array) -> Array:
    """Unit directions from points of the surface to the camera.

    Parameters
    ----------
    camera : dict
        Camera of the native capture format.
    points : (n, 3) float
        World, metres.

    Returns
    -------
    (n, 3) float64

    Examples
    --------
    >>> camera = {"model": "opencv", "camera_from_world": np.eye(4).tolist()}
    >>> towards_camera(camera, np.array([[0.0, 0.0, 2.0]]))
    array([[ 0.,  0., -1.]])
    """
    world = world_from_camera(camera)
    if camera["model"] == "orthographic":
        return np.broadcast_to(-world[:3, 2], points.shape).copy()
    offsets = world[:3, 3] - points
    return np.asarray(offsets / np.linalg.norm(offsets, axis=1, keepdims=True))


@dataclass(frozen=True)
class Hits:
    """First hits of rays.

    Attributes
    ----------
    distance : (n,) float32
        Metres along the ray; infinite where nothing was hit.
    face : (n,) int64
        Triangle, -1 where nothing was hit.
    barycentric : (n, 3) float64
        Weights of the triangle's corners.
    """

    distance: NDArray[np.float32]
    face: NDArray[np.int64]
    barycentric: Array

    @property
    def hit(self) -> NDArray[np.bool_]:
        """True where the ray met the surface; (n,)."""
        return self.face >= 0


class RayTracer:
    """Ray queries on a triangle mesh (Embree through Open3D).

    Parameters
    ----------
    mesh : SurfaceMesh
        The true surface.
    n_threads : int
        Threads of one query; 0 uses every core.

    Notes
    -----
    Rays are float32: positions are reliable to about 1e-7 of the scene's
    extent, so shadow rays start `start_offset` away from the surface.
    """

    def __init__(self, mesh: SurfaceMesh, n_threads: int = 1):
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=n_threads)
        self._scene.add_triangles(
            np.ascontiguousarray(mesh.vertices, dtype=np.float32),
            np.ascontiguousarray(mesh.faces, dtype=np.uint32),
        )
        self._n_threads = n_threads
        self.start_offset = 4e-6 * mesh.radius

    def first_hits(self, origins: Array, directions: Array) -> Hits:
        """First hits of rays.

        Parameters
        ----------
        origins, directions : (n, 3) float
            World; directions of unit length.

        Returns
        -------
        Hits
        """
        answer = self._scene.cast_rays(_packed(origins, directions), nthreads=self._n_threads)
        distance = answer["t_hit"].numpy()
        face = answer["primitive_ids"].numpy().astype(np.int64)
        face[~np.isfinite(distance)] = -1
        second_third = answer["primitive_uvs"].numpy().astype(np.float64)
        first = 1.0 - second_third.sum(axis=1, keepdims=True)
        return Hits(distance, face, np.hstack([first, second_third]))

    def occluded(self, origins: Array, targets: Array) -> NDArray[np.bool_]:
        """Tell whether the surface blocks the way from points to others.

        Parameters
        ----------
        origins, targets : (n, 3) float
            World, metres; the segments between them are tested.

        Returns
        -------
        (n,) bool
            True where something lies between.
        """
        rays = _packed(origins, targets - origins)
        blocked = self._scene.test_occlusions(rays, 0.0, 1.0, nthreads=self._n_threads)
        return np.asarray(blocked.numpy())


def _packed(origins: Array, directions: Array) -> o3d.core.Tensor:
    rays = np.zeros((len(origins), 6), dtype=np.float32)
    rays[:, :3] = origins
    rays[:, 3:] = directions
    return o3d.core.Tensor(rays)
