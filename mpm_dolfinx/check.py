# SPDX-License-Identifier: MIT
"""What is given from outside is refused in one line: the object, the value, and what is allowed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf

import numpy as np
from numpy.typing import NDArray

LONGEST = 160  # characters of a value that are shown


def line(value) -> str:
    """Return a value as it is written, in one line."""
    out = " ".join(repr(value).split())
    return out if len(out) <= LONGEST else out[: LONGEST - 3] + "..."


def numbers(
    name: str,
    value,
    *shapes: tuple[int, ...] | None,
    allowed: str = "a finite number",
    test: Callable[[NDArray[np.float64]], NDArray[np.bool_]] = np.isfinite,
) -> NDArray[np.float64]:
    """Return a value as an array of floats.

    Parameters
    ----------
    name
        Of the object, for the message.
    shapes
        What its shape may be, None for any; by default a number.
    allowed
        What it must be, in words.
    test
        Whether each number, or all of them, may be what they are.

    Raises
    ------
    ValueError
        It is not made of numbers, of another shape, or fails the test.
    """
    try:
        out = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        out = None
    if out is None or not {out.shape, None}.intersection(shapes or [()]) or not np.all(test(out)):
        shape = f" of shape {out.shape}" if out is not None and out.ndim > 1 else ""
        raise ValueError(f"{name} = {line(value)}{shape}, must be {allowed}")
    return out


def whole(name: str, value, least: int = 1) -> int:
    """Return an integer that is at least `least`; ValueError otherwise."""
    allowed = f"an integer >= {least}"
    return int(numbers(name, value, allowed=allowed, test=lambda v: (least <= v) & (v < inf) & (v == np.floor(v))))


def all_of(name: str, values, kind: type, least: int = 0) -> None:
    """Refuse what is not a sequence of at least so many objects of a kind, with a ValueError."""
    allowed = f"a list of {'at least one ' if least else ''}{kind.__name__}"
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) < least:
        raise ValueError(f"{name} = {line(values)}, must be {allowed}")
    for value in values:
        if not isinstance(value, kind):
            raise ValueError(f"{name}: {line(value)}, must be {allowed}")


def functions(name: str, values) -> None:
    """Refuse what cannot be called, with a ValueError."""
    for value in values if isinstance(values, Sequence) and not isinstance(values, str) else [values]:
        if not callable(value):
            raise ValueError(f"{name}: {line(value)}, must be a function")
