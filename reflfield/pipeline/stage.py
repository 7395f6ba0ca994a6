"""A stage of the pipeline: what computes it, and everything that its result depends on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reflfield.pipeline.code_digests import code_digest
from reflfield.pipeline.context import Context
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.util.blas_threads import one_core_blas


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage: what computes it, and everything that its result depends on.

    Parameters
    ----------
    name : str
    compute : callable
        Writes the results into a folder and returns counts.
    after : tuple of Stage
        Stages whose results it reads (and through them those before), where they are wanted.
    options : callable
        What of the options matters.
    reads : callable
        Digests of what it reads besides.
    wanted : callable
        Whether the options and the capture ask for it.
    intact : callable
        Says what is wrong with what it has left outside of its folder, if anything.
    large_products : bool
        Whether it multiplies matrices so large that the BLAS had better have threads. Lists of
        points times a rotation take twenty times as long with them.
    """

    name: str
    compute: Callable[[Context, Path], Mapping[str, Any]]
    after: tuple[Stage, ...] = ()
    options: Callable[[PipelineOptions], Any] = lambda options: None
    reads: Callable[[Context], Mapping[str, str]] = lambda context: {}
    wanted: Callable[[Context], bool] = lambda context: True
    intact: Callable[[Context, Path], str] = lambda context, folder: ""
    large_products: bool = False

    def run(self, context: Context) -> None:
        """Compute the stage, or take its earlier result."""
        before = [stage.name for stage in self.after if stage.wanted(context)]
        context.stages.run(
            self.name,
            lambda folder: self._computed(context, folder),
            options=self.options(context.options),
            inputs=self.reads(context),
            after={name: context.stages.key(name) for name in before},
            code=code_digest(self.compute.__module__),
            intact=lambda folder: self.intact(context, folder),
        )

    def _computed(self, context: Context, folder: Path) -> Mapping[str, Any]:
        with nullcontext() if self.large_products else one_core_blas():
            return self.compute(context, folder)
