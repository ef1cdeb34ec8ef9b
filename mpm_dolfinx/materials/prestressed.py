# SPDX-License-Identifier: MIT
"""Laws of soil that has a stress where it is seeded.

A law is evaluated at F F_i, F counted from the state as seeded and F_i a stretch that the points carry: the soil
answers as if its stress had come by loading, while volumes, porosities and conductivities count from the state as
seeded.  F_i has all three axes, also in plane strain.  Laws with the state `plastic`, C_p^-1, have their elastic strain
in it and need none of this.
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
"""Ends the names of what points carry of a state as seeded, from which yield is told."""


def stressed(m: Skeleton, knows_space: bool) -> Skeleton:
    """Return a material whose points may have a stress as seeded, by fields of theirs; at first they have none.

    knows_space: whether its law takes F (3, 3).
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
    """Return a law with one more field: `seeded_stretch` F_i (3, 3)."""
    names = ("energy", "kirchhoff", "update", "trial")
    given = {name: staticmethod(_seen(f, name, knows_space)) for name in names if (f := getattr(law, name)) is not None}
    more = {"__annotations__": {"seeded_stretch": Field}, "seeded_stretch": 1.0}
    more |= {"linear": law.linear, "__doc__": law.__doc__}
    return dataclass(frozen=True)(type(law.__name__, (law,), {**given, **more}))


def _seen(function: Callable, name: str, knows_space: bool) -> Callable:
    """Return one of a law's functions, called with F F_i in place of F; stresses and energies are per volume now."""
    taken = Skeleton.taken_by(function)

    def of(**given):
        stretch = given["seeded_stretch"]
        if "F" in given:
            F = embedded(given["F"])
            given["F"] = block(F * stretch) if planar(F) else F * stretch
            if not knows_space:
                given["F"] = ufl.as_matrix([[given["F"][i, j] for j in range(2)] for i in range(2)])
        out = function(**{argument: given[argument] for argument in taken})
        return out / ufl.det(stretch) if name in ("energy", "kirchhoff") else out

    arguments = dict.fromkeys([*taken, "seeded_stretch"])
    of.__signature__ = Signature([Parameter(argument, Parameter.KEYWORD_ONLY) for argument in arguments])
    of.__qualname__ = function.__qualname__
    return of
