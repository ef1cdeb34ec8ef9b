# SPDX-License-Identifier: MIT
"""Names of conditions, by which the results of the conditions are found."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import line

T = TypeVar("T")


class ByName(dict[str, T]):
    """Values of conditions by name, in the order of the conditions."""

    @property
    def array(self) -> NDArray[np.float64]:
        """All values (conditions, ...) as one array.  Without conditions its shape is (0,)."""
        return np.stack(list(self.values())) if self else np.zeros(0)

    def __missing__(self, name: Any) -> T:
        """Raise a KeyError for an unknown name, or for an index used as a name."""
        raise KeyError(f"{name!r}: must be the name of a condition: {', '.join(map(repr, self)) or 'there is none'}")


def named(conditions: Sequence[Any]) -> dict[str, Any]:
    """Return the conditions by name.  A default name consists of kind and side, and a number if necessary.

    Raises
    ------
    ValueError
        A name is invalid, or two conditions have an equal name.
    """
    given = [getattr(one, "name", None) for one in conditions]
    for name, one in zip(given, conditions, strict=True):
        if name is not None and not (isinstance(name, str) and re.fullmatch(r"[\w .-]+", name)):
            raise ValueError(f"{line(one)}: name = {line(name)}, must consist of letters, digits, blanks and _ . -")
        if name is not None and given.count(name) > 1:
            raise ValueError(f"{line(one)}: name = {line(name)} is the name of another condition, must be unique")
    out: dict[str, Any] = {}
    for name, one in zip(given, conditions, strict=True):
        base, count = name or _default(one), 1
        name = base
        while name in out or (name in given and one is not conditions[given.index(name)]):
            count += 1
            name = f"{base}_{count}"
        out[name] = one
    return out


def _default(condition: Any) -> str:
    """Return the default name of a condition, from its kind and side."""
    kind = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(condition).__name__).lower()
    side = getattr(condition, "side", None)
    return kind if side is None else f"{kind}_{re.sub(r'[^A-Za-z0-9]+', '_', str(side))}"
