"""Normals by photometric stereo: planted ones come back, glossy ones without a common lean."""

import numpy as np
import pytest

from reflfield.alignment.photometric_normals import frames_towards, photometric_normals
from reflfield.errors import ShapeError

VIEW = np.array([0.0, 0.0, 1.0])


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def dome(n):
    """Directions spread evenly within 75 degrees of the zenith."""
    z = 1 - (np.arange(n) + 0.5) / n * (1 - np.cos(np.radians(75)))
    azimuth = np.arange(n) * np.pi * (3 - np.sqrt(5))
    side = np.sqrt(1 - z * z)
    return np.stack([side * np.cos(azimuth), side * np.sin(azimuth), z], axis=1)


def tilted(rng, n, most_deg=35):
    """Normals within an angle of the view."""
    angle, azimuth = np.radians(most_deg) * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    side = np.sin(angle)
    return np.stack([side * np.cos(azimuth), side * np.sin(azimuth), np.cos(angle)], axis=1)


def ggx(normals, lights, alpha):
    """Metal of Fresnel reflectance 1 by Walter et al., written apart from the fitted model."""
    half = unit(lights + VIEW)
    cos_light = np.clip(np.einsum("nd,jd->nj", normals, lights), 0, 1)
    cos_half = np.clip(np.einsum("nd,jd->nj", normals, half), 0, 1)
    cos_view = normals @ VIEW
    distribution = alpha**2 / (np.pi * (cos_half**2 * (alpha**2 - 1) + 1) ** 2)

    def masking(cosine):
        return 2 * cosine / (cosine + np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2) + 1e-12)

    shadowing = masking(cos_light) * masking(cos_view)[:, None]
    return distribution * shadowing / (4 * cos_view[:, None])


def fitted(values, lights):
    """Normals of values (n, n_lights), beginning upright."""
    n = len(values)
    start, views = np.tile(np.float32([0, 0, 1]), (2, n, 1))
    towards = np.broadcast_to(lights, (n, *lights.shape)).astype(np.float32)
    normals, _ = photometric_normals(values.astype(np.float32), towards, views, start)
    return normals


def errors_deg(normals, truth):
    return np.degrees(np.arccos(np.clip((normals * truth).sum(axis=1), -1, 1)))


def test_matt_normals_are_exact(rng):
    truth, lights = tilted(rng, 200), dome(24)
    values = 0.3 * np.clip(truth @ lights.T, 0, None)
    # Single precision, and steps below a thousandth of a radian are the last.
    assert errors_deg(fitted(values, lights), truth).max() < 0.06


@pytest.mark.parametrize(("alpha", "most"), [(0.12, 1.0), (0.2, 1.0), (0.35, 2.5)])
def test_metal_normals_do_not_lean(rng, alpha, most):
    truth, lights = tilted(rng, 300, 25), dome(64)
    normals = fitted(ggx(truth, lights, alpha), lights)
    # Between the fitted roughnesses the lobe is a mixture, and its masking another: what it
    # misses leaves a degree, or two of wide lobes.
    assert np.median(errors_deg(normals, truth)) < most
    lean = np.degrees(np.abs((normals - truth)[:, :2].mean(axis=0)))
    assert lean.max() < 0.3
    # A matt surface would be tilted about twice as far.
    matt = unit(np.linalg.lstsq(lights, ggx(truth, lights, alpha).T, rcond=None)[0].T)
    assert np.median(errors_deg(matt, truth)) > 5.0


def test_cast_shadows_are_bounded(rng):
    truth, lights = tilted(rng, 200, 25), dome(40)
    values = 0.3 * np.clip(truth @ lights.T, 0, None)
    values[:, 3::7] = 0.0
    assert np.median(errors_deg(fitted(values, lights), truth)) < 1.0


def test_what_was_not_measured_is_not_read(rng):
    truth, lights = tilted(rng, 50), dome(24)
    values = 0.3 * np.clip(truth @ lights.T, 0, None)
    values[:, ::5] = np.nan
    assert errors_deg(fitted(values, lights), truth).max() < 0.06


def test_texels_without_light_keep_their_normal():
    start = np.float32([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0]])
    values = np.float32([[0, 0, 0, 0, 0, 0], [np.nan] * 6])
    lights = np.broadcast_to(dome(6).astype(np.float32), (2, 6, 3))
    normals, _ = photometric_normals(values, lights, np.float32([VIEW, VIEW]), start)
    np.testing.assert_array_equal(normals, start)


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1e-8, 1e8])
def test_unit_of_the_samples_does_not_matter(rng, scale):
    truth, lights = tilted(rng, 50), dome(32)
    values = ggx(truth, lights, 0.2)
    difference = errors_deg(fitted(values * scale, lights), fitted(values, lights))
    assert difference.max() < 0.1  # arccos of a product of singles near 1 is good to 0.03


def test_frames_lean_towards_the_direction(rng, rounding):
    normals, view = tilted(rng, 20).astype(np.float32), np.tile(np.float32(VIEW), (20, 1))
    frames = frames_towards(normals, view)
    products = rounding(np.float32, operations=3)
    gram = frames @ np.swapaxes(frames, 1, 2)
    assert np.abs(gram - np.eye(3)).max() < products
    np.testing.assert_array_equal(frames[:, 2], normals)
    assert (np.einsum("nd,nd->n", frames[:, 0], view) >= 0).all()
    assert np.abs(np.einsum("nd,nd->n", frames[:, 1], view)).max() < products


@pytest.mark.parametrize("angle", [1.1e-4, 3e-4, 1e-3])
def test_frames_are_upright_where_normals_hardly_differ_from_the_direction(rng, angle):
    """The difference that the x axis follows is then as small as some roundings."""
    view = unit(rng.normal(size=(500, 3)))
    normals = unit(view + angle * unit(np.cross(view, rng.normal(size=(500, 3)))))
    frames = frames_towards(normals.astype(np.float32), view.astype(np.float32))
    off = np.abs(frames @ np.swapaxes(frames, 1, 2) - np.eye(3)).max()
    assert off < 8 * np.finfo(np.float32).eps
    assert (np.linalg.det(frames) > 0.99).all()


def test_shapes_are_checked():
    with pytest.raises(ShapeError, match="lights"):
        photometric_normals(
            np.zeros((2, 6), np.float32),
            np.zeros((2, 5, 3), np.float32),
            np.zeros((2, 3), np.float32),
            np.zeros((2, 3), np.float32),
        )
