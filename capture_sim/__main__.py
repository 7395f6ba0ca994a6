"""The command `capture-sim`; interrupted at any time, it says so on one line."""

import os
import signal
from types import FrameType


def main() -> None:
    """Run the command."""
    # Libraries take seconds to be imported, and some catch whatever is raised meanwhile.
    signal.signal(signal.SIGINT, _end)
    from capture_sim.cli import main as run

    signal.signal(signal.SIGINT, signal.default_int_handler)
    run()


def _end(number: int, frame: FrameType | None) -> None:
    del number, frame
    os.write(2, b"capture-sim: interrupted; nothing was written\n")
    os._exit(130)


if __name__ == "__main__":
    main()
