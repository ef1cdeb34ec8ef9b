# SPDX-License-Identifier: MIT
"""Run times of two linear solvers, below and above the size at which the package changes from one to the other.

Each threshold is a number of displacement unknowns. Each row of the table is a scene, computed with both solvers. A
time is the processor time of two steps, in the fastest of --repeat runs. On several processes, the time is the largest
of all processes, including waiting. The thresholds are in `mpm_dolfinx/solve/solver_choice.py`.

On one process a second table follows. For each direct solver, it lists the times of a first factorisation of the
stiffness matrix, a repeated factorisation, and a solve.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial

from mpi4py import MPI
from petsc4py import PETSc

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.solve import solver_choice as plan
from mpm_dolfinx.solve.factors import BlockFactors, direct_solver

HUGE = 10**9
STEPS = 2


def block(dim: int, n: int, soil: mpm.Skeleton, fluid: bool) -> mpm.Simulation:
    """Return a block of n cells along each axis, fixed at its base, under a growing load."""
    grid = mpm.Grid([0.0] * dim, [1.0] * (dim - 1) + [1.25], [n] * (dim - 1) + [n + n // 4])
    load = mpm.Traction("top", lambda t: [0.0] * (dim - 1) + [-1e4 * t])
    walls = {"left": "x", "right": "x", "bottom": "xyz"[:dim]} | ({"front": "y", "back": "y"} if dim == 3 else {})
    wet = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("top")]} if fluid else {}
    return mpm.Simulation(
        grid,
        [mpm.box(grid, [0.0] * dim, [1.0] * dim)],
        [soil],
        walls=walls,
        conditions=[load, *wet.pop("conditions", [])],
        **wet,
    )


ELASTIC = mpm.Hencky(bulk=2e6, shear=1e6, conductivity=1e-7)
YIELDS = mpm.DruckerPrager(bulk=2e6, shear=1e6, friction=20.0, dilation=0.0, cohesion=1e4, conductivity=1e-7)
CASES: dict[str, tuple[Callable[[int], mpm.Simulation], tuple[int, ...], tuple[int, ...]]] = {
    "multigrid_3d": (lambda n: block(3, n, ELASTIC, False), (4, 8, 12, 16), (4,)),
    "multigrid_2d": (lambda n: block(2, n, ELASTIC, True), (64, 96, 128, 192), (16,)),
    "mumps": (lambda n: block(2, n, YIELDS, True), (64, 128, 192, 256), (12,)),
}
"""For each threshold: function that returns a scene with n cells along an axis, values of n, and n with --quick.
"""

FACTORED = (16, 128, 256)
"""Cells along an axis of the blocks in the second table. With --quick, only the first block is computed."""


def took(make: Callable[[int], mpm.Simulation], n: int, name: str, least: int) -> tuple[float, int, plan.SolverPlan]:
    """Return the time of the steps (s), the number of unknowns, and the chosen solvers, for one threshold."""
    usual, plan.THRESHOLDS = plan.THRESHOLDS, replace(plan.THRESHOLDS, **{name: least})
    try:
        s = make(n)
        s.step(1.0)
        began = time.process_time()
        for _ in range(STEPS):
            s.step(1.0)
        matrices, seconds = s.scene.last[1], time.process_time() - began
        return max(s.grid.comm.allgather(seconds)), matrices.momentum.unknowns.global_size, matrices.plan
    finally:
        plan.THRESHOLDS = usual


def factored(n: int, soil: mpm.Skeleton) -> Iterator[tuple[str, int, list[float]]]:
    """Yield the name of each direct solver, the number of unknowns, and the times (s) in the second table."""
    s = block(2, n, soil, True)
    s.step(1.0)
    tangent = s.tangent(1.0)
    stiffness, nodes = tangent.stiffness, np.unique(tangent.nodes, return_inverse=True)[1]
    rows = stiffness.indptr.astype(PETSc.IntType), stiffness.indices.astype(PETSc.IntType)
    symmetric, load = soil is ELASTIC, np.ones(len(nodes))

    def in_blocks() -> tuple[Callable, Callable, Callable]:
        factors = BlockFactors(*rows, nodes, tangent.components, tangent.x, 2, symmetric)
        return lambda: factors.take(stiffness.data), factors.factorise, lambda: factors.solve(load)

    def by_entries(package: str | None, dissection: bool) -> tuple[Callable, Callable, Callable]:
        A = PETSc.Mat().createAIJ(stiffness.shape, csr=(*rows, stiffness.data), comm=PETSc.COMM_SELF)
        x, b = A.createVecs()
        b.array_w[:] = load
        ksp = direct_solver(A, "calibrate", symmetric and package != "umfpack", dissection, package)
        return A.assemble, ksp.pc.setUp, lambda: ksp.solve(b, x)

    makers = {"PETSc, blocks of nodes, dissection by grid lines": in_blocks}
    makers |= {"PETSc, nested dissection": partial(by_entries, None, True)}
    makers |= {"PETSc, minimum degree": partial(by_entries, None, False)}
    makers |= {package: partial(by_entries, package, False) for package in ("mumps", "umfpack", "cholmod")}
    for name, make in makers.items():
        with suppress(PETSc.Error):  # PETSc has no such solver, or none for matrices of this symmetry
            began = time.process_time()
            actions = make()
            times = [began]
            for action in (*actions[:2], *actions):
                action()
                times.append(time.process_time())
            yield name, len(nodes), [times[2] - began, times[4] - times[2], times[5] - times[4]]


def main(argv: list[str] | None = None) -> dict:
    """Print the tables, and return the times for each threshold and number of unknowns."""
    parser = common.Parser(__doc__, __file__, processes=True)
    parser.add_argument("--repeat", type=int, default=2, help="runs of each scene with each solver")
    parser.add_argument("--quick", action="store_true", help="small blocks, one turn")
    o = parser.parse_args(argv)
    lines = []

    def show(line: str) -> None:
        lines.append(line)
        if common.first():
            print(line, flush=True)

    with common.results(o) as out:
        show(common.markdown([["threshold", "unknowns", "below it (s)", "above it (s)", "plan below", "plan above"]]))
        for name, (make, sizes, small) in CASES.items():
            for n in small if o.quick else sizes:
                pairs = [[took(make, n, name, least) for least in (HUGE, 0)] for _ in range(1 if o.quick else o.repeat)]
                below, above = (min(pair[k][0] for pair in pairs) for k in (0, 1))
                (_, unknowns, one), (_, _, other) = pairs[0]
                out[f"{name}_{n}"] = [unknowns, below, above]
                usual = getattr(plan.THRESHOLDS, name)
                show(f"| {name} {usual} | {unknowns} | {below:.3f} | {above:.3f} | {one} | {other} |")
        if MPI.COMM_WORLD.size == 1:
            show(common.markdown([["direct solver", "unknowns", "symmetric", "first (s)", "next (s)", "solve (s)"]]))
            for n, soil in itertools.product(FACTORED[:1] if o.quick else FACTORED, (ELASTIC, YIELDS)):
                for name, unknowns, times in factored(n, soil):
                    out[f"{name}, {unknowns}, {soil is ELASTIC}"] = times
                    show(f"| {name} | {unknowns} | {soil is ELASTIC} | " + " | ".join(f"{t:.3f}" for t in times) + " |")
        if common.first():
            o.out.mkdir(parents=True, exist_ok=True)
            (o.out / "calibration.md").write_text("\n".join(lines) + "\n")
        out["converged"] = True
    return out


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
