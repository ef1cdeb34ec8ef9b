# SPDX-License-Identifier: MIT
"""Mean dilatation: one volume change per cell, the cure for volumetric locking of nearly incompressible skeletons.

Four constraints of volume a cell leave a Q1 quadrilateral no freedom to bend: with nu = 0.499 it is up to half
too stiff.  Here the law sees the deformation gradient with the volume ratio of the step averaged over the cell,

    Fbar = (theta J_n / det F)^(1/d) F,     theta = sum w det(Delta) / sum w   over the cell's pieces that lock,

d = 2 in plane strain, 3 in axisymmetry.  Which do is a matter of their material (`Skeleton.nearly_incompressible`).  In
a cell that these share with others the others see their own F: one constraint a cell is left, and neither kind of
material knows of the other but by the displacements that they share.  The energy sum w psi(Fbar) / J_n has the
derivative

    sum w [dPsi/dF : dF + pi d(det Delta)],   pi = (sum w dPsi/dtheta) / (sum w),

so for given (theta, pi) the residual is that of one more term in the energy, and the tangent is symmetric:
what theta and pi contribute has rank two in each cell (Simo, Taylor and Pister 1985; F-bar of the material point
method by increments: Coombs et al. 2018).  A law that gives its stress has P(Fbar) : dFbar in place of dPsi.  The
points keep Fbar; the J_n with which the next step begins is that of the cell's domains (`cell_ratios`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.caching import Latest
from mpm_dolfinx.constitutive.axes import block
from mpm_dolfinx.constitutive.skeleton import Skeleton
from mpm_dolfinx.constitutive.user_functions import expression
from mpm_dolfinx.forms.cell_matrices import along_shapes, insert
from mpm_dolfinx.forms.point_forms import CellSums, FormPoints, PointData
from mpm_dolfinx.points.grid import Grid, sum_by
from mpm_dolfinx.problems.quadrature_data import QuadratureData


class MeanDilatation:
    """The cells' volume ratio theta of the step and the mean stress pi that goes with it.

    Parameters
    ----------
    grid
        Background grid.
    numbers
        Which parts of the pieces lock, see `QuadratureData`, in the order in which they are added.
    symmetric
        Whether the tangents of all laws are symmetric.
    """

    def __init__(self, grid: Grid, numbers: Sequence[int], symmetric: bool = True):
        self._grid, self._d, self._symmetric, self._numbers = grid, grid.stretches, symmetric, numbers
        self.theta, self.pi = fem.Function(grid.cellwise()), fem.Function(grid.cellwise())
        self._theta = ufl.variable(self.theta)
        self._filled: Latest[Cells] = Latest()
        self._volume: Latest[NDArray[np.float64]] = Latest()
        self._ratios: list[CellSums] = []
        self._ratio_slopes: list[CellSums] = []
        self._slopes: list[CellSums] = []
        self._derivatives: list[CellSums] = []

    def _along_shapes(self, T, points: FormPoints) -> list:
        """Return T : dF for the displacement of each node, whose dF is grad(v) F_n."""
        return along_shapes(T * points.F.T, points)

    def seen(self, points: FormPoints, F):
        """Return Fbar (d, d), what laws see of F, as UFL."""
        Fbar = (self._theta * ufl.det(points.F) / ufl.det(F)) ** (1 / self._d) * F
        return ufl.variable(block(Fbar)) if self._grid.axisymmetric else Fbar

    def add(
        self,
        law: type[Skeleton],
        points: FormPoints,
        F,
        Fbar,
        values: Mapping[str, object],
        known: Mapping[str, object],
    ) -> tuple:
        """Add the pieces of a part that locks.

        Parameters
        ----------
        law
            Class of its law.
        points
            Its pieces, with the field F (d, d), the deformation gradient at the start of the step.
        F
            Deformation gradient (d, d), a UFL variable.
        Fbar
            What the law sees of it, see `seen`.
        values
            UFL values of the law's parameters, state and local unknowns.
        known
            The same for what is not differentiated, see `LocalUnknowns`.

        Returns
        -------
        The first Piola-Kirchhoff stress that the residual takes, and that whose derivative the tangent takes, Pa, as
        UFL of F, theta and pi.
        """
        J_n, theta = ufl.det(points.F), self._theta
        ratio = ufl.det(F) / J_n
        self._ratios.append(CellSums([ratio], points))
        self._ratio_slopes.append(CellSums(self._along_shapes(ufl.diff(ratio, F), points), points))
        P, slope = self._stress(law, F, Fbar, known)
        self._slopes.append(CellSums([slope / J_n], points))
        of_tangent, slope = self._stress(law, F, Fbar, values)
        derivatives = [*self._along_shapes(ufl.diff(slope / J_n, F), points), ufl.diff(slope / J_n, theta)]
        if not self._symmetric:
            derivatives += self._along_shapes(ufl.diff(of_tangent / J_n, theta), points)
        self._derivatives.append(CellSums(derivatives, points))
        shared = self.pi * ufl.diff(ufl.det(F), F)
        return P + shared, of_tangent + shared

    def _stress(self, law: type[Skeleton], F, Fbar, values: Mapping[str, object]):
        """Return the derivatives by F and by theta of psi(Fbar); of a law without energy, of its work."""
        if law.kirchhoff is None:
            energy = expression(law.energy, [()], F=Fbar, **values)
            return ufl.diff(energy, F), ufl.diff(energy, self._theta)
        tau = law.kirchhoff_in_plane(Fbar, values)  # dFbar Fbar^-1 = dev(dF F^-1) + dtheta / (d theta) I
        mean = ufl.tr(tau) / self._d
        return (tau - mean * ufl.Identity(self._d)) * ufl.inv(F).T, mean / self._theta

    def set_ratios(self, data: QuadratureData) -> None:
        """Set theta at the present displacement."""
        self.theta.x.array[self._cells(data).filled] = self._mean(self._ratios, data)

    def set_stresses(self, data: QuadratureData) -> None:
        """Set pi at the present displacement and theta."""
        self.pi.x.array[self._cells(data).filled] = self._mean(self._slopes, data)

    def _mean(self, sums: Sequence[CellSums], data: QuadratureData) -> NDArray[np.float64]:
        """Return the means (cells,) of a quantity over the pieces that lock."""
        return self._total(sums, data)[:, 0] / self._volume_of(data)[:, 0]

    def assemble_matrix(self, A: PETSc.Mat, data: QuadratureData) -> None:
        """Add what theta and pi contribute to the tangent at the last update; the caller finalises it."""
        count, volume = 2**self._grid.dim * self._grid.dim, self._volume_of(data)
        derivatives = self._total(self._derivatives, data)
        b, c = self._total(self._ratio_slopes, data) / volume, derivatives[:, :count] / volume
        e = derivatives[:, count, None] / volume
        d = c if self._symmetric else derivatives[:, count + 1 :] / volume
        # (d b^T + b c^T + e b b^T) V with the means b, c, d, e of the derivatives of det(Delta), dPsi/dtheta, P
        e *= 0.5
        columns, rows = (c + e * b) * volume, (d + e * b) * volume
        matrices = b[:, :, None] * columns[:, None, :] + rows[:, :, None] * b[:, None, :]
        insert(A, self._grid, self._cells(data).filled, matrices)

    def averaged(self, delta: NDArray[np.float64], data: QuadratureData) -> NDArray[np.float64]:
        """Return the gradients Delta (m, d, d) of the pieces, those that lock with the volume ratio of their cell."""
        delta = delta.copy()
        for number in self._numbers:
            rows = data.rows[number]
            theta, own = self.theta.x.array[data.parts[number].cells], delta[rows]
            delta[rows] = own * ((theta / np.linalg.det(own)) ** (1 / self._d))[:, None, None]
        return delta

    def _parts(self, data: QuadratureData) -> list[PointData]:
        return [data.parts[number] for number in self._numbers]

    def _cells(self, data: QuadratureData) -> Cells:
        """Return the cells that hold pieces that lock."""
        places = [part.places for part in self._parts(data)]
        return self._filled(tuple(p.key for p in places), lambda: Cells([p.filled for p in places]))

    def _volume_of(self, data: QuadratureData) -> NDArray[np.float64]:
        """Return the volumes (cells, 1) of the pieces that lock."""
        key = tuple(part.key for part in self._parts(data))

        def volumes() -> NDArray[np.float64]:
            sums = [sum_by(p.places.slots, p.volume, len(p.places.filled))[:, None] for p in self._parts(data)]
            return self._cells(data).total(sums)

        return self._volume(key, volumes)

    def _total(self, sums: Sequence[CellSums], data: QuadratureData) -> NDArray[np.float64]:
        """Return the sums (cells, quantities) over all pieces that lock."""
        values = [of_part(part) for of_part, part in zip(sums, self._parts(data), strict=True)]
        return self._cells(data).total(values)


class Cells:
    """The cells of several parts; filled: all, where: the place of each part's among these."""

    def __init__(self, of_parts: Sequence[NDArray[np.int32]]):
        self.filled = np.unique(np.concatenate(of_parts))
        self.where = [np.searchsorted(self.filled, cells) for cells in of_parts]

    def total(self, values: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the sums over all parts of what the cells of each hold."""
        if len(values) == 1:
            return values[0]
        out = np.zeros((len(self.filled), values[0].shape[1]))
        for where, of_part in zip(self.where, values, strict=True):
            out[where] += of_part
        return out
