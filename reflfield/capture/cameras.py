"""Cameras: from world points to pixels and back.

Conventions, kept by every camera of the package:

* ``x_camera = camera_from_world @ x_world``; OpenCV axes: +X right, +Y down, +Z forward.
* Pixel coordinates are continuous: the centre of the top-left pixel is (0.5, 0.5), so the
  image covers ``[0, width] x [0, height]``.
* ``u = fl_x x' + cx``, ``v = fl_y y' + cy`` for coordinates ``(x', y')`` behind the lens
  (`reflfield.capture.lenses`). An orthographic camera takes ``(x', y') = (X, Y)``; its focal
  lengths are pixels per metre, and ``u`` has a term ``skew y'`` more: so a photograph is
  described that was rectified to a plane which the camera sees at a slant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture import lenses
from reflfield.capture.directions import Whereabouts, directions_towards
from reflfield.errors import CaptureError
from reflfield.util.late_import import LateImport
from reflfield.util.validation import check_shape
from reflfield.util.vector_lengths import lengths

if TYPE_CHECKING:
    from reflfield.capture import point_kernels as kernels
else:
    kernels = LateImport("reflfield.capture.point_kernels")

Array = NDArray[np.float64]

OPENCV = "opencv"
FISHEYE = "opencv_fisheye"
ORTHOGRAPHIC = "orthographic"
KINDS = (OPENCV, FISHEYE, ORTHOGRAPHIC)

# Calibration files carry six or more digits; a rotation read from one is orthonormal to
# about 1e-5. Beyond this tolerance the matrix holds scale, shear or a mistake.
RIGID_TOLERANCE = 1e-3

# Pixels of one side and of an image: the largest sensors have 400 million.
LONGEST_SIDE, MOST_PIXELS = 65_535, 2**29
# Of focal lengths, principal points, coefficients and positions; their products and squares
# stay finite.
LARGEST_NUMBER = 1e12
# Sides of an image in focal lengths, at most: an angle of view of 178 degrees.
WIDEST = 100.0


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated camera.

    Parameters
    ----------
    id : str
        Unique name within the capture.
    kind : {"opencv", "opencv_fisheye", "orthographic"}
        Perspective with lens distortion, fisheye, or parallel projection.
    width, height : int
        Image size, pixels.
    fl_x, fl_y : float
        Focal lengths in pixels; pixels per metre for an orthographic camera.
    cx, cy : float
        Principal point in pixels; (0.5, 0.5) is the centre of the top-left pixel.
    camera_from_world : (4, 4) array_like
        Rigid transform to OpenCV camera axes.
    distortion : tuple of up to 8 float
        ``k1, k2, p1, p2, k3, k4, k5, k6`` in the order of `cv2.projectPoints`; those left
        out are 0. A fisheye has only k1 .. k4.
    skew : float
        Of an orthographic camera, pixels per metre.

    Raises
    ------
    CaptureError
        If a size or focal length is not positive or beyond its range (`LONGEST_SIDE`,
        `MOST_PIXELS`, `LARGEST_NUMBER`, `WIDEST`), a number is not finite, or
        `camera_from_world` is not a rigid motion. The message names the camera.

    Examples
    --------
    A camera two metres from the origin, 100 pixels focal length, centre at (50, 40):

    >>> pose = np.eye(4)
    >>> pose[2, 3] = 2.0
    >>> camera = Camera("v0", "opencv", 100, 80, 100.0, 100.0, 50.0, 40.0, pose)
    >>> pixels, depth = camera.project([[0.2, 0.0, 0.0]])
    >>> pixels, depth
    (array([[60., 40.]]), array([2.]))
    >>> camera.centre
    array([ 0.,  0., -2.])
    """

    id: str
    kind: str
    width: int
    height: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    camera_from_world: Array
    distortion: tuple[float, ...] = ()
    skew: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise CaptureError(
                f"camera {self.id!r}: expected model {', '.join(KINDS)}, received {self.kind!r}"
            )
        _check_intrinsics(self)
        for name in ("width", "height"):
            object.__setattr__(self, name, int(getattr(self, name)))
        distortion = tuple(float(k) for k in lenses.padded(self.distortion))
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "camera_from_world", _frozen_matrix(self))

    @classmethod
    def look_at(
        cls,
        position: ArrayLike,
        target: ArrayLike = (0.0, 0.0, 0.0),
        up: ArrayLike = (0.0, 0.0, 1.0),
        *,
        width: int = 512,
        height: int = 512,
        fov_deg: float = 30.0,
        id: str = "camera",
    ) -> Camera:
        """Return a perspective camera without distortion that looks at a point.

        Parameters
        ----------
        position, target : (3,) array_like
            World points, metres.
        up : (3,) array_like
            World direction that shall point up in the image.
        width, height : int
            Image size, pixels.
        fov_deg : float
            Horizontal angle of view, degrees.
        id : str

        Raises
        ------
        CaptureError
            If `position` and `target` coincide, or a number is out of range.

        Examples
        --------
        >>> camera = Camera.look_at([0, 0, 2], up=[0, 1, 0], width=100, height=80, fov_deg=90)
        >>> round(camera.fl_x, 6), camera.project([[1, 0, 0]])[0].round(6)
        (50.0, array([[75., 40.]]))
        """
        if not 0 < fov_deg < 180:
            raise CaptureError(
                f"fov_deg: expected an angle between 0 and 180 degrees, received {fov_deg}"
            )
        focal = float(0.5 * width / np.tan(0.5 * np.radians(fov_deg)))
        centre = 0.5 * width, 0.5 * height
        pose = looking_at(position, target, up)
        return cls(id, OPENCV, width, height, focal, focal, *centre, pose)

    @property
    def rotation(self) -> Array:
        """(3, 3) rotation part of `camera_from_world`."""
        return self.camera_from_world[:3, :3]

    @property
    def centre(self) -> Array:
        """(3,) world position of the camera frame's origin.

        For an orthographic camera this is only a point of the image plane; use
        `view_directions` for directions.
        """
        return -self.rotation.T @ self.camera_from_world[:3, 3]

    @property
    def forward(self) -> Array:
        """(3,) unit world direction along which the camera looks."""
        return self.rotation[2].copy()

    @property
    def up(self) -> Array:
        """(3,) unit world direction that points up in the image."""
        return -self.rotation[1]

    @property
    def keeps_lines_straight(self) -> bool:
        """Whether straight lines stay straight in the image: no distortion, no fisheye."""
        return self.kind == ORTHOGRAPHIC or (self.kind == OPENCV and not any(self.distortion))

    @property
    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix K."""
        across = [self.fl_x, self.skew, self.cx]
        return np.array([across, [0.0, self.fl_y, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Pixels and depths of world points.

        Parameters
        ----------
        points : (n, 3) array_like
            World positions, metres.

        Returns
        -------
        pixels : (n, 2) float64
            Continuous pixel coordinates; not clipped to the image. NaN where a perspective
            camera cannot image the point: at or behind the camera, or so far off axis that
            the lens polynomial folds back.
        depth : (n,) float64
            Distance along the optical axis, metres; <= 0 is behind the camera.

        Raises
        ------
        ShapeError
            If `points` is not (n, 3).
        """
        world = _points(points)
        if self.kind == OPENCV and self.keeps_lines_straight:
            pixels, depth = np.zeros((len(world), 2)), np.zeros(len(world))
            points = np.ascontiguousarray(world)
            kernels.project_straight(points, self.camera_from_world, self.matrix, pixels, depth)
            return pixels, depth
        x_camera = world @ self.rotation.T + self.camera_from_world[:3, 3]
        depth = x_camera[:, 2]
        image = x_camera[:, :2] if self.kind == ORTHOGRAPHIC else self._through_lens(x_camera)
        pixels = image * (self.fl_x, self.fl_y) + (self.cx, self.cy)
        if self.skew:
            pixels[:, 0] += self.skew * image[:, 1]
        return pixels, depth.copy()

    def rays(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Rays through pixels.

        Parameters
        ----------
        pixels : (n, 2) array_like
            Continuous pixel coordinates.

        Returns
        -------
        origins : (n, 3) float64
            World positions: the centre of a perspective camera, a point of the image plane
            of an orthographic one.
        directions : (n, 3) float64
            Unit world directions away from the camera. NaN where the lens model has no
            inverse (only for distortion beyond any real lens).

        Raises
        ------
        ShapeError
            If `pixels` is not (n, 2).
        """
        image = np.asarray(pixels, dtype=np.float64)
        check_shape("pixels", image, (None, 2))
        image = (image - (self.cx, self.cy)) / (self.fl_x, self.fl_y)
        if self.kind == ORTHOGRAPHIC:
            image[:, 0] -= self.skew / self.fl_x * image[:, 1]
            origins = self.centre + image @ self.rotation[:2]
            return origins, np.tile(self.forward, (len(image), 1))
        ideal = image if self.keeps_lines_straight else self._before_lens(image)
        directions = ideal @ self.rotation[:2] + self.rotation[2]
        directions /= lengths(directions)[:, None]
        return np.tile(self.centre, (len(image), 1)), directions

    def view_directions(self, points: ArrayLike) -> Array:
        """Unit directions (n, 3) from world points (n, 3) towards the camera."""
        directions: Array = directions_towards(_points(points), [place_of_camera(self)])[:, 0]
        return directions

    def contains(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixel coordinates (n, 2) lie in the image; (n,) bool, False for NaN.

        The right and the lower border are excluded: each point inside has a pixel.
        """
        u, v = np.asarray(pixels, dtype=np.float64).T
        return (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)

    @cached_property
    def _largest_radius(self) -> float:
        if self.kind == FISHEYE:
            return lenses.largest_fisheye_radius(self.distortion)
        return lenses.largest_radius(self.distortion)

    def _before_lens(self, image: Array) -> Array:
        """Ideal normalised coordinates; NaN where the lens has no inverse."""
        if self.kind == FISHEYE:
            return lenses.undistort_fisheye(image, self.distortion)
        return lenses.undistort(image, self.distortion)

    def _through_lens(self, x_camera: Array) -> Array:
        """Normalised coordinates behind the lens; NaN where there is no image."""
        in_front = x_camera[:, 2] > 0
        depth = np.where(in_front, x_camera[:, 2], np.nan)
        # A point almost in the camera's own plane overflows to inf: it is off the image.
        with np.errstate(over="ignore"):
            ideal = x_camera[:, :2] / depth[:, None]
        beyond = ~(np.hypot(ideal[:, 0], ideal[:, 1]) < self._largest_radius)
        ideal[beyond] = np.nan
        if self.kind == FISHEYE:
            return lenses.distort_fisheye(ideal, self.distortion)
        with np.errstate(over="ignore", invalid="ignore"):
            return lenses.distort(ideal, self.distortion)


def place_of_camera(camera: Camera) -> Whereabouts:
    """The camera's centre; of an orthographic one the direction towards it."""
    if camera.kind == ORTHOGRAPHIC:
        return Whereabouts(-camera.forward, is_point=False)
    return Whereabouts(camera.centre, is_point=True)


def looking_at(position: ArrayLike, target: ArrayLike, up: ArrayLike) -> Array:
    """`camera_from_world` of a camera at `position` that looks at `target`.

    Parameters
    ----------
    position, target : (3,) array_like
        World points, metres.
    up : (3,) array_like
        World direction that shall point up in the image. Where it is parallel to the line
        of sight, another axis takes its place.

    Returns
    -------
    (4, 4) float64

    Raises
    ------
    CaptureError
        If `position` and `target` coincide.

    Examples
    --------
    >>> looking_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
    array([[ 1.,  0.,  0.,  0.],
           [ 0., -1.,  0.,  0.],
           [ 0.,  0., -1.,  2.],
           [ 0.,  0.,  0.,  1.]])
    """
    eye = np.asarray(position, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - eye
    distance = np.linalg.norm(forward)
    if not distance > 0:
        raise CaptureError("looking_at: position and target coincide; move one of them")
    forward = forward / distance
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.roll(np.eye(3)[np.argmax(np.abs(forward))], 1))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose + 0.0  # no negative zeros


def _points(points: ArrayLike) -> Array:
    world = np.asarray(points, dtype=np.float64)
    check_shape("points", world, (None, 3))
    return world


def not_rigid_because(matrix: Array) -> str:
    """What keeps a 4x4 matrix from being a rigid motion; empty if nothing does.

    Examples
    --------
    >>> not_rigid_because(np.diag([1.0, 1.0, -1.0, 1.0]))
    'a mirrored frame (determinant -1)'
    """
    if not np.isfinite(matrix).all():
        return "numbers that are not finite"
    if not (np.abs(matrix) <= LARGEST_NUMBER).all():
        return f"numbers beyond {LARGEST_NUMBER:g}"
    if not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=RIGID_TOLERANCE):
        return f"the last row {matrix[3].tolist()} instead of [0, 0, 0, 1]"
    singular = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if singular[-1] <= RIGID_TOLERANCE * max(singular[0], 1.0):
        return f"a singular matrix (singular values {np.round(singular, 6).tolist()})"
    if np.abs(singular - 1).max() > RIGID_TOLERANCE:
        return f"scale or shear (singular values {np.round(singular, 6).tolist()})"
    if np.linalg.det(matrix[:3, :3]) < 0:
        return "a mirrored frame (determinant -1)"
    return ""


def _frozen_matrix(camera: Camera) -> Array:
    """`camera_from_world` as a read-only rigid float64 matrix."""
    matrix = np.array(camera.camera_from_world, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise CaptureError(
            f"camera {camera.id!r}: camera_from_world: expected shape (4, 4), "
            f"received {matrix.shape}"
        )
    fault = not_rigid_because(matrix)
    if fault:
        raise CaptureError(
            f"camera {camera.id!r}: camera_from_world: expected a rotation and a translation, "
            f"received {fault}; check the calibration that wrote it"
        )
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = u @ vt  # nearest rotation: removes the rounding of text files
    matrix.setflags(write=False)
    return matrix


def _check_intrinsics(camera: Camera) -> None:
    """Refuse sizes, focal lengths and numbers that no camera can have."""
    width, height = camera.width, camera.height
    if not (width == width // 1 and height == height // 1):
        raise CaptureError(
            f"camera {camera.id!r}: expected an image size in whole pixels, received "
            f"{width} x {height}"
        )
    in_range = 1 <= width <= LONGEST_SIDE and 1 <= height <= LONGEST_SIDE
    if not in_range or width * height > MOST_PIXELS:
        raise CaptureError(
            f"camera {camera.id!r}: expected an image size of at least 1 x 1 pixels and at "
            f"most {LONGEST_SIDE} along a side and {MOST_PIXELS:,} in all, received "
            f"{width} x {height}"
        )
    n_named = len(lenses.NAMES)
    if len(camera.distortion) > n_named:
        raise CaptureError(
            f"camera {camera.id!r}: expected at most {n_named} distortion coefficients "
            f"({', '.join(lenses.NAMES)}), received {len(camera.distortion)}"
        )
    if camera.skew and camera.kind != ORTHOGRAPHIC:
        raise CaptureError(
            f"camera {camera.id!r}: skew: expected 0 of a camera that is not orthographic, "
            f"received {camera.skew}; rectify the photographs first"
        )
    inner = [camera.fl_x, camera.fl_y, camera.cx, camera.cy, camera.skew]
    numbers = [*inner, *camera.distortion]
    if not all(abs(n) <= LARGEST_NUMBER for n in numbers):  # False for NaN
        raise CaptureError(
            f"camera {camera.id!r}: expected finite intrinsics of at most {LARGEST_NUMBER:g}, "
            f"received {numbers}"
        )
    if camera.fl_x <= 0 or camera.fl_y <= 0:
        raise CaptureError(
            f"camera {camera.id!r}: camera matrix is singular or mirrored: expected fl_x and "
            f"fl_y > 0, received {camera.fl_x} and {camera.fl_y}"
        )
    least = camera.width / WIDEST, camera.height / WIDEST
    if camera.kind == OPENCV and (camera.fl_x < least[0] or camera.fl_y < least[1]):
        raise CaptureError(
            f"camera {camera.id!r}: expected fl_x and fl_y in pixels, of at least {least[0]:g} "
            f"and {least[1]:g} for images of {camera.width} x {camera.height}, received "
            f"{camera.fl_x} and {camera.fl_y}; are they millimetres, or shares of the image?"
        )
    _check_fisheye(camera)


def _check_fisheye(camera: Camera) -> None:
    """Refuse coefficients that the fisheye model does not have."""
    for name, value in zip(lenses.NAMES, camera.distortion, strict=False):
        if camera.kind == FISHEYE and value != 0 and name not in ("k1", "k2", "k3", "k4"):
            raise CaptureError(
                f"camera {camera.id!r}: {name}: expected 0, since a fisheye has only k1 .. k4, "
                f"received {value}"
            )
