"""Options that a sweep varies, their values, and configurations: sets of such values."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from reflfield.errors import InputError
from reflfield.field.clustered_pca import CLUSTERED, HALF_VECTOR
from reflfield.options import parse_settings, with_tables
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.tradeoff.work_counts import WorkCounts

Value = bool | int | float | str
# Shares of the views and the lights that make the field: no options of a run.
VIEWS, LIGHTS = "views", "lights"
SHARES = (0.5, 0.25, 0.75)
# What only changes how a field is shown, not the field.
SHOWING = ("relighting.samples_per_pixel",)
DEFAULT_NAME = "default"
MIXED = 1e-3

# Options of frames that are searched for by correlation.
OF_SEARCHED_FRAMES = (
    *("completion.passes", "completion.rank", "completion.method"),
    *("alignment.iterations", "alignment.refine", "alignment.band_limit"),
    "alignment.n_clusters",
)


@dataclass(frozen=True)
class SweptOption:
    """An option and the values that are tried.

    Parameters
    ----------
    name : str
        ``stage.option``; or "views", "lights": shares that make the field.
    values : tuple
    models : tuple of str
        Models of fields that it matters to.
    solid : bool
        Whether it needs a solid object.
    """

    name: str
    values: tuple[Value, ...]
    models: tuple[str, ...] = (HALF_VECTOR, CLUSTERED)
    solid: bool = False

    @property
    def stage(self) -> str:
        """First part of the name."""
        return self.name.partition(".")[0]

    def matters(self, counts: WorkCounts) -> bool:
        """Whether the option changes anything in a run with such counts."""
        if self.name in (VIEWS, LIGHTS):
            return (counts.n_views if self.name == VIEWS else counts.n_lights) >= 4
        needed = {
            "resampling.view_side": counts.n_views > 1,
            "resampling.light_side": counts.n_lights > 1,
            "indirect.enabled": counts.shades,
            "indirect.n_components": counts.shades,
            "indirect.bounce": counts.shades,
            # Whose frames are those of photometric stereo, of samples that are not completed.
            **dict.fromkeys(OF_SEARCHED_FRAMES, not counts.one_view),
        }
        usable = counts.model in self.models and not (self.solid and counts.is_plane)
        return usable and needed.get(self.name, True)


_HALF, _CLUSTERS = (HALF_VECTOR,), (CLUSTERED,)
# The first are tried first, where the time does not suffice for all.
SWEPT = (
    SweptOption("texture.texels_per_pixel", (0.6, 0.8, 1.1, 1.6, 2.2), solid=True),
    SweptOption("texture.largest", (128, 256, 512, 1024), solid=True),
    SweptOption("compression.half_vector.image_steps", (0, 1, 2, 4), _HALF),
    SweptOption("compression.half_vector.n_lobes", ("auto", 1, 2, 3, 4), _HALF),
    SweptOption("compression.fit", ("auto", "grid", "samples"), _CLUSTERS),
    SweptOption("alignment.iterations", (1, 2, 4, 8), _CLUSTERS),
    SweptOption("compression.half_vector.surface_from_normals", (False, True), _HALF),
    SweptOption(LIGHTS, (*SHARES, 1.0)),
    SweptOption(VIEWS, (*SHARES, 1.0)),
    SweptOption("hull.resolution", (96, 128, 192, 256), solid=True),
    SweptOption("alignment.refine", (False, True), _CLUSTERS),
    SweptOption("alignment.band_limit", (4, 6, 8, 12), _CLUSTERS),
    SweptOption("resampling.light_side", (0, 5, 7, 9, 11, 13), _CLUSTERS),
    SweptOption("resampling.view_side", (0, 5, 7, 9, 11, 13), _CLUSTERS),
    SweptOption("completion.passes", (1, 2, 4, 8), _CLUSTERS),
    SweptOption("completion.rank", (6, 12, 24), _CLUSTERS),
    SweptOption("compression.n_components", (3, 6, 12), _CLUSTERS),
    SweptOption("compression.n_clusters", (1, 4, 8, 16), _CLUSTERS),
    SweptOption("compression.samples.rounds", (1, 2, 4, 8), _CLUSTERS),
    SweptOption("compression.samples.iterations", (6, 12, 24), _CLUSTERS),
    SweptOption("compression.rank", (8, 16, 32), _CLUSTERS),
    SweptOption("compression.half_vector.smoothness", (1e-4, 3e-4, 1e-3), _HALF),
    SweptOption("indirect.n_components", (2, 8, 16), solid=True),
    SweptOption("indirect.enabled", (False, True), solid=True),
    SweptOption("indirect.bounce", (False, True), solid=True),
    SweptOption("alignment.enabled", (False, True), _CLUSTERS),
    SweptOption("alignment.n_clusters", (1, 2, 4), _CLUSTERS),
    SweptOption("completion.method", ("map", "brand"), _CLUSTERS),
    SweptOption("compression.samples.grid_refinement", (1.0, 4 / 3, 2.0), _CLUSTERS),
    SweptOption("hull.n_triangles", (5_000, 20_000, 60_000), solid=True),
    SweptOption("compression.relative_step", (0.25, 0.5, 1.0, 2.0)),
    SweptOption("relighting.samples_per_pixel", (1, 4, 16)),
)
STAGES = tuple(dict.fromkeys(option.stage for option in SWEPT))


@dataclass(frozen=True)
class Configuration:
    """Values of some options that differ from those that a sweep is about.

    Parameters
    ----------
    settings : tuple of (str, value)
        By name, ascending.
    views, lights : float
        Shares of the views and lights that make the field.
    """

    settings: tuple[tuple[str, Value], ...] = ()
    views: float = 1.0
    lights: float = 1.0

    @property
    def name(self) -> str:
        """The differences in words.

        Examples
        --------
        >>> Configuration((("hull.resolution", 96),), lights=0.5).name
        'hull.resolution=96, lights=50%'
        >>> Configuration().name
        'default'
        """
        return self._named(dict(self.settings))

    @property
    def short_name(self) -> str:
        """The differences in words, without the stages of options in groups of their own.

        Examples
        --------
        >>> Configuration((("compression.half_vector.n_lobes", 1),)).short_name
        'half_vector.n_lobes=1'
        """
        return self._named({".".join(n.split(".")[-2:]): v for n, v in self.settings})

    def _named(self, settings: Mapping[str, Value]) -> str:
        shares = {VIEWS: self.views, LIGHTS: self.lights}
        words = [f"{name}={shown(value)}" for name, value in settings.items()]
        words += [f"{name}={share:.0%}" for name, share in shares.items() if share < 1]
        return ", ".join(words) or DEFAULT_NAME

    @property
    def folder(self) -> str:
        """Name of the folder of its run."""
        text = json.dumps([self.settings, self.views, self.lights])
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def having(self, option: str, value: Value) -> Configuration:
        """The configuration with another value of an option, or share."""
        if option == VIEWS:
            return replace(self, views=float(value))
        if option == LIGHTS:
            return replace(self, lights=float(value))
        settings = {**dict(self.settings), option: value}
        return replace(self, settings=tuple(sorted(settings.items())))

    def applied_to(self, options: PipelineOptions) -> PipelineOptions:
        """Options with these values."""
        return with_tables(options, nested(dict(self.settings)))


def shown(value: Value) -> str:
    """A value as ``--set`` takes it.

    Examples
    --------
    >>> shown(True), shown(4 / 3), shown("auto")
    ('true', '1.333', 'auto')
    """
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def nested(settings: Mapping[str, Value]) -> dict[str, Any]:
    """Tables of options of values by ``stage.option``.

    Examples
    --------
    >>> nested({"compression.half_vector.n_lobes": 2, "hull.blur": 0.5})
    {'compression': {'half_vector': {'n_lobes': 2}}, 'hull': {'blur': 0.5}}
    """
    return parse_settings(f"{name}={json.dumps(value)}" for name, value in settings.items())


def value_of(options: PipelineOptions, name: str) -> Value:
    """Value of an option; of a share, all."""
    if name in (VIEWS, LIGHTS):
        return 1.0
    value: Any = options
    for part in name.split("."):
        value = getattr(value, part)
    return value


def check_stages(stages: Collection[str]) -> None:
    """Refuse names of stages that no swept option belongs to.

    Raises
    ------
    InputError
        Naming one.
    """
    for name in stages:
        if name not in STAGES:
            raise InputError(f"stages: expected some of {', '.join(STAGES)}, received {name!r}")


def options_to_sweep(counts: WorkCounts, stages: Collection[str]) -> list[SweptOption]:
    """Options of some stages, or of all if none is named, that matter to a run."""
    return [
        option
        for option in SWEPT
        if option.matters(counts) and (not stages or option.stage in stages)
    ]


def one_at_a_time(
    options: PipelineOptions, swept: Collection[SweptOption]
) -> Iterator[tuple[SweptOption, Value]]:
    """Yield changes of one option each: of all options the nearest value first, then others.

    Examples
    --------
    >>> few = [SweptOption("hull.resolution", (96, 128, 256)), SweptOption("lights", (0.5,))]
    >>> [(option.stage, value) for option, value in one_at_a_time(PipelineOptions(), few)]
    [('hull', 256), ('lights', 0.5), ('hull', 128), ('hull', 96)]
    """
    left = {}
    for option in swept:
        usual = value_of(options, option.name)
        others = [value for value in option.values if not same(value, usual)]
        is_share = option.name in (VIEWS, LIGHTS)
        left[option] = others if is_share else sorted(others, key=partial(_far, usual))
    while any(left.values()):
        for option, values in left.items():
            if values:
                yield option, values.pop(0)


def same(value: Value, other: Value) -> bool:
    """Whether two values of an option are the same; numbers but for rounding."""
    if _is_number(value) and _is_number(other):
        return math.isclose(float(value), float(other), rel_tol=MIXED)
    return value == other and isinstance(value, str) == isinstance(other, str)


def _is_number(value: Value) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _far(usual: Value, value: Value) -> float:
    """How far a number is from the usual one, as a ratio; what is no number is near."""
    if not (_is_number(value) and _is_number(usual)):
        return 0.0
    if min(float(value), float(usual)) <= 0:
        return math.inf
    return abs(math.log(float(value) / float(usual)))
