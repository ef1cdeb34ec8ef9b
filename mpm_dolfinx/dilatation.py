# SPDX-License-Identifier: MIT
"""Mean dilatation: one volume change per cell, the cure for volumetric locking of nearly incompressible skeletons.

Four constraints of volume a cell leave a P1 quadrilateral no freedom to bend: with nu = 0.499 it is up to half
too stiff.  Here the law sees the deformation gradient with the volume ratio of the step averaged over the cell,

    Fbar = (theta J_n / det F)^(1/d) F,     theta = sum w det(Delta) / sum w   over the cell's pieces,

d = 2 in plane strain.  The energy sum w psi(Fbar) / J_n has the derivative

    sum w [dPsi/dF : dF + pi d(det Delta)],   pi = (sum w dPsi/dtheta) / (sum w),

so for given (theta, pi) the residual is that of one more term in the energy, and the tangent is symmetric:
what theta and pi contribute has rank two in each cell (Simo, Taylor and Pister 1985; F-bar of the material point
method by increments: Coombs et al. 2018).  The points keep Fbar, so regrouping them into other cells changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx import _compat
from mpm_dolfinx.forms import CellSums, FormPoints, insert, shape_gradients


class MeanDilatation:
    """The cells' volume ratio theta of the step and the mean stress pi that goes with it.

    Parameters
    ----------
    pieces
        Points of integration with the field F (d, d), the deformation gradient at the start of the step.
    F
        Deformation gradient as a UFL variable.
    density
        UFL function of (Fbar), the stored energy density psi, Pa.
    """

    def __init__(self, pieces: FormPoints, F, density: Callable):
        self.pieces, self._d = pieces, pieces.grid.dim
        cellwise = _compat.function_space(pieces.grid.mesh, "DG", 0)
        self.theta, self.pi = fem.Function(cellwise), fem.Function(cellwise)
        J_n, theta = ufl.det(pieces.F), ufl.variable(self.theta)
        self.energy = density((theta * J_n / ufl.det(F)) ** (1 / self._d) * F)
        """psi(Fbar) as UFL of F and theta."""
        ratio, slope = ufl.det(F) / J_n, ufl.diff(self.energy / J_n, theta)
        self._weight = CellSums([ufl.as_ufl(1.0)], pieces)
        self._ratio, self._slope = CellSums([ratio], pieces), CellSums([slope], pieces)
        gradients = shape_gradients(pieces)

        def along_shapes(quantity) -> list:
            """Return the derivatives by the displacement of each node, whose dF is grad(v) F_n."""
            T = ufl.diff(quantity, F) * pieces.F.T
            return [ufl.dot(T, g)[i] for g in gradients for i in range(self._d)]

        self._derivatives = CellSums([*along_shapes(ratio), *along_shapes(slope), ufl.diff(slope, theta)], pieces)

    def start(self) -> None:
        """Begin a step: the volumes of the cells' contents."""
        self._volume = self._weight()[:, 0]

    def update(self) -> None:
        """Set theta and pi at the present displacement."""
        cells = self.pieces.filled
        self.theta.x.array[cells] = self._ratio()[:, 0] / self._volume
        self.pi.x.array[cells] = self._slope()[:, 0] / self._volume

    def assemble_matrix(self, A: PETSc.Mat) -> None:
        """Add what theta and pi contribute to the tangent at the last update; the caller finalises it."""
        b, c, e = np.split(
            self._derivatives() / self._volume[:, None], [half := 2**self._d * self._d, 2 * half], axis=1
        )
        # (b c^T + c b^T + e b b^T) V with the means b, c, e of the derivatives of det(Delta) and dPsi/dtheta
        half_tangent = b[:, :, None] * ((c + 0.5 * e * b) * self._volume[:, None])[:, None, :]
        insert(A, self.pieces, half_tangent + half_tangent.transpose(0, 2, 1))

    def averaged(self, delta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients Delta (m, d, d) of the pieces with the volume ratio of their cell."""
        theta = self.theta.x.array[self.pieces.cells]
        return delta * ((theta / np.linalg.det(delta)) ** (1 / self._d))[:, None, None]
