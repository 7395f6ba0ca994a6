"""Progress of long work, shown by whoever listens.

Stages call `track`; the commands install a listener (a progress bar with the
time left). Without a listener nothing is shown, so library users and tests
see no output.
"""

from __future__ import annotations

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
