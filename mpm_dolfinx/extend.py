# SPDX-License-Identifier: MIT
"""Physics of the user's own: functions that return UFL, called with those arguments that they name.

Laws and conductivities are the material's: see `materials.Skeleton`.  Terms of the balances are given to
`Simulation`; they are integrated over the configuration at the start of the step, by these names:

points
    The points of integration.  `points.dx`: their measure; `points.value(f)`, `points.grad(f)`: f and its
    gradient, f one of u and v; `points.F`: deformation gradient at the start of the step;
    `points.position`, `points.displacement`: place, and displacement since the start (or since it was reset),
    both at the start of the step; and what the material points carry in `points.data`: fields of the materials
    that are functions of place, and the laws' state.
t
    Time at the end of the step, s, a UFL constant.

A function in `terms` adds to the balance of momentum, int P : grad v dV - loads + term = 0:

u
    Increment of the displacement in the step, m; P1.
v
    Test function.  The term is a linear form in v, such as -inner(b, points.value(v)) * points.dx for a
    body force b; or a stored energy without v, whose derivative is added.
dt
    Length of the step, s, a UFL constant: for what resists the rate u / dt.

A term that is linear in v and depends on u is taken to have an unsymmetric tangent.

A function in `sources` gives the volume of fluid that is brought in a time, m^d/s:

q
    Test function, constant in the cells: the source is s * q * points.dx with s in 1/s.
p
    Pore pressure, Pa, constant in the cells.
"""

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
