"""Texels of the store in a chosen frame: as samples with taps, or resampled onto nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.color_spaces import LUMINANCE
from reflfield.observations.frame_resampling import (
    Nodes,
    resample,
)
from reflfield.observations.image_projection import directions_of, reached
from reflfield.observations.resampling_options import (
    ResamplingOptions,
    side_for,
)
from reflfield.observations.shade import Shade
from reflfield.observations.store import (
    LEAST_TEXELS_PER_CHUNK,
    Bools,
    ObservationStore,
    Observed,
)
from reflfield.observations.texel_samples import (
    POWERS,
    TexelSamples,
    TransformedSamples,
    above_horizon,
    local_directions,
    transform,
    transformed_samples,
)
from reflfield.sphere.hemisphere import softened_cosine
from reflfield.util.blas_threads import thread_pool

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]


def grid_sides(capture: Capture, options: ResamplingOptions) -> tuple[int, int]:
    """Sides of the view and light grids of a capture.

    A single view or light, and light that nobody measured, does not vary: side 1.
    """
    n_lights = capture.n_lights if capture.lights_known else 1
    view = 1 if capture.n_views == 1 else options.view_side or side_for(capture.n_views)
    light = 1 if n_lights == 1 else options.light_side or side_for(n_lights)
    return view, light


# Directions of so many are worked out together to count samples.
TEXELS_COUNTED_AT_ONCE = 1024
# Share of the values that may be missing before nodes are weighted channel by channel.
FEW_GAPS = 0.01
# Samples that are looked through for those not measured.
COUNTING_BYTES = 64 << 20
# Of the products of views and lights of a block of texels.
PRODUCT_BYTES = 256 << 20


@dataclass(frozen=True, eq=False)
class LocalLuminance:
    """Luminance of some texels' samples, with their directions in the texels' frames.

    Parameters
    ----------
    samples : (n, n_views, n_lights) float32
        Linear, 1/sr, the light's cosine included; NaN where not observed.
    views, lights : (n, n_views, 3), (n, n_lights, 3) float64
        Unit vectors. A direction that does not vary has one entry, z.
    """

    samples: Floats
    views: NDArray[np.float64]
    lights: NDArray[np.float64]


@dataclass(frozen=True)
class SampleCount:
    """Samples that count: those fitted, and those of which no channel was measured."""

    fitted: int
    unmeasured: int


def luminance_of(texels: TexelSamples, cosines: Floats) -> Floats:
    """Luminance (n, n_photographs) of samples, in their unit; NaN of no channel.

    Where only some channels were measured the sample is taken to have the colour of its
    texel: that of the matt surface which explains the samples best of which all channels
    were measured, or, without any, the samples that have each channel. The luminance is what
    the channels have over the share that they have of that colour's. Where all were measured
    this is the luminance itself. Leaving such samples out would leave nothing of a capture
    under coloured lamps; taking the missing channels for black would draw frames after the
    colours of the lamps.

    Parameters
    ----------
    texels : TexelSamples
    cosines : (n, n_lights) float32
        Of the lights to the texels' normals as far as they are known; not negative.

    Examples
    --------
    An orange texel under white light, and the same half as bright under blue light alone:

    >>> from reflfield.observations.photographed_pairs import PhotographedPairs
    >>> samples = np.array([[[0.4, 0.2, 0.1], [np.nan, np.nan, 0.05]]])
    >>> one = np.array([[[0.0, 0, 1]]])
    >>> seen, pairs = np.ones((1, 2), bool), PhotographedPairs.product(1, 2)
    >>> few = TexelSamples(samples, one, one.repeat(2, 1), seen[:, :1], seen, pairs)
    >>> luminance_of(few, np.ones((1, 2))).round(4)
    array([[0.2353, 0.1176]], dtype=float32)
    """
    values = texels.samples.astype(np.float32)
    if not texels.has_gaps or not (unmeasured := np.isnan(values)).any():
        return values @ LUMINANCE
    values = np.where(unmeasured, np.float32(0.0), values)
    counted = ~unmeasured & texels.seen[..., None]
    colour = _matt_colour(values, counted, cosines[:, texels.pairs.light]) * LUMINANCE
    whole = colour.sum(axis=1)[:, None]
    shown = np.einsum("npc,nc->np", ~unmeasured, colour)
    share = np.divide(shown, whole, out=np.zeros_like(shown), where=whole > 0)
    known = values @ LUMINANCE
    scaled = np.divide(known, share, out=np.full_like(known, np.nan), where=share > 0)
    return np.where(unmeasured.any(axis=2), scaled, known).astype(np.float32)


def _matt_colour(values: Floats, counted: Bools, cosines: Floats) -> Floats:
    """Values (n, 3) over cosines by least squares, over whole samples where there are any."""
    whole = np.asarray(counted.all(axis=2))[..., None]
    has_whole = np.asarray(whole.any(axis=(1, 2)))[:, None, None]
    counted = np.where(has_whole, whole, counted)
    total = np.einsum("npc,npc,np->nc", values, counted, cosines)
    weight = np.einsum("npc,np->nc", counted, np.square(cosines))
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)


@dataclass(frozen=True, eq=False)
class TexelReader:
    """Samples of any texels, in frames that the caller chooses.

    Parameters
    ----------
    store : ObservationStore
        Samples and what is observed.
    capture : Capture
        Cameras and lights, in the order of the store.
    positions : (n_texels, 3) float
        Metres.
    local_from_world : (n_texels, 3, 3) float32
        Frames to read in.
    sides : (int, int)
        Sides of the view and light grids.
    options : ResamplingOptions
    """

    store: ObservationStore
    capture: Capture
    positions: NDArray[np.floating]
    local_from_world: Floats
    sides: tuple[int, int]
    options: ResamplingOptions

    @property
    def n_texels(self) -> int:
        """Number of texels."""
        return self.store.n_texels

    @property
    def n_pairs(self) -> int:
        """Pairs of a view node and a light node."""
        return self.sides[0] ** 2 * self.sides[1] ** 2

    @property
    def domain_unit(self) -> float:
        """The transformed samples' unit; a power of two as well."""
        return float(2.0 ** (np.log2(self.store.unit) / POWERS[self.options.domain]))

    @property
    def weight_channels(self) -> int:
        """Weights of a pair of nodes: one, or three where channels were measured apart.

        Where that is a trace, a node counts as far as the least observed channel, and the
        completion takes a third of the work.
        """
        return 3 if self.store.gaps > FEW_GAPS else 1

    @property
    def sample_bytes_per_texel(self) -> int:
        """Memory of one texel's samples and directions."""
        n_directions = self.capture.n_views + self.capture.n_lights
        return 2 * 12 * len(self.store.observed.pairs) + 80 * n_directions

    @property
    def product_bytes_per_texel(self) -> int:
        """Memory of one texel's transformed samples as a product of views and lights."""
        n_views, n_lights = self.capture.n_views, self.capture.n_lights
        return 2 * 12 * n_views * n_lights + 80 * (n_views + n_lights)

    def blocks_of(self, texels: Indices) -> list[Indices]:
        """Texels, ascending, cut where the chunks of the store are."""
        return self._cut(texels, self.store.texels_per_chunk)

    def product_blocks_of(self, texels: Indices) -> list[Indices]:
        """Texels, ascending, cut so that their products of views and lights fit in memory."""
        fit = max(PRODUCT_BYTES // self.product_bytes_per_texel, LEAST_TEXELS_PER_CHUNK)
        return self._cut(texels, min(fit, self.store.texels_per_chunk))

    def _cut(self, texels: Indices, step: int) -> list[Indices]:
        edges = np.arange(0, self.n_texels, step)[1:]
        parts = np.split(texels, np.searchsorted(texels, edges))
        return [part for part in parts if len(part)]

    def rotated(self, local_from_world: Floats) -> TexelReader:
        """Return a reader of the same samples in other frames."""
        return replace(self, local_from_world=local_from_world)

    def measured(self, texels: Indices) -> TexelSamples:
        """Samples of some texels with their directions in the world."""
        views, lights = directions_of(self.capture, self.positions[texels])
        view_seen, light_seen = self._seen(texels)
        return TexelSamples(
            samples=self.store.read(texels),
            views=views,
            lights=lights,
            view_seen=view_seen,
            light_seen=light_seen,
            pairs=self.store.observed.pairs,
            unit=self.store.unit,
            has_gaps=self.store.has_gaps,
        )

    def _seen(self, texels: Indices) -> tuple[Bools, Bools]:
        """Views and lights of which some texels have samples that say something."""
        observed = self.store.observed
        # Outside a spot's cone the sample is no measurement, though no shadow falls there.
        lit = reached(self.capture.lights, self.positions[texels])
        return observed.views[texels], observed.lights[texels] & lit

    def count_fitted(self, texels: Indices, workers: int = 1) -> SampleCount:
        """Samples of some texels that count in the reader's frames.

        They are read only where values of some were not measured. `workers` are threads.
        """
        step = max(
            1, min(TEXELS_COUNTED_AT_ONCE, COUNTING_BYTES // self.sample_bytes_per_texel)
        )
        parts = [
            block[first : first + step]
            for block in self.blocks_of(texels)
            for first in range(0, len(block), step)
        ]
        with thread_pool(workers) as pool:
            counts = list(pool.map(self._count, parts))
        return SampleCount(sum(c.fitted for c in counts), sum(c.unmeasured for c in counts))

    def _count(self, texels: Indices) -> SampleCount:
        frames = self.local_from_world[texels]
        view, light = (
            local_directions(frames, directions)
            for directions in directions_of(self.capture, self.positions[texels])
        )
        above = above_horizon(*self._seen(texels), view, light, self.sides)
        observed, n_gaps = Observed(*above, self.store.observed.pairs), 0
        if self.store.has_gaps:
            red, green, blue = np.moveaxis(np.isnan(self.store.read(texels)), 2, 0)
            n_gaps = int(np.count_nonzero(red & green & blue & observed.of_texels(slice(None))))
        return SampleCount(observed.count() - n_gaps, n_gaps)

    def transformed(self, texels: Indices) -> TransformedSamples:
        """Transformed samples, taps and weights of some texels."""
        frames = np.ascontiguousarray(self.local_from_world[texels], np.float32)
        return transformed_samples(
            self.measured(texels), frames, self.sides, self.options.domain
        )

    def luminance(self, texels: Indices) -> LocalLuminance:
        """Luminance of the samples of some texels, as measured, and where they stand.

        See `luminance_of` for samples of which not all channels were measured.
        """
        measured = self.measured(texels)
        frames = self.local_from_world[texels].astype(np.float64)
        views = local_directions(frames, measured.views.astype(np.float64))
        lights = local_directions(frames, measured.lights.astype(np.float64))
        cosines = np.ones(lights.shape[:2], np.float32)
        if self.sides[1] > 1:
            cosines = softened_cosine(lights[..., 2]).astype(np.float32)
        values = luminance_of(measured, cosines) * np.float32(measured.unit)
        seen = np.where(measured.seen, values, np.float32(np.nan))
        samples = measured.pairs.as_product(seen, np.nan)
        if self.sides[0] == 1:
            samples, views = _mean_over(samples, 1), _upright(len(texels))
        if self.sides[1] == 1:
            samples, lights = _mean_over(samples, 2), _upright(len(texels))
        return LocalLuminance(samples, views, lights)

    def shade(self, texels: Indices) -> Shade:
        """Samples of some texels in the shadow of each light, averaged over the views."""
        views = self.store.observed.views[texels]
        _, lights = directions_of(self.capture, self.positions[texels])
        lit = self.store.observed.lights[texels]
        # Outside a spot's cone there is no light that could come back.
        strong = reached(self.capture.lights, self.positions[texels])
        shadowed = strong & ~lit
        pairs = self.store.observed.pairs
        t, photograph = np.nonzero(pairs.both(views, shadowed))
        values = self.store.read(texels)[t, photograph].astype(np.float32)
        transformed = transform(values * np.float32(self.store.unit), self.options.domain)
        measured = ~np.isnan(transformed)
        group = t * pairs.n_lights + pairs.light[photograph]
        weights = grouped_sums(measured, group, shadowed.size).reshape(*shadowed.shape, 3)
        known = np.where(measured, transformed, np.float32(0.0))
        total = grouped_sums(known, group, shadowed.size).reshape(weights.shape)
        means = total / np.maximum(weights, 1.0)
        return Shade(means.astype(np.float32), weights.astype(np.float32), lights)

    def nodes(self, texels: Indices) -> Nodes:
        """Texels resampled onto the nodes of their frames."""
        return resample(self.transformed(texels), self.sides, self.options.smoothness)


def grouped_sums(values: NDArray[Any], group: Indices, n_groups: int) -> NDArray[np.float64]:
    """Sums (n_groups, k) of the rows of values (n, k) that have the same number.

    Examples
    --------
    >>> grouped_sums(np.array([[1.0], [2.0], [4.0]]), np.array([2, 0, 2]), 3).ravel()
    array([2., 0., 5.])
    """
    columns = [np.bincount(group, column, n_groups) for column in values.T]
    return np.stack(columns, axis=1)


def _mean_over(samples: Floats, axis: int) -> Floats:
    """Mean of the observed samples along an axis, which is kept; NaN where there is none."""
    count = np.isfinite(samples).sum(axis=axis, keepdims=True)
    total = np.nansum(samples, axis=axis, keepdims=True)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _upright(n: int) -> NDArray[np.float64]:
    return np.tile([0.0, 0.0, 1.0], (n, 1, 1))


@dataclass(frozen=True, eq=False)
class NodeColumns:
    """Resampled texels as columns of a matrix: rows are (pair of nodes, channel).

    Has the interface of `factorization.ColumnSource`; columns are the texels named.
    """

    reader: TexelReader
    texels: Indices
    run_length: int = 256

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.reader.n_pairs * 3, len(self.texels)

    def read(self, columns: Indices) -> tuple[Floats, Floats]:
        """Values (n_rows, k) and weights of some columns.

        Weights have a row for each pair of nodes, or, where values were not measured, for each
        row of the values.
        """
        chosen = self.texels[columns]
        order = np.argsort(chosen)
        nodes = self.reader.nodes(chosen[order])
        back = np.argsort(order)
        k, channels = len(chosen), self.reader.weight_channels
        weights = nodes.weights
        if weights.ndim == 3 and channels == 3:
            # Of these texels everything was measured.
            weights = np.repeat(weights[..., None], 3, axis=3)
        elif weights.ndim == 4 and channels == 1:
            weights = weights.min(axis=3)
        return nodes.values.reshape(k, -1)[back].T, weights.reshape(k, -1)[back].T
