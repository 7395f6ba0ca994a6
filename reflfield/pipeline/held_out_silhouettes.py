"""Stage "frame_silhouettes": silhouettes of the photographs that fields are compared with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from reflfield.capture.capture import Capture
from reflfield.metrics.comparison_silhouettes import (
    ComparisonSilhouettes,
    open_frame_silhouettes,
    write_comparison_silhouettes,
)
from reflfield.pipeline.compared_photographs import around, frame_sets
from reflfield.pipeline.context import Job

# Stage of the frames' silhouettes, and what a record says of what was left out.
SILHOUETTES = "frame_silhouettes"


def write_silhouettes_of_frames(job: Job, folder: Path) -> dict[str, Any]:
    """Silhouettes of all views that are compared, once for all fields."""
    origins: list[str] = []
    for name, frames in frame_sets(job).items():
        made = write_comparison_silhouettes(
            frames, around(job, name), job.hull_mesh, folder / name, job.resources.workers
        )
        origins += made.origins
    return {"views": len(origins), **{o: origins.count(o) for o in sorted(set(origins))}}


def silhouettes_digests(job: Job) -> dict[str, str]:
    """Digests of what the silhouettes of the frames are made from."""
    digests = {}
    for name, frames in frame_sets(job).items():
        whole = around(job, name)
        ids = {camera.id for camera in frames.cameras}
        views = [i for i, camera in enumerate(whole.cameras) if camera.id in ids]
        digests[name] = job.digest_of(whole.subset(views), "cameras", "silhouettes")
    return digests


def silhouettes_of_frames(job: Job, name: str, frames: Capture) -> ComparisonSilhouettes:
    """Silhouettes of a set of frames, as their stage has made them."""
    return open_frame_silhouettes(job.stages.root / SILHOUETTES / name, frames)
