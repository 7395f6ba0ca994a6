"""The reflectance field: what a texel sends to any viewer under any light.

A texel holds the number of its cluster, a local frame and K coefficients. A
cluster holds a mean and K basis functions of two directions, on the nodes of
two `HemisphereGrid`. The sample for view v and light l, both in the texel's
frame, is

    value(v, l) = s(l) D^-1( mean(v, l) + sum_k coefficient_k basis_k(v, l) ),

bilinear on both grids, with D the `domain`: the signed cube root by default.
Samples are radiance divided by the irradiance of a surface facing the light,
so the cosine (and, unless it was factored out, the shadow) is included: s is that
cosine, rounded at the horizon (`sphere.hemisphere.softened_cosine`), or 1 where the
direction of the light does not vary. It stands outside the interpolation because its
root falls to the horizon too steeply for any grid.

Where shadows were factored out, a texel that a light does not reach shows indirect light
(`field.indirect`): a mean and a few functions of the light's direction in the world, shared by
all texels, with coefficients of its own.

Arrays are kept as they are stored, quantised (`field.tucker_coding`, `field.quantisation`);
properties decode them when first asked for. A field opened from a file reads only what is
used.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import FieldFileError, InputError
from reflfield.field.array_schemas import SCHEMAS, check_indices
from reflfield.field.half_vector import (
    LEAST_COSINE,
    SKEW_STEP,
    HalfVectorModel,
)
from reflfield.field.indirect_light import IndirectLight
from reflfield.field.observed_sphere import MOST_OBSERVED
from reflfield.field.quantisation import (
    QuantisedBox,
    check_finite,
    rotations_from_codes,
)
from reflfield.field.tucker_coding import unfactor_table
from reflfield.util.blas_threads import one_core_blas
from reflfield.util.validation import unit_direction

Domain = Literal["cube_root", "square_root", "linear"]
Visibility = Literal["kept", "factored"]
LightModel = Literal["known", "unknown"]

# Domain to the power that undoes it.
INVERSE_POWER = {"cube_root": 3, "square_root": 2, "linear": 1}
VISIBILITIES = ("kept", "factored")
LIGHT_MODELS = ("known", "unknown")

# Largest sample that a field may show, 1/sr, by the sum of its terms; sums of samples under
# lights of any ordinary unit stay finite as singles.
LARGEST_SAMPLE = 1e33
# Largest gain of bounced light; those that are fitted are about 1, or 0.
LARGEST_GAIN = 10.0


@dataclass(frozen=True, eq=False)
class ReflectanceField(ABC):
    """What fields of all models share. Made by `build.build_field` or `file.open_field`.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        Stored arrays by the names of the model's schema, quantised.
    domain : {"cube_root", "square_root", "linear"}
        Domain of indirect light, and of a clustered field's mean and basis.
    visibility : {"kept", "factored"}
        "kept": shadows are in the samples; "factored": they are to be traced.
    light_model : {"known", "unknown"}
        "unknown": one constant, unknown light; samples are radiance itself.
    metadata : dict
        Options, versions and counts of the run that made the field; plain
        JSON values.
    """

    arrays: Mapping[str, NDArray[Any]]
    domain: Domain = "cube_root"
    visibility: Visibility = "kept"
    light_model: LightModel = "known"
    metadata: dict[str, Any] = field(default_factory=dict)

    model: ClassVar[str]

    @abstractmethod
    def decode(self) -> None:
        """Decode what evaluation reads, before threads could each do it."""

    @property
    @abstractmethod
    def light_nodes(self) -> int:
        """Numbers that a sum over lights keeps of each texel and channel."""

    @property
    @abstractmethod
    def usual_root(self) -> float:
        """Root mean square of usual samples, transformed."""

    @property
    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Sizes of the model, by name."""

    @property
    @abstractmethod
    def parts(self) -> dict[str, NDArray[np.floating]]:
        """Decoded parts of the model, by name."""

    @property
    @abstractmethod
    def decoded_bytes(self) -> int:
        """Memory of the decoded model, what is kept only while it is decoded included."""

    @cached_property
    def positions(self) -> NDArray[np.float64]:
        """(n_vertices, 3) float64 vertices, metres, world frame."""
        check_finite("position_box", self.arrays["position_box"])
        box = self.arrays["position_box"].astype(np.float64)
        points = QuantisedBox(self.arrays["positions"], box).decode()
        return points.astype(np.float64, copy=False)

    @cached_property
    def uv(self) -> NDArray[np.float32]:
        """(n_vertices, 2) float32 texture coordinates, v up."""
        check_finite("uv_box", self.arrays["uv_box"])
        return QuantisedBox(self.arrays["uv"], self.arrays["uv_box"]).decode()

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """(n_faces, 3) int32 vertex indices."""
        return check_indices("faces", self.arrays["faces"], 0, len(self.arrays["positions"]))

    @cached_property
    def texel_of_pixel(self) -> NDArray[np.int32]:
        """(height, width) int32 nearest texel, -1 where none; row 0 is v = 1."""
        return check_indices("texel_of_pixel", self.arrays["texel_of_pixel"], -1, self.n_texels)

    @cached_property
    def local_from_world(self) -> NDArray[np.float32]:
        """(n_texels, 3, 3) float32 aligned frames."""
        step = float(self.arrays["turn_step"][0])
        return rotations_from_codes(self.arrays["turns"], step)

    @cached_property
    def indirect(self) -> IndirectLight:
        """Indirect light, transformed; see `field.indirect`."""
        functions, scale = (self.arrays[f"indirect_{n}"] for n in ("functions", "scale"))
        codes = self.arrays["indirect_coefficients"].astype(np.float32)
        self._check_samples("indirect_functions", functions, 0, codes * scale)
        gain = self.arrays["bounce_gain"]
        check_finite("bounce_gain", gain)
        self._check_bound("bounce_gain", float(np.abs(gain).max()), LARGEST_GAIN)
        return IndirectLight(functions, codes * scale, self.observed_lights, gain)

    def _check_samples(
        self, name: str, functions: NDArray[Any], axis: int, weights: NDArray[Any]
    ) -> None:
        """Demand functions, the mean first, whose weighted sums stay finite as samples."""
        others = tuple(i for i in range(functions.ndim) if i != axis)
        most = np.maximum(functions.max(axis=others), -functions.min(axis=others))
        of_weights = np.maximum(weights.max(axis=0, initial=0), -weights.min(axis=0, initial=0))
        bound = float(most[0] + most[1:].astype(np.float64) @ of_weights.astype(np.float64))
        self._check_bound(name, bound, LARGEST_SAMPLE ** (1.0 / self.inverse_power))

    def _check_bound(self, name: str, bound: float, limit: float) -> None:
        """Demand a bound on the magnitude of samples below a limit."""
        if not bound <= limit:  # nor is NaN
            wrong = (
                f"{name}: expected finite numbers, in all at most {limit:.3g}, received "
                f"{bound:.3g}; make the field again"
            )
            path = getattr(self.arrays, "path", None)
            raise InputError(wrong) if path is None else FieldFileError(f"{path}: {wrong}")

    @cached_property
    def observed_lights(self) -> NDArray[np.float64] | None:
        """(n, 3) unit directions that the capture's lights came from; None if not stated.

        Raises
        ------
        InputError
            If the metadata state something else than directions.
        """
        stated = self.metadata.get("observed_lights")
        if stated is None:
            return None
        try:
            directions = np.asarray(stated, np.float64).reshape(-1, 3)
            lengths = np.linalg.norm(directions, axis=1, keepdims=True)
            if not (np.abs(lengths - 1.0) < 0.1).all() or len(directions) > MOST_OBSERVED:
                raise ValueError
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"metadata: observed_lights: expected at most {MOST_OBSERVED} unit directions, "
                f"received {stated!r:.100}"
            ) from None
        return directions / lengths

    @property
    def n_texels(self) -> int:
        """Number of texels."""
        return len(self.arrays["turns"])

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) unit world direction that is up, of the capture; +Z where it is not stated.

        Raises
        ------
        InputError
            If the metadata state something else than a direction.
        """
        stated = self.metadata.get("up", (0.0, 0.0, 1.0))
        try:
            return unit_direction("metadata: up", stated)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"metadata: up: expected three finite numbers, not all zero, received "
                f"{stated!r:.100}"
            ) from error

    @property
    def inverse_power(self) -> int:
        """Power that leads from the domain back to samples."""
        return INVERSE_POWER[self.domain]


@dataclass(frozen=True, eq=False)
class ClusteredField(ReflectanceField):
    """Field of clusters, each with mean and basis on the nodes of two grids.

    Parameters
    ----------
    view_side, light_side : int
        Sides of the two `HemisphereGrid`; 1 means that direction does not vary.
    """

    model: ClassVar[str] = "clustered"
    view_side: int = 1
    light_side: int = 1

    def decode(self) -> None:
        """Decode what evaluation reads, before threads could each do it."""
        _ = (self.node_table, self.component_weights, self.local_from_world)

    @property
    def light_nodes(self) -> int:
        """Numbers that a sum over lights keeps of each texel and channel."""
        return self.light_side**2

    @property
    def usual_root(self) -> float:
        """Root mean square of the means, transformed."""
        return float(np.sqrt(np.mean(np.square(self.mean, dtype=np.float64))))

    @property
    def counts(self) -> dict[str, int]:
        """Sizes of the model, by name."""
        return {
            "clusters": self.n_clusters,
            "components": self.n_components,
            "view_side": self.view_side,
            "light_side": self.light_side,
        }

    @property
    def parts(self) -> dict[str, NDArray[np.floating]]:
        """Decoded parts of the model, by name."""
        return {"coefficients": self.coefficients, "mean": self.mean, "basis": self.basis}

    @property
    def decoded_bytes(self) -> int:
        """Memory of tables and coefficients, in singles."""
        n_clusters, n_functions, _ = self.arrays["function_factor"].shape
        nodes = len(self.arrays["view_factor"]) * len(self.arrays["light_factor"])
        # The table once as it is decoded and once as it is kept.
        return 2 * 12 * n_clusters * nodes * n_functions + 8 * n_functions * self.n_texels

    @cached_property
    def cluster(self) -> NDArray[np.int32]:
        """(n_texels,) int32 cluster of each texel."""
        wide = self.arrays["cluster"].astype(np.int32)
        return check_indices("cluster", wide, 0, self.n_clusters)

    @cached_property
    def coefficients(self) -> NDArray[np.float32]:
        """(n_texels, K) float32 weights of the basis functions."""
        scale = self.arrays["coefficient_scale"][self.cluster]
        return self.arrays["coefficients"].astype(np.float32) * scale

    @cached_property
    def node_table(self) -> NDArray[np.float32]:
        """(n_clusters, n_view_nodes, n_light_nodes, K + 1, 3): mean, then basis.

        Component and channel run fastest, so that one tap reads one run of
        memory. This is the largest thing a field needs: 31 MB for 16 clusters of
        10 components on 11 x 11 nodes for each direction, 411 MB on 21 x 21.
        """
        for name in ("function", "view", "light", "core"):
            check_finite(f"{name}_scale", self.arrays[f"{name}_scale"])
        check_finite("function_gain", self.arrays["function_gain"])
        check_finite("colour_factor", self.arrays["colour_factor"])
        with one_core_blas(), np.errstate(over="ignore", invalid="ignore"):
            table = unfactor_table(self.arrays)
        self._check_samples("functions", table, 1, self.coefficients)
        return np.ascontiguousarray(np.moveaxis(table, 1, 3))

    @property
    def mean(self) -> NDArray[np.float32]:
        """(n_clusters, n_view_nodes, n_light_nodes, 3) float32."""
        return self.node_table[..., 0, :]

    @property
    def basis(self) -> NDArray[np.float32]:
        """(n_clusters, K, n_view_nodes, n_light_nodes, 3) float32."""
        return np.moveaxis(self.node_table[..., 1:, :], 3, 1)

    @cached_property
    def component_weights(self) -> NDArray[np.float32]:
        """(n_texels, K + 1) float32: 1 for the mean, then the coefficients."""
        ones = np.ones((self.n_texels, 1), np.float32)
        return np.concatenate([ones, self.coefficients], axis=1)

    @property
    def n_clusters(self) -> int:
        """Number of clusters."""
        return len(self.arrays["coefficient_scale"])

    @property
    def n_components(self) -> int:
        """Number of basis functions of a cluster."""
        return int(self.arrays["coefficient_scale"].shape[1])


@dataclass(frozen=True, eq=False)
class HalfVectorField(ReflectanceField):
    """Field of functions of the half vector that all texels share; see `field.half_vector`."""

    model: ClassVar[str] = "half_vector"

    def decode(self) -> None:
        """Decode what evaluation reads, before threads could each do it."""
        _ = self.half_vector

    @property
    def light_nodes(self) -> int:
        """Numbers that a sum over lights keeps of each texel and channel."""
        return 1

    @property
    def usual_root(self) -> float:
        """Root mean square of the cube roots of the diffuse colours."""
        roots = np.cbrt(self.half_vector.diffuse.astype(np.float64))
        return float(np.sqrt(np.mean(np.square(roots))))

    @property
    def counts(self) -> dict[str, int]:
        """Sizes of the model, by name."""
        return {"lobes": self.half_vector.n_lobes}

    @property
    def parts(self) -> dict[str, NDArray[np.floating]]:
        """Decoded parts of the model, by name."""
        model = self.half_vector
        return {"diffuse": model.diffuse, "weights": model.weights, "lobes": model.lobes}

    @property
    def decoded_bytes(self) -> int:
        """Memory of lobes, weights and colours, in singles."""
        sizes = (self.arrays[name].size for name in ("lobes", "lobe_weights", "diffuse"))
        return 2 * 4 * sum(sizes)

    @cached_property
    def half_vector(self) -> HalfVectorModel:
        """Frames, coefficients and tables, decoded."""
        for name in ("diffuse_scale", "lobe_weight_scale", "lobe_scale", "diffuse_table"):
            check_finite(name, self.arrays[name])
        with np.errstate(over="ignore", invalid="ignore"):
            green, red, blue = self.arrays["diffuse"].astype(np.float32).T
            roots = np.stack([red + green, green, blue + green], axis=1)
            diffuse = np.maximum(roots * self.arrays["diffuse_scale"], 0) ** 3
            weights = self.arrays["lobe_weights"] * self.arrays["lobe_weight_scale"]
            scale = self.arrays["lobe_scale"][:, None]
            lobes = np.moveaxis(self.arrays["lobes"] * scale, 0, 1)
            weights, lobes = (np.maximum(x, 0) ** 3 for x in (weights, lobes))
            peaks = lobes.max(axis=(1, 2), initial=0.0).astype(np.float64)
            most = (weights.max(axis=0, initial=0.0).astype(np.float64) * peaks).sum()
            # The visibility factor is at most 1 over the least cosine, that of the skew 2.
            bound = float(2 * most / LEAST_COSINE + np.abs(diffuse).max(initial=0.0))
        self._check_bound("diffuse, lobe_weights, lobes", bound, LARGEST_SAMPLE)
        return HalfVectorModel(
            frames=self.local_from_world,
            diffuse=diffuse.astype(np.float32),
            weights=weights.astype(np.float32),
            lobes=np.ascontiguousarray(lobes, np.float32),
            skews=np.clip(self.arrays["lobe_skews"] * SKEW_STEP, -1, 1),
            diffuse_table=np.ascontiguousarray(self.arrays["diffuse_table"], np.float32),
        )


def check_options(
    domain: str, visibility: str, light_model: str, model: str = "clustered"
) -> None:
    """Demand known words for the options of a field.

    Raises
    ------
    InputError
        If one is unknown.
    """
    for name, value, known in (
        ("domain", domain, tuple(INVERSE_POWER)),
        ("visibility", visibility, VISIBILITIES),
        ("light_model", light_model, LIGHT_MODELS),
        ("model", model, tuple(SCHEMAS)),
    ):
        if value not in known:
            raise InputError(f"{name}: expected one of {list(known)}, received {value!r}")
