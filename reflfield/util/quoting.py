"""Text of others' making in messages: printable, and cut to a length."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from typing import Any

LONGEST_QUOTE = 200
# Names in one message.
MOST_LISTED = 5


def has_controls(text: str) -> bool:
    r"""Whether a text holds control characters, line ends or halves of surrogate pairs.

    Examples
    --------
    >>> has_controls("M\u00fcnze\u202f1"), has_controls("a\nb"), has_controls("\ud800")
    (False, True, True)
    """
    return not text.isprintable() and any(
        unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in text
    )


def printable(text: str) -> str:
    r"""Text with what cannot be printed (control characters, halves of pairs) escaped.

    Examples
    --------
    >>> printable("M\u00fcnze 1"), printable("a\nb\ud800")
    ('Münze 1', 'a\\nb\\ud800')
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def listed(names: Sequence[str]) -> str:
    """Names for messages, printable, the first few of many.

    Examples
    --------
    >>> listed([f"v{i}" for i in range(7)])
    'v0, v1, v2, v3, v4 and 2 more'
    """
    more = len(names) - MOST_LISTED
    shown = ", ".join(printable(name) for name in names[:MOST_LISTED])
    return f"{shown} and {more} more" if more > 0 else shown


def quoted(value: Any) -> str:
    """A value for messages: printable, and not longer than `LONGEST_QUOTE`."""
    if isinstance(value, (list, dict, str)) and len(value) > LONGEST_QUOTE:
        kept = dict(list(value.items())[:9]) if isinstance(value, dict) else value[:99]
        return f"{quoted(kept)} ..."
    text = repr(value)
    return text if len(text) <= LONGEST_QUOTE else text[:LONGEST_QUOTE] + " ..."
