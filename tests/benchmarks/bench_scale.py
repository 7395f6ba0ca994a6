"""The paper's job, 151 x 151 photographs and 256 x 256 texels, on this machine.

    python tests/benchmarks/bench_scale.py OUT    # simulate, process, compress, compare
    python tests/benchmarks/bench_scale.py OUT --model auto [--texels 512]
    python tests/benchmarks/bench_scale.py OUT --kill 5
    python tests/benchmarks/bench_scale.py OUT --kill-worker nanny
    python tests/benchmarks/bench_scale.py OUT --per-texel 64 128 256

A vase of glaze and paint with brushed bands of gold stands in a dome. The first form prints
seconds and peak memory of every stage with the paper's model, the second with the one that a
plain run takes, or another; the third processes once more, kills the process
(SIGKILL) at random moments, runs it again, and compares; the fourth processes on a Dask
cluster of two worker processes, kills one of them at a random moment of each stage that
reads or writes the samples, to be started again by its nanny (or, with `alone`, kills one
for good, and the other does the rest), and compares; the fifth prints what one texel costs
at several sizes of the texture. What is done already is not done again, so the forms
may follow each other. The bases are shaped by 2048 texels; all are completed and fitted.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import distributed
from benchmarks.measuring import Results

from reflfield.reproduction.object_figures import scene_text

# Works of the stages that go texel by texel: all texels that are seen, but for those that
# shape the basis in the first. Of the other works the number of texels is no matter.
SHAPING, COMPLETING = "resampling for the basis", "completing all texels"
ALIGNING = "frames of all texels"
BY_TEXELS = {
    "completion": (COMPLETING,),
    "alignment": (ALIGNING,),
    "resampling": (COMPLETING,),
    "compression": (
        "frames against the model",
        "coefficients on the samples, part 1",
        "coefficients on the samples, part 2",
    ),
}

MEASURED = ("reflfield.pipeline.stages",)
CLUSTERED = "clustered"
# Side of the texture of the paper's job.
TEXELS = 256
# Stages in which a worker is killed: those that read or write the samples by blocks.
LOSING = ("observations", "completion", "alignment", "resampling", "compression")


def simulate(arguments: argparse.Namespace) -> Path:
    """Photograph the vase, by the installed command; the capture."""
    capture = arguments.out / "capture"
    if (capture / "capture.json").is_file():
        return capture
    arguments.out.mkdir(parents=True, exist_ok=True)
    scene = arguments.out / "paper_scale.toml"
    scene.write_text(
        scene_text(arguments.directions, arguments.pixels, n_points=arguments.points)
    )
    started = time.perf_counter()
    command = Path(sys.executable).with_name("capture-sim")
    call(command, "render", scene, "-o", capture, "--workers", arguments.workers)
    # Of the largest process so far; it is the first.
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    say("simulation", time.perf_counter() - started, None, peak)
    return capture


def call(*words: object) -> None:
    """Run a command, its progress going to standard error."""
    subprocess.run(list(map(str, words)), check=True, stdout=sys.stderr)


def process_words(
    arguments: argparse.Namespace, capture: Path, out: Path, texels: int, training: int
) -> list[object]:
    """The command that processes the capture."""
    options = {
        "atlas.resolution": texels,
        "completion.training_texels": training,
        "compression.model": arguments.model,
        "compression.training_texels": training,
    }
    settings = [word for item in options.items() for word in ("--set", "{}={}".format(*item))]
    config = ("--config", arguments.config) if arguments.config else ()
    return [
        *(sys.executable, "-m", "reflfield", "run", capture, "-o", out),
        *("--workers", arguments.workers, *config, *settings),
        *("--max-memory", arguments.max_memory, "--hold-out", "views=2,lights=2"),
    ]


def say(name: str, seconds: float, cpu: float | None, peak: float) -> None:
    """One line of the table."""
    processor = "" if cpu is None else f"{cpu:9.1f}"
    print(f"{name:<20}{seconds:9.1f}{processor:>9}{peak / 2**30:8.2f}", flush=True)


def processed(arguments: argparse.Namespace, capture: Path) -> None:
    """Process the capture, and print what each stage took."""
    clustered = arguments.model == CLUSTERED
    finer = "" if arguments.texels == TEXELS else f"_{arguments.texels}"
    out = arguments.out / ("run" if clustered else f"run_{arguments.model}{finer}")
    call(*process_words(arguments, capture, out, arguments.texels, 2048))
    timings = json.loads((out / "timings.json").read_text())
    name, title = ("scale", "The paper's job")
    if not clustered:
        name = f"scale_{arguments.model}{finer}"
        title = f"{title}, the model {arguments.model}, {arguments.texels} texels a side"
    results = Results(name, title, MEASURED)
    directions, pixels = arguments.directions, arguments.pixels
    size = f"{pixels} pixels, {arguments.texels} texels a side"
    results.table(f"{directions} x {directions} photographs, {size}")
    for stage in timings["stages"]:
        say(stage["name"], stage["seconds"], stage["cpu_seconds"], stage["peak_bytes"])
        results.add(stage_cells(stage["name"], stage))
    cpu = sum(stage["cpu_seconds"] for stage in timings["stages"])
    say("after simulation", timings["seconds"], cpu, timings["peak_bytes"])
    spent = stage_cells("all", {**timings, "cpu_seconds": cpu})
    results.add(spent)
    print(f"ceiling of memory {timings['max_memory'] / 2**30:.2f} GB")
    metrics = json.loads((out / "metrics.json").read_text())
    print(f"held out: PSNR {metrics['mean']['psnr_ldr']:.2f} dB")
    print(f"field: {(out / 'field.rfld').stat().st_size / 1e6:.2f} MB")
    results.table("Held-out photographs, 2 views x 2 lights")
    size = (out / "field.rfld").stat().st_size / 1e6
    image = metrics["mean"]
    quality = {"PSNR, dB": image["psnr_ldr"], "SSIM": image["ssim"], "FLIP": image["flip"]}
    results.add(quality | {"field, MB": size} | spent)
    print(results.write())


def stage_cells(name: str, record: dict[str, Any]) -> dict[str, Any]:
    """Row of the results for one stage."""
    return {
        "stage": name,
        "wall time, s": record["seconds"],
        "CPU time, s": record["cpu_seconds"],
        "peak memory, GB": record["peak_bytes"] / 2**30,
    }


# Of stages how long they took, of photographs when they were read.
TIMES_AND_LOCKS = ("stage.json", "files.json", ".lock")


def digests(out: Path) -> dict[str, str]:
    """SHA-256 of the field and of all that the stages made, times and memory left out."""
    files = [path for path in sorted((out / "stages").rglob("*")) if path.is_file()]
    wanted = [
        path
        for path in (out / "field.rfld", *files)
        if path.name not in TIMES_AND_LOCKS and "report" not in path.parts
    ]
    sums = {}
    for path in wanted:
        with path.open("rb") as file:
            sums[str(path.relative_to(out))] = hashlib.file_digest(file, "sha256").hexdigest()
    return sums


class Moment(NamedTuple):
    """When a process is killed: in a stage with so many blocks kept, some seconds later."""

    stage: str
    n_kept: int
    wait: float


# Stages that are short, and no block of which can be waited for.
WITHOUT_BLOCKS = ("comparison", "error_analysis", "report")


def moments(stages: list[dict[str, Any]], n: int, rng: random.Random) -> list[Moment]:
    """Random moments, in order, each stage as probable as it is long.

    They are told by what is finished, not by the clock, so that none comes too late.
    """
    stages = [stage for stage in stages if stage["name"] not in WITHOUT_BLOCKS]
    drawn = rng.choices(range(len(stages)), [stage["seconds"] for stage in stages], k=n)
    chosen = []
    for i, share in sorted((i, rng.random()) for i in drawn):
        blocks = stages[i]["blocks_computed"]
        seconds = stages[i]["seconds"]
        wait = rng.random() * seconds / (blocks + 1) if blocks else 0.9 * share * seconds
        chosen.append(Moment(stages[i]["name"], int(share * blocks), wait))
    return chosen


def kept_blocks(out: Path, stage: str) -> dict[str, int]:
    """Blocks that an unfinished stage has kept, and when each was written."""
    folder = out / "stages" / f"{stage}.partial" / "blocks"
    return {str(path): path.stat().st_mtime_ns for path in folder.glob("*/*.block")}


def needed(kept: dict[str, int]) -> int:
    """Kept blocks that the resumed stage reads: not those that a finished basis is made of."""
    works = [Path(path).parent.name for path in kept]
    return len(works) - ("basis" in works) * works.count(SHAPING)


def kill_at(running: subprocess.Popen[bytes], out: Path, moment: Moment) -> None:
    """Wait for the moment, and kill the process."""
    stage = out / "stages" / f"{moment.stage}.partial"
    while not stage.is_dir() or len(kept_blocks(out, moment.stage)) < moment.n_kept:
        if running.poll() is not None or (stage.with_suffix("") / "stage.json").is_file():
            break
        time.sleep(0.01)
    with suppress(subprocess.TimeoutExpired):
        running.wait(moment.wait)
    running.kill()
    if running.wait() != -signal.SIGKILL:
        sys.exit(f"{moment}: the process had ended by itself, {running.returncode}")


def kill_and_resume(arguments: argparse.Namespace, capture: Path) -> None:
    """Process again, killed at random moments, and compare with the run that was not."""
    whole, out = arguments.out / "run", arguments.out / "killed"
    shutil.rmtree(out, ignore_errors=True)
    stages = json.loads((whole / "timings.json").read_text())["stages"]
    words = process_words(arguments, capture, out, arguments.texels, 2048)
    command = list(map(str, words))
    kept: dict[str, dict[str, int]] = {}
    for moment in moments(stages, arguments.kill, random.Random(arguments.seed)):
        kill_at(subprocess.Popen(command, stdout=sys.stderr), out, moment)
        at = [path.stem for path in out.glob("stages/*.partial")]
        for stage in at:
            before, kept[stage] = kept.get(stage, {}), kept_blocks(out, stage)
            if before.items() - kept[stage].items():
                sys.exit(f"{stage}: blocks that an earlier kill had left were computed again")
        counts = ", ".join(f"{stage} with {len(kept[stage])} blocks kept" for stage in at)
        print(f"killed in {counts or 'no stage'}", flush=True)
    subprocess.run(command, check=True, stdout=sys.stderr)
    for record in json.loads((out / "timings.json").read_text())["stages"]:
        if (stage := record["name"]) in kept:
            wanted = needed(kept[stage])
            print(
                f"{stage}: of {wanted} blocks kept at its last kill and needed "
                f"{record['blocks_resumed']} taken up, {record['blocks_computed']} computed"
            )
            if record["blocks_resumed"] < wanted:
                sys.exit(f"{stage}: blocks that the last kill had left were computed again")
    compare(whole, out)


def compare(whole: Path, out: Path) -> None:
    """Print whether two runs made the same bytes; end with status 1 if not."""
    expected, actual = digests(whole), digests(out)
    different = {name for name in expected | actual if expected.get(name) != actual.get(name)}
    print(f"{len(expected)} files compared, {len(different)} differ: {sorted(different)[:9]}")
    if different:
        sys.exit(1)


@contextmanager
def cluster_here(folder: Path, nanny: bool) -> Iterator[distributed.Client]:
    """A scheduler and two workers of one thread, in processes of their own; a client."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    scheduler_file = folder / "scheduler.json"
    at = ("--scheduler-file", scheduler_file.resolve(), "--no-dashboard", "--host", "127.0.0.1")
    kind = "--nanny" if nanny else "--no-nanny"
    commands = [("scheduler", *at, "--port", 0), *2 * [("worker", *at, kind, "--nthreads", 1)]]
    with ExitStack() as running:
        log = running.enter_context((folder / "log").open("w"))
        for words in commands:
            command = [sys.executable, "-m", "dask", *map(str, words)]
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=folder)
            # Nannies end their workers when they are asked to end.
            running.callback(process.wait)
            running.callback(process.terminate)
        deadline = time.monotonic() + 60
        while not scheduler_file.is_file() and time.monotonic() < deadline:
            time.sleep(0.1)
        client = running.enter_context(distributed.Client(scheduler_file=str(scheduler_file)))
        client.wait_for_workers(2, timeout=60)
        yield client


def lose_workers(arguments: argparse.Namespace, capture: Path) -> None:
    """Process on a cluster that loses workers, and compare with the run on threads."""
    whole, out = arguments.out / "run", arguments.out / "cluster"
    shutil.rmtree(out, ignore_errors=True)
    stages = {
        stage["name"]: stage
        for stage in json.loads((whole / "timings.json").read_text())["stages"]
    }
    rng = random.Random(arguments.seed)
    nanny = arguments.kill_worker == "nanny"
    losing = LOSING if nanny else (rng.choice(LOSING),)
    with cluster_here(arguments.out / "dask", nanny) as client:
        words = process_words(arguments, capture, out, arguments.texels, 2048)
        command = [*map(str, words), "--scheduler", client.scheduler.address]
        running = subprocess.Popen(command, stdout=sys.stderr)
        try:
            lost: set[str] = set()
            for name in losing:
                n_kept = rng.randint(0, stages[name]["blocks_computed"] * 3 // 4)
                lost |= kill_worker(processes(client, lost), client, running, out, name, n_kept)
            if running.wait() != 0:
                sys.exit(running.returncode)
        finally:
            running.kill()
    for record in json.loads((out / "timings.json").read_text())["stages"]:
        if record["blocks_computed"]:
            print(
                f"{record['name']}: {record['blocks_computed']} blocks, "
                f"{record['blocks_repeated']} begun again"
            )
    compare(whole, out)


def processes(client: distributed.Client, lost: set[str]) -> dict[str, int]:
    """Processes of the workers by their addresses, when two are there that are not lost."""
    while len(alive := set(client.nthreads()) - lost) < 2:
        time.sleep(0.1)
    identifiers: dict[str, int] = client.run(os.getpid, workers=list(alive))
    return identifiers


def kill_worker(
    workers: dict[str, int],
    client: distributed.Client,
    running: subprocess.Popen[bytes],
    out: Path,
    stage: str,
    n: int,
) -> set[str]:
    """Kill a worker that is at a block of a stage when so many of the stage are kept."""
    blocks = out / "stages" / f"{stage}.partial" / "blocks"
    while True:
        at_work = client.processing()
        busy = [address for address in workers if at_work.get(address)]
        if busy and len(list(blocks.glob("*/*.block"))) >= n and blocks.is_dir():
            os.kill(workers[busy[0]], signal.SIGKILL)
            print(f"killed in {stage}, {n} blocks kept: worker {busy[0]}", flush=True)
            return {busy[0]}
        if running.poll() is not None or (out / "stages" / stage / "stage.json").is_file():
            print(f"{stage} was over before a worker could be killed", flush=True)
            return set()
        time.sleep(0.01)


def per_texel(arguments: argparse.Namespace, capture: Path) -> None:
    """Print the processor time of one texel at several sizes of the texture."""
    print("texture       texels   CPU time per texel, ms: " + ", ".join(BY_TEXELS))
    totals = []
    results = Results("scale_per_texel", "What one texel costs", MEASURED)
    results.table(
        f"{arguments.directions} x {arguments.directions} photographs, CPU time of a texel, ms"
    )
    for side in arguments.per_texel:
        out = arguments.out / f"texels_{side}"
        words = process_words(arguments, capture, out, side, arguments.training)
        call(*words, "--until", "compression")
        stages = {
            stage["name"]: stage
            for stage in json.loads((out / "timings.json").read_text())["stages"]
        }
        completion = stages["completion"]["counts"]
        seen = completion["texels completed"]
        others = seen - completion["texels that shape the basis"]
        parts = []
        for name, works in BY_TEXELS.items():
            spent = stages[name]["work"]
            each = [
                spent.get(work, 0.0) / max(others if work == COMPLETING else seen, 1)
                for work in works
            ]
            parts.append(1e3 * sum(each))
        totals.append(sum(parts))
        shown = "".join(f"{part:9.2f}" for part in (*parts, totals[-1]))
        print(f"{side:4d} x {side:4d} {seen:9d} {shown}", flush=True)
        cells = dict(zip((*BY_TEXELS, "together"), (*parts, totals[-1]), strict=True))
        results.add({"texture": f"{side} x {side}", "texels": seen} | cells)
    mean = sum(totals) / len(totals)
    print(f"largest deviation from the mean: {max(abs(t / mean - 1) for t in totals):.1%}")
    print(results.write())


def main() -> None:
    """Parse, simulate, and what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--directions", type=int, default=151, help="cameras, and lights")
    parser.add_argument("--pixels", type=int, default=256, help="side of the photographs")
    parser.add_argument("--texels", type=int, default=TEXELS, help="side of the texture")
    parser.add_argument("--points", type=int, default=100, help="true ABRDFs to compare with")
    models = (CLUSTERED, "half_vector", "auto")
    parser.add_argument("--model", choices=models, default=CLUSTERED)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--max-memory", default="6GB")
    parser.add_argument("--config", type=Path, help="further options in TOML")
    parser.add_argument("--kill", type=int, metavar="N", help="kill N times and compare")
    parser.add_argument("--kill-worker", choices=("nanny", "alone"), help="of a Dask cluster")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--per-texel", type=int, nargs="+", metavar="SIDE")
    parser.add_argument("--training", type=int, default=512, help="texels, with --per-texel")
    arguments = parser.parse_args()

    capture = simulate(arguments)
    if arguments.per_texel:
        per_texel(arguments, capture)
        return
    print(f"{'stage':<20}{'seconds':>9}{'cpu':>9}{'GB':>8}")
    processed(arguments, capture)
    if arguments.kill:
        kill_and_resume(arguments, capture)
    if arguments.kill_worker:
        lose_workers(arguments, capture)


if __name__ == "__main__":
    main()
