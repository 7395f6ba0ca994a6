"""What one run of the pipeline works on: capture, options, folders; nothing of it changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from reflfield.capture.capture import DIGEST_PARTS, PLANE, Capture
from reflfield.errors import InputError
from reflfield.field.clustered_pca import HALF_VECTOR, ONE_VIEW_COUNTS, USUAL_COUNTS
from reflfield.observations.texel_reading import grid_sides
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.cache import StageFolder
from reflfield.pipeline.hold_out import Split, split_of, with_fewer_lights
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.util.blocks import Blocks, Scheduler
from reflfield.util.file_digests import FileDigests

T = TypeVar("T")

# Lights under which normals are found by photometric stereo at least.
LEAST_LIGHTS = 6
# Value of an option that is selected by comparison on held-out photographs.
AUTO = "auto"
# Stages whose results on a surface from normals stand beside those on the hull.
ON_SURFACE = {
    "atlas": "surface",
    "visibility": "surface_visibility",
    "observations": "surface_observations",
    "indirect": "surface_indirect",
}


class ResultCache:
    """Results of stages in memory, as long as the stages have the same keys.

    Examples
    --------
    >>> cache = ResultCache()
    >>> cache.get("texels", ("key",), lambda: 1), cache.get("texels", ("key",), lambda: 2)
    (1, 1)
    >>> cache.get("texels", ("another key",), lambda: 3)
    3
    """

    def __init__(self) -> None:
        self._values: dict[str, tuple[tuple[str, ...], Any]] = {}

    def get(self, name: str, keys: tuple[str, ...], read: Callable[[], T]) -> T:
        """Return what was read before with the same keys, or read it."""
        if name not in self._values or self._values[name][0] != keys:
            self._values[name] = keys, read()
        value: T = self._values[name][1]
        return value


@dataclass(frozen=True, eq=False)
class Context:
    """Capture, options and folders of one run.

    What the stages have left is read with the functions of `reflfield.pipeline.results`.

    Parameters
    ----------
    capture : Capture
        With the photographs that are held out.
    out : Path
        Folder of all results.
    options : PipelineOptions
    hold_out : HoldOut
    resources : Resources
    stages : StageFolder
        Folders and records of the stages.
    asked : PipelineOptions, optional
        With "auto" where `options` have what was selected; None before that.
    digests : FileDigests, optional
        Of the files that are read.
    on_surface : bool
        Whether results are those on the surface from normals, not those on the hull.

    Attributes
    ----------
    split : Split
        What each photograph is used for.
    training : Capture
        The capture without what is held out.
    held_out : Capture
        Held-out photographs that the field is compared with.
    scheduler : Scheduler
        Who computes blocks.
    cache : ResultCache
        Results of stages that several later ones read.
    """

    capture: Capture
    out: Path
    options: PipelineOptions
    hold_out: HoldOut
    resources: Resources
    stages: StageFolder
    asked: PipelineOptions | None = None
    digests: FileDigests = field(default_factory=FileDigests)
    on_surface: bool = False
    split: Split = field(init=False)
    training: Capture = field(init=False)
    held_out: Capture = field(init=False)
    scheduler: Scheduler = field(init=False)
    cache: ResultCache = field(init=False, default_factory=ResultCache)

    def __post_init__(self) -> None:
        split = split_of(self.capture, self.hold_out)
        split = with_fewer_lights(split, self.capture, self._most_photographs)
        derived = {
            "split": split,
            "training": split.training(self.capture),
            "held_out": split.compared_capture(self.capture),
            "scheduler": Scheduler(self.resources.workers, self.resources.scheduler),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)
        counts = ONE_VIEW_COUNTS if self.photometric else USUAL_COUNTS
        compression = self.options.compression.with_counts(*counts)
        object.__setattr__(self, "options", replace(self.options, compression=compression))

    @property
    def _most_photographs(self) -> int:
        """Photographs that make the field at most, about; 0 for all."""
        asked = self.asked_options
        model, shadows = asked.compression.model, asked.resampling.visibility
        may_fit = model == AUTO and not asked.wants_clusters and shadows != "kept"
        if not self.casts_shadows or not (model == HALF_VECTOR or may_fit):
            return 0
        return asked.compression.half_vector.photographs

    @property
    def asked_options(self) -> PipelineOptions:
        """Options as they were asked for, "auto" included."""
        return self.asked or self.options

    @property
    def refined(self) -> Context:
        """The context on the surface from normals, where there is one."""
        if not self.options.refines_surface or self.on_surface:
            return self
        return self.cache.get("refined", (), partial(replace, self, on_surface=True))

    def stage_of(self, stage: str) -> str:
        """Name of a stage, on the surface that this context is about."""
        return ON_SURFACE.get(stage, stage) if self.on_surface else stage

    @property
    def is_plane(self) -> bool:
        """Whether the base surface is the image plane of one view."""
        return self.capture.base_geometry == PLANE

    @property
    def casts_shadows(self) -> bool:
        """Whether shadows could be traced: not of a flat base surface or unknown lights."""
        return self.capture.lights_known and not self.is_plane

    @property
    def photometric(self) -> bool:
        """Whether frames are those of photometric stereo: of one view under known lights."""
        one_view = self.is_plane and self.training.n_views == 1 and self.training.lights_known
        enough = self.training.n_lights >= LEAST_LIGHTS
        return one_view and enough and self.options.alignment.enabled

    @property
    def visibility_kind(self) -> str:
        """Whether shadows are "kept" in the data or "factored" out."""
        if not self.casts_shadows:
            return "kept"
        asked = self.options.resampling.visibility
        if asked == AUTO:
            raise InputError(
                "resampling.visibility: expected 'kept' or 'factored' after the stage "
                "'model_selection', received 'auto'; select it with "
                "pipeline.model_selection"
            )
        return asked

    @property
    def fits_indirect_light(self) -> bool:
        """Whether shadows are traced, and are not to be black."""
        return self.options.indirect.enabled and self.visibility_kind == "factored"

    @property
    def grid_sides(self) -> tuple[int, int]:
        """Sides of the view and light grids."""
        return grid_sides(self.training, self.options.resampling)

    def digest_of(self, capture: Capture, *parts: str) -> str:
        """Digest of parts of a capture, of all without any; see `Capture.digest`."""
        digest = capture.digest(parts or DIGEST_PARTS, self.digests.digest)
        self.digests.save()
        return digest

    def blocks(self, folder: Path) -> Blocks:
        """Work by blocks of the stage that is being computed into `folder`."""
        return self.stages.blocks(self.scheduler, folder)
