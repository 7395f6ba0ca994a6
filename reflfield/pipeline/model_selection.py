"""Choices that are left open: tried on the held-out frames, and what they have come to."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reflfield.errors import InputError
from reflfield.field.clustered_pca import CLUSTERED, HALF_VECTOR, MOST_SAMPLES
from reflfield.pipeline.cache import StageFolder, plain
from reflfield.pipeline.comparison import MAIN
from reflfield.pipeline.context import AUTO, Job
from reflfield.pipeline.pipeline_options import ComparisonOptions, PipelineOptions
from reflfield.util.folders import link_folder

# Folder of the trials in that of all results, and the stage that holds what they have shown.
TRIALS, STAGE = "trials", "choices"
# What the stage leaves beside a folder of relit frames for each candidate.
OUTCOME = "choices.json"
# By so much the PSNR of a frame scatters between fields that differ in nothing that matters:
# that of the mean of four by half as much.
CHANCE_DB = 1.0
VISIBILITY, FIT = "resampling.visibility", "compression.fit"
MODEL = "compression.model"
# Samples of a texel, on average, that the half-vector model takes at least: below, frames and
# colours of a texel are hardly determined.
LEAST_HALF_VECTOR = 64


@dataclass(frozen=True)
class Candidate:
    """One way to settle what is open.

    Parameters
    ----------
    visibility : {"factored", "kept"}
    fit : {"samples", "grid", "auto"}
        "auto" where it does not matter yet.
    name : str
        Of the choices that were open; empty where none was.
    model : {"clustered", "half_vector"}
    """

    visibility: str
    fit: str
    name: str = ""
    model: str = CLUSTERED

    def settled(self, options: PipelineOptions) -> PipelineOptions:
        """Options with these choices in place of "auto"."""
        return replace(
            options,
            resampling=replace(options.resampling, visibility=self.visibility),
            compression=replace(options.compression, fit=self.fit, model=self.model),
        )


def check_choices(job: Job) -> None:
    """Refuse a choice that nothing could decide.

    Raises
    ------
    InputError
        If shadows are to be kept or factored by the held-out frames, and there are none.
    """
    if len(_visibilities(job)) > 1 and not job.held_frames.photographs:
        raise InputError(
            f"{VISIBILITY}: 'auto' expected frames to compare on, received none; hold some "
            "out with `hold_out=HoldOut(views=K, lights=K)` or "
            "`hold_out=HoldOut(photographs=K)`, or set it to 'factored' or 'kept'"
        )


def candidates(job: Job) -> tuple[Candidate, ...]:
    """All ways to settle what was asked; an earlier one is taken in doubt.

    Parameters
    ----------
    job : Job
        With its stage "visibility" done, where the fit is open.

    Returns
    -------
    tuple of Candidate
        One only, where nothing is open or nothing can be compared.
    """
    models = {shadows: _model(job, shadows) for shadows in _visibilities(job)}
    pairs = [(s, fit) for s, model in models.items() for fit in _fits(job, s, model)]
    varied = [len(set(values)) > 1 for values in zip(*pairs, strict=True)]
    names = ["-".join(v for v, varies in zip(p, varied, strict=True) if varies) for p in pairs]
    return tuple(
        Candidate(*pair, name, models[pair[0]])
        for pair, name in zip(pairs, names, strict=True)
    )


def _model(job: Job, visibility: str) -> str:
    """The model asked for, or the one that the number of samples speaks for."""
    asked = job.asked_options
    if asked.compression.model != AUTO:
        return asked.compression.model
    wants_clusters = asked.comparison.without_alignment or asked.compression.fit != AUTO
    if visibility == "kept" or not job.casts_shadows or wants_clusters:
        return CLUSTERED
    n = samples_per_texel(_settled_as(job, visibility))
    return HALF_VECTOR if LEAST_HALF_VECTOR <= n <= MOST_SAMPLES else CLUSTERED


def _settled_as(job: Job, visibility: str) -> Job:
    """The job with shadows treated in a way, as far as its samples are concerned."""
    options = Candidate(visibility, AUTO).settled(job.asked_options)
    return replace(job, options=options)


def _visibilities(job: Job) -> tuple[str, ...]:
    asked = job.asked_options.resampling.visibility
    if asked != AUTO:
        return (asked,)
    return ("factored", "kept") if job.casts_shadows else ("kept",)


def _fits(job: Job, visibility: str, model: str) -> tuple[str, ...]:
    """The fit that the number of samples speaks for, then the other if it is to be tried.

    The field on the grid is where the fit to the samples starts, and takes seconds. The fit
    to the samples is not tried where a texel has fewer than it has coefficients, or so many
    that those of enough texels would not fit in memory.
    """
    options = job.asked_options.compression
    if options.fit != AUTO or model == HALF_VECTOR:
        return (options.fit,)
    n = samples_per_texel(_settled_as(job, visibility))
    found = ("samples", "grid") if options.fits_samples(n) else ("grid", "samples")
    compared = len(job.held_frames.photographs) > 0 and can_fit_samples(job, n)
    return found if compared else found[:1]


def can_fit_samples(job: Job, n_samples: float) -> bool:
    """Whether the fit to so many samples of a texel is determined, and they fit in memory."""
    return job.asked_options.compression.n_components <= n_samples <= MOST_SAMPLES


def samples_per_texel(job: Job) -> float:
    """Samples that count, on average, of a texel that has any."""
    return job.observed.count() / max(len(job.seen_texels), 1)


def first_affected(job: Job) -> str:
    """First stage whose result depends on what is open."""
    if len(_visibilities(job)) > 1:
        return "indirect"
    return "surface" if job.asked_options.compression.model == AUTO else "compression"


def is_open(job: Job) -> bool:
    """Whether there is more than one candidate, so that trials decide."""
    asked = job.asked_options
    open_ = AUTO in (asked.resampling.visibility, asked.compression.fit)
    return open_ and len(candidates(job)) > 1


def decided(job: Job) -> Job:
    """The job with what was open settled, which takes over the stages of the trials.

    Parameters
    ----------
    job : Job
        With its stage "choices" done, where there are several candidates.

    Returns
    -------
    Job
        With the same folders and records of stages.
    """
    found = candidates(job)
    taken = found[0] if len(found) == 1 else outcome(job).taken
    root = job.out / TRIALS / taken.name / "stages"
    if taken.name and not job.stages.also and root.is_dir():
        job.stages.also = (StageFolder(root),)
    return replace(
        job,
        options=taken.settled(job.options),
        asked=job.asked_options,
        folders=job.stages,
    )


# --- trials -------------------------------------------------------------------------------


def trial_of(job: Job, candidate: Candidate, others: Sequence[StageFolder]) -> Job:
    """An ordinary run with what is open settled, in a folder of its own.

    Parameters
    ----------
    job : Job
    candidate : Candidate
    others : sequence of StageFolder
        What they have complete is taken over.
    """
    out = job.out / TRIALS / candidate.name
    options = replace(candidate.settled(job.options), comparison=ComparisonOptions())
    folders = StageFolder(out / "stages", set(job.redo), others)
    return replace(job, out=out, options=options, folders=folders)


def keep_comparison(trial: Job, candidate: Candidate, folder: Path) -> None:
    """What a finished trial has shown, under a second name where the trial may be removed."""
    link_folder(trial.stages.root / "comparison" / MAIN, folder / candidate.name)
    record = trial.stages.record("compression")
    counts = record.counts if record is not None else {}
    (folder / candidate.name / "field.json").write_text(json.dumps(counts, indent=1))


def conclude(folder: Path, tried: Sequence[tuple[Candidate, Job]]) -> dict[str, Any]:
    """Take the best of the candidates; what was found goes into the stage's folder.

    Times of the trials go to the counts, as times do.
    """
    measured = {
        candidate.name: _heldout_psnr(folder / candidate.name) for candidate, _ in tried
    }
    psnr = {name: values for name, values in measured.items() if values}
    taken = clearly_best(psnr or measured)
    text = {"taken": taken, "tried": [asdict(candidate) for candidate, _ in tried]}
    (folder / OUTCOME).write_text(json.dumps(text, indent=1))
    return {
        "candidates": len(tried),
        "taken": taken,
        "heldout PSNR, dB": {name: float(np.mean(values)) for name, values in psnr.items()},
        "trials": {
            candidate.name: [plain(asdict(record)) for record in trial.stages.records]
            for candidate, trial in tried
        },
    }


def _heldout_psnr(folder: Path) -> list[float]:
    if not (folder / "heldout.json").is_file():  # no frame shows a pixel of the object
        return []
    metrics = json.loads((folder / "heldout.json").read_text())
    return [frame["psnr_ldr"] for frame in metrics["frames"]]


def clearly_best(psnr: Mapping[str, Sequence[float]]) -> str:
    """The last of the candidates that each lead the one before by more than chance.

    Parameters
    ----------
    psnr : mapping of str to sequence of float
        dB of every frame, the same frames for all; first what is taken in doubt.

    Returns
    -------
    str
        The first, or one whose mean lead exceeds both its standard error and `CHANCE_DB`
        over the root of the number of frames.

    Examples
    --------
    A lead in one frame of four says little, one in all of them does:

    >>> clearly_best({"samples": [24.4, 25.3, 27.2, 22.2], "grid": [24.9, 25.4, 26.0, 26.2]})
    'samples'
    >>> clearly_best({"kept": [19.0, 24.7, 21.0, 18.2], "factored": [27.3, 31.4, 25.7, 22.9]})
    'factored'
    """
    names = list(psnr)
    taken = names[0]
    for name in names[1:]:
        gains = np.subtract(psnr[name], psnr[taken])
        if not len(gains):
            return taken
        scatter = max(CHANCE_DB, gains.std(ddof=1) if len(gains) > 1 else 0.0)
        if gains.mean() > scatter / np.sqrt(len(gains)):
            taken = name
    return taken


# --- what they have come to ---------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What was tried, and which was taken."""

    tried: tuple[Candidate, ...]
    taken: Candidate


def outcome(job: Job) -> Outcome:
    """What the stage "choices" has found."""
    stored = json.loads((job.stages.root / STAGE / OUTCOME).read_text())
    tried = tuple(Candidate(**entry) for entry in stored["tried"])
    return Outcome(tried, next(c for c in tried if c.name == stored["taken"]))


def trial_records(job: Job) -> dict[str, list[dict[str, Any]]]:
    """Records of the stages of every trial, by candidate; empty without trials."""
    record = job.stages.record(STAGE)
    return {} if record is None else record.counts["trials"]


def total_seconds(job: Job) -> float:
    """Time of all stages, those of the trials too; what was taken over counts once."""
    own = [asdict(record) for record in job.stages.records if record.name != STAGE]
    tried = [record for records in trial_records(job).values() for record in records]
    seconds = {(r["name"], r["key"]): r["seconds"] for r in (*own, *tried)}
    return float(sum(seconds.values()))


def words_of(job: Job) -> Iterator[str]:
    """One sentence for each option that was "auto": what was taken, and why."""
    asked, options = job.asked_options, job.options
    tried = job.stages.record(STAGE) is not None
    if asked.resampling.visibility == AUTO and options.resampling.visibility != AUTO:
        why = "no shadow could be traced" if not job.casts_shadows else _compared(job)
        yield f'{VISIBILITY} = "auto" took "{options.resampling.visibility}": {why}.'
    if asked.compression.model == AUTO and options.compression.model == HALF_VECTOR:
        n = samples_per_texel(job)
        yield (
            f'{MODEL} = "auto" took "{options.compression.model}": {n:.0f} samples per texel, '
            f"the half-vector model takes {LEAST_HALF_VECTOR} to {MOST_SAMPLES} of a solid "
            "object under known lights."
        )
    if asked.compression.fit == AUTO and options.compression.fit != AUTO:
        compared = tried and len({c.fit for c in outcome(job).tried}) > 1
        why = _compared(job) if compared else _rule(job)
        yield f'{FIT} = "auto" took "{options.compression.fit}": {why}.'


def _compared(job: Job) -> str:
    record = job.stages.record(STAGE)
    psnr = record.counts["heldout PSNR, dB"] if record is not None else {}
    if not psnr:
        return "no held-out frame shows a pixel of the object that could be measured"
    found = ", ".join(f"{name} {value:.2f} dB" for name, value in psnr.items())
    n_frames = len(job.held_frames.photographs)
    taken = outcome(job).taken.name
    doubt = "" if taken == max(psnr, key=psnr.__getitem__) else "; what is higher, is by chance"
    return f"mean LDR PSNR of the held-out frames ({n_frames}) is {found}{doubt}"


def _rule(job: Job) -> str:
    """Why the number of samples has decided on the fit."""
    n = samples_per_texel(job)
    if n > MOST_SAMPLES:
        return f"{n:.0f} samples per texel make the grids dense, and are too many to fit to"
    if not can_fit_samples(job, n):
        return f"{n:.0f} samples per texel are fewer than coefficients"
    enough = "enough" if job.options.compression.fit == "samples" else "too few"
    return f"no frames are held out, and {n:.0f} samples per texel are {enough}"
