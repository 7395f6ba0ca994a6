"""The model of costs: what each stage takes, linear in counts that are known beforehand.

CPU time, memory and disk of a stage are sums of amounts of work (`work_of`, `memory_of`,
`disk_of`) times what a unit of each takes. These unit costs are fitted to runs that have been
measured (`fitted`), by least squares of the logarithm of predicted over measured: a stage is to
be predicted within a factor, whatever its size. Times are those of a reference machine;
`machine_speed` compares this one with it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import nnls

from reflfield.errors import InputError
from reflfield.field.clustered_pca import HALF_VECTOR
from reflfield.fitting.lobe_count import MOST_LOBES, rounds_of
from reflfield.pipeline.half_vector_fit import LOBE_TEXELS, TRAINING_TEXELS, USUAL_LOBES
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.tradeoff.work_counts import WorkCounts
from reflfield.util.files import read_bytes

Amounts = Mapping[str, float]

# File of the unit costs in this package.
SHIPPED = "unit_costs.json"
FORMAT, VERSION, LARGEST_FILE = "reflfield-unit-costs", 1, 1 << 20
# Amounts are counted in such numbers of texels, samples, pixels.
UNIT = 1e-6
# Below this a stage takes nothing that matters, and its relative error says little.
LEAST_SECONDS, LEAST_MEMORY, LEAST_DISK = 0.5, 64e6, 0.5e6
# Weight of the unit costs that are known beside those of a measured run.
PRIOR_WEIGHT = 0.3
# Rounds of the fit, whose weights follow its predictions.
ROUNDS = 20
# Kinds of costs: seconds of CPU time, bytes of memory, bytes on disk.
CPU, MEMORY, DISK = "cpu", "memory", "disk"
LEAST = {CPU: LEAST_SECONDS, MEMORY: LEAST_MEMORY, DISK: LEAST_DISK}
# Stages that a process of its own computes, whose CPU time no record has: wall time counts.
BY_A_PROCESS = ("atlas",)
# Share of a stage's CPU time that threads can do at the same time.
PARALLEL_SHARE = {
    **dict.fromkeys(("surface", "compression", "completion", "alignment", "resampling"), 0.8),
    **dict.fromkeys(("silhouettes", "held_out_silhouettes", "comparison"), 0.7),
    **dict.fromkeys(("hull", "hollows", "observations", "indirect"), 0.5),
    **dict.fromkeys(("surface_indirect", "error_analysis", "model_selection"), 0.6),
    "surface_observations": 0.5,
    "left_out_views": 0.8,
}
# Starting the command and importing its libraries, CPU seconds.
START_SECONDS = 4.0


class StageMeasured(NamedTuple):
    """What a stage of a run with known counts has taken."""

    stage: str
    counts: WorkCounts
    options: PipelineOptions
    cpu: float
    memory: float
    disk: float


def lobes_of(options: PipelineOptions) -> int:
    """Lobes that are fitted; as many as usual where the photographs decide."""
    asked = options.compression.half_vector.n_lobes
    return USUAL_LOBES if asked == "auto" else int(asked)


def _left_out_views(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    """Fits of the half-vector model to a few texels with one lobe, two, and so on."""
    rounds = sum(k * rounds_of(k) for k in range(1, MOST_LOBES + 1))
    samples = min(counts.n_texels, LOBE_TEXELS) * counts.fitted_photographs
    return {"search of lobes": 1.0, "search of lobes, samples": rounds * samples * UNIT}


def _hull_fit(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    """Fit of the half-vector model to samples, and to photographs, on the hull."""
    n_photographs, lobes = counts.fitted_photographs, lobes_of(options)
    some = min(counts.n_texels, TRAINING_TEXELS)
    return {
        "tables, rounds": float(lobes * rounds_of(lobes)),
        "tables, samples": lobes * rounds_of(lobes) * some * n_photographs * UNIT,
        "coefficients, samples": lobes * counts.n_texels * n_photographs * UNIT,
        **_image_fit(counts, options),
    }


def _image_fit(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    """Steps on the photographs."""
    steps, lobes = options.compression.half_vector.image_steps, lobes_of(options)
    return {
        "image steps": float(steps > 0),
        "image steps, tables": float(steps * lobes),
        "image steps, pixels": steps * (1 + lobes) * counts.fitted_values * UNIT,
        "image steps, texels": steps * counts.n_texels * UNIT,
    }


def _surface(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    return {**_hull_fit(counts, options), "integration, texels": counts.n_texels * UNIT}


def _compression(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    field = {"field": 1.0, "field, texels": counts.n_texels * UNIT}
    if counts.model == HALF_VECTOR:
        fit = _image_fit if options.refines_surface else _hull_fit
        checked = {"field, samples": counts.n_samples * UNIT}
        return {**field, **checked, **fit(counts, options)}
    return {**field, **_clusters(counts, options)}


def _clusters(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    """Local PCA on the grid, then the fit to samples where they may be enough."""
    compression = options.compression
    if counts.one_view:
        return {"clusters of one view": compression.clusters * counts.n_samples * UNIT}
    components = 1 + compression.components
    work = {
        "clusters": float(compression.clusters),
        "clusters, texels": compression.clusters * components * counts.n_texels * UNIT,
        "clusters, nodes": components * counts.n_texels * counts.n_nodes * UNIT,
    }
    if compression.fit == "grid":
        return work
    steps = compression.samples.rounds * (1 + compression.samples.iterations / 12)
    some = min(counts.n_texels, compression.samples.max_bytes / (16 * counts.n_photographs))
    return {
        **work,
        "samples, basis": steps * components * some * counts.n_photographs * UNIT,
        "samples, coefficients": components**2 * counts.n_samples * UNIT,
        "samples, frames": counts.n_texels * UNIT,
    }


def _completion(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    completion = options.completion
    some = min(counts.n_texels, completion.training_texels)
    return {
        "completion": 1.0,
        "completion, samples": counts.n_samples * UNIT,
        "completion, nodes": counts.n_texels * counts.n_nodes * UNIT,
        "completion, basis": completion.passes * completion.rank * some * counts.n_nodes * UNIT,
        "completion, texels": completion.rank * counts.n_texels * UNIT,
    }


def _alignment(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    alignment = options.alignment
    if counts.one_view:
        return {"normals of one view": counts.n_samples * UNIT}
    if not alignment.enabled:
        return {"alignment": 1.0}
    searched = alignment.iterations * (alignment.band_limit / 8) ** 3 * counts.n_texels
    return {
        "alignment": 1.0,
        "alignment, search": searched * UNIT,
        "alignment, texels": counts.n_texels * UNIT,
        "alignment, refinement": alignment.refine * counts.n_samples * UNIT,
        "alignment, nodes": counts.n_texels * counts.n_nodes * UNIT,
    }


def _resampling(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    rank = options.compression.rank
    if counts.one_view:
        return {"fit of one view": counts.n_samples * UNIT}
    some = min(counts.n_texels, options.compression.training_texels)
    return {
        "resampling": 1.0,
        "resampling, samples": counts.n_samples * UNIT,
        "resampling, nodes": counts.n_texels * counts.n_nodes * UNIT,
        "resampling, basis": rank * some * counts.n_nodes * UNIT,
        "resampling, texels": rank * counts.n_texels * UNIT,
    }


def _silhouettes(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    made = counts.n_made / max(counts.n_views, 1) * counts.photograph_pixels
    return {"silhouettes, pixels": counts.view_pixels * UNIT, "silhouettes, made": made * UNIT}


def _hull(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    if counts.is_plane:
        return {}
    area = (options.hull.resolution / 192) ** 2
    return {
        "hull": 1.0,
        "hull, grid": area,
        "hull, views": area * counts.n_views,
        "hull, pixels": counts.view_pixels * UNIT,
    }


def _atlas(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    if counts.is_plane:
        return {}
    faces = options.hull.n_triangles or 400_000 * (options.hull.resolution / 192) ** 2
    return {
        "atlas, triangles": faces * UNIT,
        "atlas, texture": counts.texture_side**2 * UNIT,
    }


def _visibility(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    directions = counts.n_views + counts.n_lights
    return {
        "visibility": 1.0,
        "visibility, texels": counts.n_texels * UNIT,
        "visibility, rays": directions * counts.n_texels * UNIT,
        "visibility, pixels": counts.view_pixels * UNIT,
    }


def _observations(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    return {
        "observations": 1.0,
        "observations, photographs": float(counts.n_photographs),
        "observations, pixels": counts.photograph_pixels * UNIT,
        "observations, samples": counts.n_samples * UNIT,
    }


def _indirect(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    shown = counts.n_texels * counts.n_lights
    return {
        "indirect": 1.0,
        "indirect, samples": counts.n_samples * UNIT,
        "indirect, functions": (1 + options.indirect.n_components) * shown * UNIT,
    }


def _comparison(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    rays = options.relighting.samples_per_pixel / 16 * counts.compared_pixels
    return {
        "comparison": 1.0,
        "comparison, rays": rays * UNIT,
        "comparison, pixels": counts.compared_pixels * UNIT,
    }


def _analysis(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    return {
        "analysis": 1.0,
        "analysis, pixels": counts.compared_pixels * UNIT,
        "analysis, texels": counts.n_texels * UNIT,
    }


def _maps(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    return {"maps, samples": counts.n_samples * UNIT, "maps, texels": counts.n_texels * UNIT}


def _web_page(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    return {"page": 1.0, "page, texels": counts.n_texels * UNIT}


def _report(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    return {
        "report": 1.0,
        "report, compared": counts.compared_pixels * UNIT,
        "report, views": counts.view_pixels * UNIT,
    }


def _rate_distortion(counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    """Eight quantised fields, each compared."""
    fields = {"field": 8.0, "field, texels": 8 * counts.n_texels * UNIT}
    compared = {name: 8 * amount for name, amount in _comparison(counts, options).items()}
    return {**fields, **compared}


Work = Callable[[WorkCounts, PipelineOptions], dict[str, float]]
WORK: dict[str, Work] = {
    "silhouettes": _silhouettes,
    "hull": _hull,
    "hollows": lambda counts, options: {
        "observations, pixels": counts.glanced_pixels * UNIT,
        "stereo": float(counts.patches),
        "stereo, pixels": counts.patch_pixels * UNIT,
    },
    "atlas": _atlas,
    "visibility": _visibility,
    "observations": _observations,
    "held_out_silhouettes": lambda counts, options: {"compared": 1.0},
    "left_out_views": _left_out_views,
    "indirect": _indirect,
    "surface": _surface,
    "surface_visibility": _visibility,
    "surface_observations": _observations,
    "surface_indirect": _indirect,
    "completion": _completion,
    "alignment": _alignment,
    "resampling": _resampling,
    "compression": _compression,
    "maps": _maps,
    "without_alignment": _compression,
    "comparison": _comparison,
    "error_analysis": _analysis,
    "rate_distortion": _rate_distortion,
    "web_page": _web_page,
    "report": _report,
}


def memory_of(stage: str, counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    """Amounts that the peak of a stage's memory grows with."""
    fits = stage in ("surface", "compression", "without_alignment", "alignment", "completion")
    held = {"libraries": 1.0, "held, texels": counts.n_texels * UNIT}
    if stage in ("silhouettes", "hull", "hollows", "atlas"):
        return {"libraries, early": 1.0, "hull, memory": float(not counts.is_plane)}
    if not fits:
        return held | {"held, pixels": counts.largest_pixels * UNIT}
    kind = "fit" if counts.model == HALF_VECTOR else "clusters"
    pixels = counts.fitted_values if kind == "fit" else 0.0
    return held | {
        f"{kind}, memory": 1.0,
        f"{kind}, held samples": counts.n_samples * UNIT,
        # Per pixel and light: values, and derivatives after colours, lobes and rotations.
        f"{kind}, held pixels": (13 + 3 * lobes_of(options)) * pixels * UNIT,
    }


def disk_of(stage: str, counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    """Amounts that the size of a stage's results grows with."""
    amount = {
        **dict.fromkeys(("observations", "surface_observations"), counts.n_samples),
        **dict.fromkeys(("comparison", "error_analysis", "report"), counts.compared_pixels),
        "silhouettes": counts.covered_pixels,
        "completion": counts.n_texels * options.completion.rank,
        "resampling": counts.n_texels * options.compression.rank,
    }.get(stage, counts.n_texels)
    kind = stage.removeprefix("surface_")
    return {f"{kind}": 1.0, f"{kind}, amount": amount * UNIT}


def work_of(stage: str, counts: WorkCounts, options: PipelineOptions) -> dict[str, float]:
    """Amounts of work of a stage, by name; several stages share some."""
    return WORK[stage](counts, options)


AMOUNTS: dict[str, Callable[[str, WorkCounts, PipelineOptions], dict[str, float]]] = {
    CPU: work_of,
    MEMORY: memory_of,
    DISK: disk_of,
}


@dataclass(frozen=True)
class UnitCosts:
    """What a unit of each amount takes.

    Parameters
    ----------
    units : mapping of str to mapping of str to float
        For CPU seconds, bytes of memory and of disk: by the names of the amounts.
    machine_seconds : mapping of str to float
        What the reference machine took for the work of `machine_speed`.
    """

    units: Mapping[str, Amounts]
    machine_seconds: Amounts

    def cost(
        self, kind: str, stage: str, counts: WorkCounts, options: PipelineOptions
    ) -> float:
        """CPU seconds on the reference machine, or bytes, of a stage."""
        units = self.units[kind]
        amounts = AMOUNTS[kind](stage, counts, options)
        return float(sum(units.get(name, 0.0) * amount for name, amount in amounts.items()))

    def document(self) -> dict[str, Any]:
        """As `read_costs` reads them."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "machine seconds": dict(self.machine_seconds),
            "units": {kind: dict(units) for kind, units in self.units.items()},
        }


@cache
def shipped_costs() -> UnitCosts:
    """Unit costs that come with the package."""
    return costs_of((resources.files("reflfield.tradeoff") / SHIPPED).read_bytes(), SHIPPED)


def read_costs(path: Path) -> UnitCosts:
    """Unit costs that a sweep has fitted.

    Raises
    ------
    InputError
        If the file cannot be read, or holds something else.
    """
    return costs_of(read_bytes(path, LARGEST_FILE), str(path))


def costs_of(content: bytes, name: str) -> UnitCosts:
    """Unit costs of a document in JSON.

    Raises
    ------
    InputError
        If it is something else.
    """
    try:
        stored = json.loads(content)
        is_ours = stored["format"] == FORMAT and stored["version"] == VERSION
        tables = {"machine seconds": stored["machine seconds"], **stored["units"]}
        usable = all(
            isinstance(value, (int, float)) and 0 <= value < float("inf")
            for table in tables.values()
            for value in table.values()
        )
        complete = set(tables) >= {CPU, MEMORY, DISK} and all(
            tables["machine seconds"].values()
        )
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        is_ours = usable = complete = False
    if not (is_ours and usable and complete):
        raise InputError(
            f"{name}: expected unit costs as `reflfield tradeoff` writes them, received "
            "something else; run the sweep again"
        )
    return UnitCosts(stored["units"], stored["machine seconds"])


def fitted(
    measured: Iterable[StageMeasured], prior: UnitCosts | None, machine_seconds: Amounts
) -> UnitCosts:
    """Fit unit costs to stages that have been measured.

    Parameters
    ----------
    measured : iterable of StageMeasured
        NaN where something is not known.
    prior : UnitCosts, optional
        Holds what the runs do not show: another value of a unit cost costs as much as that
        relative error of a measured stage, times `PRIOR_WEIGHT`.
    machine_seconds : mapping of str to float
        Of the machine on which they were measured.

    Returns
    -------
    UnitCosts
    """
    rows = list(measured)
    units = {}
    for kind, amounts_of in AMOUNTS.items():
        known = [row for row in rows if np.isfinite(getattr(row, kind))]
        amounts = [amounts_of(row.stage, row.counts, row.options) for row in known]
        costs = np.array([getattr(row, kind) for row in known])
        known_units = None if prior is None else prior.units[kind]
        units[kind] = _fitted_units(amounts, costs, LEAST[kind], known_units)
    return UnitCosts(units, dict(machine_seconds))


def _fitted_units(
    amounts: list[dict[str, float]],
    costs: np.ndarray,
    least: float,
    prior: Amounts | None,
) -> dict[str, float]:
    """Non-negative unit costs of the least squared logarithm of predicted over measured.

    Errors over the root of predicted times measured are nearly these logarithms, and as large
    for predictions that are too low as for such that are too high: linear least squares, whose
    weights follow the predictions, a few times; of these the best is kept.
    """
    names = sorted({name for row in amounts for name in row} | set(prior or ()))
    matrix = np.array([[row.get(name, 0.0) for name in names] for row in amounts])
    known = np.array([(prior or {}).get(name, 0.0) for name in names])
    held = np.diag(PRIOR_WEIGHT / np.where(known > 0, known, np.inf))
    measured = costs + least
    predicted, best, best_error = measured, known, np.inf
    for _ in range(ROUNDS):
        weight = 1 / np.sqrt(predicted * measured)
        units, _ = nnls(
            np.vstack([matrix * weight[:, None], held]),
            np.concatenate([costs * weight, held @ known]),
            maxiter=100 * len(names),
        )
        solved = matrix @ units + least
        error = float(np.square(np.log(solved / measured)).sum())
        error += float(np.square(held @ (units - known)).sum())
        if error < best_error:
            best, best_error = units, error
        predicted = np.sqrt(predicted * solved)
    return {name: float(f"{u:.6g}") for name, u in zip(names, best, strict=True) if u > 0}
