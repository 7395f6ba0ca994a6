"""Progress of long work, shown by whoever listens.

Stages call `track`; the commands install a listener (a progress bar with the
time left). Without a listener nothing is shown, so library users and tests
see no output.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Item = TypeVar("Item")

# (description, done, total); called with done == 0 first and done == total last.
Listener = Callable[[str, int, int], None]

_listener: ContextVar[Listener | None] = ContextVar("progress_listener", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Send the progress of all work inside the block to `listener`."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def report(description: str, done: int, total: int) -> None:
    """Tell the listener, if any, that `done` of `total` steps are finished."""
    listener = _listener.get()
    if listener is not None:
        listener(description, done, total)


def track(items: Iterable[Item], total: int, description: str) -> Iterator[Item]:
    """Yield the items and report each as done when the next is asked for.

    Examples
    --------
    >>> with listening(lambda text, done, total: print(text, done, "of", total)):
    ...     for view in track(["a", "b"], 2, "views"):
    ...         pass
    views 0 of 2
    views 1 of 2
    views 2 of 2
    """
    report(description, 0, total)
    for done, item in enumerate(items, start=1):
        yield item
        report(description, done, total)


class ProgressLines:
    """Listener for logs: now and then a line with the time left.

    Parameters
    ----------
    write : callable
        Takes a line.
    interval : float
        Seconds between lines; shorter work is not reported.
    clock : callable
        Seconds, monotonic.

    Examples
    --------
    >>> seconds = iter([0.0, 2.0, 6.0])
    >>> lines = ProgressLines(print, interval=5.0, clock=lambda: next(seconds))
    >>> for done in (0, 1, 3):
    ...     lines("views", done, 10)
    views: 3 of 10, 0:14 left
    """

    def __init__(
        self,
        write: Callable[[str], None],
        interval: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._write, self._interval, self._clock = write, interval, clock
        self._started: dict[str, float] = {}
        self._said: float | None = None

    def __call__(self, description: str, done: int, total: int) -> None:
        """Hear of progress."""
        now = self._clock()
        if done == 0 or description not in self._started:
            self._started[description] = now
        if self._said is None:
            self._said = now
        if 0 < done < total and now - self._said >= self._interval:
            self._said = now
            left = round((now - self._started[description]) * (total - done) / done)
            self._write(f"{description}: {done} of {total}, {left // 60}:{left % 60:02d} left")
