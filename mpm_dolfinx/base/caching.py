# SPDX-License-Identifier: MIT
"""Cache of the last value of a function, with its key: the data on which the value depends."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Generic, TypeVar

from mpi4py import MPI

import numpy as np

from mpm_dolfinx.parallel.exchange import over_all

T = TypeVar("T")
EMPTY = object()
"""Key of an empty cache."""


class Latest(Generic[T]):
    """Cache of the last value, which is valid as long as its key is the same.

    The cache is empty while a value is computed, so an exception leaves no incomplete value in the cache.

    `derived`: caches of values that depend on this value; `clear` also empties these caches.
    """

    def __init__(self, *derived: Latest) -> None:
        self._derived = derived
        self._key: Any = EMPTY
        self.value: T | None = None
        """The last value, or None if the cache is empty."""

    def __call__(self, key: Any, make: Callable[[], T], comm: MPI.Intracomm = MPI.COMM_SELF) -> T:
        """Return the value for a key.  The value is computed again if the key differs from the last key.

        `key`: all data on which the value depends: numbers, objects, arrays that never change, or tuples of these.
        `make`: function that computes the value.
        `comm`: processes that compute the value together.  If one process needs a new value, all processes compute it.
        """
        other = self._key is not key and (self._key is EMPTY or not same(self._key, key))
        if other if comm.size == 1 else over_all(comm, other) > 0:
            self._key, self.value = EMPTY, None
            for one in self._derived:
                one.clear()
            self.value = make()
        self._key = key  # the next call mostly has the same objects in its key
        return self.value

    def clear(self) -> None:
        """Empty this cache and the caches `derived`."""
        self._key, self.value = EMPTY, None
        for one in self._derived:
            one.clear()


class Keyed:
    """Base class of objects that a unique token represents in keys.  The token does not keep the object alive."""

    @cached_property
    def key(self) -> object:
        """Token that is unique to this object."""
        return object()


def same(a: Any, b: Any) -> bool:
    """Return whether two keys are equal.  Arrays are equal if their shapes and values are equal."""
    if a is b:
        return True
    if isinstance(a, tuple) and isinstance(b, tuple):
        if len(a) != len(b):
            return False
        for one, other in zip(a, b, strict=True):
            if one is not other and not same(one, other):
                return False
        return True
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.shape == b.shape and bool(np.logical_and.reduce(a == b, axis=None))
    return not isinstance(a, np.ndarray) and not isinstance(b, np.ndarray) and bool(a == b)
