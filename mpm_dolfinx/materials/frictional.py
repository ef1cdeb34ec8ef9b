# SPDX-License-Identifier: MIT
"""Common parameters of frictional soil: angles of friction and dilation, and cohesion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mpm_dolfinx.materials.skeleton import Field, Skeleton, _check, check_given

GIVEN = {
    "friction": "in [0, 90) degrees",
    "dilation": "in [0, friction] degrees; 0 for flow without a change of volume, friction for associated flow",
    "cohesion": ">= 0 Pa",
}
"""Required constants and their ranges."""


@dataclass(frozen=True, kw_only=True)
class Frictional(Skeleton):
    """Base class of perfectly plastic and hardening laws for frictional soil.

    Parameters
    ----------
    friction
        Friction angle phi, degrees, in [0, 90).
    dilation
        Dilation angle psi, degrees, in [0, friction].
    cohesion
        Cohesion, Pa, >= 0.

    Raises
    ------
    ValueError
        A constant is out of its range or missing.
    """

    dilates: ClassVar = True

    friction: Field = None  # required: if missing, a message states its range
    dilation: Field = None
    cohesion: Field = None

    def __post_init__(self):
        super().__post_init__()
        check_given(self, GIVEN)
        _check(self, "friction", lambda v: (0 <= v) & (v < 90), "in [0, 90) degrees")
        _check(self, "cohesion", lambda v: 0 <= v, ">= 0")
        if not callable(self.friction):
            _check(self, "dilation", lambda v: (0 <= v) & (v <= self.friction), "in [0, friction] degrees")

    @property
    def symmetric(self) -> bool:
        return self.dilation == self.friction

    @property
    def nearly_incompressible(self) -> bool:
        return True  # plastic flow may be isochoric
