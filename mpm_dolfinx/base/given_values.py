# SPDX-License-Identifier: MIT
"""Values that are given as numbers or as functions of time and place: how functions are called, what they may give.

Functions are called by the names of their parameters:

t
    Time, s: the ends of the substeps, see `time_integration`.
X : (m, d), m
    Reference positions of m places.
x : (m, d), m
    Where these are at the start of the step, as for a water level.

A single parameter of another name is the time.  Other names are refused.  Parameters with a default keep it.
Constants of materials are functions of X, pressures and stresses at the start of x, the places as seeded.

A function of places gives a number, or one for each place (m,); where vectors are allowed also one vector (d,), or one
for each place (m, d).  Places may be repeated, so that m is above d, and no array may be two of these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from inspect import Parameter, signature
from types import FunctionType, MethodType

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import asked, numbers

Places = Callable[[str], NDArray[np.float64]]
"""Gives positions (m, d), m, by their name, "X" or "x"."""
PLACES = ("X", "x")
NAMES = ("t", *PLACES)
PLAIN = (FunctionType, MethodType)
LIBRARIES = ("numpy", "scipy")  # x is what their functions are of, whatever that is


def _plain(function: Callable) -> bool:
    """Return whether the parameters of a function have the names that the author of a scene has given them."""
    while isinstance(function, partial):
        function = function.func
    library = str(getattr(function, "__module__", None)).partition(".")[0] in LIBRARIES
    own = type(function).__module__.partition(".")[0] == __name__.partition(".")[0]
    return (isinstance(function, PLAIN) and not library) or own


def _parameters(function: Callable) -> list[Parameter] | None:
    """Return the parameters with which a function is called; None where it tells none."""
    try:
        every = list(signature(function).parameters.values())
    except (TypeError, ValueError):  # some that are built in
        return None
    named = [p for p in every if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    if not named and any(p.kind == p.VAR_POSITIONAL for p in every):
        return None
    return [p for p in named if p.default is p.empty] or named


def takes(function: Callable) -> tuple[str, ...] | None:
    """Return which of t, X and x a function is called with; None where its parameters have other names."""
    parameters = _parameters(function)
    names = ("t",) if parameters is None else tuple(p.name for p in parameters)
    if len(names) == 1 and names[0] not in PLACES:
        return ("t",)
    if not names or not set(names) <= set(NAMES):
        return None
    return None if names == ("x",) and not _plain(function) else names


def by_place(value) -> bool:
    """Return whether a value is a function of places."""
    return callable(value) and bool(set(PLACES) & set(takes(value) or ()))


def check_names(what: str, function: Callable, among: Sequence[str] = NAMES) -> tuple[str, ...]:
    """Return which of t, X and x a function is called with.

    Raises
    ------
    ValueError
        Its parameters have other names, or are not among those that are allowed.
    """
    names = takes(function)
    if names is not None and set(names) <= set(among):
        return names
    given = ", ".join(p.name for p in _parameters(function) or ())
    if given == "x" and "x" in among:  # an interpolation in time, say
        raise ValueError(f"{what}: an object or a library's function of x, must be lambda t: ..., or lambda x: ...")
    allowed = "must be of the time alone"
    if len(among) > 1:
        allowed = f"must be of {', '.join(among[:-1])} or {among[-1]} by these names, or of the time alone"
    raise ValueError(f"{what}: a function of ({given}), {allowed}")


def called(function: Callable, values: dict) -> object:
    """Return what a function gives for values of t, X and x."""
    parameters = _parameters(function)
    if parameters is None:
        return function(values["t"])
    by_name = {p.name: values[name] for p, name in zip(parameters, takes(function), strict=True)}
    alone = {p.name for p in parameters if p.kind == p.KEYWORD_ONLY}
    positional = [value for name, value in by_name.items() if name not in alone]
    return function(*positional, **{name: by_name[name] for name in alone})


def at_places(what: str, allowed: str, function: Callable, name: str, places: NDArray[np.float64]) -> object:
    """Return what a function of one kind of places gives, "X" or "x": its parameter has that name.

    Raises
    ------
    ValueError
        It is a function of something else, or raises.
    """
    names = [p.name for p in _parameters(function) or ()]
    if _plain(function) and names != [name]:
        kind = {"X": "reference positions", "x": "positions as seeded"}[name]
        raise ValueError(f"{what}: a function of ({', '.join(names)}), must be of {name}, the {kind}")
    return asked(what, allowed, function, places)


def given(
    what: str, value, t: float, side: Places | None = None, dim: int = 0, *, among: Sequence[str] = NAMES, number=True
) -> NDArray[np.float64]:
    """Return a value at time t (s): of shape (), or (m,) of m places; with a dimension also (d,), or (m, d).

    A function of places that gives one vector for all gives it for each: (m, d).

    Parameters
    ----------
    what
        Of which object it is, for messages.
    side
        Gives the places; None where there are none.
    dim
        Number of components that it may have.
    among
        Those of t, X and x of which it may be a function.
    number
        Whether it may be a number, also where it may have components.

    Raises
    ------
    ValueError
        Naming what it is of, what it is, and what is allowed.
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
    if not m:  # a function need not have an answer for no places
        return np.zeros(0) if number else np.zeros((0, dim))
    again = max(dim, 1) // m + 1  # times, so that there are more places than components
    repeated = {name: np.tile(x, (again, 1)) for name, x in places.items()}
    many = [*[(m * again,)] * number, *[(m * again, dim)] * bool(dim)]
    allowed = f"{allowed}, or as much for each of {m * again} places"
    out = numbers(what, asked(what, allowed, called, value, {"t": t, **repeated}), *one, *many, allowed=allowed)
    if out.shape == (dim,):
        return np.broadcast_to(out, (m, dim))
    return out[:m] if out.ndim else out
