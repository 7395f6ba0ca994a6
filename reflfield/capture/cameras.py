"""Cameras: from world points to pixels and back.

Conventions, kept by every camera of the package:

* ``x_camera = camera_from_world @ x_world``; OpenCV axes: +X right, +Y down, +Z forward.
* Pixel coordinates are continuous: the centre of the top-left pixel is (0.5, 0.5), so the
  image covers ``[0, width] x [0, height]``.
* The lens model is OpenCV's: with ``(x, y) = (X/Z, Y/Z)`` and ``r^2 = x^2 + y^2``::

      g  = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2)
      x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2)
      y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y
      u  = fl_x x' + cx,   v = fl_y y' + cy

  An orthographic camera takes ``(x', y') = (X, Y)``; its focal lengths are pixels per metre.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.checks import check_shape
from reflfield.errors import CaptureError

Array = NDArray[np.float64]

OPENCV = "opencv"
ORTHOGRAPHIC = "orthographic"

# Calibration files carry six or more digits; a rotation read from one is orthonormal to
# about 1e-5. Beyond this tolerance the matrix holds scale, shear or a mistake.
RIGID_TOLERANCE = 1e-3

# Newton's method doubles the digits with every step: lenses in use converge in 5 steps.
NEWTON_STEPS = 30
# Residual, in normalised image coordinates, at which a pixel counts as inverted.
NEWTON_TOLERANCE = 1e-9
# Leading coefficients below this change nothing within any field of view, but upset the
# search for roots.
NEGLIGIBLE = 1e-14


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated camera.

    Parameters
    ----------
    id : str
        Unique name within the capture.
    kind : {"opencv", "orthographic"}
        Perspective with lens distortion, or parallel projection.
    width, height : int
        Image size, pixels.
    fl_x, fl_y : float
        Focal lengths in pixels; pixels per metre for an orthographic camera.
    cx, cy : float
        Principal point in pixels; (0.5, 0.5) is the centre of the top-left pixel.
    camera_from_world : (4, 4) array_like
        Rigid transform to OpenCV camera axes.
    distortion : tuple of 6 float
        ``k1, k2, p1, p2, k3, k4`` in the order of `cv2.projectPoints`.

    Raises
    ------
    CaptureError
        If a size or focal length is not positive, a number is not finite, or
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
    distortion: tuple[float, ...] = (0.0,) * 6

    def __post_init__(self) -> None:
        if self.kind not in (OPENCV, ORTHOGRAPHIC):
            raise CaptureError(
                f"camera {self.id!r}: expected model 'opencv' or 'orthographic', "
                f"received {self.kind!r}"
            )
        object.__setattr__(self, "camera_from_world", _frozen_matrix(self))
        object.__setattr__(self, "distortion", tuple(float(k) for k in self.distortion))
        _check_intrinsics(self)

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
    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix K."""
        return np.array([[self.fl_x, 0.0, self.cx], [0.0, self.fl_y, self.cy], [0.0, 0.0, 1.0]])

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
        x_camera = world @ self.rotation.T + self.camera_from_world[:3, 3]
        depth = x_camera[:, 2]
        image = x_camera[:, :2] if self.kind == ORTHOGRAPHIC else self._through_lens(x_camera)
        return image * (self.fl_x, self.fl_y) + (self.cx, self.cy), depth.copy()

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
            origins = self.centre + image @ self.rotation[:2]
            return origins, np.tile(self.forward, (len(image), 1))
        ideal = undistort(image, self.distortion) if any(self.distortion) else image
        directions = ideal @ self.rotation[:2] + self.rotation[2]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.tile(self.centre, (len(image), 1)), directions

    def view_directions(self, points: ArrayLike) -> Array:
        """Unit directions (n, 3) from world points (n, 3) towards the camera."""
        world = _points(points)
        if self.kind == ORTHOGRAPHIC:
            return np.tile(-self.forward, (len(world), 1))
        towards = self.centre - world
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        return towards / np.maximum(distance, np.finfo(np.float64).tiny)

    def contains(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixel coordinates (n, 2) lie in the image; (n,) bool, NaN gives False."""
        u, v = np.asarray(pixels, dtype=np.float64).T
        return (u >= 0) & (u <= self.width) & (v >= 0) & (v <= self.height)

    def pixel_centres(self) -> Array:
        """Centres of all pixels, row by row; (height * width, 2) float64.

        Examples
        --------
        >>> Camera("v0", "opencv", 2, 1, 1.0, 1.0, 1.0, 0.5, np.eye(4)).pixel_centres()
        array([[0.5, 0.5],
               [1.5, 0.5]])
        """
        v, u = np.mgrid[: self.height, : self.width]
        return np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=1)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with images of another size: intrinsics scale per axis."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fl_x=self.fl_x * sx,
            cx=self.cx * sx,
            fl_y=self.fl_y * sy,
            cy=self.cy * sy,
        )

    @cached_property
    def _largest_radius(self) -> float:
        return largest_radius(self.distortion)

    def _through_lens(self, x_camera: Array) -> Array:
        """Distorted normalised coordinates; NaN where there is no image."""
        in_front = x_camera[:, 2] > 0
        depth = np.where(in_front, x_camera[:, 2], np.nan)
        # A point almost in the camera's own plane overflows to inf: it is off the image.
        with np.errstate(over="ignore"):
            ideal = x_camera[:, :2] / depth[:, None]
        if not any(self.distortion):
            return ideal
        beyond = ~(np.hypot(ideal[:, 0], ideal[:, 1]) < self._largest_radius)
        ideal[beyond] = np.nan
        with np.errstate(over="ignore", invalid="ignore"):
            return distort(ideal, self.distortion)


def distort(ideal: Array, distortion: tuple[float, ...]) -> Array:
    """Apply OpenCV's lens model to normalised coordinates (n, 2); see the module header.

    Examples
    --------
    Barrel distortion k1 = -0.1 at r = 1 pulls the point in by a tenth:

    >>> distort(np.array([[1.0, 0.0]]), (-0.1, 0, 0, 0, 0, 0))
    array([[0.9, 0. ]])
    """
    k1, k2, p1, p2, k3, k4 = distortion
    x, y = ideal.T
    r2 = x * x + y * y
    gain = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + k4 * r2)
    return np.stack(
        [
            x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def undistort(distorted: Array, distortion: tuple[float, ...]) -> Array:
    """Invert `distort` by Newton's method; NaN where it has no inverse.

    Parameters
    ----------
    distorted : (n, 2) float
        Normalised coordinates behind the lens.
    distortion : tuple of 6 float
        ``k1, k2, p1, p2, k3, k4``.

    Returns
    -------
    (n, 2) float64
        Normalised coordinates before the lens, on the branch that contains the axis.

    Examples
    --------
    >>> undistort(np.array([[0.9, 0.0]]), (-0.1, 0, 0, 0, 0, 0)).round(12)
    array([[1., 0.]])
    """
    limit = largest_radius(distortion)
    converged = 4 * np.finfo(np.float64).eps * max(1.0, float(np.abs(distorted).max(initial=0)))
    with np.errstate(all="ignore"):
        ideal = distorted * np.minimum(1.0, 0.9 * limit / _radii(distorted))[:, None]
        for _ in range(NEWTON_STEPS):
            residual = distort(ideal, distortion) - distorted
            if np.max(np.abs(residual), initial=0.0) <= converged:
                break
            ideal = ideal - _solve_2x2(_lens_jacobian(ideal, distortion), residual)
            # A step over the fold would land on the wrong branch.
            ideal = ideal * np.minimum(1.0, limit / _radii(ideal))[:, None]
        residual = np.abs(distort(ideal, distortion) - distorted).max(axis=1, initial=0.0)
        failed = ~(residual <= NEWTON_TOLERANCE * np.maximum(1.0, _radii(distorted)))
    ideal[failed] = np.nan
    return ideal


def largest_radius(distortion: tuple[float, ...]) -> float:
    """Radius up to which the radial lens model grows, hence can be inverted.

    The first positive root of ``d(r g(r))/dr``, or the pole of `g`; inf if there is none.

    Examples
    --------
    ``r - r^3/3`` grows until r = 1:

    >>> largest_radius((-1 / 3, 0, 0, 0, 0, 0))
    1.0
    """
    k1, k2, _, _, k3, k4 = distortion
    numerator = np.polynomial.Polynomial([1.0, k1, k2, k3])
    denominator = np.polynomial.Polynomial([1.0, k4])
    square = np.polynomial.Polynomial([0.0, 1.0])
    slope = (numerator + 2 * square * numerator.deriv()) * denominator
    slope = slope - 2 * square * numerator * denominator.deriv()
    roots = np.concatenate(
        [polynomial.trim(NEGLIGIBLE).roots() for polynomial in (slope, denominator)]
    )
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
    positive = real[real > 0]
    return float(np.sqrt(positive.min())) if len(positive) else float("inf")


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


def _radii(image: Array) -> Array:
    return np.maximum(np.hypot(image[:, 0], image[:, 1]), np.finfo(np.float64).tiny)


def _lens_jacobian(ideal: Array, distortion: tuple[float, ...]) -> Array:
    """(n, 2, 2) derivatives of `distort`."""
    k1, k2, p1, p2, k3, k4 = distortion
    x, y = ideal.T
    r2 = x * x + y * y
    top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + k4 * r2
    gain = top / bottom
    slope = ((k1 + r2 * (2 * k2 + r2 * 3 * k3)) - gain * k4) / bottom  # d gain / d r^2
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    jacobian = np.zeros((len(ideal), 2, 2))
    jacobian[:, 0, 0] = gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[:, 1, 1] = gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = cross
    return jacobian


def _solve_2x2(matrices: Array, right: Array) -> Array:
    """Cramer's rule; a singular matrix gives inf or NaN instead of an exception."""
    a, b = matrices[:, 0, 0], matrices[:, 0, 1]
    c, d = matrices[:, 1, 0], matrices[:, 1, 1]
    determinant = a * d - b * c
    x = (d * right[:, 0] - b * right[:, 1]) / determinant
    y = (a * right[:, 1] - c * right[:, 0]) / determinant
    return np.stack([x, y], axis=1)


def _frozen_matrix(camera: Camera) -> Array:
    """`camera_from_world` as a read-only rigid float64 matrix."""
    matrix = np.array(camera.camera_from_world, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise CaptureError(
            f"camera {camera.id!r}: camera_from_world: expected shape (4, 4), "
            f"received {matrix.shape}"
        )
    fault = _not_rigid_because(matrix)
    if fault:
        raise CaptureError(
            f"camera {camera.id!r}: camera_from_world: expected a rotation and a translation, "
            f"received {fault}; check the calibration that wrote it"
        )
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = u @ vt  # nearest rotation: removes the rounding of text files
    matrix.setflags(write=False)
    return matrix


def _not_rigid_because(matrix: Array) -> str:
    """What keeps a 4x4 matrix from being a rigid motion; empty if nothing does."""
    if not np.isfinite(matrix).all():
        return "numbers that are not finite"
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


def _check_intrinsics(camera: Camera) -> None:
    """Refuse sizes, focal lengths and numbers that no camera can have."""
    if camera.width < 1 or camera.height < 1:
        raise CaptureError(
            f"camera {camera.id!r}: expected an image size of at least 1 x 1 pixels, "
            f"received {camera.width} x {camera.height}"
        )
    if len(camera.distortion) != 6:
        raise CaptureError(
            f"camera {camera.id!r}: expected 6 distortion coefficients "
            f"(k1, k2, p1, p2, k3, k4), received {len(camera.distortion)}"
        )
    numbers = [camera.fl_x, camera.fl_y, camera.cx, camera.cy, *camera.distortion]
    if not np.isfinite(numbers).all():
        raise CaptureError(
            f"camera {camera.id!r}: expected finite intrinsics, received {numbers}"
        )
    if camera.fl_x <= 0 or camera.fl_y <= 0:
        raise CaptureError(
            f"camera {camera.id!r}: camera matrix is singular or mirrored: expected fl_x and "
            f"fl_y > 0, received {camera.fl_x} and {camera.fl_y}"
        )
