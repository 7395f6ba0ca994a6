"""Stage "model_selection": options that are "auto", selected on held-out photographs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reflfield.errors import InputError
from reflfield.field.clustered_pca import CLUSTERED, HALF_VECTOR, MOST_SAMPLES
from reflfield.fitting.lobe_count import fewest_lobes
from reflfield.pipeline import results
from reflfield.pipeline.cache import StageFolder, plain
from reflfield.pipeline.comparison import MAIN
from reflfield.pipeline.context import AUTO, Context
from reflfield.pipeline.pipeline_options import ComparisonOptions, PipelineOptions
from reflfield.util.folders import link_folder

# Folder of the candidate runs in that of all results, and the stage that holds what they show.
CANDIDATES, STAGE = "candidates", "model_selection"
# What the stage leaves beside a folder of relit images for each candidate.
SELECTION = "selection.json"
# By so much the PSNR of an image scatters between fields that differ in nothing that matters:
# that of the mean of four by half as much.
CHANCE_DB = 1.0
VISIBILITY, FIT = "resampling.visibility", "compression.fit"
MODEL, LOBES = "compression.model", "compression.half_vector.n_lobes"
# Samples of a texel, on average, that the half-vector model takes at least. Under 12 views and
# 12 lights there are ten: with them it shows a vase 4 dB better than clusters do, clay 1.5.
# Few views or few lights tell less of normals, and more samples are asked for.
LEAST_HALF_VECTOR, LEAST_OF_FEW, FEW = 8, 64, 6
# Error on views left out that the half-vector model may have, over that of the mean of a
# texel's nearest samples under other lights. A bowl that its hull closes with a lid has .94,
# one of gold, which is seen in itself, .83, and unseen images of both are 4 dB better with
# clusters; of objects that the model shows better .62 (brushed in another direction in each
# triangle) is most, of others .39 to .52.
LEAST_GAIN = 0.72
# Share of all pairs of view and light that were photographed, below which clusters are never
# preferred: a flash photographs one light from each view, and what completes a texel over all
# pairs would be a guess, for hours.
LEAST_SHARE_OF_PAIRS = 0.1


@dataclass(frozen=True)
class Candidate:
    """Values of the options that are "auto".

    Parameters
    ----------
    visibility : {"factored", "kept"}
    fit : {"samples", "grid", "auto"}
        "auto" where it does not matter yet.
    name : str
        Of the values that differ between candidates; empty where none does.
    model : {"clustered", "half_vector"}
    """

    visibility: str
    fit: str
    name: str = ""
    model: str = CLUSTERED

    def applied_to(self, options: PipelineOptions) -> PipelineOptions:
        """Return options with these values in place of "auto"."""
        return replace(
            options,
            resampling=replace(options.resampling, visibility=self.visibility),
            compression=replace(options.compression, fit=self.fit, model=self.model),
        )


def check_selectable(context: Context) -> None:
    """Refuse an option "auto" for which nothing could be measured.

    Raises
    ------
    InputError
        If shadows are to be kept or factored by comparison, and nothing is held out.
    """
    if len(_visibilities(context)) > 1 and not context.held_out.photographs:
        raise InputError(
            f"{VISIBILITY}: 'auto' expected held-out photographs to compare with, received "
            "none; hold some out with `hold_out=HoldOut(views=K, lights=K)` or "
            "`hold_out=HoldOut(photographs=K)`, or set it to 'factored' or 'kept'"
        )


def candidates(context: Context) -> tuple[Candidate, ...]:
    """Return all candidates; in doubt an earlier one is selected.

    Parameters
    ----------
    context : Context
        With its stage "visibility" done, where the fit is "auto".

    Returns
    -------
    tuple of Candidate
        One only, where no option is "auto" or nothing can be compared.
    """
    models = {shadows: _model(context, shadows) for shadows in _visibilities(context)}
    pairs = [(s, fit) for s, model in models.items() for fit in _fits(context, s, model)]
    varied = [len(set(values)) > 1 for values in zip(*pairs, strict=True)]
    names = ["-".join(v for v, varies in zip(p, varied, strict=True) if varies) for p in pairs]
    return tuple(
        Candidate(*pair, name, models[pair[0]]) for pair, name in zip(pairs, names, strict=True)
    )


def _model(context: Context, visibility: str) -> str:
    """The model asked for, or the one that samples and views left out suggest."""
    asked = context.asked_options.compression.model
    if asked != AUTO:
        return asked
    supported = _supports_half_vector(context, visibility)
    return HALF_VECTOR if supported and not nearest_samples_do(context) else CLUSTERED


def may_take_half_vector(context: Context) -> bool:
    """Whether there is a candidate with samples for the half-vector model, chosen by "auto"."""
    asked = context.asked_options.compression.model
    return asked == AUTO and any(
        _supports_half_vector(context, shadows) for shadows in _visibilities(context)
    )


def _supports_half_vector(context: Context, visibility: str) -> bool:
    if visibility == "kept" or not context.casts_shadows:
        return False
    if context.asked_options.wants_clusters:
        return False
    n = _samples_with(context, visibility)
    return n >= least_samples(context)


def nearest_samples_do(context: Context) -> bool:
    """Whether nearest samples show views left out about as well as the half-vector model.

    Never of photographs that are few among all pairs of view and light.
    """
    measured = results.left_out_errors(context)
    if measured is None or not measured["errors"].any():
        return False
    if share_of_pairs(context) < LEAST_SHARE_OF_PAIRS:
        return False
    return bool(measured["errors"].min() > LEAST_GAIN * measured["nearest"])


def share_of_pairs(context: Context) -> float:
    """Share of the pairs of view and light that were photographed."""
    return float(np.mean(context.training.photograph_index >= 0))


def least_samples(context: Context) -> int:
    """Samples of a texel that the half-vector model takes at least, if it is to be selected."""
    few = min(context.training.n_views, context.training.n_lights) < FEW
    return LEAST_OF_FEW if few else LEAST_HALF_VECTOR


def _with_visibility(context: Context, visibility: str) -> Context:
    """The context with shadows treated in a way, as far as its samples are concerned."""
    asked = context.asked_options
    options = Candidate(visibility, AUTO).applied_to(asked)
    return replace(context, options=options, asked=asked)


def _samples_with(context: Context, visibility: str) -> float:
    """Samples per texel with shadows treated in a way, counted once."""
    record = context.stages.record(context.stage_of("visibility"))
    return context.cache.get(
        f"samples per texel, shadows {visibility}",
        ("" if record is None else record.key,),
        lambda: samples_per_texel(_with_visibility(context, visibility)),
    )


def _visibilities(context: Context) -> tuple[str, ...]:
    asked = context.asked_options.resampling.visibility
    if asked != AUTO:
        return (asked,)
    return ("factored", "kept") if context.casts_shadows else ("kept",)


def _fits(context: Context, visibility: str, model: str) -> tuple[str, ...]:
    """Fit that the number of samples suggests, then the other if it is a candidate.

    The field on the grid is where the fit to the samples starts, and takes seconds. The fit
    to the samples is no candidate where a texel has fewer than it has coefficients, or so
    many that those of enough texels would not fit in memory.
    """
    options = context.asked_options.compression
    if options.fit != AUTO or model == HALF_VECTOR:
        return (options.fit,)
    n = _samples_with(context, visibility)
    fits = ("samples", "grid") if options.fits_samples(n) else ("grid", "samples")
    compared = len(context.held_out.photographs) > 0 and can_fit_samples(context, n)
    # Of one view all frames are known, and with them the fit to enough samples is the better.
    return fits if compared and not context.photometric else fits[:1]


def can_fit_samples(context: Context, n_samples: float) -> bool:
    """Whether the fit to so many samples of a texel is determined, and they fit in memory."""
    return context.asked_options.compression.components <= n_samples <= MOST_SAMPLES


def samples_per_texel(context: Context) -> float:
    """Samples that count, on average, of a texel that has any."""
    return results.observed(context).count() / max(len(results.measured_texels(context)), 1)


def first_affected(context: Context) -> str:
    """First stage whose result depends on what is "auto"."""
    if len(_visibilities(context)) > 1:
        return "indirect"
    return "surface" if context.asked_options.compression.model == AUTO else "compression"


def has_candidates(context: Context) -> bool:
    """Return whether there is more than one candidate, so that they are run."""
    asked = context.asked_options
    automatic = AUTO in (asked.resampling.visibility, asked.compression.fit)
    return automatic and len(candidates(context)) > 1


def with_selection(context: Context) -> Context:
    """Return the context with the selected options; stages of that candidate are taken over.

    Parameters
    ----------
    context : Context
        With its stage "model_selection" done, where there are several candidates.

    Returns
    -------
    Context
        With the same folders and records of stages.
    """
    all_candidates = candidates(context)
    selected = all_candidates[0] if len(all_candidates) == 1 else selection(context).selected
    root = context.out / CANDIDATES / selected.name / "stages"
    if selected.name and not context.stages.others and root.is_dir():
        context.stages.take_over_from([StageFolder(root)])
    return replace(
        context, options=selected.applied_to(context.options), asked=context.asked_options
    )


# --- candidate runs -----------------------------------------------------------------------


def candidate_context(
    context: Context, candidate: Candidate, others: Sequence[StageFolder]
) -> Context:
    """Return the context of an ordinary run with a candidate's options, in its own folder.

    Parameters
    ----------
    context : Context
    candidate : Candidate
    others : sequence of StageFolder
        What they have complete is taken over.
    """
    out = context.out / CANDIDATES / candidate.name
    options = replace(candidate.applied_to(context.options), comparison=ComparisonOptions())
    stages = StageFolder(out / "stages", context.stages.redo, others)
    return replace(context, out=out, options=options, stages=stages)


def keep_comparison(candidate_run: Context, candidate: Candidate, folder: Path) -> None:
    """Link what a finished candidate run has measured into a folder that stays."""
    stages = candidate_run.stages
    link_folder(stages.root / "comparison" / MAIN, folder / candidate.name)
    record = stages.record("compression")
    counts = record.counts if record is not None else {}
    (folder / candidate.name / "field.json").write_text(json.dumps(counts, indent=1))


def select(folder: Path, finished: Sequence[tuple[Candidate, StageFolder]]) -> dict[str, Any]:
    """Select the best candidate, write it into the stage's folder, and return counts.

    Times of the candidate runs go to the counts, as times do.
    """
    measured = {
        candidate.name: _heldout_psnr(folder / candidate.name) for candidate, _ in finished
    }
    psnr = {name: values for name, values in measured.items() if values}
    selected = clearly_best(psnr or measured)
    text = {
        "selected": selected,
        "candidates": [asdict(candidate) for candidate, _ in finished],
    }
    (folder / SELECTION).write_text(json.dumps(text, indent=1))
    return {
        "candidates": len(finished),
        "selected": selected,
        "heldout PSNR, dB": {name: float(np.mean(values)) for name, values in psnr.items()},
        "candidate runs": {
            candidate.name: [plain(asdict(record)) for record in stages.records]
            for candidate, stages in finished
        },
    }


def _heldout_psnr(folder: Path) -> list[float]:
    if not (folder / "heldout.json").is_file():  # no photograph shows a pixel of the object
        return []
    metrics = json.loads((folder / "heldout.json").read_text())
    return [image["psnr_ldr"] for image in metrics["images"]]


def clearly_best(psnr: Mapping[str, Sequence[float]]) -> str:
    """Return the last of the candidates that each lead the one before by more than chance.

    Parameters
    ----------
    psnr : mapping of str to sequence of float
        dB of every image, the same images for all; first what is selected in doubt.

    Returns
    -------
    str
        The first, or one whose mean lead exceeds both its standard error and `CHANCE_DB`
        over the root of the number of images.

    Examples
    --------
    A lead in one image of four says little, one in all of them does:

    >>> clearly_best({"samples": [24.4, 25.3, 27.2, 22.2], "grid": [24.9, 25.4, 26.0, 26.2]})
    'samples'
    >>> clearly_best({"kept": [19.0, 24.7, 21.0, 18.2], "factored": [27.3, 31.4, 25.7, 22.9]})
    'factored'
    """
    names = list(psnr)
    selected = names[0]
    for name in names[1:]:
        gains = np.subtract(psnr[name], psnr[selected])
        if not len(gains):
            return selected
        scatter = max(CHANCE_DB, gains.std(ddof=1) if len(gains) > 1 else 0.0)
        if gains.mean() > scatter / np.sqrt(len(gains)):
            selected = name
    return selected


# --- what was selected --------------------------------------------------------------------


@dataclass(frozen=True)
class Selection:
    """Candidates that were run, and which of them was selected."""

    candidates: tuple[Candidate, ...]
    selected: Candidate


def selection(context: Context) -> Selection:
    """Return what the stage "model_selection" has written."""
    stored = json.loads((context.stages.root / STAGE / SELECTION).read_text())
    run = tuple(Candidate(**entry) for entry in stored["candidates"])
    return Selection(run, next(c for c in run if c.name == stored["selected"]))


def candidate_records(context: Context) -> dict[str, list[dict[str, Any]]]:
    """Return the stages' records of every candidate run; empty without any."""
    record = context.stages.record(STAGE)
    return {} if record is None else record.counts["candidate runs"]


def total_seconds(context: Context) -> float:
    """Return the time of all stages and candidate runs; what was taken over counts once."""
    own = [asdict(record) for record in context.stages.records if record.name != STAGE]
    runs = [record for records in candidate_records(context).values() for record in records]
    seconds = {(r["name"], r["key"]): r["seconds"] for r in (*own, *runs)}
    return float(sum(seconds.values()))


def sentences(context: Context) -> Iterator[str]:
    """Yield one sentence for each option that was "auto": what was selected, and why."""
    asked, options = context.asked_options, context.options
    compared = context.stages.record(STAGE) is not None
    if asked.resampling.visibility == AUTO and options.resampling.visibility != AUTO:
        why = "no shadow could be traced" if not context.casts_shadows else _measured(context)
        yield f'{VISIBILITY} = "auto" selected "{options.resampling.visibility}": {why}.'
    if asked.compression.model == AUTO and options.compression.model == HALF_VECTOR:
        n = samples_per_texel(context)
        yield (
            f'{MODEL} = "auto" selected "{options.compression.model}": '
            f"{n:.0f} samples per texel, the half-vector model takes {least_samples(context)} "
            "or more of a solid object under known lights."
        )
    yield from _left_out_sentences(context)
    if asked.compression.fit == AUTO and options.compression.fit != AUTO:
        both = compared and len({c.fit for c in selection(context).candidates}) > 1
        why = _measured(context) if both else _rule(context)
        yield f'{FIT} = "auto" selected "{options.compression.fit}": {why}.'


def _left_out_sentences(context: Context) -> Iterator[str]:
    """What was selected by views left out of the fit."""
    measured = results.left_out_errors(context)
    if measured is None:
        return
    errors = measured["errors"]
    values = ", ".join(f"{value:.4f}" for value in errors)
    if context.options.compression.model == HALF_VECTOR:
        yield (
            f'{LOBES} = "auto" selected {fewest_lobes(errors)}: with 1, 2 and more lobes the '
            f"weighted error of samples of views left out of the field is {values}."
        )
    elif context.asked_options.compression.model == AUTO and nearest_samples_do(context):
        yield (
            f'{MODEL} = "auto" selected "{CLUSTERED}": the half-vector model shows samples of '
            f"views left out with a weighted error of {values} (1, 2 and more lobes), hardly "
            "better than the mean of a texel's nearest samples under other lights, "
            f"{measured['nearest']:.4f}. So it is where the hull is not the object's surface, "
            "as over the hollow of a bowl, or where the object is seen in itself."
        )


def _measured(context: Context) -> str:
    record = context.stages.record(STAGE)
    psnr = record.counts["heldout PSNR, dB"] if record is not None else {}
    if not psnr:
        return "no held-out photograph shows a pixel of the object that could be measured"
    means = ", ".join(f"{name} {value:.2f} dB" for name, value in psnr.items())
    n_images = len(context.held_out.photographs)
    selected = selection(context).selected.name
    highest = max(psnr, key=psnr.__getitem__)
    doubt = "" if selected == highest else "; a higher mean is within chance"
    return f"mean LDR PSNR on the held-out photographs ({n_images}) is {means}{doubt}"


def _rule(context: Context) -> str:
    """Why the number of samples has decided on the fit."""
    n = samples_per_texel(context)
    if n > MOST_SAMPLES:
        return f"{n:.0f} samples per texel make the grids dense, and are too many to fit to"
    if not can_fit_samples(context, n):
        return f"{n:.0f} samples per texel are fewer than coefficients"
    enough = "enough" if context.options.compression.fit == "samples" else "too few"
    return f"no photographs are held out, and {n:.0f} samples per texel are {enough}"
