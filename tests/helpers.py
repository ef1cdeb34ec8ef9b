# SPDX-License-Identifier: MIT
"""Small scenes that several tests share."""

import re
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.base.time_integration import METHODS
from mpm_dolfinx.flow.storage import StorageProblem
from mpm_dolfinx.mechanics.momentum import MomentumProblem
from mpm_dolfinx.solve import solver_choice as plan
from mpm_dolfinx.stepping import step
from mpm_dolfinx.stepping.balances import Start, balances

SOFT = mpm.Hencky(bulk=1e7 / 3, shear=5e6, porosity=0.4, conductivity=1e-4)


def rates(errors):
    """Return the orders between errors at sizes that are halved each time."""
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


def beam(*, fluid=True, ramp=0.06, load=54e3, offset=0.5, h=0.03, material=SOFT, box=1.2, **options):
    """Return (simulation, probe at the tip) of the poroelastic beam on a coarse grid."""
    grid = mpm.Grid([0, 0], [1.2, box], [round(1.2 / h), round(box / h)])
    bottom = (round(box / 2 / h) + offset) * grid.h[1]
    body, ends = mpm.box(grid, [0, bottom], [1, bottom + 0.3]), []
    if fluid:
        ends = [mpm.Drained("left"), mpm.Drained("right")]
        options["fluid"] = mpm.Fluid() if fluid is True else fluid
    simulation = mpm.Simulation(
        grid,
        [body],
        [material],
        walls={"left": "xy"},
        conditions=[top_load(load, ramp), *options.pop("conditions", ends)],
        **options,
    )
    return simulation, mpm.probes([body], [[1.0, bottom + 0.15]])


def pressed(finer: int = 1, conductivity=1e-5, bulk=6.7e6, shear=3.1e6, cells=(36, 30)) -> mpm.Simulation:
    """Return a saturated beam, clamped and pressed down more and more."""
    grid = mpm.Grid(lower=[0, -0.6], upper=[1.2, 0.4], cells=[finer * n for n in cells])
    law = mpm.Hencky(bulk=bulk, shear=shear, porosity=0.4, conductivity=conductivity)
    load = mpm.Traction("top", lambda t: (0, -1e5 * t))
    body, water = mpm.box(grid, [0, 0], [1, 0.3], per_cell=2), {"fluid": mpm.Fluid()}
    drained = [mpm.Drained("right")]
    return mpm.Simulation(grid, [body], [law], walls={"left": "xy"}, conditions=[load, *drained], **water)


def joined(*given):
    """Return arguments of scenes as one, with the conditions of all."""
    conditions = [one for options in given for one in options.get("conditions", [])]
    return {name: value for options in given for name, value in options.items()} | {"conditions": conditions}


def without(simulation, *kinds):
    """Return the active conditions, except for the given kinds."""
    return [one for one in simulation.conditions if not isinstance(one, kinds)]


def thresholds(monkeypatch, **values):
    """Let the choice of solvers follow other thresholds."""
    monkeypatch.setattr(plan, "THRESHOLDS", replace(plan.THRESHOLDS, **values))


def noting(counts, solve):
    """Return `BlockSolver.solve` that notes its iterations."""

    def noted(*how):
        found = solve(*how)
        counts.append(found[0])
        return found

    return noted


def limit(simulation, newton):
    """Let a simulation take so many Newton steps before a step is cut; before its first step."""
    simulation.scene.scheme = replace(simulation.scene.scheme, most_newton=newton)
    simulation.scene.forget()
    return simulation


class SetUp(NamedTuple):
    """The balances at the end of a step's last substep, taken as the only one, and the start of the step."""

    start: Start
    momentum: MomentumProblem
    storage: StorageProblem | None

    @property
    def matrices(self):
        return self.start.matrices


def set_up(simulation, dt):
    """Return the balances of a simulation's next step by backward Euler, set up and not solved."""
    start = step.set_up(simulation.scene, simulation.state, dt)
    whole = start.acting[-1]._replace(substep=METHODS["backward-euler"][0])
    both = balances(simulation.scene, start, whole)
    return SetUp(start, both.momentum, both.storage)


def top_load(load=54e3, ramp=0.06):
    """Return the beam's load."""
    return mpm.Traction("top", lambda t: (0, -load * min(1, t / ramp)), region=((0.05, -np.inf), (1.0, np.inf)))


def column(*, cells=10, offset=0.0, width=1, fluid=True, height=1.0, bottom=0.0, **options):
    """Return a laterally held column on the floor, its top `offset` cells above a grid line."""
    h = height / cells
    grid = mpm.Grid([0, 0], [width * h, (cells + 4) * h], [width, cells + 4])
    body = mpm.box(grid, [0, bottom], [width * h, height + offset * h])
    if fluid:
        options["fluid"] = mpm.Fluid() if fluid is True else fluid
    options.setdefault("walls", {"left": "x", "right": "x", "bottom": "y"})
    material = options.pop("material", SOFT)
    return mpm.Simulation(grid, [body], [material], **options)


def refused_in_one_line(make, name, value, folder, longest):
    """Assert that a ValueError is one line with object, value and allowed values, shorter than `longest`."""
    with pytest.raises(ValueError) as caught:
        make(folder) if make.__code__.co_argcount else make()
    line = str(caught.value)
    assert "\n" not in line and len(line) < longest
    assert name in line and value in line and re.search(r"\bmust\b|\bneeds?\b", line), line


def left_after_a_way_and_back(grid):
    """Return the mean residual stress and largest pressure of a wet beam bent while its support moves and returns."""
    hold = mpm.Displacement("left", lambda t: (np.sin(np.pi * t), 0.0))
    load = mpm.Traction("right", lambda t: (0, -600 * np.sin(np.pi * t)))
    body, soil = mpm.box(grid, [0.1, 0.5], [0.9, 0.8]), mpm.Hencky(1e6 / 3, 2e5, porosity=0.4, conductivity=1e-4)
    s = mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(), walls={}, conditions=[hold, load])
    result = s.run(1.0, 1 / 60, progress=False)
    assert result.balance < 1e-8
    return np.array([np.linalg.norm(s.effective_stress(), axis=(1, 2)).mean(), np.abs(s.points.pressure).max()])


def imbalance(s, before, soil, gravity):
    """Return the resultant of all forces on wet soil after a step, over the largest force.

    The weight counts the fluid as the balance of momentum does: without the step's change of the volume defect, and
    without the correction of the defect.  `before` are the points at the start of the step.
    """
    p, n = s.points, soil.porosity
    fluid = p.volume0 @ (p.J - 1 + n - p.data["owed"]) + before.volume0 @ (before.data["owed"] - before.data["due"])
    mass = soil.grain_density * (1 - n) * p.volume0.sum() + s.scene.fluid.density * fluid
    tools = (force[: s.grid.dim] for force in s.tool_forces.values())
    forces = np.array([*s.wall_reactions.values(), *s.reactions.values(), *tools, mass * np.array(gravity)])
    return np.abs(forces.sum(axis=0)).max() / np.abs(forces).max()


def gathered(simulation):
    """Return positions, pressures, stresses and F of all points by number, and their counts a process; {} but on 0."""
    points = simulation.points
    columns = (points.id, points.x, points.pressure, simulation.effective_stress(), points.F)
    parts = simulation.grid.comm.gather(columns)
    if not parts:
        return {}
    ids, *rows = (np.concatenate(a) for a in zip(*parts, strict=True))
    state = zip(("x", "p", "stress", "F"), (values[np.argsort(ids)] for values in rows), strict=True)
    return {**dict(state), "counts": [len(part[0]) for part in parts]}
