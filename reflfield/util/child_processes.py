"""Processes that end with the one that has started them, however it ends."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

# The system kills the process that this becomes when its parent is gone; one whose parent was
# gone before is not begun.
TIE = """
import ctypes, os, signal, sys
PR_SET_PDEATHSIG = 1
ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.argv[2], sys.argv[2:])
"""


def tied(command: Sequence[str]) -> list[str]:
    """Command line of a process that is killed when this one is gone, or killed itself.

    Parameters
    ----------
    command : sequence of str
        The first is the path of a program. To be started from a thread that outlives it.

    Returns
    -------
    list of str
        The same command on systems other than Linux, which cannot do so.
    """
    if not sys.platform.startswith("linux"):
        return list(command)
    return [sys.executable, "-I", "-S", "-c", TIE, str(os.getpid()), *command]
