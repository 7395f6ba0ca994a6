"""What can be wrong with a simulated scene.

Every message follows one pattern: what it is about, what was expected, what
arrived, what to do.
"""

from __future__ import annotations

# Characters of a value that a message shows.
LONGEST_VALUE = 200


class SceneError(ValueError):
    """A scene, or a file it names, holds something that cannot be simulated."""


def scene_error(what: str, expected: str, received: object, remedy: str = "") -> SceneError:
    """Build a `SceneError` whose message keeps the common pattern.

    Parameters
    ----------
    what : str
        Key or file the message is about.
    expected, remedy : str
        What would have been right, and what the reader should do.
    received : object
        What arrived; shown as ``repr`` unless it is text.

    Returns
    -------
    SceneError

    Examples
    --------
    >>> str(scene_error("sphere.radius", "a number > 0", -1.0, "give metres"))
    'sphere.radius: expected a number > 0, received -1.0; give metres'
    """
    text = received if isinstance(received, str) else _short(received)
    ending = f"; {remedy}" if remedy else ""
    return SceneError(f"{what}: expected {expected}, received {text}{ending}")


def _short(value: object) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of too many digits, a deep nesting
        text = f"one too long to be shown ({type(value).__name__})"
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]}..."


def shown(text: str) -> str:
    r"""Text for one line of a terminal: characters that are not printable escaped.

    Parameters
    ----------
    text : str

    Returns
    -------
    str

    Examples
    --------
    >>> print(shown("vase" + chr(27) + "[2J of clay, é"))
    vase\x1b[2J of clay, é
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
