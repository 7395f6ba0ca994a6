"""From a capture to a field: the whole pipeline in one call."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from reflfield.api.captures import open_capture
from reflfield.api.fields import Field, open_field
from reflfield.capture.capture import Capture
from reflfield.checking.quick_check import quick_check
from reflfield.options import (
    HoldOut,
    Resources,
    parse_settings,
    read_toml,
    with_tables,
)
from reflfield.pipeline.cache import StageRecord
from reflfield.pipeline.context import Context
from reflfield.pipeline.hold_out import held_out_sentence, left_out_sentences
from reflfield.pipeline.model_selection import sentences
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.publishing import published
from reflfield.pipeline.quantisation_search import missed_quality
from reflfield.pipeline.report import problems_of
from reflfield.pipeline.stages import run
from reflfield.tradeoff.presets import STANDARD, preset_settings
from reflfield.tradeoff.swept_options import nested
from reflfield.util.nested_tables import merged

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Result:
    """What `reconstruct` made.

    Parameters
    ----------
    folder : Path
        Of all results.
    metrics : dict
        Content of ``metrics.json``: ``mean`` over the held-out photographs and each of them;
        empty where nothing was compared.
    files : tuple of Path
        Results, the field first.
    stages : tuple of StageRecord
        Time, memory and counts of each stage.
    notes : tuple of str
        Sentences: what was held out, selected, or could not be compared.
    missed_quality : str
        Of a quality that was asked for and is not reached; empty where it is.
    """

    folder: Path
    metrics: dict[str, Any]
    files: tuple[Path, ...]
    stages: tuple[StageRecord, ...]
    notes: tuple[str, ...]
    missed_quality: str = ""

    @cached_property
    def field(self) -> Field:
        """The field, opened from its file."""
        return open_field(self.folder / "field.rfld")


def reconstruct(
    capture: Capture | Path | str,
    out: Path | str,
    *,
    hold_out: HoldOut | None = None,
    options: PipelineOptions | Mapping[str, Any] | None = None,
    resources: Resources | None = None,
    from_stage: str | None = None,
    until: str = "report",
) -> Result:
    """Make a relightable field of a capture, and say how good it is.

    Whatever an earlier call has left in `out`, finished or not, is used again as far as capture
    and options are the same.

    Parameters
    ----------
    capture : Capture, Path or str
        See `open_capture`.
    out : Path or str
        Folder for all results; created.
    hold_out : HoldOut, optional
        What is kept for comparison; nothing by default.
    options : PipelineOptions or mapping, optional
        Of the stages; a mapping holds tables as in a TOML file, such as
        ``{"hull": {"resolution": 64}}``.
    resources : Resources, optional
        Threads, memory, cluster. They do not affect the result.
    from_stage : str, optional
        Compute this stage and all later ones again, even if nothing has changed.
    until : str
        Stop after this stage.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If capture, options or a stage's name cannot be used.
    GeometryError
        If the silhouettes do not determine a surface.
    """
    held, limits = hold_out or HoldOut(), resources or Resources()
    folder = Path(out)
    if limits.scheduler is not None:  # whose workers run in folders of their own
        folder = folder.resolve()
    if not isinstance(capture, Capture):
        capture = open_capture(Path(capture).resolve(), test_split=held.test)
    if not isinstance(options, PipelineOptions):
        options = with_tables(PipelineOptions(), options or {})
    for finding in quick_check(capture):
        text = finding.line().partition(": ")[2]
        log.warning("%s (`reflfield check` shows more)", text)
    context = run(
        *(capture, folder, options),
        hold_out=held,
        resources=limits,
        from_stage=from_stage,
        until=until,
    )
    return _result(context)


def _result(context: Context) -> Result:
    compared = context.stages.record("comparison") is not None
    notes = (
        f"held out: {held_out_sentence(context.split)}",
        *left_out_sentences(context.capture, context.split),
        *sentences(context),
        *problems_of(context),
    )
    return Result(
        folder=context.out,
        metrics=json.loads((context.out / "metrics.json").read_text()) if compared else {},
        files=tuple(published(context)),
        stages=tuple(context.stages.records),
        notes=notes,
        missed_quality=missed_quality(context),
    )


def read_options(
    path: Path | str | None = None,
    settings: Iterable[str] = (),
    preset: str = STANDARD,
    capture: Capture | None = None,
) -> PipelineOptions:
    """Return options of a preset, overridden by a TOML file, and that by single settings.

    Parameters
    ----------
    path : Path or str, optional
        Defaults hold for what it leaves out.
    settings : iterable of str
        ``stage.option=value``.
    preset : {"standard", "preview", "best"}
        "preview" takes a fifth of the time, or less; "best" more. "standard" are the defaults.
    capture : Capture, optional
        That the preset is for: what suits the model of its fields is set as well.

    Raises
    ------
    InputError
        If a name is unknown or a value has the wrong type.

    Examples
    --------
    >>> read_options(settings=["hull.resolution=64"]).hull.resolution
    64
    """
    tables = read_toml(Path(path)) if path is not None else {}
    options = with_tables(PipelineOptions(), nested(preset_settings(preset, capture)))
    return with_tables(options, merged(tables, parse_settings(settings)))
