# SPDX-License-Identifier: MIT
"""How functions of the user's are called: with the arguments that they name."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature


def call(function: Callable, **available):
    """Call a function of the user's with those of the available arguments that it names.

    Raises
    ------
    ValueError
        Naming the function, the argument that there is not, and those that there are.
    """
    wanted = list(signature(function).parameters)
    for name in wanted:
        if name not in available:
            raise ValueError(
                f"{getattr(function, '__qualname__', function)}: argument {name!r}, "
                f"must be some of {', '.join(available)}"
            )
    return function(**{name: available[name] for name in wanted})
