"""The command `capture-sim`; interrupted at any time, it says so on one line."""

import os
import signal
from types import FrameType


def main() -> None:
    """Run the command."""
    # Libraries take seconds to be imported, and some catch whatever is raised meanwhile, as
    # does the parser of the command line; what writes files asks for an exception instead.
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _end)
    from capture_sim.cli import main as run

    run()


def _end(number: int, frame: FrameType | None) -> None:
    del number, frame
    os.write(2, b"capture-sim: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()
