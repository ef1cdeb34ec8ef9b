# SPDX-License-Identifier: MIT
"""Local unknowns: what a law's stress depends on beside F, and what equations at each point determine.

A law names unknowns y, trial values z(F) and residuals f(y, z); f = 0 is solved by Newton's method at all points at
once, to round-off.  The forms see

    y = y* + Y (z(F) - z*),     Y = -(df/dy)^-1 df/dz  at the solution (y*, z*),

whose value is y* and whose derivative by F is that of the solution: UFL's derivative of a stress that is a function of
y and F is the consistent tangent, and no iteration is unrolled.  y*, z* and Y are coefficients at the points.  A law
may also give y(z) and its derivative in numpy.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.caching import Latest
from mpm_dolfinx.constitutive.skeleton import BY_SCENE, Skeleton
from mpm_dolfinx.constitutive.user_functions import call
from mpm_dolfinx.errors import NotConverged
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointExpression
from mpm_dolfinx.parallel.exchange import first
from mpm_dolfinx.validation import instance, line

MOST, HALVINGS = 60, 25  # iterations, and halvings of their steps in all
CLOSE = 1e-9  # a Newton step below this, relative to unknowns of order one, leaves round-off
ROUND_OFF = 1e-15  # of residuals of order one


class Solved(NamedTuple):
    """Solution at some points: key of their data; unknowns (n, m), trial values (n, k) and slopes Y (n, m k)."""

    key: object
    unknowns: NDArray[np.float64]
    trial: NDArray[np.float64]
    slopes: NDArray[np.float64]


class LocalUnknowns:
    """The local unknowns of a law at some points, as coefficients of forms.

    Parameters
    ----------
    law
        Class of the law.
    points
        The points, which carry what the law takes.
    F
        Deformation gradient (d, d) that the law sees, as UFL.
    values
        UFL values of the law's parameters and state, and the constants that the scene gives to laws.
    """

    def __init__(self, law: type[Skeleton], points: FormPoints, F, values: Mapping[str, object]):
        self._law, self._comm = law, points.grid.comm
        trial = call(law.trial, F=F, **values) if law.trial is not None else {"F": F}
        instance(f"{law.__name__}.trial: what it gives", trial, dict)
        given = {"trial": trial}
        trial = {name: value for name, value in trial.items() if isinstance(value, ufl.core.expr.Expr)}
        z = _parts(trial.values())
        self._trial, self._solved = PointExpression(ufl.as_vector(z), points), Latest()
        self._dt = values["dt"]
        self._equations = _Equations(law, points, trial, {name: values[name] for name in BY_SCENE})
        m, k = self._equations.count, len(z)
        shapes = {"unknowns": (m,), "trial": (k,), "slopes": (m, k)}
        at = {
            what: points.follow(f"local {what}", s, lambda data, w=what: self._now(data, w))
            for what, s in shapes.items()
        }
        # component by component: in 3D products of tensors take ten times as long to compile
        off = [z[j] - at["trial"][j] for j in range(k)]
        y = [at["unknowns"][i] + sum(at["slopes"][i, j] * off[j] for j in range(k)) for i in range(m)]
        self.values = given | _named({name: np.shape(start) for name, start in law.unknowns.items()}, y)
        """The unknowns by name, as UFL that depends on F, and `trial`."""

    def update(self, data: PointData) -> None:
        """Solve for the unknowns of points at their present F; all processes together.

        Raises
        ------
        NotConverged
            Naming the first point where the equations could not be solved.
        """
        trial = self._trial.evaluate(data)
        self._solved((data.key, trial, float(self._dt.value)), lambda: self._equations.solve(data, trial), self._comm)

    def _now(self, data: PointData, what: str) -> NDArray[np.float64]:
        solved = self._solved.value
        if solved is None or solved.key is not data.key:
            raise RuntimeError(f"{self._law.__name__}: local unknowns are asked for before they are solved")
        return getattr(solved, what)


class _Equations:
    """The equations f(y, z) = 0 of a law at points that carry what they take."""

    def __init__(
        self, law: type[Skeleton], points: FormPoints, trial: Mapping[str, object], by_scene: Mapping[str, fem.Constant]
    ):
        self._law, self._grid, self._by_scene = law, points.grid, by_scene
        equations = law.residual or law.solution
        self._names = [name for name in (*law.parameters, *law.state) if name in law.taken_by(equations)]
        self._points = own = FormPoints(points.grid, **{name: getattr(points, name).ufl_shape for name in self._names})
        starts = {name: np.asarray(start, dtype=float) for name, start in law.unknowns.items()}
        self._start = np.concatenate([start.ravel() for start in starts.values()])
        self.count = m = len(self._start)
        self._unknowns = {name: start.shape for name, start in starts.items()}
        self._trial = {name: value.ufl_shape for name, value in trial.items()}
        if law.residual is None:
            return
        k = sum(_size(s) for s in self._trial.values())
        y, z = (ufl.variable(own.follow(name, (size,), _given)) for name, size in (("unknowns", m), ("trial", k)))
        given = {name: getattr(own, name) for name in self._names} | _named(self._unknowns, y) | self._by_scene
        residual = call(law.residual, **self._with_trial(_named(self._trial, z)), **given)
        instance(f"{law.__name__}.residual: what it gives", residual, dict)
        found = {name: ufl.as_ufl(value) for name, value in residual.items()}
        self._check("residual", {name: value.ufl_shape for name, value in found.items()})
        f = ufl.as_vector(_parts(found[name] for name in self._unknowns))
        by_y, by_z = ufl.diff(f, y), ufl.diff(f, z)
        steps = [by_y[i, j] for i in range(m) for j in range(m)]
        self._newton = PointExpression(ufl.as_vector([*(f[i] for i in range(m)), *steps]), own)
        self._slopes = PointExpression(ufl.as_vector([*steps, *(by_z[i, j] for i in range(m) for j in range(k))]), own)

    def _with_trial(self, values: dict) -> dict:
        """Return trial values as the law's equations name them."""
        return {"trial": values} if self._law.trial is not None else values

    def _check(self, function: str, shapes: dict[str, tuple[int, ...]]) -> None:
        """Refuse equations that do not give what the unknowns are."""
        if shapes != self._unknowns:
            allowed = f"the unknowns' names and shapes {self._unknowns}"
            raise ValueError(f"{self._law.__name__}.{function}: gives {shapes}, must have {allowed}")

    def solve(self, data: PointData, trial: NDArray[np.float64]) -> Solved:
        """Return the solution at points with trial values (n, k); all processes together."""
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
        shown = [f"{self._law.__name__}: local equations have no solution at {data.x[i]}" for i in failed[:1]]
        if message := first(self._grid.comm, "".join(shown)):
            raise NotConverged(message)
        out = self._slopes.evaluate(at, None, {"unknowns": y, "trial": trial})
        by_y, by_z = out[:, : m * m].reshape(-1, m, m), out[:, m * m :].reshape(n, m, trial.shape[1])
        return Solved(data.key, y, trial, -_solve(by_y, by_z).reshape(n, m * trial.shape[1]))

    def _in_numpy(self, data: PointData, trial: NDArray[np.float64]) -> Solved:
        """Return the solution of a law that gives it in numpy."""
        n, values, start = len(trial), {}, 0
        for name, shape in self._trial.items():
            values[name] = trial[:, start : start + _size(shape)].reshape(n, *shape)
            start += _size(shape)
        given = {name: data[name].reshape(n, *getattr(self._points, name).ufl_shape) for name in self._names}
        given |= {name: float(constant.value) for name, constant in self._by_scene.items()}
        blocks, refused = [], ""
        try:
            found = call(self._law.solution, **self._with_trial(values), **given)
            blocks = self._checked(found, n)
        except ValueError as error:
            refused = str(error)
        if message := first(self._grid.comm, refused):  # what one process refuses, all must
            raise ValueError(message)
        y, slopes = (np.concatenate(parts, axis=1) for parts in zip(*blocks, strict=True))
        lost = np.flatnonzero(~(np.isfinite(y).all(axis=1) & np.isfinite(slopes).all(axis=(1, 2))))
        shown = [f"{self._law.__name__}.solution: is not finite at {data.x[i]}" for i in lost[:1]]
        if message := first(self._grid.comm, "".join(shown)):
            raise NotConverged(message)
        return Solved(data.key, y, trial, slopes.reshape(n, self.count * trial.shape[1]))

    def _checked(self, found, n: int) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Return each unknown (n, m) and its slopes (n, m, k) from what a law in numpy gives at n points.

        Raises
        ------
        ValueError
            An unknown is missing, is no pair of values and derivatives, or has another shape or kind of number; a
            derivative is by what is no trial value.
        """
        name = f"{self._law.__name__}.solution"
        instance(f"{name}: what it gives", found, dict)
        for unknown, pair in found.items():
            if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and isinstance(pair[1], dict)):
                raise ValueError(f"{name}: {unknown} = {line(pair)}, must be a pair: values, and a dict of derivatives")
        self._check("solution", {unknown: np.shape(value)[1:] for unknown, (value, _) in found.items()})
        blocks = []
        for unknown, shape in self._unknowns.items():
            value, slopes = found[unknown]
            for of in slopes:
                if of not in self._trial:
                    among = ", ".join(self._trial)
                    raise ValueError(f"{name}: derivative of {unknown} by {line(of)}, must be by some of {among}")
            m, parts = _size(shape), []
            for of, by in self._trial.items():
                wanted = (n, *shape, *by)
                slope = _real(f"{name}: derivative of {unknown} by {of}", slopes.get(of, np.zeros(wanted)), wanted)
                parts.append(slope.reshape(n, m, _size(by)))
            value = _real(f"{name}: {unknown}", value, (n, *shape))
            blocks.append((value.reshape(n, m), np.concatenate(parts, axis=2)))
        return blocks


def _real(name: str, value, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return real numbers of a shape; others are refused with a ValueError."""
    value = np.asarray(value)
    if value.shape != shape:
        raise ValueError(f"{name} has shape {value.shape}, must be {shape}")
    if value.dtype.kind not in "fiu":
        raise ValueError(f"{name} has numbers of type {value.dtype}, must be real")
    return value.astype(float, copy=False)


def _newton(system, y: NDArray[np.float64]) -> NDArray[np.int64]:
    """Solve f(y) = 0 at all points, in place: Newton's method with a line search; return the points where it fails.

    system: called with rows (r,) and values (r, m), sets these and returns f (r, m), df/dy (r, m, m) and norms (r,).
    """
    rows, lost = np.arange(len(y)), np.zeros(len(y), dtype=bool)
    f, slope, norm = system(rows, y)
    halvings = np.zeros(len(y), dtype=int)
    for _ in range(MOST):
        step, begun = _solve(slope, f[:, :, None])[:, :, 0], y[rows]
        close = (np.abs(step) <= CLOSE * np.maximum(1.0, np.abs(begun))).all(axis=1) | (norm <= ROUND_OFF)
        lost[rows] = ~np.isfinite(step).all(axis=1)
        y[rows] = begun - step  # of those that are close this is the solution
        on = ~(close | lost[rows])
        rows, step, begun, norm, length = rows[on], step[on], begun[on], norm[on], np.ones(int(on.sum()))
        if not len(rows):
            break
        f, slope, new = system(rows, begun - step)
        while len(worse := np.flatnonzero(~(new < norm) & (halvings[rows] < HALVINGS))):
            length[worse] /= 2
            halvings[rows[worse]] += 1
            f[worse], slope[worse], new[worse] = system(rows[worse], begun[worse] - length[worse, None] * step[worse])
        lost[rows] = ~(new < norm)
        on = ~lost[rows]
        rows, f, slope, norm = rows[on], f[on], slope[on], new[on]
    lost[rows] = True  # after so many iterations
    return np.flatnonzero(lost)


def _solve(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return A^-1 b (n, m, k) of matrices (n, m, m); not finite where there is none."""
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
    """Return all components of UFL values."""
    return [value[i] if i else value for value in values for i in np.ndindex(value.ufl_shape)]


def _size(shape: tuple[int, ...]) -> int:
    return int(np.prod(shape, dtype=int))


def _named(shapes: Mapping[str, tuple[int, ...]], vector) -> dict:
    """Return tensors of given shapes that a UFL vector holds one after the other."""
    out, start = {}, 0
    for name, shape in shapes.items():
        index = np.arange(start, start + _size(shape)).reshape(shape)
        out[name] = ufl.as_tensor(_nested(vector, index)) if shape else vector[start]
        start += index.size
    return out


def _nested(vector, index: NDArray[np.int64]):
    return [_nested(vector, row) for row in index] if index.ndim else vector[int(index)]


def _given(data: PointData) -> NDArray[np.float64]:
    raise RuntimeError("trial values and unknowns are given with each evaluation")
