"""One thread for the BLAS while blocks of work have threads of their own."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController


class _OneCore:
    """Limit of the BLAS to one thread that any number of threads may hold at once.

    The limits of `threadpoolctl` give back what they found: of two that overlap, the one that
    ends last would find the other's, and leave one thread to the process for good.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._limit: Any = None

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._limit = _thread_pools(len(sys.modules)).limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._limit.restore_original_limits()


_ONE_CORE = _OneCore()


def one_core_blas() -> AbstractContextManager[None]:
    """Keep the BLAS from threads of its own: the blocks have theirs, and two layers fight."""
    return _ONE_CORE


@contextmanager
def thread_pool(workers: int) -> Iterator[ThreadPoolExecutor]:
    """Threads, at least one, for parts of some work; the BLAS has one in each of them."""
    with one_core_blas(), ThreadPoolExecutor(max(workers, 1)) as pool:
        yield pool


@lru_cache(maxsize=1)
def _thread_pools(n_modules: int) -> ThreadpoolController:
    """Libraries with threads in this process; finding them takes milliseconds.

    Looked for again when modules were loaded, which may have brought another.
    """
    return ThreadpoolController()
