"""An alignment model as named arrays, so that a pipeline can keep it between blocks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.alignment_model import (
    AlignmentModel,
    HarmonicTargets,
    Projection,
    SampleTargets,
)
from reflfield.alignment.frame_ambiguity import Symmetry
from reflfield.alignment.refinement import RefinementOptions
from reflfield.alignment.spline_targets import SplineTargets
from reflfield.sphere.coupling import Coupled
from reflfield.sphere.harmonic_projection import Projector

Arrays = dict[str, NDArray[Any]]
NO_LIMIT = np.inf


def arrays_of_model(model: AlignmentModel) -> Arrays:
    """Everything that a model holds, without pickling."""
    projector, max_tilt = model.projection.projector, model.projection.max_tilt
    arrays: Arrays = {
        "views": np.asarray(projector.views),
        "lights": np.asarray(projector.lights),
        "band_limits": np.array(projector.band_limits),
        "prior": model.projection.prior,
        "max_tilt": np.array(NO_LIMIT if max_tilt is None else max_tilt),
        "history": model.history,
        "symmetries": _kinds(model.harmonic.symmetries),
        **_blocks("plain", model.harmonic.plain),
        **_blocks("imputed", model.harmonic.imputed),
    }
    if model.sharp is not None:
        sharp = model.sharp
        arrays |= {
            "sharp": sharp.targets.values,
            "sides": np.array(sharp.targets.sides),
            "in_plane": sharp.in_plane,
            "common": sharp.common,
            "sharp symmetries": _kinds(sharp.symmetries),
            **{f"option {name}": np.array(x) for name, x in asdict(sharp.options).items()},
            **_blocks("targets", model.targets),
        }
    return arrays


def model_of_arrays(arrays: Mapping[str, NDArray[Any]]) -> AlignmentModel:
    """Return the model that `arrays_of_model` was given."""
    limits = (int(arrays["band_limits"][0]), int(arrays["band_limits"][1]))
    max_tilt = float(arrays["max_tilt"])
    projection = Projection(
        Projector(arrays["views"], arrays["lights"], limits),
        arrays["prior"],
        None if max_tilt == NO_LIMIT else max_tilt,
    )
    harmonic = HarmonicTargets(
        _coupled("plain", arrays, limits),
        _coupled("imputed", arrays, limits),
        _symmetries(arrays["symmetries"]),
    )
    sharp, targets = None, harmonic.imputed
    if "sharp" in arrays:
        sides = arrays["sides"]
        names = RefinementOptions.__dataclass_fields__
        sharp = SampleTargets(
            SplineTargets(arrays["sharp"], int(sides[0]), int(sides[1])),
            RefinementOptions(**{name: arrays[f"option {name}"].item() for name in names}),
            arrays["in_plane"],
            arrays["common"],
            _symmetries(arrays["sharp symmetries"]),
        )
        targets = _coupled("targets", arrays, limits)
    return AlignmentModel(projection, harmonic, sharp, targets, arrays["history"])


def _kinds(symmetries: tuple[Symmetry, ...]) -> NDArray[np.str_]:
    return np.array([symmetry.kind for symmetry in symmetries])


def _symmetries(kinds: NDArray[np.str_]) -> tuple[Symmetry, ...]:
    return tuple(Symmetry(str(kind)) for kind in kinds)


def _blocks(name: str, coupled: Coupled) -> Arrays:
    return {f"{name} {j}": block for j, block in enumerate(coupled.blocks)}


def _coupled(name: str, arrays: Mapping[str, NDArray[Any]], limits: tuple[int, int]) -> Coupled:
    blocks = tuple(arrays[f"{name} {j}"] for j in range(sum(limits) - 1))
    return Coupled(limits, blocks)
