# SPDX-License-Identifier: MIT
"""User-defined terms in the balance of momentum, integrated over bodies and sides: see `user_functions`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.faces import Surface
from mpm_dolfinx.conditions.acting import Acting, FormsOf, Loads, Place, Setting
from mpm_dolfinx.conditions.conditions import OnSide
from mpm_dolfinx.forms.point_forms import FormPoints, PointData, PointForm
from mpm_dolfinx.materials.user_functions import compiling, term_of


class OwnTerm(NamedTuple):
    """A user-defined term."""

    given: Callable | OnSide  # definition of the term by the user
    points: FormPoints  # integration points
    form: PointForm
    slope: PointForm | None  # derivative with respect to u, None if zero
    seeded: bool  # whether the term depends on the displacement of a side


class OwnTerms:
    """User-defined terms of a scene, for all of its stages.

    `terms`: functions for bodies, or `OnSide` with functions for sides.
    `pieces`: all integration points.
    `forms`: forms of the scene's conditions, with u and the velocity of the bodies.
    `t`, `dt`, in s: time at the end of the substep, and time since the start of the step, as UFL constants.
    """

    def __init__(
        self, terms: Sequence[Callable | OnSide], pieces: FormPoints, forms: FormsOf, t: fem.Constant, dt: fem.Constant
    ):
        self.symmetric = True
        self.holding = False
        self.rates = False
        """Whether any term depends on velocity."""
        u = forms.u
        more = {"t": t, "dt": dt, "velocity": forms.velocity.value}
        v, du = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)
        self.terms: list[OwnTerm] = []
        for term in terms:
            on_side, d = isinstance(term, OnSide), pieces.grid.dim
            points = FormPoints(pieces.grid, normal=(d,), position=(d,), displacement=(d,)) if on_side else pieces
            form, potential = term_of(term.term if on_side else term, u, v, points=points, u=u, v=v, **more)
            holds = u in form.coefficients()
            with compiling(f"terms: {line(term)}", "linear in v, or an energy of u"):
                slope = PointForm(ufl.derivative(form, u, du), points) if holds else None
                seeded = on_side and points.displacement in form.coefficients()
                self.terms.append(OwnTerm(term, points, PointForm(form, points), slope, seeded))
            self.symmetric &= potential or not holds
            self.holding |= holds
            self.rates |= forms.velocity.among(form)

    def acting(self, setting: Setting) -> Acting:
        """Return the terms in a stage."""
        return OwnTermsOfStage(self.terms, setting)


class OwnTermsOfStage(Acting):
    """User-defined terms in a stage, with the faces of terms on sides."""

    title = "user-defined terms"

    def __init__(self, terms: Sequence[OwnTerm], setting: Setting):
        self._grid, self.linear = setting.grid, all(term.slope is None for term in terms)
        self._terms = [(one, setting.sides.of(one.given) if isinstance(one.given, OnSide) else None) for one in terms]
        self.surfaces = [faces for _, faces in self._terms if faces is not None]
        self.seeded = [faces for term, faces in self._terms if term.seeded]

    def placed(self, place: Place) -> Loads:
        """Return the terms at the integration points of bodies and sides."""
        return OwnLoads([(term, self._data(term.points, faces, place)) for term, faces in self._terms])

    def _data(self, of: FormPoints, faces: Surface | None, place: Place) -> PointData:
        if faces is None:
            return place.pieces.of_points
        p = place.cut.surface(faces)
        area, now = p.area(place.points), p.now(place.points)
        size = np.linalg.norm(area, axis=1, keepdims=True)
        fields = {"normal": area / size, "position": now, "displacement": now - p.origin(place.points)}
        cell, x, fields = self._grid.gathered([(p.cell, p.x, fields | {"size": size[:, 0]})])
        return of.at(cell, x, fields.pop("size"), **fields)


class OwnLoads(Loads):
    """Nodal forces of user-defined terms in a substep, integrated over bodies and sides."""

    def __init__(self, terms: Sequence[tuple[OwnTerm, PointData]]):
        self._terms = terms
        self.holding = any(term.slope is not None for term, _ in terms)
        self.linear = not self.holding

    def resists(self, b: NDArray[np.float64]) -> None:
        """Add the nodal forces of the terms at u."""
        for term, data in self._terms:
            term.form.assemble_vector(b, data)

    def tangent(self, K: PETSc.Mat) -> None:
        """Add the derivatives of the nodal forces with respect to u."""
        for term, data in self._terms:
            if term.slope is not None:
                term.slope.assemble_matrix(K, data)
