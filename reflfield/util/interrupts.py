"""Ctrl-C and requests to end: work is left in order, anything else is ended at once.

Nothing that takes time to import is imported here: a signal in the first seconds, while
libraries are loaded, ends the process with one line.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class Stopped(BaseException):
    """A signal asked to end while there was work to leave in order.

    Parameters
    ----------
    number : int
        Of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.status = 128 + number
        self.word = WORDS[signal.Signals(number)]


class _State:
    """Whether there is work to leave in order, and it has not been asked to end yet."""

    working = False


def _stop(number: int, _: FrameType | None) -> None:
    if _State.working:
        _State.working = False  # the next signal ends at once
        raise Stopped(number)
    os.write(2, f"reflfield: {WORDS[signal.Signals(number)]}\n".encode())
    os._exit(128 + number)


@contextmanager
def ending_on_signals() -> Iterator[None]:
    """Inside the block, signals end the process with one line and status 128 + number.

    Those that whoever started the process has it ignore stay ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may say what signals do
        return
    heeded = [number for number in WORDS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _stop) for number in heeded}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def leaving_work_in_order() -> Iterator[None]:
    """Inside the block, the first signal raises `Stopped`: nothing is left half done."""
    _State.working = True
    try:
        yield
    finally:
        _State.working = False
