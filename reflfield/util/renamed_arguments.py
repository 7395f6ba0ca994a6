"""Functions whose arguments were renamed: old names are accepted, with one line of warning."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

from reflfield.errors import InputError

Function = TypeVar("Function", bound=Callable[..., Any])

log = logging.getLogger(__name__)


def accepts_old_names(**renamed: str) -> Callable[[Function], Function]:
    """Return a decorator of functions that accept old names of their keyword arguments.

    Parameters
    ----------
    **renamed : str
        Present names by old ones. The decorated function raises an `InputError` that names
        both where a call gives both.

    Examples
    --------
    >>> @accepts_old_names(count="n")
    ... def twice(*, n):
    ...     return 2 * n
    >>> logging.disable()
    >>> twice(count=3)
    6
    >>> logging.disable(logging.NOTSET)
    """

    def decorator(function: Function) -> Function:
        @wraps(function)
        def wrapper(*positional: Any, **named: Any) -> Any:
            for old, new in renamed.items():
                if old not in named:
                    continue
                if new in named:
                    raise InputError(
                        f"{new}, {old}: expected one of the two, received both; leave out "
                        f"`{old}`, the old name"
                    )
                log.warning(
                    "argument %r is now %r; the old name is accepted until version 0.2",
                    *(old, new),
                )
                named[new] = named.pop(old)
            return function(*positional, **named)

        return cast(Function, wrapper)

    return decorator
