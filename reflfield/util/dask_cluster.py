"""Blocks on the workers of a dask cluster, which may come, go and die meanwhile.

Each worker has only a few blocks in hand for each of its threads, and their results are
fetched and kept as they arrive. So what dies with a worker is what it was at, and not all
that it has computed; that is given to the others. No worker needs what another one has:
fetching from one that dies can leave dask's workers and scheduler waiting for each other.
"""

from __future__ import annotations

import sys
import time
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NoReturn

from threadpoolctl import ThreadpoolController

from reflfield.errors import InputError
from reflfield.util.late_import import LateImport
from reflfield.util.progress import report

if TYPE_CHECKING:
    import cloudpickle
    import distributed
else:  # installed with the extra "cluster", and imported only where a cluster computes
    cloudpickle, distributed = LateImport("cloudpickle"), LateImport("distributed")

# How often a block is tried again that failed, and how many workers may die with the same
# one in hand: it may be what kills them.
RETRIES = 3
MOST_DEATHS = 4
CONNECTING_SECONDS = 30
CLOSING_SECONDS = 5
# How long a run waits, saying so, while a cluster has no worker.
WAITING_SECONDS = 300
# Blocks in hand for each thread of a worker: one that is computed, and the next.
BLOCKS_PER_THREAD = 2
POLLING_SECONDS = 0.02
COUNTING_SECONDS = 1.0
# Where workers tell that they begin a block.
TOPIC = "reflfield-blocks-begun"
GO_ON = "run the same command again, which goes on from the blocks that are finished"


def check_installed() -> None:
    """Demand what computes on a cluster, which is not installed with all else.

    Raises
    ------
    InputError
        If it is missing; the message says how it is installed.
    """
    missing = [name for name in ("dask", "distributed", "cloudpickle") if not find_spec(name)]
    if missing:
        raise InputError(
            f"scheduler: expected the packages of a dask cluster, found no "
            f'{", ".join(missing)}; install them with: pip install "reflfield[cluster]"'
        )


def _lost_errors() -> tuple[type[Exception], ...]:
    """What the calls of a client raise when its scheduler is gone; of the first: time-outs."""
    return (OSError, distributed.client.ClosedClientError)


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
    at_once : int, optional
        At most so many blocks in the hands of one worker, so that it computes no more of them
        at a time.

    Attributes
    ----------
    begun : int
        How often a worker has begun a block: more often than there are blocks if workers
        were lost or failed.
    """

    def __init__(
        self,
        address: str,
        function: Callable[[Any, Any], Any],
        context: Any,
        at_once: int | None = None,
    ) -> None:
        self.begun = 0
        self._at_once = at_once
        self._address, self._function, self._context = address, function, context
        self._token = uuid.uuid4().hex
        self._left: deque[int] = deque()
        # Address of the worker and number of the block that a future is of.
        self._in_hand: dict[Any, tuple[str, int]] = {}
        self._contexts: dict[str, Any] = {}
        self._deaths: Counter[int] = Counter()
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
        self._left.extend(blocks)
        n_kept = 0
        with self._connected() as client:
            finished = distributed.as_completed(with_results=True, raise_errors=False)
            with self._needing_the_scheduler():
                client.subscribe_topic(TOPIC, self._hear)
            while n_kept < len(blocks):
                with self._needing_the_scheduler():
                    self._check(client)
                    threads = self._workers.threads(client)
                    if not finished.has_ready():
                        self._take_back_of_lost(threads)
                    finished.update(self._hand_out(client, threads, blocks))
                if not finished.has_ready():
                    time.sleep(POLLING_SECONDS)
                    continue
                future, result = next(finished)
                if future in self._in_hand:  # not taken back
                    address, number = self._in_hand.pop(future)
                    yield number, self._usable(future, result, address)
                    n_kept += 1

    @contextmanager
    def _connected(self) -> Iterator[distributed.Client]:
        try:
            client = distributed.Client(
                self._address, timeout=CONNECTING_SECONDS, set_as_default=False
            )
        except (OSError, ValueError) as error:
            raise InputError(
                f"scheduler: expected a dask scheduler at {self._address}, found none "
                f"({error}); start one with `dask scheduler`"
            ) from error
        try:
            with client.as_current(), warnings.catch_warnings():
                # The context is large, and sent once to each worker.
                warnings.filterwarnings("ignore", message="Sending large graph")
                yield client
        finally:
            # A scheduler that is gone does not say goodbye.
            with suppress(*_lost_errors()):
                client.close(timeout=CLOSING_SECONDS)

    @contextmanager
    def _needing_the_scheduler(self) -> Iterator[None]:
        try:
            yield
        except _lost_errors() as error:
            self._lost(error)

    def _lost(self, error: BaseException | None) -> NoReturn:
        raise InputError(
            f"scheduler: expected the scheduler at {self._address} to stay, lost it; start "
            f"it and its workers, then {GO_ON}"
        ) from error

    def _check(self, client: distributed.Client) -> None:
        """Find a connection that is lost, or was and is another now: its futures are void."""
        if client.status != "running" or any(f.cancelled() for f in self._contexts.values()):
            self._lost(None)

    def _take_back_of_lost(self, threads: Mapping[str, int]) -> None:
        """Take blocks back that workers had in hand who are not there any more."""
        for future, (address, number) in list(self._in_hand.items()):
            if address not in threads:
                del self._in_hand[future]
                future.cancel()
                self._left.appendleft(number)
                self._deaths[number] += 1
                if self._deaths[number] >= MOST_DEATHS:
                    _deadly(address)
        for address in self._contexts.keys() - threads.keys():
            del self._contexts[address]

    def _hand_out(
        self, client: distributed.Client, threads: Mapping[str, int], blocks: Mapping[int, Any]
    ) -> list[distributed.Future]:
        """Hand blocks out, to all workers one for each thread before they get the next."""
        new = []
        n_in_hand = Counter(address for address, _ in self._in_hand.values())
        for each in range(1, BLOCKS_PER_THREAD + 1):
            for address, n_threads in threads.items():
                while self._left and n_in_hand[address] < self._most_in_hand(each, n_threads):
                    number = self._left.popleft()
                    new.append(self._submitted(client, address, blocks[number]))
                    self._in_hand[new[-1]] = (address, number)
                    n_in_hand[address] += 1
        return new

    def _most_in_hand(self, each: int, n_threads: int) -> int:
        """Blocks that a worker may have: it begins them all at once if it has the threads."""
        if self._at_once is None or self._at_once >= n_threads:
            return each * n_threads
        return self._at_once

    def _submitted(
        self, client: distributed.Client, address: str, block: Any
    ) -> distributed.Future:
        at = {"workers": [address], "pure": False, "retries": RETRIES}
        if address not in self._contexts:
            self._contexts[address] = client.submit(_unpacked, self._packed, **at)
        context = self._contexts[address]
        return client.submit(_on_worker, self._function, context, block, self._token, **at)

    @cached_property
    def _packed(self) -> bytes:
        return cloudpickle.dumps(self._context)

    def _hear(self, event: tuple[float, str]) -> None:
        if event[1] == self._token:
            self.begun += 1

    def _usable(self, future: distributed.Future, result: Any, address: str) -> Any:
        # Whatever has become of the future meanwhile: its worker may have died since.
        if isinstance(result, _Computed):
            return result.value
        if future.status != "error":
            self._lost(None)
        _, error, traceback = result
        if isinstance(error, distributed.KilledWorker):
            _deadly(address)
        raise error.with_traceback(traceback)


def _deadly(address: str) -> NoReturn:
    raise InputError(
        f"scheduler: expected workers that live through a block, lost {MOST_DEATHS} at the "
        f"same one, the last of them {address}; see its log, give workers more memory "
        f"(`dask worker --memory-limit`), and {GO_ON}"
    )


class _Workers:
    """How many workers a cluster has; waits for some, saying so, but not for ever."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._threads: dict[str, int] = {}
        self._counted = self._seen = -COUNTING_SECONDS
        self._waited = False

    def threads(self, client: distributed.Client) -> dict[str, int]:
        """Number of threads of each worker by its address, as of a second ago at most.

        Raises
        ------
        InputError
            If there have been none for long.
        """
        now = time.monotonic()
        if self._seen < 0:
            self._seen = now
        if now - self._counted >= COUNTING_SECONDS:
            self._threads = dict(client.nthreads())
            self._counted = now
            if self._threads:
                self._seen = now
            self._say(int(now - self._seen))
        return self._threads

    def _say(self, seconds: int) -> None:
        name = f"waiting for workers of {self._address}"
        if seconds >= WAITING_SECONDS:
            raise InputError(
                f"scheduler: expected workers at {self._address}, found none for "
                f"{WAITING_SECONDS} s; start some with `dask worker {self._address}`, then "
                f"{GO_ON}"
            )
        if seconds:
            report(name, seconds, WAITING_SECONDS)
        elif self._waited:
            report(name, WAITING_SECONDS, WAITING_SECONDS)
        self._waited = seconds > 0


def threads_here(otherwise: int) -> int:
    """Threads for a block that has threads of its own.

    Parameters
    ----------
    otherwise : int
        What to use in the process that runs the job.

    Returns
    -------
    int
        On a cluster's worker, as many as it was started with, wherever the job runs.
    """
    if "distributed" not in sys.modules:  # nor is this a worker
        return otherwise
    try:
        return int(distributed.get_worker().state.nthreads)
    except ValueError:  # no worker is computing this
        return otherwise


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


def _unpacked(context: bytes) -> Any:
    return cloudpickle.loads(context)
