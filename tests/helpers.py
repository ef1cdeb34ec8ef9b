# SPDX-License-Identifier: MIT
"""Small scenes that several tests share."""

import re
from dataclasses import fields, replace
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
    """Return the orders of convergence between errors, if each size is half of the size before."""
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
    """Return a saturated beam, clamped at one end, under a load that increases."""
    grid = mpm.Grid(lower=[0, -0.6], upper=[1.2, 0.4], cells=[finer * n for n in cells])
    law = mpm.Hencky(bulk=bulk, shear=shear, porosity=0.4, conductivity=conductivity)
    load = mpm.Traction("top", lambda t: (0, -1e5 * t))
    body, water = mpm.box(grid, [0, 0], [1, 0.3], per_cell=2), {"fluid": mpm.Fluid()}
    drained = [mpm.Drained("right")]
    return mpm.Simulation(grid, [body], [law], walls={"left": "xy"}, conditions=[load, *drained], **water)


def joined(*given):
    """Merge the arguments of several scenes into one dictionary, with the conditions of all scenes."""
    conditions = [one for options in given for one in options.get("conditions", [])]
    return {name: value for options in given for name, value in options.items()} | {"conditions": conditions}


def without(simulation, *kinds):
    """Return the conditions of a simulation, except for some kinds."""
    return [one for one in simulation.conditions if not isinstance(one, kinds)]


def thresholds(monkeypatch, **values):
    """Replace thresholds in the choice of solvers."""
    monkeypatch.setattr(plan, "THRESHOLDS", replace(plan.THRESHOLDS, **values))


def noting(counts, solve):
    """Return `BlockSolver.solve` with a record of its numbers of iterations in `counts`."""

    def noted(*how):
        found = solve(*how)
        counts.append(found[0])
        return found

    return noted


def limit(simulation, newton):
    """Set the largest number of Newton steps before a step is cut. Call this function before the first step."""
    simulation.scene.scheme = replace(simulation.scene.scheme, most_newton=newton)
    simulation.scene.forget()
    return simulation


class SetUp(NamedTuple):
    """Start of a step, and the balances at its end, for one substep of backward Euler."""

    start: Start
    momentum: MomentumProblem
    storage: StorageProblem | None

    @property
    def matrices(self):
        return self.start.matrices


def set_up(simulation, dt):
    """Return the balances of a simulation's next step by backward Euler before they are solved."""
    start = step.set_up(simulation.scene, simulation.state, dt)
    whole = start.acting[-1]._replace(substep=METHODS["backward-euler"][0])
    both = balances(simulation.scene, start, whole)
    return SetUp(start, both.momentum, both.storage)


def top_load(load=54e3, ramp=0.06):
    """Return the load of the beam."""
    return mpm.Traction("top", lambda t: (0, -load * min(1, t / ramp)), region=((0.05, -np.inf), (1.0, np.inf)))


def column(*, cells=10, offset=0.0, width=1, fluid=True, height=1.0, bottom=0.0, **options):
    """Return a column between smooth walls on the floor, with the top `offset` cells above a grid line."""
    h = height / cells
    grid = mpm.Grid([0, 0], [width * h, (cells + 4) * h], [width, cells + 4])
    body = mpm.box(grid, [0, bottom], [width * h, height + offset * h])
    if fluid:
        options["fluid"] = mpm.Fluid() if fluid is True else fluid
    options.setdefault("walls", {"left": "x", "right": "x", "bottom": "y"})
    material = options.pop("material", SOFT)
    return mpm.Simulation(grid, [body], [material], **options)


def refused_in_one_line(make, name, value, folder, longest):
    """Assert that `make` raises a ValueError in one line: object, value and allowed values, shorter than `longest`."""
    with pytest.raises(ValueError) as caught:
        make(folder) if make.__code__.co_argcount else make()
    line = str(caught.value)
    assert "\n" not in line and len(line) < longest
    assert name in line and value in line and re.search(r"\bmust\b|\bneeds?\b", line), line


def left_after_a_way_and_back(grid):
    """Return mean residual stress and largest pressure of a wet beam whose support moves and returns."""
    hold = mpm.Displacement("left", lambda t: (np.sin(np.pi * t), 0.0))
    load = mpm.Traction("right", lambda t: (0, -600 * np.sin(np.pi * t)))
    body, soil = mpm.box(grid, [0.1, 0.5], [0.9, 0.8]), mpm.Hencky(1e6 / 3, 2e5, porosity=0.4, conductivity=1e-4)
    s = mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(), walls={}, conditions=[hold, load])
    result = s.run(1.0, 1 / 60, progress=False)
    assert result.balance < 1e-8
    return np.array([np.linalg.norm(s.effective_stress(), axis=(1, 2)).mean(), np.abs(s.points.pressure).max()])


def imbalance(s, before, soil, gravity):
    """Return the resultant of all forces on wet soil after a step, divided by the largest force.

    The weight contains the fluid as in the balance of momentum: without the change of the volume defect in the step,
    and without its correction. `before` are the points at the start of the step.
    """
    p, n = s.points, soil.porosity
    fluid = p.volume0 @ (p.J - 1 + n - p.data["owed"]) + before.volume0 @ (before.data["owed"] - before.data["due"])
    mass = soil.grain_density * (1 - n) * p.volume0.sum() + s.scene.fluid.density * fluid
    tools = (force[: s.grid.dim] for force in s.tool_forces.values())
    forces = np.array([*s.wall_reactions.values(), *s.reactions.values(), *tools, mass * np.array(gravity)])
    return np.abs(forces.sum(axis=0)).max() / np.abs(forces).max()


def arrays_of(points):
    """Return all arrays of material points by name."""
    return {f.name: getattr(points, f.name) for f in fields(points) if f.name != "data"} | dict(points.data)


def gathered(simulation, **columns):
    """Return positions and columns of all points by id, and the numbers of points of the processes (on process 0).

    `columns`: arrays over the points of each process; by default pressures, stresses and F.
    """
    points = simulation.points
    columns = columns or {"p": points.pressure, "stress": simulation.effective_stress(), "F": points.F}
    parts = simulation.grid.comm.gather((points.id, points.x, *columns.values()))
    if not parts:
        return {}
    ids, *rows = (np.concatenate(a) for a in zip(*parts, strict=True))
    order = np.argsort(ids)
    state = {name: values[order] for name, values in zip(("x", *columns), rows, strict=True)}
    return {**state, "counts": [len(part[0]) for part in parts]}
