"""Modules that are imported when they are first used, because their import takes long."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class LateImport:
    """Stands for a module until one of its names is asked for.

    Parameters
    ----------
    name : str
        Of the module, absolute.

    Examples
    --------
    >>> LateImport("math").sqrt(4.0)
    2.0
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        # Who looks into the names of a module, as doctest does, uses nothing of it.
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(import_module(self._name), name)
