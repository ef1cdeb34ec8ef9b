# SPDX-License-Identifier: MIT
"""Laws of soil with an initial stress.

The initial stretch F_i (3, 3) of a point causes its initial stress.  The law is evaluated at F F_i, where F is the
deformation gradient relative to the seeded state.  Volumes, porosities and conductivities refer to the seeded state.
Laws with the state variable `plastic` need no F_i, because the inverse plastic metric C_p^-1 stores the initial strain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from inspect import Parameter, Signature

import numpy as np
import ufl

from mpm_dolfinx.forms.axes import block, embedded, planar
from mpm_dolfinx.materials.skeleton import Field, Skeleton

AT_REST = " at rest"
"""Suffix in the names of point fields that store the initial values of state variables."""


def stressed(m: Skeleton, knows_space: bool) -> Skeleton:
    """Return a material whose initial stress or stretch is a field at the points.

    `knows_space`: whether the material's law accepts F (3, 3).
    """
    if "initial_stress" in (names := [f.name for f in fields(m)]):
        own = m.initial_stress if callable(m.initial_stress) else _everywhere(m.initial_stress)
        return type(m)(**{name: getattr(m, name) for name in names} | {"initial_stress": own, "bulk": None})
    if "plastic" in m.state:
        return m
    given = {name: getattr(m, name) for name in names}
    return prestressed(type(m), knows_space)(**given, seeded_stretch=_everywhere(np.eye(3)))


def _everywhere(value) -> Callable:
    return lambda X: np.tile(value, (len(X), *[1] * np.ndim(value))).astype(float)


@cache
def prestressed(law: type[Skeleton], knows_space: bool) -> type[Skeleton]:
    """Return a law that is evaluated at F F_i, with the additional parameter `seeded_stretch` for F_i."""
    names = ("energy", "kirchhoff", "update", "trial")
    used = {name: f for name in names if (f := getattr(law, name)) is not None}
    given = {name: staticmethod(_from_seeded(f, name, knows_space)) for name, f in used.items()}
    more = {"__annotations__": {"seeded_stretch": Field}, "seeded_stretch": 1.0}
    more |= {"linear": law.linear, "__doc__": law.__doc__}
    return dataclass(frozen=True)(type(law.__name__, (law,), {**given, **more}))


def _from_seeded(function: Callable, name: str, knows_space: bool) -> Callable:
    """Return a function of F that evaluates `function`, a method of a law, at F F_i."""
    names = Skeleton.arguments_of(function)

    def of(**given):
        stretch = given["seeded_stretch"]
        if "F" in given:
            F = embedded(given["F"])
            given["F"] = block(F * stretch) if planar(F) else F * stretch
            if not knows_space:
                given["F"] = ufl.as_matrix([[given["F"][i, j] for j in range(2)] for i in range(2)])
        out = function(**{argument: given[argument] for argument in names})
        return out / ufl.det(stretch) if name in ("energy", "kirchhoff") else out

    arguments = dict.fromkeys([*names, "seeded_stretch"])
    of.__signature__ = Signature([Parameter(argument, Parameter.KEYWORD_ONLY) for argument in arguments])
    of.__qualname__ = function.__qualname__
    return of
