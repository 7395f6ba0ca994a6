"""From a fitted model to a field of the size, or the quality, that was asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.build import (
    FittedReflectance,
    Quantisation,
    build_field,
    quantisation_error,
)
from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.clustered_pca import CompressionOptions
from reflfield.field.file import PackedSizes
from reflfield.field.indirect_light import IndirectLight
from reflfield.field.observed_sphere import distinct_directions
from reflfield.field.reflectance_field import ClusteredField
from reflfield.field.step_search import field_as_asked
from reflfield.metrics.sample_residual import sample_error
from reflfield.observations.image_projection import directions_of
from reflfield.observations.texel_reading import TexelReader
from reflfield.pipeline import results
from reflfield.pipeline.bounce_fit import with_bounced_light
from reflfield.pipeline.cache import versions
from reflfield.pipeline.context import Context
from reflfield.util.progress import track

Floats = NDArray[np.float32]

# Clusters that are tried where a size or a quality is asked for, and components of each.
CLUSTERS_TRIED = (1, 2, 4, 8, 16)
COMPONENTS_TRIED = 10
# Samples that the search for a quality looks at; the result is measured on more.
SAMPLES_MEASURED = 100_000
# Quantisation step over the residual that leaves the quality of a model as it is.
FINE_SHARE = 1 / 64
# 0 dB would not be asked for at all.
LEAST_PSNR = 0.01
# A field counts as reaching a quality within this.
CLOSE_DB = 0.005
# The finished field is measured on other samples than the search: a missing quality that is
# less may be by chance.
CHANCE_DB = 0.05


@dataclass(frozen=True, eq=False)
class FieldMaker:
    """Fields of one run: what they have in common.

    Parameters
    ----------
    context : Context
    options : CompressionOptions
    made_with : dict
        All options, for the metadata.
    """

    context: Context
    options: CompressionOptions
    made_with: dict[str, Any]

    @property
    def searches(self) -> bool:
        """Whether clusters and components are chosen by size or quality."""
        asked = self.context.options.compression
        return self.options is asked and (asked.size > 0 or asked.psnr > 0)

    def fitted(
        self, model: ClusteredModel, frames: Floats, indirect: IndirectLight | None = None
    ) -> FittedReflectance:
        """Model and frames as a field takes them."""
        return FittedReflectance(
            local_from_world=frames,
            cluster=model.cluster,
            coefficients=model.coefficients,
            mean=model.mean,
            basis=model.basis,
            domain=self.context.options.resampling.domain,  # type: ignore[arg-type]
            indirect=indirect,
        )

    def build(
        self,
        model: ClusteredModel,
        frames: Floats,
        step: float,
        indirect: IndirectLight | None = None,
    ) -> ClusteredField:
        """Quantise the model on the base surface into a field."""
        context = self.context
        return build_field(
            results.base_surface(context),
            self.fitted(model, frames, indirect),
            visibility=context.visibility_kind,  # type: ignore[arg-type]
            light_model="known" if context.training.lights_known else "unknown",
            metadata=field_metadata(context, self.made_with),
            quantisation=Quantisation(step),
        )

    def made(self, model: ClusteredModel, frames: Floats) -> ClusteredField:
        """Field of the size, the quality or the relative step that was asked for."""
        options = self.options
        step = options.step * model.residuals[-1]
        harmonics = results.indirect_light(self.context)
        plain = self.build(model, frames, step)
        indirect = with_bounced_light(self.context, plain, harmonics)

        def build(at: float) -> ClusteredField:
            return self.build(model, frames, at, indirect)

        return field_as_asked(build, self.quality, step, size=options.size, least=options.psnr)

    def quality(self, field: ClusteredField) -> float:
        """LDR PSNR on the samples, dB."""
        context = self.context
        error = sample_error(
            field,
            results.base_reader(context),
            results.measured_texels(context),
            SAMPLES_MEASURED,
        )
        return error.psnr_ldr

    def quality_of(self, model: ClusteredModel, reader: TexelReader) -> float:
        """LDR PSNR on the samples of a model that is hardly quantised, dB."""
        step = FINE_SHARE * model.residuals[-1]
        return self.quality(self.build(model, reader.local_from_world, step))

    def size_of(self, model: ClusteredModel, reader: TexelReader) -> int:
        """Bytes of the field of a model, as it was asked for."""
        return PackedSizes().of(self.made(model, reader.local_from_world))

    def ranked(
        self,
        fitted: Callable[[CompressionOptions], ClusteredModel],
        frames: Floats,
        gain: float,
    ) -> list[CompressionOptions]:
        """Clusters and components with which completed texels make good fields, best first.

        The best of a size has the least error; of a quality, the fewest bytes.

        Parameters
        ----------
        fitted : callable
            From options to the model of the completed texels.
        frames : (n_texels, 3, 3) float32
        gain : float
            By which the fit to the samples raises the quality of a model, dB.
        """
        n_seen, options = len(results.measured_texels(self.context)), self.options
        tried = [n for n in CLUSTERS_TRIED if n == 1 or n * COMPONENTS_TRIED <= n_seen]
        goal = max(options.psnr - gain, LEAST_PSNR) if options.psnr else 0.0
        maker = replace(self, options=replace(options, psnr=goal))
        candidates = []
        for n in track(tried, len(tried), "clusters for the size"):
            wanted = replace(options, n_clusters=n, n_components=COMPONENTS_TRIED)
            model = fitted(wanted)
            field = maker.made(model, frames)
            candidates.append((maker._cost(field, model, frames), n, components_used(field)))
        return [
            replace(options, n_clusters=n, n_components=used)
            for _, n, used in sorted(candidates)
        ]

    def _cost(self, field: ClusteredField, model: ClusteredModel, frames: Floats) -> float:
        """What is to be least: the error, or the bytes; in dB below the goal if missed."""
        options = self.options
        if options.size:
            added = quantisation_error(self.fitted(model, frames), field)
            return float(np.hypot(model.residuals[-1], added))
        missing = options.psnr - self.quality(field)
        # Bytes count only where the quality is reached.
        return float(PackedSizes().of(field)) if missing <= CLOSE_DB else 1e12 * (1 + missing)


def components_used(field: ClusteredField) -> int:
    """Components that have a coefficient other than zero.

    Components are sorted by what they explain.
    """
    used = np.flatnonzero(np.any(field.arrays["coefficients"] != 0, axis=0))
    return int(used[-1]) + 1 if len(used) else 0


def field_metadata(context: Context, made_with: dict[str, Any]) -> dict[str, Any]:
    """What a field says of its making: nothing that a change would not make again."""
    later = ("relighting", "comparison")
    options = {name: value for name, value in made_with.items() if name not in later}
    observed = (
        {"observed_lights": observed_lights(context)} if context.fits_indirect_light else {}
    )
    return {
        "capture": context.capture.name,
        "up": context.capture.up.tolist(),
        **observed,
        "views": context.training.n_views,
        "lights": context.training.n_lights,
        "photographs": len(context.training.photographs),
        "held_out": held_out(context),
        "options": options,
        "versions": versions(),
    }


def held_out(context: Context) -> dict[str, int]:
    """What of the capture did not make the field."""
    held = {"views": len(context.split.views), "lights": len(context.split.lights)}
    chosen = context.hold_out.photographs > 0 or context.hold_out.test
    return held | ({"photographs": len(context.split.compared)} if chosen else {})


def missed_quality(context: Context) -> str:
    """What to say of a quality that was asked for and is not reached; empty where it is."""
    record, asked = context.stages.record("compression"), context.options.compression.psnr
    if record is None or not asked:
        return ""
    reached = record.counts["LDR PSNR of the samples, dB"]
    if reached >= asked - CHANCE_DB:
        return ""
    return (
        f"quality not reached: {asked:g} dB asked for, {reached:.2f} dB on the samples is the "
        "most that this model has; raise texture.texels_per_pixel or compression.rank, or ask "
        "for less"
    )


def observed_lights(context: Context) -> list[list[float]]:
    """Directions from the object's centre to the lights, rounded."""
    centre = results.texels(context).position.mean(axis=0, dtype=np.float64)
    _, lights = directions_of(context.training, centre[None])
    return distinct_directions(lights[0]).tolist()
