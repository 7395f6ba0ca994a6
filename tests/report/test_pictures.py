"""Pictures: colours that can be read back, overlays, layouts."""

import numpy as np
import pytest

from reflfield.errors import InputError, ShapeError
from reflfield.render.exposure import ExposureMeter, encoded_picture
from reflfield.report import pictures


def test_normals_can_be_read_back(rng):
    normals = rng.normal(size=(20, 20, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    decoded = pictures.directions_coloured(normals) / 255 * 2 - 1
    # Half a step of 8 bits over [-1, 1].
    assert np.abs(decoded - normals).max() <= 1 / 255 + 1e-12


def test_tonemapping_is_exact_at_the_ends_and_grey_where_unknown():
    image = np.array([[[0, 0, 0], [0.5, 0.5, 0.5], [9, 9, 9], [np.nan, 0, 0]]])
    shown = encoded_picture(image, exposure=2.0)[0]
    assert shown.tolist() == [[0] * 3, [255] * 3, [255] * 3, [128] * 3]


def test_exposure_ignores_what_is_not_shown(rounding):
    image = np.ones((4, 4, 3))
    image[0] = 100
    shown = np.ones((4, 4), bool)
    shown[0] = False
    for brightness, expected in ((1, 1), (4, 0.25), (0, 1)):
        meter = ExposureMeter()
        meter.add(brightness * image, shown)
        assert meter.exposure_or_one == pytest.approx(expected, abs=rounding(np.float64))


def test_false_colour_is_monotone_and_clips():
    shown = pictures.false_colour([np.linspace(-1, 2, 7)], 0, 1, "gray")[0, :, 0].astype(int)
    assert (np.diff(shown) >= 0).all()
    assert shown[0] == shown[2] == 0
    assert shown[-1] == shown[4] == 255
    with pytest.raises(InputError, match="low < high"):
        pictures.false_colour([[0.0]], 1, 1)


def test_labels_differ_from_their_neighbours_in_number():
    colours = pictures.labels_coloured(np.arange(64)[None])[0].astype(int)
    assert len(np.unique(colours, axis=0)) == 64
    assert np.abs(np.diff(colours, axis=0)).sum(axis=1).min() > 60  # of 765; seen by eye


def test_overlay_tells_missing_from_excess():
    silhouette, hull = np.zeros((20, 20)), np.zeros((20, 20))
    silhouette[5:15, 5:12] = 1
    hull[5:15, 8:15] = 1
    painted = pictures.silhouettes_overlay(np.zeros((20, 20, 3)), silhouette, hull)
    assert painted[10, 6].tolist() == list(pictures.MISSING_COLOUR)
    assert painted[10, 13].tolist() == list(pictures.EXCESS_COLOUR)
    assert painted[10, 10].tolist() == [0, 0, 0]
    assert painted[4, 6].tolist() == list(pictures.SILHOUETTE_COLOUR)
    assert painted[10, 15].tolist() == list(pictures.HULL_COLOUR)
    with pytest.raises(ShapeError, match="hull_silhouette"):
        pictures.silhouettes_overlay(np.zeros((20, 20, 3)), silhouette, hull[1:])


def test_texture_places_each_texel(rng):
    layout = rng.permutation(12).reshape(3, 4)
    layout[0, 0] = -1
    values = rng.normal(size=(12, 3))
    placed = pictures.texture(values, layout)
    assert np.isnan(placed[0, 0]).all()
    assert np.array_equal(placed[2, 3], values[layout[2, 3]])
    with pytest.raises(InputError, match="texel_of_pixel"):
        pictures.texture(values[:5], layout)
    assert np.isnan(pictures.texture(np.zeros((0, 3)), [[-1]])).all()


def test_shrinking_keeps_the_mean(rng):
    picture = rng.integers(0, 255, (64, 32, 3), dtype=np.uint8)
    small = pictures.fitted(picture, 16)
    assert small.shape == (16, 8, 3)
    assert abs(small.mean() - picture.mean()) < 0.5  # rounding to 8 bits
    assert pictures.fitted(picture, 64) is picture
