"""What a command may use, and how its work is shown and ended."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from reflfield.errors import InputError
from reflfield.util.terminal import showing_progress

NOTHING_LEFT = "nothing half-written is left"
GOES_ON = "the same command goes on where it stopped"


@contextmanager
def working(if_interrupted: str = NOTHING_LEFT) -> Iterator[None]:
    """Show progress, and leave work in order on Ctrl-C; libraries are imported before."""
    from reflfield.geometry.open3d_library import load_open3d

    load_open3d()
    with showing_progress(if_interrupted):
        yield


def limits(
    workers: int, max_memory: str, scheduler: str | None = None, store: str | None = None
) -> Any:
    """What a command may use."""
    from reflfield.options import Resources, parse_bytes

    return Resources(n_workers(workers), parse_bytes(max_memory), scheduler, store)


def n_workers(wanted: int) -> int:
    """Threads to use; 0 takes one per core that this process may use."""
    from reflfield.options import MOST_WORKERS, available_cores

    if not 0 <= wanted <= MOST_WORKERS:
        raise InputError(
            f"--workers: expected 1 to {MOST_WORKERS}, or 0 for one per core, received {wanted}"
        )
    return wanted or available_cores()
