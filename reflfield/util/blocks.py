"""Pure functions over numbered blocks: on threads here or on a cluster, kept as they finish.

The result of a block depends on its context and its number alone, and is written to a file
of its own, with a checksum, before it counts. So a killed run goes on where it stopped, a
lost worker costs the blocks that it was at, and the same bytes come out whoever works.
"""

from __future__ import annotations

import hashlib
import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.util.blas_threads import one_core_blas
from reflfield.util.dask_cluster import ClusterWork
from reflfield.util.files import replacing
from reflfield.util.progress import report

Arrays: TypeAlias = Mapping[str, NDArray[Any]]
# What computes one block: from the context that all blocks share and the block itself.
BlockFunction: TypeAlias = Callable[[Any, Any], Arrays]
Keep: TypeAlias = Callable[[int, Any], None]


@dataclass(frozen=True)
class Scheduler:
    """Who computes the blocks; nothing of it changes what they give.

    Parameters
    ----------
    workers : int
        Threads of this process.
    address : str, optional
        Of the scheduler of a `dask.distributed` cluster, such as ``tcp://host:8786``; its
        workers compute in place of the threads.
    """

    workers: int = 1
    address: str | None = None

    def run(
        self,
        function: BlockFunction,
        context: Any,
        blocks: Mapping[int, Any],
        keep: Keep,
        *,
        at_once: int | None = None,
        done: Callable[[], None] = lambda: None,
    ) -> int:
        """Compute blocks, in any order.

        Parameters
        ----------
        function : callable
            ``function(context, block)``; for a cluster, context and block can be pickled.
        context : object
            Shared by all blocks.
        blocks : mapping of int to object
        keep : callable
            Called once for each block with its number and its result.
        at_once : int, optional
            At most so many threads, where memory allows no more; of a cluster, of each worker,
            whose memory is its own.
        done : callable
            Called after each block, from this thread.

        Returns
        -------
        int
            How often a block was begun again: one that the cluster had lost with a worker
            that died, or one that failed at first.

        Raises
        ------
        InputError
            If no scheduler answers at `address`, or it, or its workers, are lost for good.
        """
        if not blocks:
            return 0
        if self.address is not None:
            work = ClusterWork(self.address, function, context, at_once)
            for number, result in work.results(blocks):
                keep(number, result)
                done()
            return work.begun - len(blocks)
        threads = max(1, min(self.workers, at_once or self.workers, len(blocks)))

        def compute(number: int) -> None:
            keep(number, function(context, blocks[number]))

        # The pool is left when no block is at work any more, also after an error.
        with one_core_blas(), ThreadPoolExecutor(threads) as pool:
            computed = [pool.submit(compute, number) for number in blocks]
            try:
                for each in as_completed(computed):
                    each.result()
                    done()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
        return 0


@dataclass(frozen=True)
class BlockFiles:
    """Results of numbered blocks, each in a file that begins with its checksum.

    Parameters
    ----------
    folder : Path
        Created with the first block.

    Examples
    --------
    >>> import tempfile
    >>> files = BlockFiles(Path(tempfile.mkdtemp()) / "sums")
    >>> files.write(3, {"sum": np.array(6)})
    >>> int(files.read(3)["sum"]), files.read(4)
    (6, None)
    """

    folder: Path

    def path(self, number: int) -> Path:
        """File of a block."""
        return self.folder / f"{number:06d}.block"

    def write(self, number: int, arrays: Arrays) -> None:
        """Write a block's result, whole or not at all.

        It is not waited for until it is on the disk, which for hundreds of blocks takes
        seconds: after a power failure it may be damaged, and is then computed again.
        """
        text = io.BytesIO()
        np.savez(text, **dict(arrays))  # type: ignore[arg-type]
        self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(self.path(number), flushed=False) as unfinished:
            unfinished.write_bytes(hashlib.sha256(text.getbuffer()).digest() + text.getbuffer())

    def read(self, number: int) -> dict[str, NDArray[Any]] | None:
        """Result of a block; None if it is absent or damaged."""
        try:
            data = self.path(number).read_bytes()
        except FileNotFoundError:
            return None
        digest, text = data[:32], memoryview(data)[32:]
        if hashlib.sha256(text).digest() != digest:
            return None
        with np.load(io.BytesIO(text), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}


@dataclass(frozen=True)
class Results(Sequence[dict[str, NDArray[Any]]]):
    """Results of all blocks of one work, read from their files as they are asked for."""

    files: BlockFiles
    n_blocks: int

    def __len__(self) -> int:
        return self.n_blocks

    def __getitem__(self, number: Any) -> Any:
        if not 0 <= number < self.n_blocks:
            raise IndexError(number)
        answer = self.files.read(number)
        if answer is None:
            raise InputError(
                f"{self.files.path(number)}: expected the block that was written, found it "
                "gone or damaged; leave the folder alone and run again"
            )
        return answer

    def joined(self, name: str) -> NDArray[Any]:
        """One array of all blocks, end to end."""
        return np.concatenate([arrays[name] for arrays in self])


@dataclass
class Tally:
    """Blocks that one stage computed, and those that an interrupted run had left.

    Parameters
    ----------
    computed, resumed : int
    repeated : int
        Times that one of those computed was begun again, lost with a worker of a cluster.
    cpu_seconds : dict of str to float
        CPU time of this process only, by the name of the work.
    """

    computed: int = 0
    resumed: int = 0
    repeated: int = 0
    cpu_seconds: dict[str, float] = field(default_factory=dict, compare=False)

    @contextmanager
    def timing(self, name: str) -> Iterator[None]:
        """Add the processor time of the block to a work."""
        started = time.process_time()
        try:
            yield
        finally:
            spent = time.process_time() - started
            self.cpu_seconds[name] = self.cpu_seconds.get(name, 0.0) + spent


@dataclass(frozen=True)
class Blocks:
    """Work of one stage, by blocks.

    Parameters
    ----------
    scheduler : Scheduler
    folder : Path
        Where results are kept until the stage is complete.
    tally : Tally
        Counts what is computed and what is found.
    """

    scheduler: Scheduler
    folder: Path
    tally: Tally = field(default_factory=Tally)

    def map(
        self,
        name: str,
        function: BlockFunction,
        context: Any,
        blocks: Sequence[Any],
        *,
        intact: Callable[[Any, Any], bool] | None = None,
        at_once: int | None = None,
    ) -> Results:
        """Results of a function on all blocks, in their order.

        Parameters
        ----------
        name : str
            Of this work within its stage.
        function : callable
            ``function(context, block)`` gives arrays by name.
        context : object
        blocks : sequence
            The same ones whatever the resources, so that a run can be taken up.
        intact : callable, optional
            ``intact(context, block)``: whether what the block wrote elsewhere is still there.
        at_once : int, optional
            See `Scheduler.run`.

        Returns
        -------
        Results
            One for each block, read when it is asked for.
        """
        files = BlockFiles(self.folder / name)
        kept = self._kept(files, context, blocks, intact)
        left = {n: block for n, block in enumerate(blocks) if n not in kept}
        self.tally.resumed += len(kept)
        report(name, len(kept), len(blocks))

        def done() -> None:
            self.tally.computed += 1
            finished = self.tally.computed - before
            report(name, len(kept) + finished, len(blocks))

        before = self.tally.computed
        with self.tally.timing(name):
            self.tally.repeated += self.scheduler.run(
                function, context, left, files.write, at_once=at_once, done=done
            )
        return Results(files, len(blocks))

    def _kept(
        self,
        files: BlockFiles,
        context: Any,
        blocks: Sequence[Any],
        intact: Callable[[Any, Any], bool] | None,
    ) -> set[int]:
        """Blocks whose results, and what they wrote elsewhere, are there and verified."""
        present = {n: block for n, block in enumerate(blocks) if files.read(n) is not None}
        if intact is None:
            return set(present)
        answers: dict[int, bool] = {}
        self.scheduler.run(
            partial(_checked, intact), context, present, answers.__setitem__, at_once=1
        )
        return {n for n, answer in answers.items() if answer}

    def once(self, name: str, compute: Callable[[], Arrays]) -> dict[str, NDArray[Any]]:
        """Result of work that cannot be cut into blocks, done in this process and kept."""
        files = BlockFiles(self.folder / name)
        answer = files.read(0)
        if answer is not None:
            self.tally.resumed += 1
            return answer
        with self.tally.timing(name):
            files.write(0, compute())
        self.tally.computed += 1
        return Results(files, 1)[0]


def _checked(intact: Callable[[Any, Any], bool], context: Any, block: Any) -> Any:
    return intact(context, block)
