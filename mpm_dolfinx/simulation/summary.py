# SPDX-License-Identifier: MIT
"""Summary of a scene: its terms and solvers, and its distribution over processes."""

from __future__ import annotations

import resource
import sys
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

import numpy as np

from mpm_dolfinx.materials.skeleton import LOCKING
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.stage import KINDS
from mpm_dolfinx.stepping.state import State


@dataclass(frozen=True)
class Part:
    """A term or solver of a scene."""

    name: str
    used: bool  # whether the scene has it
    why: str  # form of the term, or the reason for its absence


def parts(scene: Scene, state: State) -> list[Part]:
    """Return all terms and solvers, and whether and why a scene uses them at present."""
    return [*_momentum(scene, state), *_storage(scene, state), *_solvers(scene, state)]


def _either(name: str, used, what: str, otherwise: str) -> Part:
    return Part(name, bool(used), what if used else otherwise)


def _momentum(s: Scene, state: State) -> list[Part]:
    m, number = s.momentum, {kind.title: len(state.stage.of(*kind.conditions)) for kind in KINDS}
    laws, evolves = ", ".join(law.__name__ for law in s.materials.laws), ", ".join(s.materials.state_names)
    return [
        _either("reset of the grid", state.resets > 1, f"{state.resets} so far", "nothing has moved so far"),
        _either("moving grid lines", s.grid.follow is not None, "at each reset", "lines stay"),
        _either("axisymmetry", s.grid.axisymmetric, "rings about r = 0", "plane strain" if s.grid.dim == 2 else "3D"),
        Part(
            "stress",
            True,
            f"{laws}; integrated over {'exact domains' if s.numerics.quadrature == 'domain' else 'points'}",
        ),
        _either(
            "mean dilatation",
            m.dilatation,
            f"F-bar, for nu > {LOCKING} or plastic flow",
            f"nu <= {LOCKING}, no plastic flow",
        ),
        _either("state of the law", evolves, evolves, "the stress depends on F only"),
        _either("kept volumes", s.motion.keeps_volumes, "of yielded domains", "not requested, or no plastic flow"),
        _either("initial stress", s.initial.given, f"of {len(s.initial.given)} bodies", "none given"),
        _either("inertia", state.stage.inertia, "of all bodies", "not asked" if m.inertia is None else "quasi-static"),
        _either("body force", s.gravity is not None, "gravity", "no gravity"),
        *(_either(kind.title, number[kind.title], f"{number[kind.title]}", "none given") for kind in KINDS),
        _either("ghost penalty", m.ghost.form.used, "faces of nearly empty cells", "no nearly empty cell so far"),
        _either("user-defined terms", m.own.terms, f"{len(m.own.terms)}", "none given"),
    ]


def _storage(s: Scene, state: State) -> list[Part]:
    storage, count = s.storage, {one.title: one.count for one in state.stage.feeding}
    names = ("pore pressure", "fluxes between cells", "weight of the fluid", "open sides", "damping of pressure jumps")
    through = "contacts that conduct"
    if storage is None:
        return [Part(name, False, "no fluid") for name in (*names, through, "pores that drain", "retention", "sources")]
    still, f = "no conductivity", storage.fluxes
    return [
        Part(names[0], True, "finite volumes, coupled"),
        _either(names[1], f.flux, f"two-point, conductivities over {s.fluid.unit_weight:.6g} N/m^3", still),
        _either(names[2], f.gravity, "gravity", "no gravity" if f.flux else still),
        _either(names[3], names[3] in count, f"{count.get(names[3])} drained or with inflow", "no-flow sides only"),
        _either(names[4], f.damp.used, "little flow within a step", "enough flow within a step, so far"),
        _either(through, through in count, f"{count.get(through)}", "no fluid passes between groups"),
        _either("pores that drain", storage.drains, "as a free surface falls", "pores stay full"),
        _either("retention", storage.retains, _laws(s), "no suction drains pores"),
        _either("sources", "sources" in count, f"{count.get('sources')}", "none given"),
    ]


def _laws(s: Scene) -> str:
    laws = s.materials.retentions
    return "" if laws is None else ", ".join(dict.fromkeys(type(law).__name__ for law in laws.laws))


def _solvers(s: Scene, state: State) -> list[Part]:
    kind = "symmetric" if s.momentum.symmetric and state.stage.symmetric else "unsymmetric: LU and FGMRES"
    once = "first order in time" if s.numerics.method == "backward-euler" else "no time derivatives"
    return [
        _either("coupling", s.storage, f"{s.scheme.coupling}, {kind}", "no fluid: Newton on the momentum"),
        _either(
            "one factorisation for many steps",
            s.momentum.linear and all(one.linear for one in state.stage.acting),
            "linear law: until active cells or time step change",
            "the tangent depends on the strain",
        ),
        Part("linear solvers", True, str(s.last[1].plan) if s.last[1] else "planned in the first step"),
        _either("second substep", len(s.substeps(state.stage)) > 1, "second order in time", once),
    ]


def table(scene: Scene, state: State) -> str:
    """Return the terms and solvers of a scene as a table."""
    rows = parts(scene, state)
    width = max(len(part.name) for part in rows)
    return "\n".join(f"{part.name:{width}}  {'yes' if part.used else 'no ':3}  {part.why}" for part in rows)


def imbalance(scene: Scene, state: State) -> dict[str, float]:
    """Return the imbalance of points, pieces and active cells over the processes, by name.

    An imbalance is the largest count on any process, divided by the mean count of all processes.  Before the first
    step, the imbalance of pieces and cells is 1.  All processes must call this function.
    """
    comm, (on_grid, _) = scene.grid.comm, scene.last
    pieces = on_grid.data.pieces if on_grid else None
    counts = [len(state.points), len(pieces.cells), len(pieces.places.filled)] if pieces else [len(state.points), 0, 0]
    counts = np.array(counts, dtype=float)
    total, most = over_all(comm, counts), over_all(comm, counts, MPI.MAX)
    ratio = np.divide(most * comm.size, total, out=np.ones_like(counts), where=total > 0)
    return dict(zip(("points", "pieces", "active cells"), ratio.tolist(), strict=True))


def peak_memory() -> float:
    """Return the peak memory of this process, in MB."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage includes the parent process on Linux
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 1024)
