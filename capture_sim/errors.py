"""What can be wrong with a simulated scene.

Every message follows one pattern: what it is about, what was expected, what
arrived, what to do.
"""

from __future__ import annotations


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
    shown = received if isinstance(received, str) else repr(received)
    ending = f"; {remedy}" if remedy else ""
    return SceneError(f"{what}: expected {expected}, received {shown}{ending}")
