# SPDX-License-Identifier: MIT
"""What a scene is compiled to: its terms and solvers, and why it does without the others; how it is shared out."""

from __future__ import annotations

import resource
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from mpm_dolfinx.constitutive.skeleton import LOCKING

if TYPE_CHECKING:
    from mpm_dolfinx.simulation import Simulation


@dataclass(frozen=True)
class Part:
    """A term or solver: its name, whether the scene has it, what it is or why it is left out."""

    name: str
    used: bool
    why: str


def parts(simulation: Simulation) -> list[Part]:
    """Return the terms and solvers of a scene, as they are so far: some are compiled when first they are needed."""
    return [*_momentum(simulation), *_storage(simulation), *_solvers(simulation)]


def _either(name: str, used, what: str, otherwise: str) -> Part:
    return Part(name, bool(used), what if used else otherwise)


def _momentum(s: Simulation) -> list[Part]:
    m, side = s.momentum, s.boundary
    laws = ", ".join(law.__name__ for law, _ in s.laws)
    state = ", ".join(name for law, _ in s.laws for name in law.state)
    return [
        _either("reset of the grid", s.resets > 1, f"{s.resets} so far", "nothing has moved so far"),
        Part("stress", True, f"{laws}; integrated over {'exact domains' if s.quadrature == 'domain' else 'points'}"),
        _either(
            "mean dilatation", m.dilatation, f"nu > {LOCKING}, or plastic flow", f"nu <= {LOCKING}, no plastic flow"
        ),
        _either("state of the law", state, state, "the stress depends on F only"),
        _either("body force", s.gravity is not None, "gravity", "no gravity"),
        _either("tractions", side.loads, f"on {len(side.loads)} sides", "no tractions"),
        _either("given displacements", side.holds, f"on {len(side.holds)} sides", "no given displacements"),
        _either("rigid plates", side.plates, f"on {len(side.plates)} sides", "no plates"),
        _either("ghost penalty", m.ghost.used, "faces of partly filled cells", "no partly filled cell so far"),
        _either("terms of the user's", m.terms, f"{len(m.terms)}", "none given"),
    ]


def _storage(s: Simulation) -> list[Part]:
    storage, outlets = s.storage, s.boundary.outlets
    names = ("pore pressure", "fluxes between cells", "weight of the fluid", "open sides", "damping of pressure jumps")
    if storage is None:
        return [Part(name, False, "no fluid") for name in (*names, "sources")]
    still = "nothing conducts"
    return [
        Part(names[0], True, "finite volumes, coupled"),
        _either(names[1], storage.flows, "two-point", still),
        _either(names[2], storage.gravity, "gravity", "no gravity" if storage.flows else still),
        _either(names[3], outlets, f"{len(outlets)} drained or with inflow", "sealed"),
        _either(names[4], storage.damp.used, "little flows within a step", "enough flows within a step, so far"),
        _either("sources", storage.sources, f"{len(storage.sources)}", "none given"),
    ]


def _solvers(s: Simulation) -> list[Part]:
    m, coupling = s.momentum, s.coupler.coupling
    kind = "symmetric" if m.symmetric else "unsymmetric: LU and FGMRES"
    return [
        _either("coupling", s.storage, f"{coupling}, {kind}", "no fluid: Newton on the momentum"),
        _either(
            "one factorisation for many steps",
            m.linear,
            "linear law: until active cells or time step change",
            "the tangent depends on the strain",
        ),
    ]


def table(simulation: Simulation) -> str:
    """Return the parts of a scene as a table."""
    rows = parts(simulation)
    width = max(len(part.name) for part in rows)
    return "\n".join(f"{part.name:{width}}  {'yes' if part.used else 'no ':3}  {part.why}" for part in rows)


def imbalance(simulation: Simulation) -> dict[str, float]:
    """Return the most that one process has over the mean of all: points, pieces, active cells; after the first step.

    1 is perfect; the time of a step goes with the pieces.  Called on all processes together.
    """
    comm, pieces = simulation.grid.comm, simulation.pieces
    mine = np.array([len(simulation.points), len(pieces.cells), len(pieces.filled)], dtype=float)
    total, most = np.empty_like(mine), np.empty_like(mine)
    comm.Allreduce(mine, total)
    comm.Allreduce(mine, most, MPI.MAX)
    ratio = np.divide(most * comm.size, total, out=np.ones_like(mine), where=total > 0)
    return dict(zip(("points", "pieces", "active cells"), ratio.tolist(), strict=True))


def peak_memory() -> float:
    """Return the most memory that this process has had, MB."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux counts the parent's into getrusage
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 1024)
