# SPDX-License-Identifier: MIT
"""Validation of values in a scene, which are numbers or functions of time and position.

An error message has one line, with the object, its value, and the allowed values.

The parameter names of a function decide its arguments:

t
    Time, s, at the end of a substep, see `time_integration`.
X : (n, d), m
    Reference positions of n places.
x : (n, d), m
    Positions of the n places at the start of the step, for example to prescribe a water level.

If a function has a single parameter with another name, this parameter receives the time.  If one of several parameters
has another name, an error is raised.  Parameters with a default value receive an argument only if all parameters have
default values.  Material constants may be functions of X.  Initial pressures and stresses may be functions of x, the
seeded positions.

A function of position returns a number or an array (n,).  Where vectors are allowed, the function may also return a
vector (d,) or an array (n, d).  If n <= d, the function receives each position several times, so that an array (n,) is
longer than a vector.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from inspect import signature
from math import inf
from pathlib import Path
from types import FunctionType, MethodType
from typing import ClassVar, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

LONGEST = 160  # largest number of characters of a value in a message
_known: WeakKeyDictionary[Callable, _Arguments] = WeakKeyDictionary()
"""Cache of the arguments of each function."""


def line(value) -> str:
    """Return the representation of a value in one line."""
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

    `name`: name of the object, for the message.
    `shapes`: allowed shapes; None allows any shape.  By default only a scalar is allowed.
    `allowed`: description of the allowed values, for the message.
    `test`: function that returns for the array, or for each number, whether it is allowed.

    Raises
    ------
    ValueError
        The value is not numeric, has another shape, or fails the test.
    """
    try:
        out = np.asarray(value)
        out = None if out.dtype.kind in "USc" else out.astype(float)  # "1" is text, not a number
    except (TypeError, ValueError):
        out = None
    fits = out is not None and {out.shape, None}.intersection(shapes or [()])
    if not fits or not np.logical_and.reduce(test(out), axis=None):
        shape = f" of shape {out.shape}" if out is not None and out.ndim > 1 else ""
        raise ValueError(f"{name} = {line(value)}{shape}, must be {allowed}")
    return out


class Constants:
    """Base class of objects with constants.  Names of other programs raise TypeError with a formula."""

    FOREIGN: ClassVar[Mapping[str, str]] = {}
    """Names of other programs, and how to compute the constants of this class from them."""

    def __new__(cls, *args, **given):
        for name in given:
            if name in cls.FOREIGN and name not in cls.__dataclass_fields__:
                what = f"{cls.__name__}: {name} = {line(given[name])} is no constant"
                raise TypeError(f"{what}, must be given as {cls.FOREIGN[name]}")
        return super().__new__(cls)


def whole(name: str, value, least: int = 1) -> int:
    """Return the value as an integer.  Raise ValueError if it is not an integer >= `least`."""
    allowed = f"an integer >= {least}"
    return int(numbers(name, value, allowed=allowed, test=lambda v: (least <= v) & (v < inf) & (v == np.floor(v))))


def instance(name: str, value, kind: type) -> None:
    """Raise a ValueError if a value is not an instance of a class."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} = {line(value)}, must be a {kind.__name__}")


def flag(name: str, value) -> None:
    """Raise a ValueError if a value is not a boolean."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} = {line(value)}, must be True or False")


def chosen(name: str, values, among: Sequence[int], what: str) -> None:
    """Raise a ValueError unless values are a list of distinct indices from `among`."""
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise ValueError(f"{name} = {line(values)}, must be a list of {what}")
    for i, value in enumerate(values):
        if not isinstance(value, (int, np.integer)) or value not in among or value in values[:i]:
            options = ", ".join(map(str, among)) or "there is none"
            raise ValueError(f"{name}: body {line(value)}, must be one of the {what} ({options}), and listed once")


def all_of(name: str, values, kind: type | tuple[type, ...], least: int = 0) -> None:
    """Raise a ValueError if values are not a list of instances of a class, or if there are fewer than `least`."""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    allowed = f"a list of {'at least one ' if least else ''}{' or '.join(k.__name__ for k in kinds)}"
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) < least:
        what = f"a single {type(values).__name__}" if isinstance(values, kinds) else line(values)
        raise ValueError(f"{name} = {what}, must be {allowed}")
    for value in values:
        if not isinstance(value, kind):
            if isinstance(value, (list, tuple)) and any(isinstance(one, kind) for one in value):
                allowed = "unpacked: [*objects] instead of [objects]"
            raise ValueError(f"{name}: {line(value)}, must be {allowed}")


def functions(name: str, values) -> None:
    """Raise a ValueError if values are not a sequence of functions."""
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise ValueError(f"{name} = {line(values)}, must be a list of functions")
    for value in values:
        if not callable(value):
            raise ValueError(f"{name}: {line(value)}, must be a function")


def asked(name: str, allowed: str, function: Callable, *values):
    """Return the value of a user's function.  If the function fails, raise ValueError with the object's name."""
    try:
        return function(*values)
    except Exception as error:
        if allowed.startswith("UFL") and "ufunc" in str(error):
            allowed = f"{allowed}, with ufl.exp and the like in place of numpy.exp"
        raise ValueError(f"{name}: raises {type(error).__name__}: {line_of(error)}, must be {allowed}") from error


def path(name: str, value) -> Path:
    """Return a value as a path.  Raise ValueError if the value is neither text nor a path."""
    if not isinstance(value, (str, os.PathLike)):
        raise ValueError(f"{name} = {line(value)}, must be a path")
    return Path(value)


@contextmanager
def on_disk(name: str, allowed: str) -> Iterator[None]:
    """Context that adds the name of the object, and allowed values, to the message of an OSError."""
    try:
        yield
    except OSError as error:
        what = f"{name}: {error.strerror or line_of(error)}, must be {allowed}"
        raise OSError(error.errno, what, error.filename) from error


Places = Callable[[str], NDArray[np.float64]]
"""Function that returns reference positions for "X", and current positions for "x", both (n, d), in m."""
PLACES = ("X", "x")
NAMES = ("t", *PLACES)
PLAIN = (FunctionType, MethodType)
LIBRARIES = ("numpy", "scipy")  # in their functions, an argument named x need not be a position


def _plain(function: Callable) -> bool:
    """Return whether the function is defined in the scene or in this package, and not in a library."""
    while isinstance(function, partial):
        function = function.func
    library = str(getattr(function, "__module__", None)).partition(".")[0] in LIBRARIES
    own = type(function).__module__.partition(".")[0] == __name__.partition(".")[0]
    return (isinstance(function, PLAIN) and not library) or own


class _Arguments(NamedTuple):
    """Arguments that a function receives."""

    parameters: tuple[str, ...]  # names of the parameters that receive arguments
    names: tuple[str, ...] | None  # see `takes`
    alone: Mapping[str, str]  # keyword-only parameters, and their names among t, X and x
    positional: tuple[str, ...]  # names among t, X and x of the other parameters, in their order


_OF_TIME = _Arguments((), ("t",), {}, ("t",))  # of functions whose parameters Python does not know


def _arguments(function: Callable) -> _Arguments:
    """Return the arguments that `called` passes to a function."""
    try:
        return _known[function]
    except (KeyError, TypeError):  # some objects have no hash
        pass
    try:
        every = list(signature(function).parameters.values())
    except (TypeError, ValueError):  # some built-in functions
        return _OF_TIME
    named = [p for p in every if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    if not named and any(p.kind == p.VAR_POSITIONAL for p in every):
        return _OF_TIME
    given = [p for p in named if p.default is p.empty] or named
    parameters = tuple([p.name for p in given])
    names = ("t",) if len(given) == 1 and parameters[0] not in PLACES else parameters
    if not names or not set(names) <= set(NAMES) or (names == ("x",) and not _plain(function)):
        names = None
    alone = {p.name: name for p, name in zip(given, names or (), strict=False) if p.kind == p.KEYWORD_ONLY}
    positional = tuple([name for p, name in zip(parameters, names or (), strict=False) if p not in alone])
    out = _Arguments(parameters, names, alone, positional)
    with suppress(TypeError):
        _known[function] = out
    return out


def takes(function: Callable) -> tuple[str, ...] | None:
    """Return the names among t, X and x that a function takes as arguments, or None if it has other parameters."""
    return _arguments(function).names


def by_place(value) -> bool:
    """Return whether a value is a function of position."""
    return callable(value) and bool(set(PLACES) & set(takes(value) or ()))


def check_names(what: str, function: Callable, among: Sequence[str]) -> tuple[str, ...]:
    """Return the names among t, X and x that a function takes as arguments.

    Raises
    ------
    ValueError
        The parameters have other names, or names that are not in `among`.
    """
    names = takes(function)
    if names is not None and set(names) <= set(among):
        return names
    given = ", ".join(_arguments(function).parameters)
    if given == "x" and "x" in among:  # such as an interpolation in time
        raise ValueError(f"{what}: an object, or a function of x in a library, must be lambda t: ..., or lambda x: ...")
    allowed = "must be a function of the time alone"
    if len(among) > 1:
        allowed += f", or of parameters named {', '.join(among[:-1])} or {among[-1]}"
    raise ValueError(f"{what}: a function of ({given}), {allowed}")


def called(function: Callable, values: dict) -> object:
    """Call a function, and return its result.  `values` contains arguments by name: t, X or x."""
    _, _, alone, positional = _arguments(function)
    return function(*map(values.get, positional), **dict(zip(alone, map(values.get, alone.values()), strict=True)))


def at_places(what: str, allowed: str, function: Callable, name: str, places: NDArray[np.float64]) -> object:
    """Return the value of a function of positions.  Its only parameter must have the name `name` ("X" or "x").

    Raises
    ------
    ValueError
        The function has other parameters, or raises an exception.
    """
    names = _arguments(function).parameters
    if _plain(function) and names != (name,):
        kind = {"X": "reference positions", "x": "positions as seeded"}[name]
        raise ValueError(f"{what}: a function of ({', '.join(names)}), must be a function of {name}, the {kind}")
    return asked(what, allowed, function, places)


def given(
    what: str, value, t: float, side: Places | None = None, dim: int = 0, *, among: Sequence[str] = NAMES, number=True
) -> NDArray[np.float64]:
    """Return a value at time t.

    The result has the shape () or, for m places, (m,).  If `dim` = d > 0, the shapes (d,) and (m, d) are also possible.
    If a function of position returns a single vector (d,), the result (m, d) contains it m times.

    Parameters
    ----------
    what
        Name of the object, for messages.
    t
        Time, s.
    side
        Function that returns the positions of m places, or None if the value may only depend on time.
    dim
        Number of components of a vector value, or 0 if only scalars are allowed.
    among
        Names among t, X and x that the parameters of a function may have.
    number
        Whether a scalar is allowed as well, if `dim` > 0.

    Raises
    ------
    ValueError
        The value is not allowed.  The message names the object, the value and the allowed values.
    """
    one = [*[()] * number, *[(dim,)] * bool(dim)]
    allowed = f"a finite number{f' or {dim} of them' if dim else ''}" if number else f"{dim} finite numbers"
    if not callable(value):
        return numbers(what, value, *one, allowed=allowed)
    names = check_names(what, value, among if side is not None else ("t",))
    places = {name: side(name) for name in names if name in PLACES}
    if not places:
        allowed = f"{allowed} for a time"
        return numbers(what, asked(what, allowed, called, value, {"t": t}), *one, allowed=allowed)
    m = len(next(iter(places.values())))
    if not m:  # a function may fail without places
        return np.zeros(0) if number else np.zeros((0, dim))
    again = max(dim, 1) // m + 1  # repetitions that make m exceed the number of components
    repeated = {name: np.tile(x, (again, 1)) for name, x in places.items()}
    many = [*[(m * again,)] * number, *[(m * again, dim)] * bool(dim)]
    allowed = f"{allowed}, or one of these for each of {m * again} places"
    out = numbers(what, asked(what, allowed, called, value, {"t": t, **repeated}), *one, *many, allowed=allowed)
    if out.shape == (dim,):
        return np.broadcast_to(out, (m, dim))
    return out[:m] if out.ndim else out
