# SPDX-License-Identifier: MIT
"""User-defined functions that return UFL.

The package passes each argument by its name; the names are listed below.  `skeleton.Skeleton` describes functions for
laws and conductivities.  `Simulation` takes functions for terms of the balances, integrated over the configuration at
the start of the step.  Possible arguments of these functions are:

points
    Quadrature points.  The integral of 1 over the measure `points.dx` is the volume of the material points.
    `points.value(f)` and `points.grad(f)` are the value and gradient of f = u or v.  In axisymmetry the gradient is (3,
    3), with f_r / r on the diagonal.  `points.F` is the deformation gradient at the start of the step, in the shape of
    grad u; det F is the volume ratio since seeding.  `points.position` is the position at the start of the step.
    `points.displacement` is the displacement since the start of the run, or since a stage that reset it to zero.  Other
    attributes are the laws' state variables, and parameters that are functions of position.
t
    Time at the end of the substep, s, as a UFL constant.

A function in `terms` is added to the balance of momentum, `int P : grad v dV - loads + term = 0`.  This function may
also have the arguments:

u
    Increment of the displacement in the step, m; Q1.
v
    Test function.  The term is a linear form in v, such as -inner(b, points.value(v)) * points.dx for a body force b.
    A term without v is a stored energy; its derivative with respect to u is added.
velocity
    Velocity, m/s, from the scheme of time integration, for viscous resistance.
dt
    Time since the start of the step, s, as a UFL constant; `u / dt` is the mean velocity.

The tangent of a term with v is assumed to be unsymmetric.

The function of a `Source` returns the inflow as a volume rate of fluid at zero pressure, m^d/s.  This function may also
have the arguments:

q
    Test function, constant in the cells.  The source is `s * q * points.dx` with s in 1/s.
p
    Pore pressure, Pa, constant in the cells.
p_n
    Pore pressure at the start of the step, Pa, constant in the cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from inspect import signature

import numpy as np
import ufl
from ufl.algorithms import extract_coefficients
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.check_arities import ArityMismatch
from ufl.corealg.traversal import unique_pre_traversal

from mpm_dolfinx.base.validation import asked, instance, line, line_of


def call(function: Callable, kind: str = "UFL", /, **available):
    """Call a user-defined function with the arguments in its signature.

    ValueError is raised if the function has an unknown argument or fails.

    `kind`: type of the result, for messages.
    """
    names = list(signature(function).parameters)
    for name in names:
        if name not in available:
            raise ValueError(f"{_name(function)}: argument {name!r}, must be one of {', '.join(available)}")
    given = {name: available[name] for name in names}
    return asked(_name(function), f"{kind} of {', '.join(names) or 'no argument'}", lambda: function(**given))


def expression(function: Callable, shapes: Sequence[tuple[int, ...]], of: str = "", **available):
    """Return the result of a user-defined function as a UFL expression with one of the given shapes.

    ValueError is raised if the function fails, or if the result is not UFL.  ValueError is also raised if the result
    has a wrong shape or does not depend on the argument named `of`.
    """
    value = call(function, **available)
    allowed = f"UFL of shape {' or '.join(map(str, shapes))}{f' that depends on {of}' if of else ''}"
    try:
        out = ufl.as_ufl(value)
        apply_algebra_lowering(out)  # here UFL detects most errors
    except Exception as error:  # UFL raises several kinds of errors
        why = f" ({line_of(error)})" if isinstance(value, ufl.core.expr.Expr) else ""
        raise ValueError(f"{_name(function)}: returns {line(value)}{why}, must be {allowed}") from error
    if out.ufl_shape not in shapes:
        raise ValueError(f"{_name(function)}: returns shape {out.ufl_shape}, must be {allowed}")
    if of and not any(part is available[of] for part in unique_pre_traversal(out)):
        raise ValueError(f"{_name(function)}: returns {line_of(out)}, must be {allowed}")
    _check_parts(_name(function), out)
    return out


def _check_parts(what: str, out: ufl.core.expr.Expr) -> None:
    """Raise ValueError if UFL contains infinite numbers, NaN, or an index of two different sizes."""
    for part in unique_pre_traversal(out):
        if isinstance(part, ufl.constantvalue.RealValue) and not np.isfinite(float(part)):
            raise ValueError(f"{what}: contains {float(part)}, must be finite")
        if isinstance(part, ufl.classes.Product):
            sizes: dict[int, int] = {}
            for factor in part.ufl_operands:
                for index, size in zip(factor.ufl_free_indices, factor.ufl_index_dimensions, strict=True):
                    if sizes.setdefault(index, size) != size:
                        raise ValueError(f"{what}: index of sizes {sizes[index]} and {size}, must be of one size")


def named(what: str, given, shapes: Mapping[str, tuple[int, ...]], some: bool = False) -> dict:
    """Return `given`, the result of a user-defined function, as a dict of UFL with these shapes, or raise ValueError.

    `some`: whether the dict may lack some of the names.
    """
    instance(f"{what}: its result", given, dict)
    allowed, out = f"{'some of ' if some else ''}the names and shapes {dict(shapes)}", {}
    for name, value in given.items():
        try:
            out[name] = ufl.as_ufl(value)
        except Exception as error:  # UFL raises several kinds of errors
            raise ValueError(f"{what}: {name} = {line(value)}, must be UFL; the dict must have {allowed}") from error
        _check_parts(f"{what}: {name}", out[name])
    found = {name: value.ufl_shape for name, value in out.items()}
    if not found or found.items() - shapes.items() or not (some or len(found) == len(shapes)):
        raise ValueError(f"{what}: returns {found}, must have {allowed}")
    if not any(extract_coefficients(value) for value in out.values()):
        raise ValueError(f"{what}: returns only numbers, must be UFL that depends on its arguments")
    return out


def form(kind: str, function: Callable, **available) -> ufl.Form:
    """Return the form of a user-defined function, integrated over the points.

    ValueError is raised if the function fails, or if its result is not a form or has integrals over the grid.
    """
    out, dx = call(function, **available), available["points"].dx
    allowed = "a form with points.dx"
    if not isinstance(out, ufl.Form):
        raise ValueError(f"{kind}: {_name(function)} returns {line(out)}, must be {allowed}")
    for integral in out.integrals():
        if (integral.integral_type(), integral.subdomain_id()) != (dx.integral_type(), dx.subdomain_id()):
            raise ValueError(f"{kind}: {_name(function)} returns an integral over the grid, must be {allowed}")
        _check_parts(f"{kind}: {_name(function)}", integral.integrand())
    return out


def term_of(term: Callable, unknown: ufl.Coefficient, test: ufl.Argument, **available) -> tuple[ufl.Form, bool]:
    """Return a user-defined term as a linear form, and whether it derives from an energy.

    ValueError is raised if the term fails or depends on neither the unknown nor v.
    """
    out = form("terms", term, **available)
    if out.arguments():
        return out, False
    if unknown not in out.coefficients():
        raise ValueError(f"terms: {line(out)} depends on neither u nor v, must be a form in one of them")
    return ufl.derivative(out, unknown, test), True


@contextmanager
def compiling(what: str, allowed: str) -> Iterator[None]:
    """Replace errors of UFL and its compiler by a ValueError that begins with the object's name, `what`."""
    try:
        yield
    except (Exception, ArityMismatch) as error:  # UFL and FFCx raise many kinds of errors; one is no Exception
        if isinstance(error, (ValueError, OSError)) and _is_ours(error):  # OSError: a fault of the C compiler
            raise
        why = f"{type(error).__name__}: {line_of(error)}"
        raise ValueError(f"{what}: does not compile ({why}), must be {allowed}") from error


def _is_ours(error: Exception) -> bool:
    """Return whether an error was raised in this package, and not in a library."""
    frames = error.__traceback__
    while frames.tb_next is not None:
        frames = frames.tb_next
    return frames.tb_frame.f_globals["__name__"].startswith("mpm_dolfinx")


def _name(function: Callable) -> str:
    return getattr(function, "__qualname__", repr(function))
