"""Blocks on the workers of a dask cluster, which may come, go and die meanwhile.

The cluster has only a few blocks in hand for each thread of its workers, and their results
are fetched and kept as they arrive. So what dies with a worker is what it was at, and not
all that it has computed; dask gives that to another worker.
"""

from __future__ import annotations

import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NoReturn

import distributed
from threadpoolctl import ThreadpoolController

from reflfield.errors import InputError
from reflfield.progress import report

# How often a block is tried again that failed. One whose worker died is tried again as often
# as the scheduler's `allowed-failures` say.
RETRIES = 3
CONNECTING_SECONDS = 30
CLOSING_SECONDS = 5
# How long a run waits, saying so, while a cluster has no worker.
WAITING_SECONDS = 300
# Blocks in hand for each thread of the workers: one that is computed, and the next.
BLOCKS_PER_THREAD = 2
POLLING_SECONDS = 0.02
COUNTING_SECONDS = 1.0
# Where workers tell that they begin a block.
TOPIC = "reflfield-blocks-begun"
# What the calls of a client raise when its scheduler is gone; of the first are time-outs.
LOST = (OSError, distributed.client.ClosedClientError)
GO_ON = "run the same command again, which goes on from the blocks that are finished"


class ClusterWork:
    """Blocks that a cluster computes, a few at a time.

    Parameters
    ----------
    address : str
        Of the scheduler.
    function : callable
        ``function(context, block)``.
    context : object
        Shared by all blocks.

    Attributes
    ----------
    begun : int
        How often a worker has begun a block: more often than there are blocks if workers
        were lost or failed.
    """

    def __init__(self, address: str, function: Callable[[Any, Any], Any], context: Any) -> None:
        self.begun = 0
        self._address, self._function, self._context = address, function, context
        self._token = uuid.uuid4().hex
        self._number_of: dict[Any, int] = {}
        self._workers = _Workers(address)

    def results(self, blocks: Mapping[int, Any]) -> Iterator[tuple[int, Any]]:
        """Number and result of every block, as they arrive.

        The next blocks are handed out when the caller, having kept a result, asks for more.

        Raises
        ------
        InputError
            If the scheduler does not answer, or is lost; if the workers are, and no other
            comes; if one block is the death of several.
        """
        left = iter(blocks.items())
        with self._connected() as client:
            finished = distributed.as_completed(with_results=True, raise_errors=False)
            with self._needing_the_scheduler():
                client.subscribe_topic(TOPIC, self._hear)
                # One large argument, sent once; as a task it outlives the worker that has it.
                shared = client.submit(_same, self._context, pure=False, retries=RETRIES)
            n_kept = 0
            while n_kept < len(blocks):
                with self._needing_the_scheduler():
                    self._check(client, shared)
                    for number, block in self._next(left, client):
                        future = client.submit(
                            *(_on_worker, self._function, shared, block, self._token),
                            pure=False,
                            retries=RETRIES,
                        )
                        self._number_of[future] = number
                        finished.add(future)
                if not finished.has_ready():
                    time.sleep(POLLING_SECONDS)
                    continue
                future, result = next(finished)
                yield self._number_of.pop(future), self._usable(future, result)
                n_kept += 1

    @contextmanager
    def _connected(self) -> Iterator[distributed.Client]:
        try:
            client = distributed.Client(
                self._address, timeout=CONNECTING_SECONDS, set_as_default=False
            )
        except (OSError, ValueError) as error:
            raise InputError(
                f"--scheduler: expected a dask scheduler at {self._address}, found none "
                f"({error}); start one with `dask scheduler`"
            ) from error
        try:
            with client.as_current(), warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Sending large graph")
                yield client
        finally:
            # A scheduler that is gone does not say goodbye.
            with suppress(*LOST):
                client.close(timeout=CLOSING_SECONDS)

    @contextmanager
    def _needing_the_scheduler(self) -> Iterator[None]:
        try:
            yield
        except LOST as error:
            self._lost(error)

    def _lost(self, error: BaseException | None) -> NoReturn:
        raise InputError(
            f"--scheduler: expected the scheduler at {self._address} to stay, lost it; start "
            f"it and its workers, then {GO_ON}"
        ) from error

    def _check(self, client: distributed.Client, shared: distributed.Future) -> None:
        """Find a connection that is lost, or was and is another now: its futures are void."""
        if client.status != "running" or shared.cancelled():
            self._lost(None)

    def _next(
        self, left: Iterator[tuple[int, Any]], client: distributed.Client
    ) -> Iterator[tuple[int, Any]]:
        """Blocks to be handed out now: none while there are no workers."""
        wanted = BLOCKS_PER_THREAD * self._workers.count_threads(client)
        while len(self._number_of) < wanted:
            block = next(left, None)
            if block is None:
                return
            yield block

    def _hear(self, event: tuple[float, str]) -> None:
        if event[1] == self._token:
            self.begun += 1

    def _usable(self, future: distributed.Future, result: Any) -> Any:
        # Whatever has become of the future meanwhile: its worker may have died since.
        if isinstance(result, _Computed):
            return result.value
        if future.status != "error":
            self._lost(None)
        _, error, traceback = result
        if isinstance(error, distributed.KilledWorker):
            raise InputError(
                f"--scheduler: expected workers that live through a block, lost "
                f"{error.allowed_failures + 1} at the same one, the last of them "
                f"{error.last_worker.address}; see its log, give workers more memory "
                f"(`dask worker --memory-limit`), and {GO_ON}"
            ) from error
        raise error.with_traceback(traceback)


class _Workers:
    """How many workers a cluster has; waits for some, saying so, but not for ever."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._n_threads = 0
        self._counted = self._seen = -COUNTING_SECONDS
        self._waited = False

    def count_threads(self, client: distributed.Client) -> int:
        """Threads of all workers, as of a second ago at most.

        Raises
        ------
        InputError
            If there have been none for long.
        """
        now = time.monotonic()
        if self._seen < 0:
            self._seen = now
        if now - self._counted >= COUNTING_SECONDS:
            self._n_threads = sum(client.nthreads().values())
            self._counted = now
            if self._n_threads:
                self._seen = now
            self._say(int(now - self._seen))
        return self._n_threads

    def _say(self, seconds: int) -> None:
        name = f"waiting for workers of {self._address}"
        if seconds >= WAITING_SECONDS:
            raise InputError(
                f"--scheduler: expected workers at {self._address}, found none for "
                f"{WAITING_SECONDS} s; start some with `dask worker {self._address}`, then "
                f"{GO_ON}"
            )
        if seconds:
            report(name, seconds, WAITING_SECONDS)
        elif self._waited:
            report(name, WAITING_SECONDS, WAITING_SECONDS)
        self._waited = seconds > 0


@dataclass(frozen=True)
class _Computed:
    """What a worker has computed, told apart from what dask puts in the place of it."""

    value: Any


@lru_cache(maxsize=1)
def _limit_worker() -> None:
    """Give the BLAS of a cluster's worker one thread, for good: its tasks overlap."""
    ThreadpoolController().limit(limits=1, user_api="blas")


def _on_worker(
    function: Callable[[Any, Any], Any], context: Any, block: Any, token: str
) -> Any:
    distributed.get_worker().log_event(TOPIC, token)
    _limit_worker()
    return _Computed(function(context, block))


def _same(context: Any) -> Any:
    return context
