# SPDX-License-Identifier: MIT
"""Results of conditions, by name of the condition."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


class ByName(dict[str, T]):
    """Values of conditions by name, in the order of the conditions."""

    @property
    def array(self) -> NDArray[np.float64]:
        """All values (conditions, ...) as one array.  Without conditions its shape is (0,)."""
        return np.stack(list(self.values())) if self else np.zeros(0)

    def __missing__(self, name: Any) -> T:
        """Raise KeyError for an unknown name."""
        known = ", ".join(map(repr, self)) or "the names of results, but there are none"
        raise KeyError(f"{name!r}: must be one of {known}")
