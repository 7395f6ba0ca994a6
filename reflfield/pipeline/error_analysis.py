"""Stage "error_analysis": trivial baselines beside the field, and where its error lies."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.image_writing import write_exr
from reflfield.field.file import open_field
from reflfield.metrics import error_kinds
from reflfield.metrics.baselines import BLACK, MEAN, Baselines, BaselineScores, albedo_of_means
from reflfield.metrics.error_kinds import KindErrors, KindFinder, errors_by_kind
from reflfield.metrics.held_out_photographs import RelitPairs
from reflfield.metrics.image_metrics import Comparison, metrics_text, worst_to_best
from reflfield.observations.image_projection import directions_of, shines
from reflfield.pipeline import comparison, results
from reflfield.pipeline.context import Context
from reflfield.pipeline.hold_out import held_out_counts
from reflfield.pipeline.maps import AVERAGES
from reflfield.pipeline.memory import readers_at_once, within_memory
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.nearest_photographs import NearestPhotographs, filled_from_nearest
from reflfield.sphere.hemisphere import softened_cosine
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import track

STAGE = "error_analysis"
# Of the analysis of one set of photographs, as of ``metrics.json``.
BASELINES, ERROR_KINDS, SHOWN = "baselines", "error_kinds", "shown"
KIND_FILE = "kinds.npz"
# Texels whose directions to all lights are worked out together: 200 bytes for each pair.
PAIRS_AT_ONCE = 1 << 19


@dataclass(frozen=True, eq=False)
class Analyser:
    """What the analysis of a field's images takes.

    Parameters
    ----------
    baselines : Baselines
    kinds : KindFinder
    """

    baselines: Baselines
    kinds: KindFinder


def write_error_analysis(context: Context, folder: Path) -> dict[str, Any]:
    """Measure the baselines, find where the error lies, and write ``metrics.json``."""
    analysed, n_images = {}, 0
    analyser: Analyser | None = None
    for name, pairs in comparison.relit_pairs(context).items():
        compared = comparison.comparison_of(context, name)
        if compared is not None:
            # Where nothing was compared the baselines, of all texels, are not needed.
            analyser = analyser or analyser_of(context)
            (folder / name).mkdir()
            at_once = min(context.resources.workers, readers_at_once(context))
            analysed[name] = analyse(analyser, pairs, compared, folder / name, at_once)
            (folder / f"{name}.json").write_text(json.dumps(analysed[name], indent=2))
            n_images += len(pairs)
    (folder / "metrics.json").write_text(_metrics(context, analysed))
    return {"images": n_images}


def _metrics(context: Context, analysed: Mapping[str, dict[str, Any]]) -> str:
    """``metrics.json``: that of the first set compared, with its analysis."""
    if not analysed:
        return metrics_text(None, held_out=held_out_counts(context.split))
    name, errors = next(iter(analysed.items()))
    compared = comparison.comparison_of(context, name)
    return metrics_text(
        None if compared is None else compared.to_dict(),
        held_out=held_out_counts(context.split),
        **metrics_of(errors),
    )


def metrics_of(analysed: Mapping[str, Any]) -> dict[str, Any]:
    """What ``metrics.json`` says of an analysis."""
    return {key: analysed[key] for key in (BASELINES, ERROR_KINDS)}


def analysis_of(context: Context, name: str) -> dict[str, Any] | None:
    """Analysis of one set of photographs, as the stage has written it."""
    path = context.stages.root / STAGE / f"{name}.json"
    return json.loads(path.read_text()) if path.is_file() else None


def analyser_of(context: Context) -> Analyser:
    """Baselines of a run: of the photographs and samples that made the field."""
    context = context.refined
    field = open_field(results.field_file(context))
    options = within_memory(context.options.relighting, context.resources)
    surface = FieldSurface(field, context.resources.workers, options.ray_offset)
    visible = results.view_visible(context)
    nearest = NearestPhotographs(surface, context.training, lambda view: visible[:, view])
    albedo = mean_albedo(context)
    return Analyser(
        Baselines(field, surface, albedo, nearest, options), KindFinder(surface, albedo)
    )


def mean_albedo(context: Context) -> NDArray[np.floating]:
    """Albedo over pi of each texel with the mean of its samples, (n_texels, 3)."""
    means = results.arrays(context, "maps", AVERAGES)["average"]
    if np.isnan(means).all(axis=0).any():  # a colour that no light has
        means = np.where(np.isnan(means).all(axis=0), np.float32(0.0), means)
    albedo = albedo_of_means(means, mean_cosines(context))
    return filled_from_nearest(albedo, results.texels(context).position)


def mean_cosines(context: Context) -> NDArray[np.float64]:
    """Mean cosine of the lights of each texel's samples, (n_texels, 3); 1 without lights.

    Of each channel over the lights that have that colour. What is saturated counts all the
    same.
    """
    texels, training = results.texels(context), context.training
    if not training.lights_known:
        return np.ones((len(texels), 3))
    observed = results.observed(context)
    means = np.zeros((len(texels), 3))
    step = max(1, PAIRS_AT_ONCE // training.n_lights)
    for first in range(0, len(texels), step):
        part = slice(first, first + step)
        _, lights = directions_of(training, texels.position[part])
        cosines = softened_cosine(np.einsum("nld,nd->nl", lights, texels.normal[part]))
        shining = shines(training.lights, texels.position[part])
        weights = observed.part(part).counts()
        of_channel = weights[..., None] * shining
        total = np.einsum("nlc,nl->nc", of_channel, cosines)
        means[part] = total / np.maximum(of_channel.sum(axis=1), 1.0)
    return means


def analyse(
    analyser: Analyser,
    pairs: RelitPairs,
    compared: Comparison,
    folder: Path,
    at_once: int = 1,
) -> dict[str, Any]:
    """Measure the baselines of photographs, and find of what kind their errors are.

    Parameters
    ----------
    analyser : Analyser
    pairs : RelitPairs
        That were measured.
    compared : Comparison
        Of them.
    folder : Path
        Gets the images of a few photographs.
    at_once : int
        Photographs that are analysed side by side.

    Returns
    -------
    dict
        Plain: metrics of the baselines, errors by kind, and the photographs shown.
    """
    scores, errors = BaselineScores(compared.exposure), KindErrors.none()
    shown = shown_photographs(compared)

    def one(index: int) -> tuple[BaselineScores, KindErrors]:
        is_shown = pairs.capture.photographs[index].name in shown
        of_one = BaselineScores(compared.exposure)
        return of_one, _analyse_one(
            analyser, pairs, index, of_one, folder if is_shown else None
        )

    with thread_pool(at_once) as pool:
        analysed = pool.map(one, range(len(pairs)))
        for of_one, kind_errors in track(analysed, len(pairs), "baselines"):
            scores.extend(of_one)
            errors += kind_errors
    return {
        BASELINES: scores.to_dict(analyser.baselines.missing),
        ERROR_KINDS: {
            "kinds": errors.to_dict(),
            "definitions": dict(error_kinds.DEFINITIONS),
        },
        SHOWN: shown,
    }


def shown_photographs(compared: Comparison) -> list[str]:
    """Photographs whose baselines and kinds are shown: of middling error, and the worst."""
    ranked = [image.name for image in worst_to_best(compared.images)]
    return list(dict.fromkeys([ranked[len(ranked) // 2], ranked[0]]))


def image_file(folder: Path, photograph: str, baseline: str) -> Path:
    """File of the image of a baseline, of a photograph that is shown."""
    return folder / f"{photograph}.{baseline}.exr"


def _analyse_one(
    analyser: Analyser,
    pairs: RelitPairs,
    index: int,
    scores: BaselineScores,
    folder: Path | None,
) -> KindErrors:
    """Score the baselines of one photograph, and return the errors of its image."""
    photograph = pairs.capture.photographs[index]
    camera, light = (
        pairs.capture.cameras[photograph.camera],
        pairs.capture.lights[photograph.light],
    )
    # Before the photograph is read: others are, for this.
    nearest = analyser.baselines.nearest_to(camera, light, photograph.name)
    if nearest is not None:
        scores.add_nearest(photograph.name, nearest)
    pair, errors = pairs.read(index), KindErrors.none()
    for name, image in analyser.baselines.images(camera, light, nearest):
        scores.add(pair, name, image)
        if folder is not None and name != BLACK:
            write_exr(image_file(folder, photograph.name, name), image)
        if name == MEAN:
            kinds = analyser.kinds.kinds(pair, camera, light, image, scores.exposure)
            errors = errors_by_kind(pair, kinds, scores.exposure)
            if folder is not None:
                np.savez_compressed(folder / f"{photograph.name}.{KIND_FILE}", kinds=kinds)
        del image  # before the next one is made
    return errors
