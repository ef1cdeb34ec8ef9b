# SPDX-License-Identifier: MIT
"""Tied sides: two opposite sides of a body have equal displacements (periodic boundary condition).

The penalty energy is `k/2 int (u_one - u_other)^2 dA`.  Here u_one and u_other are the displacements at opposite
positions of the two sides, and k is the penalty stiffness.  Displacements are measured from the initial positions of
the bodies, so errors do not accumulate.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from itertools import combinations, product

from petsc4py import PETSc

import numpy as np
import scipy.sparse
from dolfinx import fem
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.base.tolerances import NEAR
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.bodies.faces import Surface, interpolate
from mpm_dolfinx.conditions.acting import Acting, At, Loads, Place, Setting
from mpm_dolfinx.conditions.conditions import HOLD, Drained, Inflow, Quiet, Rain, Tied, holding
from mpm_dolfinx.contact.pairs import at_nodes, on_owners, shape_values_in
from mpm_dolfinx.forms.unknowns import Unknowns, petsc_matrix
from mpm_dolfinx.grid.grid import Grid


class Tie:
    """Two opposite tied sides, and their pairs of opposite faces.

    `partner` (n,): index of the face on the other side, for each face on the first side.
    `offset` (n, d), in m: vector from each face on the first side to its opposite face.
    `axis`: axis normal to the sides.
    """

    def __init__(self, tied: Tied, one: Surface, other: Surface):
        self.one, self.other = one, other
        self.axis = int(one.face[0]) // 2
        at, opposite = one.places().mean(axis=1), other.places().mean(axis=1)
        along = np.arange(at.shape[1]) != self.axis
        off, self.partner = cKDTree(opposite[:, along]).query(at[:, along])
        alike = (one.face == one.face[0]).all() and (other.face == one.face[0] ^ 1).all()
        small = NEAR * one.whole0.min() ** (1 / max(1, at.shape[1] - 1))
        if not alike or len(one) != len(other) or len(np.unique(self.partner)) < len(one) or (off > small).any():
            raise ValueError(f"{line(tied)}: its sides must be opposite sides of a body from mpm.box, with equal faces")
        self.offset = opposite[self.partner] - at


class Ties(Acting):
    """The tied sides of a stage.

    Parameters
    ----------
    setting, ties
        Data of the stage (`setting`), and the tied sides by name (`ties`).

    Raises
    ------
    ValueError
        The sides are not opposite, or their faces differ.  A side is tied twice, or is quiet, or has a flow condition.
    """

    conditions, title = (Tied,), "tied sides"

    def __init__(self, setting: Setting, ties: Mapping[str, Tied]):
        self._grid, self._materials = setting.grid, setting.materials
        of = setting.sides.of
        self._ties = [Tie(tied, of(tied), of(Tied(tied.other, tied.side))) for tied in ties.values()]
        self.surfaces = [tie.one for tie in self._ties]
        self.seeded = [faces for tie in self._ties for faces in (tie.one, tie.other)]
        sides = [(tied, (tie.one, tie.other)) for tied, tie in zip(ties.values(), self._ties, strict=True)]
        excluded = [(one, (of(one),)) for one in setting.of(Quiet, Drained, Inflow, Rain).values()]
        for (one, faces), (other, others) in [*combinations(sides, 2), *product(sides, excluded)]:
            for a, b in product(faces, others):
                a.check_apart(b, (one, other))

    def placed(self, place: Place) -> Loads:
        """Return the penalty forces in a substep."""
        grid, points = self._grid, place.points
        d, rows = grid.dim, []
        modulus = self._materials.table(points, holding)
        for tie in self._ties:
            p = place.cut.surface(tie.one)
            present, at = points.find(tie.other.id)
            moved = np.zeros((len(tie.other), 2**d, d))
            moved[present] = points.corners[at] - points.origin[at]
            moved = grid.comm.allreduce(moved)
            across = p.xi * np.where(np.arange(d) == tie.axis, -1.0, 1.0)
            gap = p.now(points) - p.origin(points) - interpolate(moved[tie.partner[p.face]], across)
            y = p.x + tie.offset[p.face]
            inside = y - NEAR * np.sign(tie.offset[p.face, [tie.axis]])[:, None] * grid.least * np.eye(d)[tie.axis]
            other = grid.number(grid.index_from_base(inside)) + p.cell // grid.cells * grid.cells
            area = np.linalg.norm(p.area(points), axis=1)
            stiffness = HOLD * modulus[p.at] * area / grid.sizes_at(p.x).min(axis=-1)
            rows.append((p.cell, p.x, {"other": other, "y": y, "stiffness": stiffness, "gap": gap}))
        cell, x, fields = grid.gathered(rows)
        return TieLoads(grid, cell, x, **fields | {"other": fields["other"].astype(np.int64)})


class TieLoads(Loads):
    """Penalty forces of tied sides in a substep.

    Parameters
    ----------
    cell : (m,)
        Local cells that contain positions on one side.
    x : (m, d), m
        Positions on this side.
    other : (m,)
        Lexicographic indices of the cells that contain the opposite positions; other processes may own these cells.
    y : (m, d), m
        Opposite positions on the other side.
    stiffness : (m,), N/m
        Penalty stiffness k, multiplied by the area of the surface at each position.
    gap : (m, d), m
        Differences of displacements between both sides at the start of the step.
    """

    couples = True

    def __init__(self, grid: Grid, cell, x, other, y, stiffness: NDArray[np.float64], gap: NDArray[np.float64]):
        self._grid = grid
        values = np.concatenate([grid.shape_values(cell, x), -shape_values_in(grid, other, y)], axis=1)
        self._stiffness, self._gap = np.repeat(stiffness, grid.dim), gap.ravel()
        self._difference = lambda unknowns: at_nodes(grid, unknowns, cell, values, other)
        self._cells, self._rest = (cell, other), 0.0
        self._operator: Latest[PETSc.Mat] = Latest()

    def _B(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return the matrix that maps the unknowns to differences of displacements between both sides."""
        return self._operator((unknowns,), lambda: self._difference(unknowns), self._grid.comm)

    def push(self, at: At, residual: PETSc.Vec, on: Unknowns) -> None:
        """Add the penalty forces at u to the residual."""
        B = self._B(at.unknowns)
        w = B.createVecLeft()
        B.mult(at.unknowns.gather_owned((at.u + self._rest)[at.unknowns.owned]), w)
        w.array_w[:] = self._stiffness * (w.array_r + self._gap)
        B = B if on is at.unknowns else self._difference(on)
        B.multTransposeAdd(w, residual, residual)

    def moved(self, u: fem.Function) -> Loads:
        """Return the ties after an additional displacement u of the nodes."""
        out = copy(self)
        out._rest = u.x.array.copy()
        return out

    @property
    def held_cells(self) -> NDArray[np.int32]:
        """Cells that contain positions on the tied sides."""
        cell, other = self._cells
        return np.append(cell, on_owners(self._grid, other))

    def pattern(self, unknowns: Unknowns) -> PETSc.Mat:
        """Return a zero matrix with the sparsity pattern of `coupling`."""
        out = self.coupling(At(unknowns, np.empty(0)))  # the coupling does not depend on the displacement
        out.zeroEntries()
        return out

    def coupling(self, at: At) -> PETSc.Mat:
        """Return the derivative of the penalty forces with respect to the nodal displacements."""
        B = self._B(at.unknowns)
        k = scipy.sparse.diags(self._stiffness, format="csr")
        return petsc_matrix(k, B.getLocalSize()[0], self._grid.comm, own=True).PtAP(B)
