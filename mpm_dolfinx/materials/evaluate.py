# SPDX-License-Identifier: MIT
"""Stresses and new state at material points, and conductivities in pieces of particle domains."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import cached_property
from inspect import signature
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.forms.axes import block
from mpm_dolfinx.forms.point_forms import NONE, FormPoints, PointData, PointExpression
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.local_unknowns import LocalUnknowns
from mpm_dolfinx.materials.skeleton import BY_SCENE, Skeleton
from mpm_dolfinx.materials.user_functions import call, compiling, expression, named
from mpm_dolfinx.parallel.exchange import first
from mpm_dolfinx.points.material_points import MaterialPoints


class LawAtPoints:
    """A constitutive law, evaluated at its material points.

    Parameters
    ----------
    grid
        Background grid, or None outside a scene.
    law
        Class of the law.
    shapes
        Shape of each parameter and state variable of the law.
    stretches
        Number of rows, 2 or 3, of the deformation gradients that the law receives; by default `grid.stretches`.
    cell_size
        Cell size passed to the law, m; by default the mean edge length of the cell that contains the point.
    """

    def __init__(
        self,
        grid: Grid | None,
        law: type[Skeleton],
        shapes: dict[str, tuple[int, ...]],
        stretches: int | None = None,
        cell_size: float | None = None,
    ):
        self.grid = grid = grid or Grid([0] * 3, [1.0] * 3, [2] * 3, comm=MPI.COMM_SELF)
        self.law = law
        self._shapes = shapes
        self._stretches = grid.stretches if stretches is None else stretches
        self._cell_size = cell_size

    @cached_property
    def points(self) -> FormPoints:
        """Integration points, with F and the law's parameters and state variables as fields."""
        return FormPoints(self.grid, F=(self._stretches, self._stretches), **self._shapes)

    @cached_property
    def _by_scene(self) -> dict[str, Any]:
        return by_scene(self.grid, self._cell_size, self.law, self.points)

    @cached_property
    def _F(self):
        return ufl.variable(self.points.F)

    @cached_property
    def _local(self) -> LocalUnknowns | None:
        return LocalUnknowns(self.law, self.points, self._F, self._given) if self.law.unknowns else None

    @property
    def _given(self) -> dict:
        return {**{name: getattr(self.points, name) for name in self._shapes}, **self._by_scene}

    @cached_property
    def _values(self) -> dict:
        own = self._local.known if self._local is not None else {}
        return {**self._given, **own}

    def _evaluate(self, expression: PointExpression, data: PointData, dt: float = 0.0) -> NDArray[np.float64]:
        """Solve for the local unknowns of the law, and return the values of an expression at the points."""
        self._by_scene["dt"].value = dt
        given = NONE if self._local is None else self._local.solve(data, derive=False)
        return expression.evaluate(data, live=expression.live(data, given))

    def data(
        self, points: MaterialPoints, rows: NDArray[np.int64], values: dict[str, NDArray[np.float64]]
    ) -> PointData:
        """Return the values that forms need at the points with the indices `rows`.

        `values`: arrays (n, ...) of F, parameters and state at all points, by name.
        """
        x = points.x[rows]
        cells = self.grid.locals[self.grid.number(self.grid.index_from_base(x))]
        inputs = {name: values[name][rows] for name in ("F", *self._shapes)}
        inputs["F"] = inputs["F"][:, : self._stretches, : self._stretches]
        return self.points.at(cells, x, points.volume0[rows], **inputs)

    @cached_property
    def _stress(self) -> PointExpression:
        F = self._F
        return PointExpression(self.law.first_piola(F, self._values) * F.T / ufl.det(F), self.points)

    def stress(self, data: PointData, dt: float = 0.0) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, d, d), in Pa.

        `dt`: time since the last update of the state, in s.
        """
        return self._evaluate(self._stress, data, dt)

    @cached_property
    def _energy(self) -> PointExpression:
        return PointExpression(expression(self.law.energy, [()], "F", F=self._F, **self._values), self.points)

    def energy(self, data: PointData) -> NDArray[np.float64]:
        """Return the stored energy (n,) per reference volume, in Pa.  The law must define `energy`."""
        return self._evaluate(self._energy, data)

    @cached_property
    def _out_of_plane(self) -> PointExpression | None:
        across = self.law.out_of_plane(self._F, self._values)
        return None if across is None else PointExpression(across, self.points)

    def stress_3d(self, data: PointData) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, 3, 3), in Pa, with nan for undefined out-of-plane stresses."""
        if self._stretches == 3:
            return self.stress(data)
        out = np.zeros((len(data.cells), 3, 3))
        out[:, :2, :2], across = self.stress(data), self._out_of_plane
        out[:, 2, 2] = np.nan if across is None else self._evaluate(across, data)
        return out

    @cached_property
    def _update(self) -> tuple[PointExpression, dict[str, tuple[int, ...]]]:
        """UFL expression of all new state variables as one vector, and the shapes of the state variables."""
        what, shapes = f"{self.law.__name__}.update", {name: np.shape(value) for name, value in self.law.state.items()}
        new = named(what, call(self.law.update, F=self._F, **self._values), shapes, some=True)
        parts = [f[i] if i else f for f in new.values() for i in np.ndindex(f.ufl_shape)]
        with compiling(what, f"real UFL of {shapes}"):
            return PointExpression(ufl.as_vector(parts), self.points), {name: shapes[name] for name in new}

    def new_state(self, data: PointData, dt: float) -> list[tuple[str, NDArray[np.float64]]]:
        """Return names and values of the updated state variables after a step of length dt, in s."""
        if self.law.update is None:
            return []
        expression, shapes = self._update
        values = self._evaluate(expression, data, dt)
        out = []
        start = 0
        for name, shape in shapes.items():
            stop = start + int(np.prod(shape, dtype=int))
            out.append((name, values[:, start:stop].reshape(-1, *shape)))
            start = stop
        return out


def knows_space(grid: Grid, m: Skeleton) -> bool:
    """Return whether a material's law accepts F (3, 3) in plane strain.

    Some user-defined laws accept F (2, 2) only.  Laws with local unknowns are assumed to accept F (3, 3).

    `m`: material whose constants are arrays (1, ...) with the value at one point.
    """
    law = type(m)
    function, shape = (law.energy, ()) if law.kirchhoff is None else (law.kirchhoff, (3, 3))
    if law.unknowns or function is None:
        return True
    values = {name: np.asarray(getattr(m, name, np.zeros(1)), dtype=float)[0] for name in law.parameters}
    given = {name: fem.Constant(grid.mesh, value) for name, value in values.items()}
    given |= {name: fem.Constant(grid.mesh, np.asarray(value, dtype=float)) for name, value in law.state.items()}
    F = ufl.variable(FormPoints(grid, F=(3, 3)).F)
    log = logging.getLogger("UFL")  # UFL logs errors before it raises them
    log.disabled, before = True, log.disabled
    try:
        law_of_F = expression(function, [shape], F=F, **given, **by_scene(grid))
        apply_derivatives(apply_algebra_lowering(ufl.diff(law_of_F, F)))  # here UFL detects sizes that disagree
    except Exception:  # UFL raises several kinds of errors
        return False
    finally:
        log.disabled = before
    return True


def by_scene(
    grid: Grid, cell_size: float | None = None, law: type[Skeleton] | None = None, points: FormPoints | None = None
) -> dict[str, Any]:
    """Return the time since the start of the step and the cell size as UFL, by name.

    `points`: integration points of the law.  If cells have several sizes, each point stores the size of its cell.
    """
    if points is not None and not grid.even and cell_size is None and "cell_size" in law.by_scene:
        sizes = points.follow("cell_size", (), lambda data: grid.volumes(data.cells)[:, None] ** (1 / grid.dim))
        return {"dt": fem.Constant(grid.mesh, 0.0), "cell_size": sizes}
    size = mean_size(grid) if cell_size is None else cell_size
    return dict(zip(BY_SCENE, (fem.Constant(grid.mesh, 0.0), fem.Constant(grid.mesh, float(size))), strict=True))


def mean_size(grid: Grid) -> float:
    """Return the edge length, in m, of the square or cube with the volume of the largest cell."""
    return float(np.prod([w.max() for w in grid.widths]) ** (1 / grid.dim))


MOST = 100.0
"""Upper limit of the softness, because softness is infinite in perfectly plastic flow.

Sensitivity (scene "soil" of tests/plateaus.py): half this value changes the result by 4.0e-03, and twice this value by
5.0e-03. Finer cells change it by 3.0e-02.
"""


class SoftnessAtPoints:
    """Softness of yielding points: elastic shear modulus divided by tangent shear modulus.

    In plastic flow, volume strains and pressures may alternate from cell to cell.  The coefficient tau that damps
    pressure jumps between cells must then grow with the softness of the soil.

    The deviatoric strain of a step is e = dev sym dF F^-1, with the change dF of F.  With the Kirchhoff stress T(s) at
    F - (1 - s) dF, the tangent shear modulus is G_t = (dT/ds) : e / (2 e : e) at s = 1.  In soil at rest, the direction
    of e is random.  The softness therefore uses a weighted mean of two moduli: G_t with the weight e : e, and the
    modulus of the previous step with the weight `NEAR`^4.  The forms use the softness of the previous step, because
    Newton's method may not converge with the softness of the current iterate.

    `grid`, `law`, `shapes`, `stretches`: see `LawAtPoints`.
    """

    def __init__(self, grid: Grid, law: type[Skeleton], shapes: dict[str, tuple[int, ...]], stretches: int):
        self._law = law
        self._grid = grid
        self._shapes = shapes
        self._stretches = d = stretches
        self._points = points = FormPoints(grid, F=(d, d), dF=(d, d), **shapes)
        s = ufl.variable(fem.Constant(grid.mesh, 1.0))
        F = points.F - (1 - s) * points.dF
        F = ufl.variable(block(F) if d > grid.dim else F)
        self._by_scene = by_scene(grid, None, law, points)
        values = {**{name: getattr(points, name) for name in shapes}, **self._by_scene}
        self._local = LocalUnknowns(law, points, F, values) if law.unknowns else None
        if self._local is not None:
            values |= self._local.values
        tau = law.first_piola(F, values) * F.T
        e = ufl.sym(points.dF * ufl.inv(points.F))
        e -= ufl.tr(e) / d * ufl.Identity(d)
        self._along = PointExpression(ufl.as_vector([ufl.inner(e, e), ufl.inner(ufl.diff(tau, s), e)]), points)

    def __call__(self, at: PointData, dF: NDArray, shear: NDArray, dt: float, before: NDArray) -> NDArray[np.float64]:
        """Return the softness of points, in [1, `MOST`].

        `at`: F, parameters and state of n points.
        `dF` (n, d, d): change of F in a step of length dt, in s.
        `shear` (n,), in Pa: elastic shear modulus.
        `before` (n,): softness in the previous step.
        """
        self._by_scene["dt"].value = dt
        fields = {name: at[name] for name in ("F", *self._shapes)}
        dF = dF[:, : self._stretches, : self._stretches]
        data = PointData(self._points, at.places, at.volume, {"dF": dF, **fields})
        given = NONE if self._local is None else self._local.solve(data)
        weight, work = self._along.evaluate(data, live=self._along.live(data, given)).T
        elastic = 2 * shear * (weight + NEAR**4)
        return np.clip(elastic / np.maximum(work + 2 * shear * NEAR**4 / before, elastic / MOST), 1.0, MOST)


class ConductivityAtPieces:
    """Conductivities that depend on deformation and position, evaluated at pieces of particle domains.

    Parameters
    ----------
    materials
        The scene's materials.
    laws
        Distinct conductivity laws of the materials.
    pieces
        Integration points of the pieces.  If `laws` is not empty, they have F, position, conductivity and porosity0.
    displacement
        Increment of the displacement since the start of the step.
    pressure
        DG0 pressure of the cells, Pa, at the start of the substep.
    """

    def __init__(
        self,
        materials: Sequence[Skeleton],
        laws: Sequence[Callable],
        pieces: FormPoints,
        displacement: fem.Function,
        pressure: fem.Function,
    ):
        self._points = pieces
        self._materials = materials
        self._u = displacement
        self.by_pressure = any("p" in signature(law).parameters for law in laws)
        """Whether any of the conductivity laws depends on the pore pressure p."""
        self._p = pressure
        self._laws = {law: PointExpression(self._in_ufl(law), pieces) for law in laws}

    def _in_ufl(self, law: Callable):
        points, F = self._points, self._points.increment(self._u) * self._points.F
        J = ufl.det(F)
        return expression(
            law,
            [()],
            conductivity=points.conductivity,
            F=F,
            J=J,
            porosity=ufl.max_value(0.0, 1 - (1 - points.porosity0) / J),  # trial displacements may close pores
            porosity0=points.porosity0,
            x=points.position + points.moved_by(self._u),
            p=self._p,
        )

    def evaluate(self, data: PointData, material: NDArray[np.int32], begins: bool) -> NDArray[np.float64]:
        """Return the conductivities of pieces, in m/s, at the present displacement.

        `material` (n,): index of the material of each piece.

        Raises
        ------
        ValueError
            At the start of a step, a conductivity is negative or not finite.
        NotConverged
            Later in a step, a conductivity is negative or not finite.
        """
        out = data["conductivity"][:, 0].copy()
        for law, k in self._laws.items():
            rows = np.flatnonzero([m.conductivity_law is law for m in self._materials])
            chosen = np.isin(material, rows)
            out[chosen] = k.evaluate(data)[chosen]
            invalid = np.flatnonzero(chosen & ~((out >= 0) & (out < np.inf)))[:1]
            messages = [f"k = {out[i]:g} at {data.x[i] + data.points.grid.base}" for i in invalid]
            if message := first(self._points.grid.comm, "".join(messages)):
                kind = ValueError if begins else NotConverged
                raise kind(f"conductivity law: {message}, must be >= 0 and finite")
        return out


def sampled(law: Callable) -> list[float | None]:
    """Return a law's conductivities in three states of deformation, to be stored in checkpoints."""
    out = []
    for J in (0.75, 1.0, 1.25):
        F = ufl.as_matrix([[J, J / 8], [0.0, 1.0]])
        state = {"J": J, "porosity": 1 - 0.5 / J, "porosity0": 0.5, "conductivity": 1.0, "p": 1e6 * (J - 1)}
        given = {name: ufl.as_ufl(value) for name, value in state.items()}
        try:
            k = expression(law, [()], F=F, x=ufl.as_vector([0.25, 0.75]), **given)
            out.append(float(apply_algebra_lowering(k)(())))
        except Exception:  # a law need not accept numbers
            out.append(None)
    drains = getattr(law, "specific_yield", 0.0)
    return out + [drains] * (drains > 0)
