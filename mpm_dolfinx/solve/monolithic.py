# SPDX-License-Identifier: MIT
"""Both linearised problems at once, where factors of K cost too much: large bodies in 3D, larger ones in 2D.

    [ K  -B^T ] [du]   [R_u]
    [ B   C   ] [dp] = [R_p]

GMRES, preconditioned from the right with the upper triangle in which the fixed-stress operator P = C + beta V
stands for the Schur complement C + B K^-1 B^T, and one multigrid cycle each for K^-1 and P^-1.

In 3D it takes 7 to 12 iterations to 1e-3, each with one cycle on K.  With algebraic multigrid and Jacobi's smoothing
(10 to 15), conjugate gradients on the Schur complement took 3, but with 35 to 60 cycles in their inner solves; flexible
GMRES with inner solves to 0.1 or 0.01 12 to 24 cycles, MINRES with the diagonal blocks 17 to 23, leaving five times the
residual.  In 2D it takes 8 to 1e-5, 12 with an algebraic cycle on P.

At nu = 0.499 the cycle is poor: more than 100 iterations with 14^3 cells.  A solve that takes `MANY`, or is foreseen
to, goes on with factors of K in place of the cycle, which serve until they take as many: for the other tangents of the
step about 10 iterations.  A step takes 6.2 s, 8.5 s where each tangent is factorised (then 4 to 6 iterations); four
steps of soil that yields, 12^3 cells, 33 and 41 s.  MUMPS factorises 3190 unknowns in 0.2 s, 8610 in 1.4 s (PETSc in
3.4 s).  No solve takes more than 19 then, nor more than 22 at nu = 0.49 where contrasts are 1e3.

In 2D soil that yields would take 20 to 500 (a footing on 41 cells, whatever smooths): bands that slide are a cell wide,
and no coarse grid has them.  With a viscosity of 0.05 it takes 28, and on 41 cells a tenth less time than factors, but
on 81 cells 1.7 times as much.

To give the storage what of K resists changes of volume, p -> p + k B u, leaves K as at nu = 0.3, but pressures that
alternate almost free: 500 iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from weakref import finalize

from petsc4py import PETSc

import numpy as np
from dolfinx.common import Timer
from numpy.typing import NDArray

from mpm_dolfinx.base.caching import Latest
from mpm_dolfinx.flow.storage import FluxSlope, StorageSystem
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.mechanics.momentum import MomentumSystem
from mpm_dolfinx.solve.linear import direct_solver, factorise, nodal_solver, renewed, solved

MANY, MOST = 29, 500
"""Iterations after which factors take the place of the multigrid cycle on K, and most of all."""
EARLY = 6
"""After every so many factors do so at once if the residual falls too slowly in them for `MANY` to be enough."""
RESTART = 200
"""Iterations after which GMRES starts anew.

Two steps of soil that yields, 24^3 cells on four processes, take 68 s in at most 138 iterations a solve with 60, and
49 s in 109 with 200.  With 30, PETSc's, FGMRES on the Schur complement of a footing on 41 cells stagnates where the
tangent is nearly singular: solves that end after 500 iterations take 50.  Vectors are allocated as they are needed.
"""
LEAST = 1e-4
"""What counts as a little fluid, over what the forces would displace if none was in the pores.

In sealed bodies nearly nothing changes places: with scales that differ by 5e5 rounding left 2e-5 of a residual.
"""
FACTORISED = 20000
"""Unknown displacements in 3D up to which K is factorised where the multigrid takes many iterations.

MUMPS takes 8 s and 0.2 GB for as many, where K is not symmetric 15 s and 0.4 GB.
"""


Scale = NDArray[np.float64] | float


def factorisable(unknowns: Unknowns) -> bool:
    """Return whether factors of K may take the place of its cycle."""
    return unknowns.dim == 2 or unknowns.global_size <= FACTORISED


class BlockOperator:
    """Operator and preconditioner for PETSc, with rows scaled by what counts as equally large.

    Parameters
    ----------
    momentum, storage
        The matrices.
    momentum_cycle, storage_cycle
        What stands for K^-1 and P^-1.
    factors : Latest
        Preconditioners with factors of a K, and maybe of a P, which take the place of the cycles where there are some.
    """

    def __init__(
        self,
        momentum: MomentumSystem,
        storage: StorageSystem,
        momentum_cycle: PETSc.PC,
        storage_cycle: PETSc.PC,
        factors: Latest[tuple[PETSc.PC, PETSc.PC]],
    ):
        self._momentum, self._storage, self._factors = momentum, storage, factors
        self._cycles, self._split = (momentum_cycle, storage_cycle), momentum.unknowns.size
        self._u, self._f = momentum.unknowns.vector(), momentum.unknowns.vector()
        self._p, self._g = storage.unknowns.vector(), storage.unknowns.vector()
        self.slope: list[FluxSlope] = []
        self.scale: list[NDArray[np.float64]] = [np.ones(self._split), np.ones(storage.unknowns.size)]

    @property
    def _inverses(self) -> tuple[PETSc.PC, PETSc.PC]:
        """What stands for K^-1 and P^-1."""
        return self._factors.value or self._cycles

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply by the operator."""
        s = self._storage
        self.part(x, self._u, self._p)
        s.lost(self._u, self._g, *self.slope)
        s.C.multAdd(self._p, self._g, self._g)
        s.B_momentum.multTranspose(self._p, self._f)
        self._f.scale(-1.0)
        self._momentum.K.multAdd(self._u, self._f, self._f)
        self.join(self._f, self._g, y, *(1 / scale for scale in self.scale))

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply the preconditioner."""
        self.part(x, self._f, self._g, *self.scale)
        on_u, on_p = self._inverses
        on_p.apply(self._g, self._p)
        self._storage.B_momentum.multTransposeAdd(self._p, self._f, self._f)
        on_u.apply(self._f, self._u)
        self.join(self._u, self._p, y)

    def displaced(self) -> NDArray[np.float64]:
        """Return how much fluid the forces of the residual displace in each part (parts,), m^d/N."""
        forces = self._momentum.residual
        self._inverses[0].apply(forces, self._u)
        self._storage.B.mult(self._u, self._g)
        norms = self._momentum.of_parts.norms(forces.array_r)
        displaced = self._storage.of_parts.norms(self._g.array_r)
        return np.divide(displaced, norms, out=np.zeros(len(norms)), where=norms > 0)

    def part(self, x: PETSc.Vec, u: PETSc.Vec, p: PETSc.Vec, scale_u: Scale = 1.0, scale_p: Scale = 1.0) -> None:
        """Set (u, p) to the scaled parts of x."""
        values = x.array_r
        np.multiply(values[: self._split], scale_u, out=u.array_w)
        np.multiply(values[self._split :], scale_p, out=p.array_w)

    def join(self, u: PETSc.Vec, p: PETSc.Vec, x: PETSc.Vec, scale_u: Scale = 1.0, scale_p: Scale = 1.0) -> None:
        """Set the parts of x to (u, p), scaled."""
        values = x.array_w
        np.multiply(u.array_r, scale_u, out=values[: self._split])
        np.multiply(p.array_r, scale_p, out=values[self._split :])


class BlockSolver:
    """GMRES on displacement and pressure together.

    Parameters
    ----------
    momentum, storage
        The matrices.
    momentum_cycle, storage_cycle
        One multigrid cycle each on K and on P.
    symmetric
        Whether K is.
    """

    def __init__(
        self,
        momentum: MomentumSystem,
        storage: StorageSystem,
        momentum_cycle: PETSc.PC,
        storage_cycle: PETSc.PC,
        symmetric: bool,
    ):
        self._momentum, self._storage, self._symmetric = momentum, storage, symmetric
        self._storage_cycle = storage_cycle
        self._factors: Latest[tuple[PETSc.PC, PETSc.PC]] = Latest()
        self._operator = BlockOperator(momentum, storage, momentum_cycle, storage_cycle, self._factors)
        finalize(self, vars(self._operator).clear)  # PETSc keeps contexts, and what they refer to
        size = (momentum.unknowns.size + storage.unknowns.size, None)
        self._A = PETSc.Mat().createPython((size, size), self._operator, comm=momentum.unknowns.comm)
        self._A.setUp()
        self._x, self._b = self._A.createVecs()
        self._ksp = PETSc.KSP().create(self._A.comm)
        self._ksp.setType(PETSc.KSP.Type.GMRES)
        self._ksp.setOptionsPrefix("mpm_block_")
        self._ksp.setPCSide(PETSc.PC.Side.RIGHT)
        self._ksp.setGMRESRestart(RESTART)
        self._ksp.pc.setType(PETSc.PC.Type.PYTHON)
        self._ksp.pc.setPythonContext(self._operator)
        self._ksp.setOperators(self._A)
        self._ksp.setMonitor(_foresight())
        self._ksp.setFromOptions()

    @property
    def factorised(self) -> bool:
        """Whether factors take the place of the multigrid cycle."""
        return self._factors.value is not None

    def begin(self) -> None:
        """Begin a step, which depends on no factors of the one before."""
        self._factors.clear()

    def linearise(self) -> None:
        """Take the present P; factors, which serve all tangents of a step, stay."""
        renewed(self._storage_cycle, self._storage.P)

    def solve(
        self,
        du: PETSc.Vec,
        dp: PETSc.Vec,
        scales: tuple[NDArray, NDArray],
        rtol: float,
        slope: FluxSlope | None = None,
    ) -> int:
        """Solve for (du, dp) with the problems' residuals on the right; return the number of iterations.

        Parameters
        ----------
        scales : (parts,), (parts,)
            Of the two residuals in each part, N and m^d: what counts as equally large.
        rtol
            Relative to the norm of both residuals, scaled, in each part.
        slope
            What the fluxes gain by displacements; without, it is left out.
        """
        self._operator.slope[:] = [] if slope is None else [slope]
        on_u, on_p = self._momentum.of_parts, self._storage.of_parts
        residuals = self._momentum.residual, self._storage.residual
        scale_u, scale_p = scales
        scale_p = np.maximum(scale_p, LEAST * scale_u * self._operator.displaced())
        if on_u.count > 1:  # nothing couples the parts: each counts as much
            sizes = [of.norms(r.array_r) for of, r in zip((on_u, on_p), residuals, strict=True)]
            size = np.hypot(sizes[0] / scale_u, sizes[1] / scale_p)
            scale_u, scale_p = (scale * np.where(size > 0, size, 1.0) for scale in (scale_u, scale_p))
        self._operator.scale[:] = scale = scale_u[on_u.of], scale_p[on_p.of]
        self._operator.join(*residuals, self._b, *(1 / s for s in scale))
        few = factorisable(self._momentum.unknowns)
        self._ksp.setTolerances(rtol=rtol, atol=0.0, max_it=MANY if few else MOST)
        self._ksp.solve(self._b, self._x)
        count = solved(self._ksp, "momentum and storage")
        if few and self._ksp.getConvergedReason() < 0:
            with Timer("mpm: factorisation"):
                self._factors(object(), self._factorised)
            self._ksp.setTolerances(rtol=rtol, atol=0.0, max_it=MOST)
            self._ksp.setInitialGuessNonzero(True)
            self._ksp.solve(self._b, self._x)
            self._ksp.setInitialGuessNonzero(False)
            count += solved(self._ksp, "momentum and storage")
        self._operator.part(self._x, du, dp)
        return count

    def _factorised(self) -> tuple[PETSc.PC, PETSc.PC]:
        """Return preconditioners with factors of the present K, and in 2D of the present P, which may change."""
        K, unknowns = self._momentum.K, self._momentum.unknowns
        if unknowns.dim == 3:
            solvers = [direct_solver(K, "factors", self._symmetric, package="mumps")]
        else:
            solvers = [nodal_solver(K, "factors", unknowns, self._symmetric)]
            solvers.append(direct_solver(self._storage.P, "storage_factors", often=True))
        for ksp in solvers:
            ksp.setUp()
            ksp.pc.setReusePreconditioner(True)
        found = [ksp.pc for ksp in solvers]
        factorise(*found)
        return found[0], found[1] if found[1:] else self._storage_cycle


def _foresight() -> Callable[[PETSc.KSP, int, float], None]:
    """Return a monitor that ends iterations with a multigrid cycle which `MANY` would not be enough for."""
    before = goal = 0.0

    def monitor(ksp: PETSc.KSP, count: int, norm: float) -> None:
        nonlocal before, goal
        rtol, _, _, most = ksp.getTolerances()
        goal = goal if count else rtol * norm
        if count % EARLY:
            return
        if count and most == MANY and norm * (norm / before) ** ((MANY - count) / EARLY) > goal:
            ksp.setTolerances(max_it=count)
        before = norm

    return monitor
