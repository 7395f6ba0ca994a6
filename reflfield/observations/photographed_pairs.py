"""Which pairs of a view and a light were photographed: the axis of the samples.

A capture is a list of photographs. Samples have one entry for each of them, ordered by view,
then light: only what was photographed takes memory and time. Where every view was photographed
under every light, this is the product of views and lights, row by row.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.capture import Capture
from reflfield.errors import InputError
from reflfield.util.validation import check_shape

Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]
Entry = TypeVar("Entry", bound=np.generic)


@dataclass(frozen=True, eq=False)
class PhotographedPairs:
    """Pairs of a view and a light, each at most once, ordered by view, then light.

    Parameters
    ----------
    view, light : (n_pairs,) int
    n_views, n_lights : int

    Raises
    ------
    ShapeError
        If there are not as many lights as views.
    InputError
        If a pair is out of range, repeats, or comes after a larger one.

    Examples
    --------
    The first of two views under both lights, the second under the second light:

    >>> pairs = PhotographedPairs.of_table([[True, True], [False, True]])
    >>> pairs.view, pairs.light
    (array([0, 0, 1]), array([0, 1, 1]))
    >>> pairs.as_product(np.array([[1.0, 2.0, 3.0]]), np.nan)
    array([[[ 1.,  2.],
            [nan,  3.]]])
    """

    view: Indices
    light: Indices
    n_views: int
    n_lights: int

    def __post_init__(self) -> None:
        check_shape("light", self.light, self.view.shape)
        pairs = self.view * self.n_lights + self.light
        inside = (self.view >= 0) & (self.view < self.n_views)
        inside &= (self.light >= 0) & (self.light < self.n_lights)
        if not (inside.all() and (np.diff(pairs) > 0).all()):
            raise InputError(
                f"pairs: expected pairs of {self.n_views} views and {self.n_lights} lights in "
                "ascending order, none twice, received others"
            )

    @classmethod
    def of(cls, capture: Capture) -> PhotographedPairs:
        """Pairs that a capture has photographs of."""
        return cls.of_table(capture.photograph_index >= 0)

    @classmethod
    def of_table(cls, photographed: ArrayLike) -> PhotographedPairs:
        """Pairs that are True in a table (n_views, n_lights)."""
        table = np.asarray(photographed, np.bool_)
        check_shape("photographed", table, (None, None))
        view, light = np.nonzero(table)
        return cls(view, light, *table.shape)

    @classmethod
    def product(cls, n_views: int, n_lights: int) -> PhotographedPairs:
        """Every view under every light."""
        return cls.of_table(np.ones((n_views, n_lights), np.bool_))

    def __len__(self) -> int:
        return len(self.view)

    @property
    def is_product(self) -> bool:
        """Whether every view was photographed under every light."""
        return len(self) == self.n_views * self.n_lights

    @cached_property
    def table(self) -> Bools:
        """(n_views, n_lights) True where a photograph exists."""
        table = np.zeros((self.n_views, self.n_lights), np.bool_)
        table[self.view, self.light] = True
        return table

    def both(self, views: Bools, lights: Bools) -> Bools:
        """(k, n_pairs) True where the view and the light of a pair are.

        Parameters
        ----------
        views : (k, n_views) bool
        lights : (k, n_lights) bool
        """
        if self.is_product:
            return (views[:, :, None] & lights[:, None]).reshape(len(views), len(self))
        return views[:, self.view] & lights[:, self.light]

    def as_product(self, values: NDArray[Entry], missing: Any) -> NDArray[Entry]:
        """Values (k, n_pairs, ...) as (k, n_views, n_lights, ...).

        Parameters
        ----------
        values : (k, n_pairs, ...)
        missing : scalar
            What stands for pairs that were not photographed.
        """
        shape = (len(values), self.n_views, self.n_lights, *values.shape[2:])
        if self.is_product:
            return values.reshape(shape)
        table = np.full(shape, missing, values.dtype)
        table[:, self.view, self.light] = values
        return table
