"""Kinds of pixels on surfaces whose outline, shadow, texture and highlight are known."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.lights import DirectionalLight, Light
from reflfield.metrics.error_kinds import (
    GRAZING,
    HIGHLIGHT,
    KINDS,
    NO_KIND,
    REST,
    SHADOW,
    SHADOW_EDGE,
    SILHOUETTE,
    TEXTURE_EDGE,
    KindErrors,
    KindFinder,
    errors_by_kind,
)
from reflfield.metrics.image_metrics import ImagePair
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.exposure import display
from tests.synthetic_fields import FramedSurface, baked_field, lambert, sphere_surface

SIZE, SCALE = 120, 50.0  # pixels; pixels per metre


def overhead(size=SIZE, scale=SCALE):
    """Orthographic camera that looks down; columns follow +x, rows -y."""
    pose = looking_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    return Camera("top", "orthographic", size, size, scale, scale, size / 2, size / 2, pose)


def column(x):
    """Where a point of the world lies along a row of the image, in pixels."""
    return SIZE / 2 + SCALE * x


def floor_under_a_strip(n=64):
    """Square of 2 x 2 m at z = 0, and above it at z = .5 a strip from x = .4 to x = .6."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    floor = np.concatenate([2 * corners - 1, np.zeros((4, 1))], axis=1)
    strip = np.concatenate([corners * [0.2, 2] + [0.4, -1], np.full((4, 1), 0.5)], axis=1)
    uv = np.concatenate([corners * [0.5, 1], corners * [0.5, 1] + [0.5, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return FramedSurface(
        positions=np.concatenate([floor, strip]),
        faces=np.concatenate([faces, faces + 4]),
        uv=uv,
        texel_of_pixel=np.arange(2 * n * n).reshape(n, 2 * n),
        base_from_world=np.tile(np.eye(3), (2 * n * n, 1, 1)),
    )


@pytest.fixture(scope="module")
def floor():
    field = baked_field(floor_under_a_strip(), lambert(0.5), visibility="factored")
    return FieldSurface(field, 1)


@pytest.fixture(scope="module")
def sphere():
    return FieldSurface(baked_field(sphere_surface(48), lambert(0.5)), 1)


def kinds_of(surface, light, *, silhouette, grey=0.2, albedo=None, spot=None, **images):
    """Kinds of a uniform photograph whose mean texture is as bright."""
    flat = np.full((*silhouette.shape, 3), grey)
    photograph = flat.copy()
    if spot is not None:
        photograph[spot] = 0.9
    pair = ImagePair("a", photograph, flat, silhouette, **images)
    albedo = np.ones((surface.field.n_texels, 3)) if albedo is None else albedo
    return KindFinder(surface, albedo).kinds(pair, overhead(), light, flat, 1.0)


# The light comes from +x: a point at z = .5 casts its shadow .5 * 4 / 3 m towards -x.
SIDEWAYS = DirectionalLight([0.8, 0.0, 0.6])
SHADOW_BORDERS = (0.4 - 2 / 3, 0.6 - 2 / 3)


def whole():
    return np.ones((SIZE, SIZE))


def test_a_shadow_and_its_edges_are_where_geometry_says(floor):
    kinds = kinds_of(floor, SIDEWAYS, silhouette=whole())
    row = kinds[SIZE // 2]
    x = np.arange(SIZE) + 0.5
    left, right = (column(border) for border in SHADOW_BORDERS)
    near = np.minimum(np.abs(x - left), np.abs(x - right))
    assert set(np.flatnonzero(row == SHADOW_EDGE)) == set(np.flatnonzero(near < 2))
    assert (row[(x > left + 2) & (x < right - 2)] == SHADOW).all()
    # The strip hides the floor from x = .4 on: its edges are outlines, not shadows.
    strip = np.minimum(np.abs(x - column(0.4)), np.abs(x - column(0.6)))
    assert (row[strip < 4] == SILHOUETTE).all()
    lit = (near > 2) & (strip > 4.5) & (np.abs(x - SIZE / 2) < SCALE - 5)
    assert (row[lit & ((x < left) | (x > right))] == REST).all()


def test_without_a_direction_of_the_light_there_are_no_shadows(floor):
    kinds = kinds_of(floor, Light("l", "unknown"), silhouette=whole())
    assert not np.isin(kinds, [SHADOW, SHADOW_EDGE]).any()


def test_a_step_of_albedo_is_a_texture_edge(floor):
    table = floor.texels.position
    albedo = np.where(table[:, :1] < -0.5, 0.2, 0.8) * np.ones(3)
    kinds = kinds_of(floor, Light("l", "unknown"), silhouette=whole(), albedo=albedo)
    x = np.arange(SIZE) + 0.5
    # The two texels beside the step, 1.6 pixels each, blend over one.
    columns = np.flatnonzero(kinds[SIZE // 2] == TEXTURE_EDGE)
    assert len(columns)
    assert np.abs(x[columns] - column(-0.5)).max() < 3
    assert (kinds[30:90, columns] == TEXTURE_EDGE).all()
    # A tenth more is no edge.
    faint = np.where(table[:, :1] < -0.5, 0.8, 0.88) * np.ones(3)
    kinds = kinds_of(floor, Light("l", "unknown"), silhouette=whole(), albedo=faint)
    assert not (kinds == TEXTURE_EDGE).any()


def test_what_is_brighter_than_the_mean_texture_is_a_highlight(floor):
    spot = np.zeros((SIZE, SIZE), bool)
    spot[55:60, 30:34] = True
    kinds = kinds_of(floor, Light("l", "unknown"), silhouette=whole(), spot=spot)
    assert np.array_equal(kinds == HIGHLIGHT, spot)


def test_a_highlight_on_a_shadow_edge_counts_as_the_edge(floor):
    spot = np.ones((SIZE, SIZE), bool)
    plain = kinds_of(floor, SIDEWAYS, silhouette=whole())
    bright = kinds_of(floor, SIDEWAYS, silhouette=whole(), spot=spot)
    first = np.isin(plain, [SILHOUETTE, SHADOW_EDGE, NO_KIND])
    assert np.array_equal(bright[first], plain[first])
    assert (bright[~first] == HIGHLIGHT).all()


def test_rings_of_a_sphere(sphere):
    """Radius 50 pixels: outline within 4 pixels, then what is seen under less than .3."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    radius = np.hypot(x, y)
    silhouette = (radius < SCALE).astype(float)
    above = DirectionalLight([0, 0, 1])
    kinds = kinds_of(sphere, above, silhouette=silhouette)
    # The outermost 2 pixels are not measured, nor what is beyond.
    assert (kinds[radius > SCALE - 1] == NO_KIND).all()
    assert (kinds[(radius > SCALE - 3.5) & (radius < SCALE - 2.8)] == SILHOUETTE).all()
    # cos = .3 is at r = .954 R = 47.7: inside the outline's band. From closer none is grazing.
    inner = radius < SCALE - 5.5
    assert (kinds[inner] == REST).all()
    # Of a silhouette that reaches less far the grazing ring is no outline.
    assert KINDS[GRAZING] == "grazing"


def test_what_is_seen_under_a_small_cosine_is_grazing(floor):
    """The floor from far below the zenith, at 11 degrees above it: a cosine of .2."""
    pose = looking_at([5 * np.cos(0.2), 0, 5 * np.sin(0.2)], [-0.3, 0, 0], [0, 0, 1])
    low = replace(overhead(), camera_from_world=pose)
    flat = np.full((SIZE, SIZE, 3), 0.2)
    pair = ImagePair("a", flat, flat, whole())
    finder = KindFinder(floor, np.ones((floor.field.n_texels, 3)))
    kinds = finder.kinds(pair, low, Light("l", "unknown"), flat, 1.0)
    hit = finder.guides(low, Light("l", "unknown"), slice(0, SIZE), slice(0, SIZE)).hit
    seen = hit & (kinds != SILHOUETTE) & (kinds != NO_KIND)
    assert seen.any()
    assert (kinds[seen] == GRAZING).all()


def test_the_border_of_the_image_is_no_outline(floor):
    """The floor fills a smaller image: only the strip above it has an outline."""
    small, shape = overhead(40), (40, 40)
    flat = np.full((*shape, 3), 0.2)
    pair = ImagePair("a", flat, flat, np.ones(shape))
    finder = KindFinder(floor, np.ones((floor.field.n_texels, 3)))
    kinds = finder.kinds(pair, small, Light("l", "unknown"), flat, 1.0)
    # The strip begins at x = .4, which is column 40; nearer than 4 to it are the last ones.
    assert (kinds[2:-2, 2:35] == REST).all()
    assert (kinds[:2] == NO_KIND).all()


def test_saturated_pixels_have_no_kind(floor):
    excluded = np.zeros((SIZE, SIZE), bool)
    excluded[50:60, 50:60] = True
    kinds = kinds_of(floor, Light("l", "unknown"), silhouette=whole(), excluded=excluded)
    assert (kinds[excluded] == NO_KIND).all()
    assert (kinds[62:70, 50:60] == REST).all()


def test_squared_errors_add_up_by_kind(rounding):
    """Two kinds side by side with errors of .1 and .3 of what is displayed."""
    photograph = np.full((40, 40, 3), 0.25)
    relit = photograph.copy()
    relit[:, :20], relit[:, 20:] = 0.3, 0.5
    kinds = np.full((40, 40), NO_KIND, np.uint8)
    kinds[5:35, 5:20], kinds[5:35, 20:35] = REST, HIGHLIGHT
    pair = ImagePair("a", photograph, relit, np.ones((40, 40)))
    errors = errors_by_kind(pair, kinds, 1.0)
    first, small, large = display([0.25, 0.3, 0.5], 1.0)
    squares = np.array([(small - first) ** 2, (large - first) ** 2])
    sums = rounding(float, operations=3 * 450)
    assert errors.pixels[[REST, HIGHLIGHT]].tolist() == [450, 450]
    assert errors.squares[[REST, HIGHLIGHT]] == pytest.approx(3 * 450 * squares, rel=sums)
    said = (errors + errors + KindErrors.none()).to_dict()
    share = squares[1] / squares.sum()
    assert said["highlight"]["share_of_squared_error"] == pytest.approx(share, rel=sums)
    assert said["rest"]["psnr_ldr"] == pytest.approx(-10 * np.log10(squares[0]), rel=sums)
    assert said["shadow"] == {
        "share_of_pixels": 0.0, "share_of_squared_error": 0.0, "psnr_ldr": None,
    }  # fmt: skip
