"""One configuration of a sweep, run and measured in a process of its own.

``python -m reflfield.tradeoff.measured_run`` reads a pickled `Job` from the sweep that has
started it, and leaves ``outcome.json``. A process of its own has its own peak of memory, and
takes nothing with it if it dies.
"""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from reflfield.capture.capture import Capture
from reflfield.errors import InputError, ReflfieldError
from reflfield.field.file import open_field
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.open3d_library import load_open3d
from reflfield.metrics.comparison_silhouettes import write_comparison_silhouettes
from reflfield.metrics.held_out_photographs import compare_with_photographs
from reflfield.options import HoldOut, Resources
from reflfield.pipeline import results, stages
from reflfield.pipeline.comparison import comparison_of
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import within_memory
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.truth_comparison import truth_scores
from reflfield.tradeoff.stage_costs import BY_A_PROCESS
from reflfield.util.child_processes import tied
from reflfield.util.files import replacing

OUTCOME = "outcome.json"
WORKER = "reflfield.tradeoff.measured_run"
# What the record of a stage says that a sweep keeps.
KEPT = ("name", "key", "seconds", "cpu_seconds", "peak_bytes", "size_bytes", "reused")
# Status of a process that refuses its input, as of the commands.
REFUSED = 2
LONGEST_REASON = 300


@dataclass(frozen=True, eq=False)
class Job:
    """What a process is to run.

    Parameters
    ----------
    key : str
        Of everything that the outcome depends on; stands in it.
    capture : Capture
        With a test split to measure on.
    out : Path
    options : PipelineOptions
    resources : Resources
    reuse : tuple of Path
        Other runs, whose stages are taken over where they are the same.
    reported : Capture, optional
        Photographs that the finished field in `out` is measured on instead of being made.
    """

    key: str
    capture: Capture
    out: Path
    options: PipelineOptions
    resources: Resources
    reuse: tuple[Path, ...] = ()
    reported: Capture | None = None


def run_in_process(job: Job) -> dict[str, Any]:
    """Run a job in a process of its own, and return its outcome.

    An input that a configuration cannot be used with is an outcome, too: its ``failed`` says
    why.

    Raises
    ------
    ReflfieldError
        If the process dies.
    """
    job.out.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    done = subprocess.run(
        tied([sys.executable, "-m", WORKER]),
        input=pickle.dumps(job),
        capture_output=True,
        check=False,
    )
    said = done.stderr.decode(errors="replace").strip().splitlines()
    last = said[-1][:LONGEST_REASON] if said else ""
    if done.returncode == REFUSED:
        outcome: dict[str, Any] = {"key": job.key, "failed": last}
    elif done.returncode:
        raise ReflfieldError(
            f"{job.out}: expected the run to end, but its process ended with status "
            f"{done.returncode}: {last}"
        )
    else:
        outcome = json.loads((job.out / OUTCOME).read_text())
    outcome["command seconds"] = time.perf_counter() - started
    write_json(job.out / OUTCOME, outcome)
    return outcome


def write_json(path: Path, document: Any) -> None:
    """Write a document whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def distinct(records: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Records of the stages that a run has computed, or taken over, each once.

    Those of candidate runs stand in place of their selection.

    Examples
    --------
    >>> runs = {"a": [{"name": "hull", "key": "1"}], "b": [{"name": "hull", "key": "1"}]}
    >>> selection = {"name": "model_selection", "counts": {"candidate runs": runs}, "key": "2"}
    >>> [record["name"] for record in distinct([selection, {"name": "maps", "key": "3"}])]
    ['hull', 'maps']
    """
    flat: list[Mapping[str, Any]] = []
    for record in records:
        if record["name"] == stages.MODEL_SELECTION.name:
            of_candidates = record["counts"]["candidate runs"].values()
            flat += [one for candidate in of_candidates for one in candidate]
        else:
            flat.append(record)
    return [dict(record) for record in {record["key"]: record for record in flat}.values()]


def cpu_of(record: Mapping[str, Any]) -> float:
    """CPU seconds of a stage; of one that a process of its own computes, its wall time."""
    by_process = record["name"] in BY_A_PROCESS
    return float(record["seconds" if by_process else "cpu_seconds"])


def measured_outcome(job: Job) -> dict[str, Any]:
    """Run the pipeline up to the comparison, and return what it took and how good it is."""
    context = stages.run(
        *(job.capture, job.out, job.options),
        hold_out=HoldOut(test=True),
        resources=job.resources,
        until=stages.COMPARISON.name,
        reuse=job.reuse,
    )
    records = [
        {name: record[name] for name in KEPT}
        for record in distinct(asdict(record) for record in context.stages.records)
    ]
    return {
        "key": job.key,
        "stages": records,
        "field bytes": results.field_file(context).stat().st_size,
        "chosen on": _images(context, "heldout"),
        "unseen": _images(context, "truth"),
        "truth": _truth(context),
    }


def _images(context: Context, name: str) -> dict[str, Any]:
    """Metrics of one set of photographs; empty where it was not compared."""
    compared = comparison_of(context, name)
    if compared is None:
        return {}
    return {"mean": compared.mean, "psnr": [image.psnr_ldr for image in compared.images]}


def _truth(context: Context) -> dict[str, float]:
    """Errors of surface, frames and completion where the capture brings the truth."""
    scores = truth_scores(context, open_field(results.field_file(context)))
    counts = scores.counts() if scores is not None else {}
    return {name: value for name, value in counts.items() if isinstance(value, float)}


def reported_outcome(job: Job, reported: Capture) -> dict[str, Any]:
    """Measure the finished field of a run on photographs that no choice has seen."""
    field = open_field(job.out / "field.rfld")
    options = within_memory(job.options.relighting, job.resources)
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        silhouettes = write_comparison_silhouettes(
            reported, reported, Mesh(field.positions, field.faces), folder, options.workers
        )
        compared = compare_with_photographs(
            field, reported, silhouettes, folder / "relit", options
        )
    return {"mean": compared.mean, "psnr": [image.psnr_ldr for image in compared.images]}


def main() -> None:
    """Run the job on standard input."""
    load_open3d()
    job: Job = pickle.load(sys.stdin.buffer)
    try:
        if job.reported is None:
            outcome = measured_outcome(job)
        else:
            outcome = json.loads((job.out / OUTCOME).read_text())
            outcome["reported"] = reported_outcome(job, job.reported)
    except (InputError, ReflfieldError) as error:
        sys.stderr.write(f"\n{' '.join(str(error).split())}\n")
        sys.exit(REFUSED)
    write_json(job.out / OUTCOME, outcome)


if __name__ == "__main__":
    main()
