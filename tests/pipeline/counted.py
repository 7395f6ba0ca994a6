"""The command `reflfield` in small blocks, with a note of each time that one is computed.

    python -c "import counted; counted.main()" NOTES run CAPTURE ...

NOTES gets a file for each time that a block is begun, and one when it has ended, in a folder
for its stage and work. A file ``die`` in such a folder makes the process that begins a block
there kill itself: it holds how many are begun before, and after how many seconds.
To be imported by the workers of a cluster, too: blocks must be as small there.
"""

import os
import signal
import sys
import threading
import time
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reflfield import cli
from reflfield.observations import store
from reflfield.pipeline import silhouettes, texel_columns, visibility
from reflfield.util.blocks import Blocks

store.LEAST_TEXELS_PER_CHUNK, store.CHUNK_BYTES, store.VIEWS_PER_CHUNK = 64, 1 << 10, 1
texel_columns.COLUMNS_AT_ONCE = 25
silhouettes.VIEWS_AT_ONCE = 2
visibility.DIRECTIONS_AT_ONCE = 2
# What a block takes longer, so that a moment in the middle of one is met.
SECONDS = 0.04


@dataclass(frozen=True)
class Counted:
    """Function of numbered blocks that leaves notes."""

    function: Any
    notes: Path

    def __call__(self, context: Any, block: Any) -> Any:
        number, inner = block
        name = f"{number}.{os.getpid()}.{uuid.uuid4().hex}"
        (self.notes / f"{name}.begun").touch()
        self._die_if_it_is_time()
        time.sleep(SECONDS / 2)
        result = self.function(context, inner)
        time.sleep(SECONDS / 2)
        (self.notes / f"{name}.ended").touch()
        return result

    def _die_if_it_is_time(self) -> None:
        request = self.notes / "die"
        try:
            before, delay = request.read_text().split()
            if len(list(self.notes.glob("*.begun"))) <= int(before):
                return
            request.unlink()  # one process dies, the first
        except FileNotFoundError:
            return
        (self.notes / "killed").write_text(str(os.getpid()))
        kill = threading.Timer(float(delay), os.kill, (os.getpid(), signal.SIGKILL))
        kill.daemon = True
        kill.start()


def counting(notes: Path) -> None:
    """Make all work by blocks leave notes."""
    original = Blocks.map

    def counted_map(self, name, function, context, blocks, *, intact=None, at_once=None):
        folder = notes / self.folder.parent.stem / name
        folder.mkdir(parents=True, exist_ok=True)
        return original(
            self,
            name,
            Counted(function, folder),
            context,
            list(enumerate(blocks)),
            intact=intact and Inner(intact),
            at_once=at_once,
        )

    Blocks.map = counted_map


@dataclass(frozen=True)
class Inner:
    """Function of blocks without their numbers."""

    function: Any

    def __call__(self, context: Any, block: Any) -> Any:
        return self.function(context, block[1])


def main() -> None:
    """Run the command."""
    counting(Path(sys.argv.pop(1)))
    cli.main()
