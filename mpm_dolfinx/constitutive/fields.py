# SPDX-License-Identifier: MIT
"""The materials of a scene at its points: parameters that differ from place to place, state, several laws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import fields
from functools import cached_property

import numpy as np
import ufl
from numpy.typing import NDArray

from mpm_dolfinx.validation import instance, numbers
from mpm_dolfinx.solve.newton import NotConverged
from mpm_dolfinx.parallel.exchange import first
from mpm_dolfinx.constitutive.user_functions import call, expression
from mpm_dolfinx.forms.point_forms import FormPoints, PointExpression
from mpm_dolfinx.points.grid import Grid
from mpm_dolfinx.constitutive.skeleton import Fluid, Skeleton
from mpm_dolfinx.points.bodies import Body, MaterialPoints

RESERVED = (
    "F",
    "offset",
    "weight",
    "storage",
    "density",
    "position",
    "displacement",
    "porosity0",
    "grid",
    "dx",
    "cells",
    "filled",
    "slots",
    "places",
    "x",
    "data",
    "version",
)
"""Names that points of integration need themselves."""


class SceneMaterials:
    """The materials of a scene; what differs from point to point is put into `points.data`, and found there.

    Parameters
    ----------
    grid
        Background grid.
    materials
        Material of each index that the bodies name.
    bodies
        All bodies; their reference positions are where fields are evaluated.
    points
        The points of this process, as seeded.
    """

    def __init__(self, grid: Grid, materials: Sequence[Skeleton], bodies: Sequence[Body], points: MaterialPoints):
        self._grid, self.materials = grid, materials
        X, index = _reference(bodies, len(materials))
        evaluated = [m.at(X[index == i]) for i, m in enumerate(materials)]
        self.laws = list(dict.fromkeys(map(type, materials)))
        self.conductivity_laws = list(dict.fromkeys(m.conductivity_law for m in materials if m.conductivity_law))
        """The different conductivity laws of the scene."""
        self._law = np.array([self.laws.index(type(m)) for m in materials])
        self.stiffest = max(float(np.max(m.oedometric, initial=0.0)) for m in evaluated)
        """Largest oedometric modulus, Pa."""
        self.conducts = any(m.conductivity_law or np.any(np.asarray(m.conductivity) > 0) for m in evaluated)
        """Whether fluid flows anywhere."""
        self.nearly_incompressible = any(np.any(m.nearly_incompressible) for m in evaluated)
        """Whether Q1 cells would lock somewhere."""
        self._fields = [[name for name in _names(m) if callable(getattr(m, name))] for m in materials]
        self.shapes: dict[str, tuple[int, ...]] = {}
        """Shape of each parameter and variable of state."""
        for i, m in enumerate(evaluated):
            rows = np.flatnonzero(index == i)
            values = {name: getattr(m, name) for name in self._fields[i]}
            self._add_shapes(_spread(m, values, len(rows)), points)
            for name, value in values.items():
                everywhere = np.zeros((len(X), *value.shape[1:]))
                everywhere[rows] = value
                mine = everywhere[points.id]
                points.data[name] = mine + points.data[name] if name in points.data else mine
        self._at_points = [
            LawAtPoints(grid, law, {name: self.shapes[name] for name in _takes(law)}) for law in self.laws
        ]

    def _add_shapes(self, m: Skeleton, points: MaterialPoints) -> None:
        """Note the shapes of what a material's law takes, and seed its state."""
        law = type(m)
        if (law.energy is None) == (law.kirchhoff is None):
            which = "neither" if law.energy is None else "both"
            raise ValueError(f"{law.__name__}: has {which}, must define energy or kirchhoff")
        for name in law.parameters:
            if not hasattr(m, name):
                known = ", ".join([*_names(m), *law.state])
                raise ValueError(f"{law.__name__}: its law takes {name!r}, must be F or some of {known}")
            value = _known(f"{law.__name__}: {name}", getattr(m, name))
            self._set_shape(law, name, value.shape[1:])
        for name, value in law.state.items():
            value = _known(f"{law.__name__}: state {name!r}", value)
            self._set_shape(law, name, value.shape)
            points.data[name] = np.tile(value, (len(points), *[1] * value.ndim))

    def _set_shape(self, law, name: str, shape: tuple[int, ...]) -> None:
        if name in RESERVED or hasattr(FormPoints, name):
            raise ValueError(f"{law.__name__}: the name {name!r} is taken; parameters and state must have another")
        other = self.shapes.setdefault(name, shape)
        if other != shape:
            raise ValueError(f"{law.__name__}: {name} has shape {shape}, in another law {other}; must agree")

    @property
    def symmetric(self) -> bool:
        """Whether the tangents of all materials are symmetric."""
        return all(m.symmetric for m in self.materials)

    def parts(self, pieces: FormPoints, common: Sequence[str]) -> list[tuple[type[Skeleton], FormPoints]]:
        """Return each law with points for the pieces that follow it; a single law's are all `pieces`.

        The points of several laws have the fields `common` of the pieces and what their law takes.
        """
        if len(self.laws) == 1:
            return [(self.laws[0], pieces)]
        names = [dict.fromkeys([*common, *_takes(law)]) for law in self.laws]
        shapes = [{name: getattr(pieces, name).ufl_shape for name in taken} for taken in names]
        return [(law, FormPoints(pieces.grid, **s)) for law, s in zip(self.laws, shapes, strict=True)]

    def law_of(self, points: MaterialPoints) -> NDArray[np.int64]:
        """Return the number of each point's law (n,)."""
        return self._law[points.material]

    def table(self, points: MaterialPoints, value: Callable[..., float], *columns: NDArray) -> NDArray[np.float64]:
        """Return value(material, *columns) at the points (n, ...); columns (n,) are values at the points."""
        if not columns and not any(self._fields):
            return np.array([value(m) for m in self.materials])[points.material]
        out = None
        for i in range(len(self.materials)):
            rows = np.flatnonzero(points.material == i)
            values = value(self._at(points, i, rows), *(column[rows] for column in columns))
            out = np.zeros((len(points), *np.shape(values)[1:])) if out is None else out
            out[rows] = values
        return out

    def _at(self, points: MaterialPoints, i: int, rows: NDArray[np.int64]) -> Skeleton:
        """Return a material whose constants are arrays over some of its points."""
        return _spread(self.materials[i], {name: points.data[name][rows] for name in self._fields[i]}, len(rows))

    def values(self, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return all parameters and state at the points (n, ...), zero where a point's law does not know them."""
        out = {name: np.zeros((len(points), *shape)) for name, shape in self.shapes.items()} | self.state(points)
        for i, m in enumerate(self.materials):
            rows = np.flatnonzero(points.material == i)
            at = self._at(points, i, rows)
            for name in m.parameters:
                out[name][rows] = getattr(at, name)
        return out

    def porosity(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the porosity n = 1 - (1 - n_0) / J at the points (n,)."""
        return 1 - (1 - self.table(points, lambda m: m.porosity)) / points.J

    def storage(self, points: MaterialPoints, fluid: Fluid) -> NDArray[np.float64]:
        """Return the storage coefficient at the points (n,), 1/Pa."""
        return self.table(points, lambda m, n: m.storage(fluid.bulk, n), self.porosity(points))

    def state(self, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return the state at the points (n, ...)."""
        return {name: points.data[name] for name in self.shapes if any(name in law.state for law in self.laws)}

    def effective_stress(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, d, d), Pa, at the points."""
        out = np.zeros_like(points.F)
        for law, rows in self._place(points):
            out[rows] = law.stress()
        return out

    def update_state(self, points: MaterialPoints) -> None:
        """Set the state of the points anew, given with the F of the end of the step.

        Raises
        ------
        NotConverged
            The new state is not finite; the state of the points is then what it was.
        """
        if all(law.update is None for law in self.laws):
            return
        new = [(law.law, rows, name, v) for law, rows in self._place(points) for name, v in law.new_state().items()]
        bad = [(law, name, rows[~_finite(values)]) for law, rows, name, values in new]
        shown = [f"{law.__name__}.update: {name!r} is not finite at {points.x[i[0]]}" for law, name, i in bad if len(i)]
        if message := first(self._grid.comm, "".join(shown[:1])):
            raise NotConverged(message, [])
        for _, rows, name, values in new:
            points.data[name][rows] = values

    def _place(self, points: MaterialPoints) -> list[tuple[LawAtPoints, NDArray[np.int64]]]:
        """Put every law at the points that follow it; return the laws with the indices of their points."""
        number, out = self.law_of(points), []
        values = {"F": points.F, **self.values(points)}
        for k, law in enumerate(self._at_points):
            out.append((law, np.flatnonzero(number == k)))
            law.place(points, out[-1][1], values)
        return out


def _known(name: str, value) -> NDArray[np.float64]:
    """Return what a law takes as an array; it may be infinite, but not nan."""
    out = numbers(name, value, None, allowed="numbers", test=np.isreal)
    if np.isnan(out).any():
        raise ValueError(f"{name} = nan, must be numbers")
    return out


def _finite(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which rows (n,) of values (n, ...) are finite."""
    return np.isfinite(values).all(axis=tuple(range(1, np.ndim(values))))


def _takes(law: type[Skeleton]) -> list[str]:
    """Return the names of the parameters and of the state that a law takes."""
    return [*law.parameters, *law.state]


def _reference(bodies: Sequence[Body], count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the reference positions (n, d) of all points of all processes and the index (n,) of their material."""
    for body in bodies:
        if not 0 <= body.material < count:
            raise ValueError(f"body: material = {body.material!r}, must be an index of the {count} materials")
    return (
        np.concatenate([b.centre for b in bodies]),
        np.concatenate([np.full(len(b), b.material) for b in bodies]),
    )


def _names(m: Skeleton) -> list[str]:
    """Return the names of a material's fields."""
    return [f.name for f in fields(m) if f.name != "conductivity_law"]


def _spread(m: Skeleton, values: dict[str, NDArray[np.float64]], n: int) -> Skeleton:
    """Return a copy of a material with values (n, ...) of some fields, its other numbers repeated n times."""
    out = copy(m)
    for name in _names(m):
        value = getattr(m, name)
        if name in values:
            value = values[name]
        elif not (callable(value) or isinstance(value, str) or value is None):
            value = np.broadcast_to(np.asarray(value, dtype=float), (n, *np.shape(value)))
        vars(out)[name] = value  # the values have been checked
    return out


class LawAtPoints:
    """A law evaluated at the material points that follow it.

    Parameters
    ----------
    grid
        Background grid.
    law
        Class of the law.
    shapes
        Shape of each of its parameters and of its variables of state.
    """

    def __init__(self, grid: Grid, law: type[Skeleton], shapes: dict[str, tuple[int, ...]]):
        self.grid, self.law, self._shapes = grid, law, shapes

    @cached_property
    def points(self) -> FormPoints:
        """The points, with F and what the law takes."""
        return FormPoints(self.grid, F=(self.grid.dim, self.grid.dim), **self._shapes)

    @cached_property
    def _values(self) -> dict:
        return {name: getattr(self.points, name) for name in self._shapes}

    def place(self, points: MaterialPoints, rows: NDArray[np.int64], values: dict[str, NDArray[np.float64]]) -> None:
        """Put the law at some of the material points, with values (n, ...) of F and of what it takes."""
        x = points.x[rows]
        cells = self.grid.local(self.grid.number(self.grid.index(x)))
        taken = {name: values[name][rows] for name in ("F", *self._shapes)}
        self.points.place(cells, x, points.volume0[rows], **taken)

    @cached_property
    def _stress(self) -> PointExpression:
        F = ufl.variable(self.points.F)
        return PointExpression(self.law.first_piola(F, self._values) * F.T / ufl.det(F), self.points)

    def stress(self) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, d, d), Pa, at the points where they have been placed."""
        return self._stress.evaluate()

    @cached_property
    def _update(self) -> PointExpression:
        """All components of the new state in one vector, whose parts have the shapes `self._parts`."""
        given = call(self.law.update, F=self.points.F, **self._values)
        instance(f"{self.law.__name__}.update: the new state", given, dict)
        new = {name: ufl.as_ufl(f) for name, f in given.items()}
        for name, f in new.items():
            if name not in self.law.state or f.ufl_shape != np.shape(self.law.state[name]):
                raise ValueError(f"{self.law.__name__}.update: {name!r} of shape {f.ufl_shape} is not in its state")
        self._parts = {name: f.ufl_shape for name, f in new.items()}
        parts = [f[i] if i else f for f in new.values() for i in np.ndindex(f.ufl_shape)]
        return PointExpression(ufl.as_vector(parts), self.points)

    def new_state(self) -> dict[str, NDArray[np.float64]]:
        """Return the state (n, ...) that follows from the F of the end of a step and the old state."""
        if self.law.update is None:
            return {}
        values, out, start = self._update.evaluate(), {}, 0
        for name, shape in self._parts.items():
            stop = start + int(np.prod(shape, dtype=int))
            out[name] = values[:, start:stop].reshape(-1, *shape)
            start = stop
        return out


class ConductivityAtPieces:
    """Conductivities that depend on deformation and place, evaluated at the pieces at the start of a step.

    Parameters
    ----------
    scene
        The scene's materials.
    pieces
        Points with the fields F, position, conductivity and porosity0, where a material has a conductivity law.
    """

    def __init__(self, scene: SceneMaterials, pieces: FormPoints):
        self._points, self._materials = pieces, scene.materials
        self._laws = {law: PointExpression(self._in_ufl(law), pieces) for law in scene.conductivity_laws}

    def _in_ufl(self, law: Callable):
        points, J = self._points, ufl.det(self._points.F)
        return expression(
            law,
            [()],
            conductivity=points.conductivity,
            F=points.F,
            J=J,
            porosity=1 - (1 - points.porosity0) / J,
            porosity0=points.porosity0,
            x=points.position,
        )

    def evaluate(self, material: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return the conductivities (m,), m/s, of pieces of the given materials (m,)."""
        out = self._points.data["conductivity"][:, 0].copy()
        for law, k in self._laws.items():
            rows = np.flatnonzero([m.conductivity_law is law for m in self._materials])
            chosen = np.isin(material, rows)
            out[chosen] = k.evaluate()[chosen]
            bad = np.flatnonzero(chosen & ~((out >= 0) & (out < np.inf)))[:1]
            shown = [f"k = {out[i]:g} at {self._points.x[i]}" for i in bad]
            if where := first(self._points.grid.comm, "".join(shown)):
                raise ValueError(f"conductivity law: {where}, must be >= 0 and finite")
        return out
