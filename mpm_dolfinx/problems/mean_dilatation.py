# SPDX-License-Identifier: MIT
"""Mean dilatation: one volume change per cell, the cure for volumetric locking of nearly incompressible skeletons.

Four constraints of volume a cell leave a Q1 quadrilateral no freedom to bend: with nu = 0.499 it is up to half
too stiff.  Here the law sees the deformation gradient with the volume ratio of the step averaged over the cell,

    Fbar = (theta J_n / det F)^(1/d) F,     theta = sum w det(Delta) / sum w   over the cell's pieces,

d = 2 in plane strain.  The energy sum w psi(Fbar) / J_n has the derivative

    sum w [dPsi/dF : dF + pi d(det Delta)],   pi = (sum w dPsi/dtheta) / (sum w),

so for given (theta, pi) the residual is that of one more term in the energy, and the tangent is symmetric:
what theta and pi contribute has rank two in each cell (Simo, Taylor and Pister 1985; F-bar of the material point
method by increments: Coombs et al. 2018).  A law that gives its stress has P(Fbar) : dFbar in place of dPsi.  The
points keep Fbar, so regrouping them into other cells changes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.caching import Latest
from mpm_dolfinx.constitutive.skeleton import Skeleton
from mpm_dolfinx.constitutive.user_functions import expression
from mpm_dolfinx.forms.cell_matrices import insert, shape_gradients
from mpm_dolfinx.forms.point_forms import CellSums, FormPoints, PointData


class MeanDilatation:
    """The cells' volume ratio theta of the step and the mean stress pi that goes with it.

    Parameters
    ----------
    pieces
        All points of integration, with the field F (d, d), the deformation gradient at the start of the step.
    u
        Increment of the displacement in the step.
    symmetric
        Whether the tangents of all laws are symmetric.
    """

    def __init__(self, pieces: FormPoints, u: fem.Function, symmetric: bool = True):
        self._grid, self._d, self._symmetric = pieces.grid, pieces.grid.dim, symmetric
        cellwise = pieces.grid.cellwise()
        self.theta, self.pi = fem.Function(cellwise), fem.Function(cellwise)
        F = pieces.deformation(u)
        ratio = ufl.det(F) / ufl.det(pieces.F)
        self._weight, self._ratio = CellSums([ufl.as_ufl(1.0)], pieces), CellSums([ratio], pieces)
        self._ratio_slope = CellSums(self._along_shapes(ufl.diff(ratio, F), pieces), pieces)
        self._volume: Latest[NDArray[np.float64]] = Latest()
        self._slopes: list[CellSums] = []
        self._derivatives: list[CellSums] = []

    def _along_shapes(self, T, points: FormPoints) -> list:
        """Return T : dF for the displacement of each node, whose dF is grad(v) F_n."""
        T = T * points.F.T
        return [ufl.dot(T, g)[i] for g in shape_gradients(points) for i in range(self._d)]

    def add(self, law: type[Skeleton], points: FormPoints, F, values: Mapping[str, object]):
        """Add the pieces that follow a law.

        Parameters
        ----------
        law
            Class of the law.
        points
            Its pieces; theirs are the cells of `pieces`.
        F
            Deformation gradient (d, d), a UFL variable.
        values
            UFL values of the law's parameters and state.

        Returns
        -------
        The first Piola-Kirchhoff stress that the residual takes, Pa, as UFL of F, theta and pi.
        """
        J_n, theta = ufl.det(points.F), ufl.variable(self.theta)
        P, slope = self._stress(law, F, theta, J_n, values)
        self._slopes.append(CellSums([slope / J_n], points))
        derivatives = [*self._along_shapes(ufl.diff(slope / J_n, F), points), ufl.diff(slope / J_n, theta)]
        if not self._symmetric:
            derivatives += self._along_shapes(ufl.diff(P / J_n, theta), points)
        self._derivatives.append(CellSums(derivatives, points))
        return P + self.pi * ufl.diff(ufl.det(F), F)

    def _stress(self, law: type[Skeleton], F, theta, J_n, values: Mapping[str, object]):
        """Return the derivatives by F and by theta of psi(Fbar); of a law without energy, of its work."""
        Fbar = (theta * J_n / ufl.det(F)) ** (1 / self._d) * F
        if law.kirchhoff is None:
            energy = expression(law.energy, [()], F=Fbar, **values)
            return ufl.diff(energy, F), ufl.diff(energy, theta)
        tau = law.kirchhoff_in_plane(Fbar, values)  # dFbar Fbar^-1 = dev(dF F^-1) + dtheta / (d theta) I
        mean = ufl.tr(tau) / self._d
        return (tau - mean * ufl.Identity(self._d)) * ufl.inv(F).T, mean / theta

    def update(self, data: PointData, parts: Sequence[PointData]) -> None:
        """Set theta and pi at the present displacement; parts: the pieces of each law."""
        cells, volume = data.places.filled, self._volume_of(data)[:, 0]
        self.theta.x.array[cells] = self._ratio(data)[:, 0] / volume
        self.pi.x.array[cells] = _total(self._slopes, data, parts)[:, 0] / volume

    def assemble_matrix(self, A: PETSc.Mat, data: PointData, parts: Sequence[PointData]) -> None:
        """Add what theta and pi contribute to the tangent at the last update; the caller finalises it."""
        count, volume = 2**self._d * self._d, self._volume_of(data)
        derivatives = _total(self._derivatives, data, parts)
        b, c = self._ratio_slope(data) / volume, derivatives[:, :count] / volume
        e = derivatives[:, count, None] / volume
        d = c if self._symmetric else derivatives[:, count + 1 :] / volume
        # (d b^T + b c^T + e b b^T) V with the means b, c, d, e of the derivatives of det(Delta), dPsi/dtheta, P
        e *= 0.5
        columns, rows = (c + e * b) * volume, (d + e * b) * volume
        matrices = b[:, :, None] * columns[:, None, :] + rows[:, :, None] * b[:, None, :]
        insert(A, self._grid, data.places.filled, matrices)

    def _volume_of(self, data: PointData) -> NDArray[np.float64]:
        """Return the volumes (cells, 1) of what the filled cells hold."""
        return self._volume(data.key, lambda: self._weight(data))

    def averaged(self, delta: NDArray[np.float64], cells: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return the gradients Delta (m, d, d) of pieces in cells (m,) with the volume ratio of their cell."""
        theta = self.theta.x.array[cells]
        return delta * ((theta / np.linalg.det(delta)) ** (1 / self._d))[:, None, None]


def _total(sums: Sequence[CellSums], data: PointData, parts: Sequence[PointData]) -> NDArray[np.float64]:
    """Return the sums over all laws (cells, quantities) in the cells of `data`."""
    total = 0.0
    for of_law, part in zip(sums, parts, strict=True):
        values = of_law(part)
        if part is not data:
            everywhere = np.zeros((len(data.places.filled), values.shape[1]))
            everywhere[np.searchsorted(data.places.filled, part.places.filled)] = values
            values = everywhere
        total = total + values
    return total
