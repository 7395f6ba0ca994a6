"""Cameras on a sphere and exact silhouettes of balls, for the tests of this package."""

import numpy as np

from reflfield.capture.cameras import Camera

DISTANCE = 4.0


def directions(n):
    """Spiral of n unit vectors."""
    index = np.arange(n) + 0.5
    z = 1.0 - 2.0 * index / n
    azimuth = index * np.pi * (1.0 + np.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def looking_at(position, target):
    forward = np.asarray(target, float) - position
    forward /= np.linalg.norm(forward)
    spare = np.eye(3)[np.argmin(np.abs(forward))]
    right = np.cross(forward, spare)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def cameras(n, size=96, kind="opencv", centre=(0, 0, 0), scale=1.0, zoom=1.5):
    focal = size * zoom
    if kind == "orthographic":
        focal /= DISTANCE * scale
    return [
        Camera(
            f"v{number:03d}", kind, size, size, focal, focal, size / 2, size / 2,
            looking_at(np.asarray(centre) + DISTANCE * scale * way, centre),
        )
        for number, way in enumerate(directions(n))
    ]  # fmt: skip


def ball_silhouette(camera, centre=(0, 0, 0), radius=1.0, samples=4):
    """Coverage of a ball, by rays through `samples`^2 points of each pixel."""
    v, u = np.mgrid[: camera.height * samples, : camera.width * samples]
    points = np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=1) / samples
    origins, ways = camera.rays(points)
    offset = np.asarray(centre) - origins
    along = (offset * ways).sum(axis=1)
    hit = (offset * offset).sum(axis=1) - along * along < radius * radius
    blocks = hit.reshape(camera.height, samples, camera.width, samples)
    return blocks.mean(axis=(1, 3)).astype(np.float32)


def distance_to_cones(views, points, radius=1.0):
    """Exact signed distance to the hull of a ball at the origin: smallest over the cones."""
    half_angle = np.arcsin(radius / DISTANCE)
    smallest = np.full(len(points), np.inf)
    for camera in views:
        offset = points - camera.centre
        along = offset @ camera.forward
        across = np.sqrt(np.maximum((offset**2).sum(axis=1) - along**2, 0.0))
        signed = along * np.sin(half_angle) - across * np.cos(half_angle)
        smallest = np.minimum(smallest, signed)
    return smallest


# Balls of an object without any symmetry: centres and radii.
LOBES = (((0, 0, 0), 0.6), ((0.55, 0.2, 0.1), 0.35), ((-0.1, 0.5, 0.45), 0.3))


def lobed_silhouette(camera, scale=1.0):
    """Coverage of an object of three balls, every ball scaled about the origin."""
    parts = [
        ball_silhouette(camera, scale * np.asarray(centre, float), scale * radius, samples=2)
        for centre, radius in LOBES
    ]
    return np.max(parts, axis=0)
