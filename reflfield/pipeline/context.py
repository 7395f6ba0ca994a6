"""One run of the pipeline: what it works on, and what its stages have left on disk."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import DIGEST_PARTS, PLANE, Capture
from reflfield.errors import InputError
from reflfield.field.indirect_light import IndirectLight
from reflfield.geometry.mesh import Mesh, read_ply
from reflfield.geometry.texels import TexelTable, texel_table
from reflfield.geometry.uv_atlas import Atlas
from reflfield.observations.image_projection import pairs_photographed
from reflfield.observations.store import Location, ObservationStore, Observed, place_of
from reflfield.observations.texel_reading import TexelReader, grid_sides
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.cache import RESTARTABLE, StageFolder, key_of
from reflfield.pipeline.clipped_values import MEASURED, stored_measured
from reflfield.pipeline.hold_out import Split, split_of
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.silhouette_store import SILHOUETTES, StoredSilhouettes
from reflfield.util.blocks import Blocks, Scheduler
from reflfield.util.file_digests import FileDigests
from reflfield.util.files import load_arrays

# What an option says that is decided by comparison.
AUTO = "auto"
# Stages whose results on a surface from normals stand beside those on the hull.
ON_SURFACE = {
    "atlas": "surface",
    "visibility": "surface_visibility",
    "observations": "surface_observations",
    "indirect": "surface_indirect",
}
# In the folder of the observations: the samples, or the name of the place where they are.
SAMPLES, ELSEWHERE = RESTARTABLE[0], "samples.location"


@dataclass(frozen=True, eq=False)
class Job:
    """Capture, options and results so far.

    Parameters
    ----------
    capture : Capture
        With the photographs that are held out.
    out : Path
        Folder of all results.
    options : PipelineOptions
    hold_out : HoldOut
    resources : Resources
    redo : set of str
        Stages to compute again.
    asked : PipelineOptions, optional
        With "auto" where `options` say what it has come to; None before that.
    folders : StageFolder, optional
        Of the stages; by default, new ones in `out`.
    digests : FileDigests, optional
        Of the files that are read.
    on_surface : bool
        Whether results are those on the surface from normals, not those on the hull.
    """

    capture: Capture
    out: Path
    options: PipelineOptions
    hold_out: HoldOut = field(default_factory=HoldOut)
    resources: Resources = field(default_factory=Resources)
    redo: frozenset[str] = frozenset()
    asked: PipelineOptions | None = None
    folders: StageFolder | None = None
    digests: FileDigests = field(default_factory=FileDigests)
    on_surface: bool = False

    @cached_property
    def stages(self) -> StageFolder:
        """Folders of the stages."""
        return self.folders or StageFolder(self.out / "stages", set(self.redo))

    @cached_property
    def refined(self) -> Job:
        """The job on the surface from normals, where there is one."""
        if not self.options.refines_surface or self.on_surface:
            return self
        return replace(self, folders=self.stages, on_surface=True)

    def folder_of(self, stage: str) -> Path:
        """Folder of a stage's result, on the surface that this job is about."""
        return self.stages.root / (ON_SURFACE.get(stage, stage) if self.on_surface else stage)

    def digest_of(self, capture: Capture, *parts: str) -> str:
        """Digest of parts of a capture, of all without any; see `Capture.digest`."""
        digest = capture.digest(parts or DIGEST_PARTS, self.digests.digest)
        self.digests.save()
        return digest

    @property
    def asked_options(self) -> PipelineOptions:
        """Options as they were asked for, "auto" included."""
        return self.asked or self.options

    @cached_property
    def scheduler(self) -> Scheduler:
        """Who computes blocks."""
        return Scheduler(self.resources.workers, self.resources.scheduler)

    def blocks(self, folder: Path) -> Blocks:
        """Work by blocks of the stage that is being computed into `folder`."""
        return self.stages.blocks(self.scheduler, folder)

    @property
    def samples_location(self) -> Location:
        """Where the samples of all texels are: in their stage's folder, or in a store."""
        folder = self.folder_of("observations")
        if (folder / ELSEWHERE).is_file():
            return (folder / ELSEWHERE).read_text()
        return folder / SAMPLES

    def new_samples_location(self, folder: Path) -> Location:
        """Where the stage that is computed into `folder` puts the samples.

        In a store, in a place of its own for each key, which is noted in the folder.
        """
        if self.resources.store is None:
            return folder / SAMPLES
        location = place_of(self.resources.store, key_of(folder))
        (folder / ELSEWHERE).write_text(location)
        return location

    @cached_property
    def split(self) -> Split:
        """What each photograph is used for."""
        return split_of(self.capture, self.hold_out)

    @cached_property
    def training(self) -> Capture:
        """The capture without what is held out."""
        return self.split.training(self.capture)

    @cached_property
    def held_frames(self) -> Capture:
        """Held-out photographs that the field is compared with."""
        return self.split.frames(self.capture)

    @property
    def is_plane(self) -> bool:
        """Whether the base surface is the image plane of one view."""
        return self.capture.base_geometry == PLANE

    @property
    def view_silhouettes(self) -> StoredSilhouettes:
        """Coverage of every training view, each read when it is asked for."""
        path = self.stages.root / "silhouettes" / SILHOUETTES
        return StoredSilhouettes(path, self.training.cameras)

    @cached_property
    def hull_mesh(self) -> Mesh:
        """Base surface."""
        return read_ply(self.stages.root / "hull" / "hull.ply")

    @cached_property
    def surface_atlas(self) -> Atlas:
        """Base surface with texture coordinates."""
        stored = self.result("atlas", "atlas.npz")
        height, width = (int(n) for n in stored.pop("size"))
        return Atlas(**stored, height=height, width=width)

    @cached_property
    def texels(self) -> TexelTable:
        """What each texel stands for."""
        return texel_table(self.surface_atlas)

    @cached_property
    def view_seen(self) -> NDArray[np.bool_]:
        """(n_texels, n_views) True where the camera sees the texel."""
        return self.result("visibility", "visibility.npz")["views"]

    @cached_property
    def light_seen(self) -> NDArray[np.bool_]:
        """(n_texels, n_lights) True where the light reaches the texel."""
        return self.result("visibility", "visibility.npz")["lights"]

    @property
    def casts_shadows(self) -> bool:
        """Whether shadows could be traced: not of a flat base surface or unknown lights."""
        return self.capture.lights_known and not self.is_plane

    @property
    def visibility_kind(self) -> str:
        """Whether shadows are "kept" in the data or "factored" out."""
        if not self.casts_shadows:
            return "kept"
        asked = self.options.resampling.visibility
        if asked == AUTO:
            raise InputError(
                "resampling.visibility: expected 'kept' or 'factored' after the stage "
                "'choices', received 'auto'; select it with pipeline.model_selection"
            )
        return asked

    @cached_property
    def observed(self) -> Observed:
        """Which samples count."""
        factored = self.visibility_kind == "factored"
        lights = self.light_seen if factored else np.ones_like(self.light_seen)
        return Observed(self.view_seen, lights, pairs_photographed(self.training))

    @cached_property
    def sides(self) -> tuple[int, int]:
        """Sides of the view and light grids."""
        return grid_sides(self.training, self.options.resampling)

    @cached_property
    def base_reader(self) -> TexelReader:
        """Samples in the base frames."""
        return TexelReader(
            store=ObservationStore(self.samples_location, self.observed),
            capture=self.training,
            positions=self.texels.position,
            local_from_world=self.texels.local_from_world,
            sides=self.sides,
            options=self.options.resampling,
        )

    @cached_property
    def sampled(self) -> NDArray[np.bool_]:
        """(n_texels, n_lights) True where a camera sees the texel under a light that counts."""
        pairs = self.observed.views.astype(np.float32) @ self.observed.pairs.astype(np.float32)
        return np.asarray(pairs * self.observed.lights > 0)

    @cached_property
    def seen_texels(self) -> NDArray[np.intp]:
        """Texels with at least one sample of which something was measured."""
        measured = stored_measured(self.result("observations", MEASURED))
        return np.flatnonzero((self.sampled & measured).any(axis=1))

    @cached_property
    def texels_in_view(self) -> NDArray[np.intp]:
        """Texels that some camera sees."""
        return np.flatnonzero(self.view_seen.any(axis=1))

    @property
    def finds_indirect_light(self) -> bool:
        """Whether shadows are traced, and are not to be black."""
        return self.options.indirect.enabled and self.visibility_kind == "factored"

    @property
    def indirect_light(self) -> IndirectLight | None:
        """What texels show in traced shadows, if anything."""
        if not self.finds_indirect_light:
            return None
        stored = self.result("indirect", "indirect.npz")
        return IndirectLight(stored["functions"], stored["coefficients"])

    def training_texels(self, most: int) -> NDArray[np.intp]:
        """At most so many seen texels, drawn at random, ascending."""
        seen = self.seen_texels
        if not len(seen):
            raise InputError(
                "capture: expected texels that a camera sees under a light, found none; check "
                "the calibration and the positions of the lights"
            )
        if len(seen) <= most:
            return seen
        rng = np.random.default_rng(self.options.seed)
        return np.sort(rng.choice(seen, most, replace=False))

    def result(self, stage: str, name: str) -> dict[str, NDArray[Any]]:
        """Arrays that a stage has written.

        Raises
        ------
        InputError
            If the file is damaged, or holds more than the memory.
        """
        return load_arrays(self.folder_of(stage) / name, self.resources.max_memory)
