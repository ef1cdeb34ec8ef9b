# SPDX-License-Identifier: MIT
"""The one kind of cache: a value with the key that it was made for, compared by value."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Generic, TypeVar

from mpi4py import MPI

import numpy as np

from mpm_dolfinx.parallel.exchange import over_all

T = TypeVar("T")


class Latest(Generic[T]):
    """The value that was made last.

    While a value is being made there is none: what breaks off in between leaves no half-made one.
    """

    def __init__(self) -> None:
        self._entry: tuple[Any, T] | None = None

    def __call__(self, key: Any, make: Callable[[], T], comm: MPI.Intracomm = MPI.COMM_SELF) -> T:
        """Return the value of a key, made anew where the key is another than the last one's.

        Parameters
        ----------
        key
            All that the value depends on: arrays, that nobody changes, numbers, objects, or tuples of these.
        make
            Makes the value.
        comm
            Processes that make it together: all do where one has to.
        """
        other = self._entry is None or not same(self._entry[0], key)
        if over_all(comm, other) > 0:
            self._entry = None
            self._entry = key, make()
        return self._entry[1]

    @property
    def value(self) -> T | None:
        """The value, None where there is none."""
        return None if self._entry is None else self._entry[1]

    def clear(self) -> None:
        """Forget the value."""
        self._entry = None


class Keyed:
    """What may be part of a key without being kept alive by it: its `key` stands for it."""

    @cached_property
    def key(self) -> object:
        """An object that nothing else has."""
        return object()


def same(a: Any, b: Any) -> bool:
    """Return whether two keys are equal: arrays by shape and values, tuples one by one."""
    if a is b:
        return True
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    return not isinstance(a, np.ndarray) and not isinstance(b, np.ndarray) and bool(a == b)
