# SPDX-License-Identifier: MIT
"""What is given from outside is refused in one line: the object, the value, and what is allowed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

LONGEST = 160  # characters of a value that are shown


def line(value) -> str:
    """Return a value as it is written, in one line."""
    return _short(repr(value))


def line_of(error: Exception) -> str:
    """Return the message of an error in one line."""
    return _short(str(error))


def _short(text: str) -> str:
    out = " ".join(text.split())
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
        out = np.asarray(value)
        out = None if out.dtype.kind in "USc" else out.astype(float)  # "1" is a word
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


def instance(name: str, value, kind: type) -> None:
    """Refuse what is not an object of a kind, with a ValueError."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} = {line(value)}, must be a {kind.__name__}")


def flag(name: str, value) -> None:
    """Refuse what is neither true nor false, with a ValueError."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} = {line(value)}, must be True or False")


def chosen(name: str, values, among: Sequence[int], what: str) -> None:
    """Refuse what is not a list of indices among those that are allowed, each once, with a ValueError."""
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise ValueError(f"{name} = {line(values)}, must be a list of {what}")
    for i, value in enumerate(values):
        if not isinstance(value, (int, np.integer)) or value not in among or value in values[:i]:
            there = ", ".join(map(str, among)) or "none is"
            raise ValueError(f"{name}: body {line(value)}, must be one of the {what}, each once: {there}")


def all_of(name: str, values, kind: type | tuple[type, ...], least: int = 0) -> None:
    """Refuse what is not a sequence of at least so many objects of a kind, with a ValueError."""
    kinds = " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
    allowed = f"a list of {'at least one ' if least else ''}{kinds}"
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) < least:
        raise ValueError(f"{name} = {line(values)}, must be {allowed}")
    for value in values:
        if not isinstance(value, kind):
            raise ValueError(f"{name}: {line(value)}, must be {allowed}")


def functions(name: str, values) -> None:
    """Refuse what is not a sequence of functions, with a ValueError."""
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise ValueError(f"{name} = {line(values)}, must be a list of functions")
    for value in values:
        if not callable(value):
            raise ValueError(f"{name}: {line(value)}, must be a function")


def asked(name: str, allowed: str, function: Callable, *values):
    """Return what a function of the user's gives; a ValueError from what it raises, or if it cannot be called."""
    try:
        return function(*values)
    except Exception as error:
        raise ValueError(f"{name}: raises {type(error).__name__}: {line_of(error)}, must be {allowed}") from error


def path(name: str, value) -> Path:
    """Return a path; ValueError if it is none."""
    if not isinstance(value, (str, os.PathLike)):
        raise ValueError(f"{name} = {line(value)}, must be a path")
    return Path(value)


@contextmanager
def on_disk(name: str, allowed: str) -> Iterator[None]:
    """Name the object and the remedy in an OSError: a folder that is not there, a disk that is full."""
    try:
        yield
    except OSError as error:
        what = f"{name}: {error.strerror or line_of(error)}, must be {allowed}"
        raise OSError(error.errno, what, error.filename) from error
