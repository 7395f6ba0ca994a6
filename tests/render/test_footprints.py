"""Taps of a pixel's rays, merged into one entry for each texel, against sums by hand."""

import numpy as np

from reflfield.render.footprints import blended, merged_taps

# Sums of a few hundred single-precision weights in double precision.
CLOSE = 1e3 * np.finfo(np.float64).eps


def random_taps(rng, n_hits=200, n_pixels=12, n_texels=9):
    pixel = np.sort(rng.integers(0, n_pixels, n_hits))
    texels = rng.integers(-1, n_texels, (n_hits, 4)).astype(np.int32)
    weights = rng.random((n_hits, 4)).astype(np.float32)
    weights[(texels < 0) | (rng.random((n_hits, 4)) < 0.2)] = 0.0
    return pixel, texels, weights, rng.standard_normal((n_hits, 3))


def test_entries_have_the_weighted_sums_of_their_taps():
    rng = np.random.default_rng(4)
    pixel, texels, weights, positions = random_taps(rng)
    per_hit = rng.random(len(pixel)) < 0.5
    entries = merged_taps(pixel, texels, weights, positions)
    summed = entries.summed(per_hit)
    pairs = set(zip(entries.pixel.tolist(), entries.texel.tolist(), strict=True))
    assert len(pairs) == len(entries.pixel)
    for e, (p, t) in enumerate(zip(entries.pixel, entries.texel, strict=True)):
        of_entry = (pixel[:, None] == p) & (texels == t) & (weights > 0)
        w = np.where(of_entry, weights, 0.0).sum(axis=1, dtype=np.float64)
        np.testing.assert_allclose(summed[e], w[per_hit].sum(), rtol=CLOSE, atol=CLOSE)
        mean = (w[:, None] * positions).sum(axis=0) / w.sum()
        np.testing.assert_allclose(entries.position[e], mean, rtol=CLOSE, atol=CLOSE)
    # Nothing that has weight is left out.
    every = merged_taps(pixel, texels, weights, positions).summed(np.ones(len(pixel)))
    np.testing.assert_allclose(every.sum(), weights.sum(dtype=np.float64), rtol=CLOSE)


def test_nothing_met_gives_no_entries():
    nothing = merged_taps(
        np.zeros(0, np.int64), np.zeros((0, 4), np.int32), np.zeros((0, 4), np.float32),
        np.zeros((0, 3)),
    )  # fmt: skip
    assert len(nothing.pixel) == len(nothing.summed(np.zeros(0))) == 0


def test_values_blend_by_the_shares_of_the_corners():
    rng = np.random.default_rng(2)
    values, corners = rng.standard_normal((7, 2)), rng.integers(0, 7, (30, 3)).astype(np.int32)
    shares = rng.dirichlet(np.ones(3), 30)
    expected = np.einsum("nk,nkd->nd", shares, values[corners])
    np.testing.assert_allclose(blended(values, corners, shares), expected, atol=CLOSE)
