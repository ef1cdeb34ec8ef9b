# SPDX-License-Identifier: MIT
"""Geometric multigrid on the background grid: each coarse grid has twice the cell size of the finer grid.

Displacements are interpolated linearly between nodes, and pressures between cell centres. Coarse matrices are Q^T A Q
(Galerkin) with the fine matrix A and the interpolation Q.

With 504000 displacements and 251000 pressures in 2D (10^6 points), the set-up of both hierarchies takes 0.33 s, and a
cycle 0.06 s. A step takes 2.6 s with multigrid, and 7.6 s with a direct solver. For a wet cube of 20^3 cells in shear,
16 Newton steps take 2.0 s, and 11.6 s with smoothed aggregation (GAMG).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpm_dolfinx.parallel.exchange import Exchange, over_all
from mpm_dolfinx.solve.petsc_options import set_defaults
from mpm_dolfinx.solve.solver_choice import INCOMPLETE, ONE_SWEEP, THREE_SWEEPS

OPTIONS = {
    "pc_mg_galerkin": "both",
    "mg_levels_ksp_type": "richardson",
    "mg_levels_ksp_max_it": "1",
    "mg_levels_pc_type": "sor",
}
SMOOTHERS = {
    ONE_SWEEP: OPTIONS,
    THREE_SWEEPS: OPTIONS | {"mg_levels_ksp_type": "chebyshev", "mg_levels_ksp_max_it": "3"},
    INCOMPLETE: OPTIONS
    | {
        "mg_levels_ksp_type": "chebyshev",
        "mg_levels_pc_type": "bjacobi",
        "mg_levels_sub_pc_type": "ilu",
        "mg_levels_sub_pc_factor_shift_type": "positive_definite",
    },
}
"""Options of each smoother.

`THREE_SWEEPS` is for nearly incompressible bodies where a direct solver cannot replace multigrid. The test is a cube of
14^3 cells with nu = 0.49, in layers with a stiffness ratio of 1000. GMRES takes 126 iterations with this smoother, and
112 iterations with GAMG. With one sweep, GMRES fails.

`INCOMPLETE` is for yielding soil: incomplete factors without fill (Wittum 1989), one block on each process. One step of
Chebyshev's method applies these factors. Such a single step is a step of Richardson's method, with a damping factor
from an estimate of the largest eigenvalue. Sweeps converge slowly in yielding soil. The test is the block beyond its
limit load in `tests/test_solvers.py`. With 24^3 cells, one solve takes 82 iterations with three sweeps, and 11
iterations with incomplete factors. At nu = 0.49, incomplete factors fail, and three sweeps replace them.
"""
MAYBE, NOT, IS = range(3)  # see `_shared`
NONE = np.iinfo(np.int64).max


def multigrid_solver(
    A: PETSc.Mat,
    name: str,
    places: NDArray[np.int64],
    held: NDArray[np.int64],
    nodal: bool,
    coarsest: int,
    smoother: str = ONE_SWEEP,
    lines: Sequence[NDArray[np.float64]] | None = None,
) -> PETSc.KSP:
    """Return GMRES with multigrid, which is set up again after A has changed.

    `A`: matrix, whose entries may be set later.
    `name`: prefix of the solver's PETSc options.
    `places` (n, d + 1), >= 0: grid indices of the local unknowns along each axis, and index of the component.
    `held` (m, d + 1): indices, as in `places`, of fixed degrees of freedom in cells of bodies.
    `nodal`: whether the unknowns belong to nodes.
    `coarsest`: largest number of unknowns on the coarsest grid.
    `smoother`: name in `SMOOTHERS`.
    `lines` (n,) along each axis, m: grid lines, for cells of different sizes.
    """
    ksp = PETSc.KSP().create(A.comm)
    ksp.setType(PETSc.KSP.Type.GMRES)
    ksp.setPCSide(PETSc.PC.Side.RIGHT)
    ksp.setOptionsPrefix(f"mpm_{name}_{smoother}_")  # separate from the options for factors
    steps = interpolations(A.comm.tompi4py(), places, held, nodal, coarsest, lines)
    ksp.pc.setType(PETSc.PC.Type.MG)
    ksp.pc.setMGLevels(len(steps) + 1)
    for level, Q in zip(range(len(steps), 0, -1), steps, strict=True):
        ksp.pc.setMGInterpolation(level, Q)
    set_defaults(ksp, SMOOTHERS[smoother])
    ksp.setOperators(A)
    ksp.setFromOptions()
    return ksp


def interpolations(
    comm: MPI.Intracomm,
    places: NDArray[np.int64],
    held: NDArray[np.int64],
    nodal: bool,
    coarsest: int,
    lines: Sequence[NDArray[np.float64]] | None = None,
) -> list[PETSc.Mat]:
    """Return the interpolations from each coarse grid to the next finer grid, beginning with the finest grid.

    `comm`: processes that share the unknowns. For other parameters see `multigrid_solver`.
    """
    steps: list[PETSc.Mat] = []
    size = before = over_all(comm, len(places))
    while not steps or coarsest < size < 0.7 * before:  # bodies of few cells have no coarser grid
        Q, places, held = interpolation(comm, places, held, nodal, lines)
        if lines is not None:  # half as many cells; the last cell may extend beyond the grid
            lines = [x[::2] if len(x) % 2 else np.append(x[::2], 2 * x[-1] - x[-2]) for x in lines]
        size, before = over_all(comm, len(places)), size
        steps.append(Q)
    return steps


def interpolation(
    comm: MPI.Intracomm,
    places: NDArray[np.int64],
    held: NDArray[np.int64],
    nodal: bool,
    lines: Sequence[NDArray[np.float64]] | None = None,
) -> tuple[PETSc.Mat, NDArray[np.int64], NDArray[np.int64]]:
    """Return the interpolation matrix, and the local unknowns and fixed degrees of freedom of the coarse grid.

    A coarse cell is an unknown if it contains an unknown fine cell. A coarse node is an unknown if it coincides with a
    free fine node, or interpolates to free fine nodes only.
    """
    rows, coarse, weights = _hats(places, nodal, lines)
    near_fixed = _hats(held, nodal, lines)[1]
    whole = 1.0 if nodal else 0.75 ** (places.shape[1] - 1)  # weight of the coinciding node, or of the coarse cell
    states = np.concatenate([np.where(weights == whole, IS, MAYBE if nodal else NOT), np.full(len(near_fixed), NOT)])
    among = np.concatenate([coarse, near_fixed])
    shape = tuple(int(n) for n in over_all(comm, among.max(axis=0, initial=0), MPI.MAX) + 3)  # indices start at -1
    keys, at = np.unique(np.ravel_multi_index((among + 1).T, shape), return_inverse=True)
    stated = np.full(len(keys), MAYBE)
    for word in (NOT, IS):
        stated[at[states == word]] = word
    number, owned = _shared(comm, keys, int(np.prod(shape)), stated)
    column = number[at[: len(coarse)]]
    kept = column != NONE
    rows, column, weights = (values[kept] for values in (rows, column, weights))
    if not nodal:
        weights = weights / np.bincount(rows, weights, len(places))[rows]
    Q = scipy.sparse.coo_matrix((weights, (rows, column)), shape=(len(places), column.max(initial=-1) + 1)).tocsr()
    Q.sort_indices()
    csr = Q.indptr.astype(PETSc.IntType), Q.indices.astype(PETSc.IntType), Q.data
    sizes = (len(places), None), (np.count_nonzero(owned), None)
    found = np.column_stack(np.unravel_index(keys, shape)) - 1
    return PETSc.Mat().createAIJ(sizes, csr=csr, comm=comm), found[owned], found[(number == NONE) & nodal]


def _hats(
    places: NDArray[np.int64], nodal: bool, lines: Sequence[NDArray[np.float64]] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the fine unknown, coarse unknown (grid indices) and weight of each entry of an interpolation matrix."""
    half, odd = np.divmod(places[:, :-1], 2)
    if nodal:
        share = 0.5
        if lines is not None:  # weight of the upper node
            share = np.empty(half.shape)
            for a, x in enumerate(lines):
                x = np.append(x, 2 * x[-1] - x[-2])
                share[:, a] = ((x[1:-1] - x[:-2]) / (x[2:] - x[:-2]))[np.maximum(places[:, a] - 1, 0)]
        ends = (half, half + 1), (np.where(odd, 1 - share, 1.0), np.where(odd, share, 0.0))
    else:
        ends = (half, half + 2 * odd - 1), (np.full(half.shape, 0.75), np.full(half.shape, 0.25))
    parts = []
    for choice in product((0, 1), repeat=half.shape[1]):
        place, along = (np.stack([of[end][:, k] for k, end in enumerate(choice)], axis=1) for of in ends)
        weight = along.prod(axis=1)
        rows = np.flatnonzero(weight)
        parts.append((rows, np.column_stack([place[rows], places[rows, -1]]), weight[rows]))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def _shared(
    comm: MPI.Intracomm, keys: NDArray[np.int64], count: int, stated: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the index of each coarse unknown or `NONE`, and whether this process owns the unknown.

    `keys`: integers >= 0 and < `count` that identify the coarse unknowns on all processes.  `stated`: status of each
    key, `MAYBE`, `NOT` or `IS`; the largest status on all processes applies.
    """
    ask = Exchange(comm, (keys * comm.size // count).astype(np.int32))
    distinct, who = np.unique(ask.send(keys), return_inverse=True)

    def of_all(values: NDArray[np.int64], op: np.ufunc) -> NDArray[np.int64]:
        found = np.full(len(distinct), NONE if op is np.minimum else 0)
        op.at(found, who, ask.send(values))
        return ask.back(found[who])

    rank = np.where(of_all(stated, np.maximum) == NOT, NONE, comm.rank)
    owned, number = (rank != NONE) & (of_all(rank, np.minimum) == comm.rank), np.full(len(keys), NONE)
    own = np.count_nonzero(owned)
    start = comm.exscan(own) if comm.size > 1 else 0
    number[owned] = (start or 0) + np.arange(own)
    return of_all(number, np.minimum), owned
