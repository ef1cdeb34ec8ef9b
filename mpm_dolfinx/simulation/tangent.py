# SPDX-License-Identifier: MIT
"""Tangent of both balances as sparse matrices, for example for modes of vibration and sensitivities."""

from __future__ import annotations

from dataclasses import dataclass

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from mpm_dolfinx.base.time_integration import METHODS
from mpm_dolfinx.base.validation import numbers
from mpm_dolfinx.simulation.events import Simulated
from mpm_dolfinx.stepping.balances import balances
from mpm_dolfinx.stepping.step import set_up


@dataclass(frozen=True, eq=False)
class Tangent:
    """Derivatives of the residuals with respect to displacements and pressures, for a step by backward Euler.

    Let du (n,), in m, be changes of the displacements, and dp (k,), in Pa, changes of the pressures. Forces, in N (N/m
    in plane strain), then change by `stiffness` du + `pressure` dp. Fluid contents, in m^d, change by `content` du +
    `storage` dp. Without fluid, `pressure`, `content`, `storage` and `cells` are None.

    Parameters
    ----------
    stiffness : (n, n)
        Derivative of forces with respect to displacements.  The matrix includes the ghost penalty, the penalties of
        prescribed displacements and contacts, and the inertia of free tools, but not the inertia of bodies.  Fixed
        displacement components are excluded.
    nodes, components : (n,)
        Index of the grid node, and of the axis, of each displacement.
    x : (n, d)
        Position of the node of each displacement, m.
    pressure : (n, k)
        Derivative of forces with respect to pressures.
    content : (k, n)
        Derivative of fluid contents with respect to displacements, without the derivative of the fluxes.
    storage : (k, k)
        Derivative of fluid contents with respect to pressures.
    cells : (k,)
        Index of the cell of each pressure.
    """

    stiffness: csr_matrix
    nodes: NDArray[np.int64]
    components: NDArray[np.int64]
    x: NDArray[np.float64]
    pressure: csr_matrix | None = None
    content: csr_matrix | None = None
    storage: csr_matrix | None = None
    cells: NDArray[np.int64] | None = None


def tangent(simulation: Simulated, dt: float) -> Tangent:
    """Return the tangent at the present state, for a step of length `dt`, in s.

    Raises
    ------
    ValueError
        The scene runs on several processes, or `dt` is not positive.
    """
    scene, state = simulation.scene, simulation.state
    numbers("dt", dt, test=lambda v: (0 < v) & (v < np.inf), allowed="> 0 and finite")
    if scene.grid.comm.size > 1:
        raise ValueError(f"tangent: the scene runs on {scene.grid.comm.size} processes, must be on one")
    start = set_up(scene, state, dt)
    acting = start.begun(start.acting[-1]._replace(substep=METHODS["backward-euler"][0]), None)
    both = balances(scene, start, acting)
    momentum, storage = both.momentum, both.storage
    momentum.assemble_residual()
    unknowns = momentum.system.unknowns
    K = momentum.assemble_tangent()
    if state.stage.inertia:
        K = K + start.matrices.mass.stiffness(0.0)
    blocks = {"stiffness": _csr(K), "x": unknowns.positions}
    blocks |= dict(zip(("nodes", "components"), unknowns.nodes, strict=True))
    if storage is not None:
        storage.assemble_residual()
        storage.assemble_tangent(of_suction=momentum.of_suction())
        of = storage.system
        blocks |= {"pressure": -_csr(of.B_momentum).T.tocsr(), "content": _csr(of.B), "storage": _csr(of.C)}
        blocks["cells"] = of.unknowns.owned.copy()
    scene.forget()  # no later step may reuse these matrices
    return Tangent(**blocks)


def _csr(A: PETSc.Mat) -> csr_matrix:
    """Return a PETSc matrix of one process as a SciPy matrix."""
    rows, columns, values = A.getValuesCSR()
    return csr_matrix((values.copy(), columns.copy(), rows.copy()), shape=A.getSize())
