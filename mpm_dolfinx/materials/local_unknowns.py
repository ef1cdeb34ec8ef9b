# SPDX-License-Identifier: MIT
"""Local unknowns of laws, determined by equations at each point.

Some stresses have no closed formula.  A law then has unknowns y, trial values z(F) and residuals f(y, z) at each point.
Newton's method solves f = 0 at all points together, up to round-off.  With the solution (y*, z*), the forms contain

    y = y* + Y (z(F) - z*),     Y = -(df/dy)^-1 df/dz  at (y*, z*).

This y has the right value and the right derivative with respect to F.  UFL's derivative of a stress is therefore the
consistent tangent, although the forms contain no iterations.  The points store y*, z* and Y as coefficients.

If the law has an energy, the tangent is the second derivative of the energy, and the expression for y has a
second-order term.  If a law has a numpy function `solution`, this function computes y(z) and dy/dz.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations_with_replacement, product
from typing import NamedTuple

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import EPSILON, ITERATIONS, SAME
from mpm_dolfinx.base.validation import asked, instance, line
from mpm_dolfinx.forms.point_forms import FormPoints, Given, PointData, PointExpression
from mpm_dolfinx.materials.skeleton import BY_SCENE, Skeleton
from mpm_dolfinx.materials.user_functions import call, named
from mpm_dolfinx.parallel.exchange import first, together

HALVINGS = 25  # largest number of halvings of steps at a point, in all its Newton iterations together


class Solved(NamedTuple):
    """Solution of the local equations at n points."""

    unknowns: NDArray[np.float64]  # (n, m)
    trial: NDArray[np.float64]  # trial values (n, k)
    derive: Callable[[], Derived]  # function that returns the derivatives


class Derived(NamedTuple):
    """Derivatives of the unknowns with respect to the trial values, at n points."""

    slopes: NDArray[np.float64]  # first derivatives Y (n, m k)
    bends: NDArray[np.float64] | None = None  # second derivatives (n, m k k), for laws with an energy


class LocalUnknowns:
    """The local unknowns of a law at its points, as coefficients of forms.

    `law`: class of the law.
    `points`: the points, with the law's parameters and state.
    `F`: deformation gradient (d, d) of the law, as UFL.

    Attributes
    ----------
    values
        Dictionary of UFL: the unknowns as functions of F, by name, and the trial values under the name `trial`.
    known
        Like `values`, but the unknowns do not depend on F.  For laws with an energy, `known` equals `values`.
    """

    def __init__(self, law: type[Skeleton], points: FormPoints, F, values: Mapping[str, object]):
        self._law, self._comm = law, points.grid.comm
        trial = call(law.trial, F=F, **values) if law.trial is not None else {"F": F}
        instance(f"{law.__name__}.trial: its result", trial, dict)
        given = {"trial": trial}
        trial = {name: value for name, value in trial.items() if isinstance(value, ufl.core.expr.Expr)}
        if not trial:
            raise ValueError(f"{law.__name__}.trial: returns {line(given['trial'])}, must contain UFL of F")
        z = _parts(trial.values())
        self._trial, self._dt = PointExpression(ufl.as_vector(z), points), values["dt"]
        self._solved: Latest[Solved] = Latest()
        self._derived: Latest[Derived] = Latest()
        self._of_energy = law.kirchhoff is None
        bends = self._of_energy and law.residual is not None
        self._equations = _Equations(law, points, trial, {name: values[name] for name in BY_SCENE}, bends)
        m, k = self._equations.count, len(z)
        shapes = {"unknowns": (m,), "trial": (k,), "slopes": (m, k)} | ({"bends": (m, k * k)} if bends else {})
        at = {what: points.follow(f"local {what}", s) for what, s in shapes.items()}
        # component by component: in 3D products of tensors take ten times as long to compile
        off = [z[j] - at["trial"][j] for j in range(k)]
        y = [at["unknowns"][i] + sum(at["slopes"][i, j] * off[j] for j in range(k)) for i in range(m)]
        if bends:  # the tangent contains the second derivative of the unknowns with respect to F
            for i, (j, l) in product(range(m), combinations_with_replacement(range(k), 2)):
                y[i] += at["bends"][i, k * j + l] * off[j] * off[l] / (2 if j == l else 1)
        shapes = {name: np.shape(start) for name, start in law.unknowns.items()}
        self.values = given | _named(shapes, y)
        self.known = self.values if self._of_energy else given | _named(shapes, at["unknowns"])

    def solve(self, data: PointData, derive: bool = True, motion: tuple = ()) -> Given:
        """Solve for the unknowns at the present F, and return values for the forms.  All processes must call this.

        `derive`: whether to compute also the derivatives dy/dz, which forms with `values` need.
        `motion`: numbers that identify the present displacement.  Results are reused while `data`, `motion` and dt are
        the same.
        """
        key = data.key, motion, float(self._dt.value)
        solved = self._solved(key, lambda: self._equations.solve(data, self._trial.evaluate(data)), self._comm)
        out = {"local unknowns": solved.unknowns, "local trial": solved.trial}
        if derive or self._of_energy:
            derived = self._derived(solved.derive, solved.derive, self._comm)
            out |= {"local slopes": derived.slopes, "local bends": derived.bends}
        return out


class _Equations:
    """The local equations f(y, z) = 0 of a law at its points."""

    def __init__(
        self,
        law: type[Skeleton],
        points: FormPoints,
        trial: Mapping[str, object],
        by_scene: Mapping[str, fem.Constant],
        bends: bool,
    ):
        self._law = law
        self._grid = points.grid
        self._by_scene = by_scene
        equations = law.residual or law.solution
        self._names = [name for name in (*law.parameters, *law.state) if name in law.arguments_of(equations)]
        self._points = own = FormPoints(points.grid, **{name: getattr(points, name).ufl_shape for name in self._names})
        starts = {name: np.asarray(start, dtype=float) for name, start in law.unknowns.items()}
        self._start = np.concatenate([start.ravel() for start in starts.values()])
        self.count = m = len(self._start)
        self._unknowns = {name: start.shape for name, start in starts.items()}
        self._trial = {name: value.ufl_shape for name, value in trial.items()}
        if law.residual is None:
            return
        k = sum(_size(s) for s in self._trial.values())
        y, z = (ufl.variable(own.follow(name, (size,))) for name, size in (("unknowns", m), ("trial", k)))
        given = {name: getattr(own, name) for name in self._names} | _named(self._unknowns, y) | self._by_scene
        residual = call(law.residual, **self._with_trial(_named(self._trial, z)), **given)
        found = named(f"{law.__name__}.residual", residual, self._unknowns)
        f = ufl.as_vector(_parts(found[name] for name in self._unknowns))
        by_y, by_z = ufl.diff(f, y), ufl.diff(f, z)
        steps = [by_y[i, j] for i in range(m) for j in range(m)]
        self._newton = PointExpression(ufl.as_vector([*(f[i] for i in range(m)), *steps]), own)
        self._slopes = PointExpression(ufl.as_vector([*steps, *(by_z[i, j] for i in range(m) for j in range(k))]), own)
        self._bends = None
        if bends:  # the second derivative of f along y = y* + Y (z - z*)
            Y = own.follow("slopes", (m, k))
            along = ufl.as_matrix([[_along(by_y, by_z, Y, m, (i,), j) for j in range(k)] for i in range(m)])
            by_y, by_z = ufl.diff(along, y), ufl.diff(along, z)
            each = product(range(m), range(k), range(k))
            self._bends = PointExpression(ufl.as_vector([_along(by_y, by_z, Y, m, (i, j), l) for i, j, l in each]), own)

    def _with_trial(self, values: dict) -> dict:
        """Return the arguments of `residual` or `solution` that contain the trial values, by name."""
        return {"trial": values} if self._law.trial is not None else values

    def solve(self, data: PointData, trial: NDArray[np.float64]) -> Solved:
        """Return the solution at points with trial values (n, k).  All processes must call this method."""
        if self._law.residual is None:
            return self._in_numpy(data, trial)
        m, n = self.count, len(trial)
        at = PointData(self._points, data.places, data.volume, {name: data[name] for name in self._names})
        y = np.tile(self._start, (n, 1))

        def system(rows: NDArray[np.int64], values: NDArray[np.float64]):
            y[rows] = values
            out = self._newton.evaluate(at, None if len(rows) == n else rows, {"unknowns": y, "trial": trial})
            f, norm = out[:, :m], np.abs(out[:, :m]).max(axis=1)
            return f, out[:, m:].reshape(-1, m, m), np.where(norm < np.inf, norm, np.inf)

        failed = _newton(system, y)
        self._refuse(data, failed, ": local equations have no solution")

        def derive() -> Derived:
            given = {"unknowns": y, "trial": trial}
            out, k = self._slopes.evaluate(at, None, given), trial.shape[1]
            by_y, by_z = out[:, : m * m].reshape(-1, m, m), out[:, m * m :].reshape(n, m, k)
            slopes = -_solve(by_y, by_z)
            undetermined = np.flatnonzero(~np.isfinite(slopes).all(axis=(1, 2)))
            self._refuse(data, undetermined, ".residual: does not determine the unknowns")
            if self._bends is None:
                return Derived(slopes.reshape(n, m * k))
            second = self._bends.evaluate(at, None, given | {"slopes": slopes.reshape(n, m * k)})
            bends = -_solve(by_y, second.reshape(n, m, k * k))
            return Derived(slopes.reshape(n, m * k), bends.reshape(n, m * k * k))

        return Solved(y, trial, derive)

    def _refuse(self, data: PointData, failed: NDArray[np.int64], why: str) -> None:
        """Raise NotConverged on all processes if `failed` contains points on any process."""
        messages = [f"{self._law.__name__}{why} at {data.x[i] + data.points.grid.base}" for i in failed[:1]]
        if message := first(self._grid.comm, "".join(messages)):
            raise NotConverged(message)

    def _in_numpy(self, data: PointData, trial: NDArray[np.float64]) -> Solved:
        """Return the local unknowns that the law's numpy function `solution` computes."""
        n, k, values, start = *trial.shape, {}, 0
        for name, shape in self._trial.items():  # copies, because a law may change its arguments
            values[name] = trial[:, start : start + _size(shape)].reshape(n, *shape).copy()
            start += _size(shape)
        given = {name: data[name].reshape(n, *getattr(self._points, name).ufl_shape).copy() for name in self._names}
        given |= {name: float(constant.value) for name, constant in self._by_scene.items()}
        found: dict = {}

        def solution() -> list[NDArray[np.float64]]:
            found.update(self._checked(call(self._law.solution, "numpy", **self._with_trial(values), **given), n))
            return [found[of][0].reshape(n, _size(shape)) for of, shape in self._unknowns.items()]

        def derive() -> Derived:
            each = together(self._grid.comm, lambda: [self._slopes_of(of, found[of][1], n) for of in self._unknowns])
            slopes = np.concatenate(each, axis=1)
            self._refuse(data, np.flatnonzero(~np.isfinite(slopes).all(axis=(1, 2))), ".solution: is not finite")
            return Derived(slopes.reshape(n, self.count * k))

        y = np.concatenate(together(self._grid.comm, solution), axis=1)
        self._refuse(data, np.flatnonzero(~np.isfinite(y).all(axis=1)), ".solution: is not finite")
        return Solved(y, trial, derive)

    @property
    def _title(self) -> str:
        return f"{self._law.__name__}.solution"

    def _checked(self, found, n: int) -> dict:
        """Return the checked unknowns and derivatives from the result of `solution`, or raise ValueError."""
        instance(f"{self._title}: its result", found, dict)
        for of, pair in found.items():
            if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and isinstance(pair[1], dict)):
                allowed = "must be a pair of values and a dict of derivatives"
                raise ValueError(f"{self._title}: {of} = {line(pair)}, {allowed}")
        if set(found) != set(self._unknowns):
            names = (", ".join(map(str, of)) or "nothing" for of in (found, self._unknowns))
            raise ValueError("{}: returns {}, must return {}".format(self._title, *names))
        out = {}
        for of, shape in self._unknowns.items():
            values, slopes = found[of]
            for by in slopes:
                if by not in self._trial:
                    what = f"{self._title}: derivative of {of} with respect to {line(by)}"
                    raise ValueError(f"{what}, must be with respect to one of {', '.join(self._trial)}")
            known = {by: slope if callable(slope) else self._slope(of, by, slope, n) for by, slope in slopes.items()}
            out[of] = _real(f"{self._title}: {of}", values, (n, *shape)), known
        return out

    def _slope(self, of: str, by: str, given, n: int) -> NDArray[np.float64]:
        """Return the derivative (n, ..., ...) of an unknown with respect to a trial value."""
        what = f"{self._title}: derivative of {of} with respect to {by}"
        value = asked(what, "a function without arguments that gives it", given) if callable(given) else given
        return _real(what, value, (n, *self._unknowns[of], *self._trial[by]))

    def _slopes_of(self, of: str, given: Mapping[str, object], n: int) -> NDArray[np.float64]:
        """Return the derivatives (n, m, k) of one unknown with respect to all trial values.

        `given`: derivatives, by name of the trial value.  A missing derivative is zero.
        """
        m, parts = _size(self._unknowns[of]), []
        for by, shape in self._trial.items():
            slope = self._slope(of, by, given[by], n) if by in given else np.zeros((n, m, _size(shape)))
            parts.append(slope.reshape(n, m, _size(shape)))
        return np.concatenate(parts, axis=2)


def _along(by_y, by_z, Y, m: int, i: tuple[int, ...], j: int):
    """Return the total derivative of f_i(y(z), z) with respect to z_j, with dy/dz = Y, as UFL."""
    return by_z[(*i, j)] + sum(by_y[(*i, a)] * Y[a, j] for a in range(m))


def _real(name: str, value, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return a value as an array of real numbers with this shape."""
    try:
        value = np.asarray(value)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name} = {line(value)}, must be an array of shape {shape}") from error
    if value.shape != shape:
        raise ValueError(f"{name} has shape {value.shape}, must be {shape}")
    if value.dtype.kind not in "fiu":
        raise ValueError(f"{name} has numbers of type {value.dtype}, must be real")
    return value.astype(float, copy=False)


def _newton(system, y: NDArray[np.float64]) -> NDArray[np.int64]:
    """Solve f(y) = 0 in place, and return the indices of points without a solution.

    `system`: function of point indices (r,) and of y (r, m) at these points, which returns f, df/dy and the norms of f.
    """
    rows, failed = np.arange(len(y)), np.zeros(len(y), dtype=bool)
    f, slope, norm = system(rows, y)
    halvings = np.zeros(len(y), dtype=int)
    for _ in range(ITERATIONS):
        step, old = _solve(slope, f[:, :, None])[:, :, 0], y[rows]
        solved, failed[rows] = norm <= 4 * EPSILON, ~np.isfinite(step).all(axis=1)
        step[solved & failed[rows]] = 0.0  # a solution, which may not be unique
        failed[rows] &= ~solved
        close = (np.abs(step) <= SAME * np.maximum(1.0, np.abs(old))).all(axis=1) | solved
        y[rows] = old - step  # the solution at points with a small step
        on = ~(close | failed[rows])
        rows, step, old, norm = (values[on] for values in (rows, step, old, norm))
        length = np.ones(int(on.sum()))
        if not len(rows):
            break
        f, slope, new = system(rows, old - step)
        while len(worse := np.flatnonzero(~(new < norm) & (halvings[rows] < HALVINGS))):
            length[worse] /= 2
            halvings[rows[worse]] += 1
            f[worse], slope[worse], new[worse] = system(rows[worse], old[worse] - length[worse, None] * step[worse])
        failed[rows] = ~(new < norm)
        on = ~failed[rows]
        rows, f, slope = (values[on] for values in (rows, f, slope))
        norm = new[on]
    failed[rows] = True  # not solved by `ITERATIONS` iterations
    return np.flatnonzero(failed)


def _solve(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return A^-1 b for matrices A.  The result is not finite if A is singular."""
    with np.errstate(all="ignore"):
        if A.shape[1] == 1:
            return b / A
        if A.shape[1] == 2:  # a tenth of LAPACK's time
            (a11, a12), (a21, a22) = A.transpose(1, 2, 0)[..., None]
            det = a11 * a22 - a12 * a21
            return np.stack([a22 * b[:, 0] - a12 * b[:, 1], a11 * b[:, 1] - a21 * b[:, 0]], axis=1) / det[:, None]
        try:
            return np.linalg.solve(A, b)
        except np.linalg.LinAlgError:
            singular = ~(np.abs(np.linalg.det(A)) > 0)
            return np.linalg.solve(np.where(singular[:, None, None], np.nan, A), b)


def _parts(values) -> list:
    """Return the list of all scalar components of UFL values."""
    return [value[i] if i else value for value in values for i in np.ndindex(value.ufl_shape)]


def _size(shape: tuple[int, ...]) -> int:
    return int(np.prod(shape, dtype=int))


def _named(shapes: Mapping[str, tuple[int, ...]], vector) -> dict:
    """Divide the components of a UFL vector among tensors, and return the tensors by name."""
    out, start = {}, 0
    for name, shape in shapes.items():
        index = np.arange(start, start + _size(shape)).reshape(shape)
        out[name] = ufl.as_tensor(_nested(vector, index)) if shape else vector[start]
        start += index.size
    return out


def _nested(vector, index: NDArray[np.int64]):
    return [_nested(vector, row) for row in index] if index.ndim else vector[int(index)]
