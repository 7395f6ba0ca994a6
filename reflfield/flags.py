"""Messages of the library, which name arguments, as the user of a command reads them: flags.

In a message an argument stands before the first colon (``max_memory: expected ...``) or in
backticks (``raise `max_memory```); nothing else is touched, file names and values included.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator

# Argument of the library -> flag of the commands.
FLAGS = {
    "settings": "--set",
    "hold_out": "--hold-out",
    "from_stage": "--from",
    "until": "--until",
    "workers": "--workers",
    "max_memory": "--max-memory",
    "scheduler": "--scheduler",
    "store": "--store",
    "format": "--format",
    "follow_links": "--follow-links",
    "test_split": "--hold-out test",
    "encoding": "--encoding",
    "layer": "--layer",
    "field_photographs": "--photographs",
    "size": "--size",
    "budget": "--budget",
    "preset": "--preset",
    "stages": "--stages",
    "tradeoff": "--tradeoff",
    "psnr": "--psnr",
    "n_images": "--orbit",
    "elevation_deg": "--elevation",
    "environment": "--environment",
    "convention": "--convention",
    "environment_up": "--environment-up",
    "environment_rotation": "--environment-rotation",
    "light": "--light",
    "samples_per_pixel": "--rays-per-pixel",
    "to": "--to",
    "out": "--out",
    "port": "--port",
    "sphere": "--sphere",
    "matt_sphere": "--matt-sphere",
    "grey_card": "--grey-card",
    "radius": "--radius",
    "focal": "--focal",
    "color_checker": "--color-checker",
    "view": "--view",
    "mesh": "--on",
    "tiles": "--tile",
    "only": "--only",
    "n_directions": "--directions",
    "photograph_side": "--pixels",
}
# These only in backticks: before a colon they are parts of a capture.
QUOTED_FLAGS = {**FLAGS, "cameras": "--cameras", "lights": "--lights"}
# Flags that were renamed, old -> new: accepted, with one line, until the next minor version.
RENAMED_FLAGS = {"--frames": "--capture", "--samples": "--rays-per-pixel"}
_QUOTED = re.compile(r"`(\w+)(?:=([^`]*))?`")
_HOLD_OUT = re.compile(r"HoldOut\((.*)\)")


def with_flags(message: str) -> str:
    """Return a message of the library with flags in place of arguments.

    Examples
    --------
    >>> with_flags("max_memory: expected 2.0 GB, received 1.0 GB; raise it")
    '--max-memory: expected 2.0 GB, received 1.0 GB; raise it'
    >>> with_flags("a.exr: out of the folder; allow it with `follow_links=True`")
    'a.exr: out of the folder; allow it with --follow-links'
    >>> with_flags("hold some out with `hold_out=HoldOut(views=K, lights=K)`")
    'hold some out with --hold-out views=K,lights=K'
    >>> with_flags("lights: expected one; correct them with `lights=True`")
    'lights: expected one; correct them with --lights'
    >>> with_flags("light 'l0': start one with `dask scheduler`")
    "light 'l0': start one with `dask scheduler`"
    """
    head, colon, rest = message.partition(":")
    names = head.split(", ")
    if colon and all(name in FLAGS for name in names):
        message = ", ".join(FLAGS[name] for name in names) + colon + rest
    return _QUOTED.sub(_flag, message)


def current_flags(words: Iterable[str], say: Callable[[str], None]) -> Iterator[str]:
    """Yield the words of a command line with renamed flags replaced, saying so.

    Examples
    --------
    >>> list(current_flags(["relight", "f.rfld", "--samples=4"], print))
    reflfield: note: --samples is now --rays-per-pixel; it is accepted until version 0.2
    ['relight', 'f.rfld', '--rays-per-pixel=4']
    """
    for word in words:
        flag, equals, value = word.partition("=")
        if flag in RENAMED_FLAGS:
            say(
                f"reflfield: note: {flag} is now {RENAMED_FLAGS[flag]}; it is accepted until "
                "version 0.2"
            )
            flag = RENAMED_FLAGS[flag]
        yield f"{flag}{equals}{value}"


def _flag(quoted: re.Match[str]) -> str:
    name, value = quoted.groups()
    if name not in QUOTED_FLAGS:
        return quoted.group()
    if value in (None, "True"):
        return QUOTED_FLAGS[name]
    return f"{QUOTED_FLAGS[name]} {_word(value)}"


def _word(value: str) -> str:
    """Return a value as one word of a command line."""
    counts = _HOLD_OUT.fullmatch(value)
    if counts is None:
        return value.strip("'\"")
    return counts.group(1).replace("test=True", "test").replace(", ", ",")
