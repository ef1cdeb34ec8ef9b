# SPDX-License-Identifier: MIT
"""F-bar: one volume ratio for each cell, against volumetric locking of nearly incompressible skeletons.

The law is evaluated at a scaled deformation gradient Fbar.  The volume ratio theta of Fbar in the step is a mean over
the cell:

    Fbar = (theta J_n / det F)^(1/3) F,     theta = sum w det(Delta) / sum w   over the cell's pieces with F-bar.

Here w is the volume of a piece, Delta = I + grad u is the deformation gradient of the step, F = Delta F_n, and
J_n = det F_n.  The scaling acts along all three axes, so in plane strain there is an out-of-plane stretch.  Only nearly
incompressible materials use Fbar (`Skeleton.nearly_incompressible`).  With the energy psi of the law and
Psi = psi(Fbar) / J_n, the energy sum w Psi has the derivative

    sum w [dPsi/dF : dF + pi d(det Delta)],   pi = (sum w dPsi/dtheta) / (sum w).

At fixed theta and pi, the tangent is symmetric.  The derivatives with respect to theta and pi add a matrix of rank two
in each cell (Simo, Taylor and Pister 1985; incremental F-bar in material points: Coombs et al. 2018).  For a law
without an energy, P(Fbar) : dFbar replaces dPsi.  Points store Fbar at the end of the step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.forms.axes import block, embedded
from mpm_dolfinx.forms.cell_matrices import Beside, insert
from mpm_dolfinx.forms.point_forms import CellSums, FormPoints, Given, PointData, PointExpression
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.skeleton import Skeleton
from mpm_dolfinx.materials.user_functions import expression
from mpm_dolfinx.mechanics.quadrature_data import QuadratureData
from mpm_dolfinx.points.material_points import ACROSS, with_ratio

STRESS = "stress of the law"


class SumsOfPart(NamedTuple):
    """Kernels that sum over the integration points of one law in each cell.  Theta and pi follow from the sums."""

    ratio: CellSums
    stress: PointExpression  # components of P for the residual, then the derivative of psi by theta for pi


class FBar:
    """F-bar modification of laws, with theta and pi of each cell as fields.

    `symmetric`: whether the tangents of all laws are symmetric.
    """

    def __init__(self, grid: Grid, symmetric: bool):
        self.grid = grid
        self.symmetric = symmetric
        self.theta, self.pi = fem.Function(grid.cellwise()), fem.Function(grid.cellwise())
        self._theta = ufl.variable(self.theta)

    def of(self, points: FormPoints, F):
        """Return Fbar (3, 3) as a UFL variable, or (2, 2) for laws that accept only F (2, 2)."""
        ratio = self._theta * ufl.det(points.F) / ufl.det(F)
        if self.grid.stretches == 2 and ACROSS not in points.functions:
            return ufl.variable(ufl.sqrt(ratio) * F)
        ratio = ratio ** (1 / 3)
        if self.grid.stretches == 2:  # F and the out-of-plane stretch are scaled together, see `in_space`
            across = getattr(points, ACROSS)
            return ufl.variable(embedded(ratio / ufl.sqrt(across) * F, ratio * across))
        return ufl.variable(block(ratio * F) if self.grid.axisymmetric else ratio * F)

    def forms(
        self,
        law: type[Skeleton],
        points: FormPoints,
        F,
        Fbar,
        ratio,
        values: Mapping[str, object],
        known: Mapping[str, object],
    ) -> tuple:
        """Return the stress of a law that uses F-bar, and the kernels of its integrals over each cell.

        `points`: integration points of the law, with the field F at the start of the step.
        `F`: deformation gradient (d, d), a UFL variable.
        `Fbar`: result of `of`.
        `ratio`: det Delta, with Delta F_n = F.
        `values`: UFL values of the law's parameters, state and local unknowns.
        `known`: like `values`, but the local unknowns do not depend on F.

        Returns
        -------
        The first Piola-Kirchhoff stress, in Pa, as UFL of F, theta and pi, for the residual.
        The derivative (d, d, d, d) of this stress with respect to F, in Pa, for the tangent.
        Integrals over each cell for the tangent, see `MeanDilatation.assemble_matrix`.
        Kernels for the sums over each cell that give theta and pi.
        """
        J_n, J = ufl.det(points.F), ufl.det(F)
        P, slope = self.stresses(law, F, Fbar, known)
        stress = PointExpression(ufl.as_vector([*(P[i] for i in np.ndindex(P.ufl_shape)), slope / J_n]), points)
        sums, own = SumsOfPart(CellSums([ratio], points), stress), points.follow(STRESS, P.ufl_shape)
        P_F, P_theta, slope_F, slope_theta = self._slopes(law, F, Fbar, values)
        shared, share = self.pi * ufl.diff(J, F), 1 / J_n
        along = [share * T for T in (ufl.diff(J, F), slope_F, *([] if self.symmetric else [P_theta]))]
        beside = Beside(along, [share * slope_theta])
        return (block(own) if self.grid.axisymmetric else own) + shared, P_F + ufl.diff(shared, F), beside, sums

    def stresses(self, law: type[Skeleton], F, Fbar, values: Mapping[str, object]) -> tuple:
        """Return the derivatives of psi(Fbar) with respect to F and theta."""
        if law.kirchhoff is None:
            energy = expression(law.energy, [()], F=Fbar, **values)
            return ufl.diff(energy, F), ufl.diff(energy, self._theta)
        tau = law.kirchhoff_in_plane(Fbar, values)  # dFbar Fbar^-1 = dev(dF F^-1) + dtheta / (n theta) I, n = 3 or 2
        mean = ufl.tr(tau) / Fbar.ufl_shape[0]
        return _dev(tau, F) * ufl.inv(F).T, mean / self._theta

    def _slopes(self, law: type[Skeleton], F, Fbar, values: Mapping[str, object]) -> tuple:
        """Return the derivatives of both results of `stresses` with respect to F and theta.

        In 2D a law without an energy is differentiated with respect to Fbar only.  With Fbar = s F,

            dtau = s C : dF + (theta dtau/dtheta) (dtheta / theta - F^-T : dF),   C = dtau/dFbar,

        where F and s F have only their (d, d) components in the plane.
        """
        P, slope = self.stresses(law, F, Fbar, values)
        if law.kirchhoff is None or self.grid.dim == 3:
            return tuple(ufl.diff(of, by) for of in (P, slope) for by in (F, self._theta))
        d, n = range(F.ufl_shape[0]), Fbar.ufl_shape[0]
        theta = self._theta
        G = ufl.inv(F).T
        i, j, k, l, m = ufl.indices(5)
        tau = law.kirchhoff_in_plane(Fbar, values)
        C = ufl.diff(tau, Fbar)
        G_F = ufl.diff(G, F)
        tau_theta = ufl.as_tensor(C[i, j, k, l] * Fbar[k, l], (i, j)) / (n * theta)
        s = sum(Fbar[a, b] * G[a, b] for a in d for b in d) / len(d)

        def by_F(part, by_theta):
            """Return dtau/dF for one component of tau, from dtau/dFbar and dtau/dtheta."""
            return ufl.as_matrix([[s * part(a, b) - theta * by_theta * G[a, b] for b in d] for a in d])

        mean_theta = ufl.tr(tau_theta) / n
        mean_F = by_F(lambda a, b: sum(C[c, c, a, b] for c in range(n)) / n, mean_theta)
        tau_F = ufl.as_tensor([[by_F(lambda a, b, c=c, e=e: C[c, e, a, b], tau_theta[c, e]) for e in d] for c in d])
        P_F = ufl.as_tensor(
            tau_F[i, m, k, l] * G[m, j] - mean_F[k, l] * G[i, j] + _dev(tau, F)[i, m] * G_F[m, j, k, l], (i, j, k, l)
        )
        return P_F, _dev(tau_theta, F) * G, mean_F / theta, (mean_theta - slope) / theta


class MeanDilatation:
    """The volume ratio theta and the mean stress pi of each cell, for F-bar.

    `parts`: kernels of each law with F-bar, by index of the law.
    `dt`: time since the start of the step, s.
    """

    def __init__(self, fbar: FBar, parts: Mapping[int, SumsOfPart], dt: fem.Constant):
        self._dt = dt
        self._grid, self._symmetric = fbar.grid, fbar.symmetric
        self.theta, self.pi = fbar.theta, fbar.pi
        self.numbers = list(parts)
        self._sums = list(parts.values())
        self._filled: Latest[Cells] = Latest()
        self._volume: Latest[NDArray[np.float64]] = Latest()
        self._ratios: Latest[None] = Latest()
        self._stresses: Latest[list[Given]] = Latest()

    def total(
        self, data: QuadratureData, sums: Sequence[NDArray[np.float64]]
    ) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
        """Return the cells with F-bar, the totals of `sums` over all laws, and the volumes of pieces with F-bar."""
        return self._cells(data).filled, self._cells(data).total(sums), self._volume_of(data)

    def at(self, data: QuadratureData, motion: tuple, solve: Callable[[], Sequence[Given]]) -> list[Given]:
        """Set theta and pi.  Return the values that the forms of each law need.  All processes must call this method.

        `motion`: cache key that identifies the present displacement.
        `solve`: function that solves for local unknowns of the laws.
        """

        def given_stresses() -> list[Given]:
            given, sums = [*solve()], []
            for number, part, of in zip(self.numbers, self._parts(data), self._sums, strict=True):
                values = of.stress.evaluate(part, live=of.stress.live(part, given[number]))
                sums.append(part.places.total(part.volume * values[:, -1])[:, None])
                given[number] = {**given[number], STRESS: values[:, :-1]}
            self._set_mean(self.pi, sums, data)
            return given

        self._set_ratios(data, motion)
        return self._stresses((self._key(data), motion, float(self._dt.value)), given_stresses, self._grid.comm)

    def _set_ratios(self, data: QuadratureData, motion: tuple) -> None:
        """Set theta.  `motion`: see `at`."""

        def ratios() -> None:
            sums = [of.ratio(part) for of, part in zip(self._sums, self._parts(data), strict=True)]
            self._set_mean(self.theta, sums, data)

        self._ratios((self._key(data), motion), ratios)

    def _set_mean(self, f: fem.Function, sums: Sequence[NDArray[np.float64]], data: QuadratureData) -> None:
        """Set f in each cell to its volume-weighted mean over the pieces with F-bar.

        `sums`: for each law, the integrals (cells, 1) of f over the pieces in each cell.
        """
        f.x.array[self._cells(data).filled] = self._cells(data).total(sums)[:, 0] / self._volume_of(data)[:, 0]

    def assemble_matrix(self, A: PETSc.Mat, data: QuadratureData, sums: Sequence[NDArray[np.float64]]) -> None:
        """Add the contribution of theta and pi to the tangent, without final assembly.

        `sums`: for each law, integrals (cells, quantities) over each cell, see the third result of `FBar.forms`.
        """
        count, volume = 2**self._grid.dim * self._grid.dim, self._volume_of(data)
        b, c, *other, e = np.split(
            self._cells(data).total([sums[number] for number in self.numbers]) / volume,
            range(count, (2 if self._symmetric else 3) * count + 1, count),
            axis=1,
        )
        d = c if self._symmetric else other[0]
        # (d b^T + b c^T + e b b^T) V, with means over the volume V of derivatives: with respect to u, b of det(Delta)
        # and c of dPsi/dtheta; with respect to theta, d of P and e of dPsi/dtheta
        columns, rows = (c + 0.5 * e * b) * volume, (d + 0.5 * e * b) * volume
        matrices = b[:, :, None] * columns[:, None, :] + rows[:, :, None] * b[:, None, :]
        insert(A, self._grid, self._cells(data).filled, matrices)

    def average(self, delta: NDArray[np.float64], data: QuadratureData, motion: tuple) -> None:
        """Scale the gradients `delta` of pieces with F-bar: their determinants become the cells' volume ratios."""
        self._set_ratios(data, motion)
        for number in self.numbers:
            rows = data.rows[number]
            theta, own = self.theta.x.array[data.parts[number].cells], delta[rows]
            delta[rows] = with_ratio(own, theta)

    def _parts(self, data: QuadratureData) -> list[PointData]:
        return [data.parts[number] for number in self.numbers]

    def _cells(self, data: QuadratureData) -> Cells:
        """Return the cells with pieces that use F-bar."""
        places = [part.places for part in self._parts(data)]
        return self._filled(tuple(p.key for p in places), lambda: Cells([p.filled for p in places]))

    def _key(self, data: QuadratureData) -> tuple:
        return tuple(part.key for part in self._parts(data))

    def _volume_of(self, data: QuadratureData) -> NDArray[np.float64]:
        """Return the total volume, in m^d, of the pieces with F-bar in each cell that has such pieces."""
        key = self._key(data)

        def volumes() -> NDArray[np.float64]:
            sums = [p.places.total(p.volume)[:, None] for p in self._parts(data)]
            return self._cells(data).total(sums)

        return self._volume(key, volumes)


def _dev(tau, F):
    """Return the components (d, d) of the deviator of a UFL tensor."""
    d, mean = range(F.ufl_shape[0]), ufl.tr(tau) / tau.ufl_shape[0]
    return ufl.as_matrix([[tau[a, b] - mean if a == b else tau[a, b] for b in d] for a in d])


class Cells:
    """The cells with pieces that use F-bar (`filled`), and the indices in `filled` of the cells of each law."""

    def __init__(self, of_parts: Sequence[NDArray[np.int32]]):
        self.filled = np.unique(np.concatenate(of_parts))
        self.where = [np.searchsorted(self.filled, cells) for cells in of_parts]

    def total(self, values: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return sums (cells, quantities) over all laws.  `values`: for each law, the values in its cells."""
        if len(values) == 1:
            return values[0]
        out = np.zeros((len(self.filled), values[0].shape[1]))
        for where, of_part in zip(self.where, values, strict=True):
            out[where] += of_part
        return out
