"""Time by name, added up over threads."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up the wall-clock seconds of named pieces of work.

    Examples
    --------
    >>> clock = Stopwatch()
    >>> with clock.measure("shadows"):
    ...     pass
    >>> clock.seconds("shadows") >= 0.0, clock.seconds("nothing of the kind")
    (True, 0.0)
    """

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._lock = threading.Lock()

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the time that the block takes to `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            with self._lock:
                self._seconds[name] = self._seconds.get(name, 0.0) + elapsed

    def seconds(self, name: str) -> float:
        """Seconds added to `name` so far; of all threads together."""
        return self._seconds.get(name, 0.0)
