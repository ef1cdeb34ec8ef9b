# SPDX-License-Identifier: MIT
"""The initial state: given stresses and pore pressures, balanced with the loads.

Given stresses and the scheme's error leave out-of-balance forces. Steps of the momentum balance at fixed pressures
remove these forces. Their deformation adds to the elastic strain of the points, whose positions do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import Report, StepFailed
from mpm_dolfinx.base.fluid_content import mass_potential, pressure_of
from mpm_dolfinx.base.tolerances import FOREVER, ROUND_OFF
from mpm_dolfinx.bodies.bodies import pressure_at
from mpm_dolfinx.conditions.acting import Loads, Place
from mpm_dolfinx.domains.pressure_transport import PiecePressures
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.materials.initial_stress import strained
from mpm_dolfinx.mechanics.momentum import MomentumProblem
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.parallel.messages import ConditionWarning, log, warn
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.solve.newton import solve_substep
from mpm_dolfinx.solve.schur import Kept, LinearSolvers, planned
from mpm_dolfinx.stepping.balances import Start
from mpm_dolfinx.stepping.scene import Scene, When
from mpm_dolfinx.stepping.state import State, Stay
from mpm_dolfinx.stepping.step import set_up

DEPTH, PATIENCE, LESS = 40, 16, 0.7
"""Mixed iterations; the iteration ends after PATIENCE ones that do not reduce the residual by the factor LESS.

A wet bank, its law elastic or frictional, blocks on a rough base, a half held one: forces left 4e-5 to 3e-9 with 40 and
16 and with 80 and 24, in as many iterations; with 40 and 8 up to 6e-3.
"""
REMARKABLE = 0.05
"""Change of stress in the balance, over the largest given stress, from which a warning is given.

Also the largest relative residual of the forces, due to the scheme's error.
"""


def pieces_at_start(scene: Scene, points: MaterialPoints) -> PiecePressures:
    """Return the pressures of pieces for a pressure field; cells have the field's values at their centroids."""
    on_grid = scene.on_grid(points)
    grid = scene.grid
    pressure = scene.initial.pressure
    cut = on_grid.cut
    contents = on_grid.contents
    bulk = scene.fluid.bulk
    pi = mass_potential(
        cut.pieces_to_cells(pressure_at(pressure, cut.pieces.x + grid.base)), bulk
    )  # potentials are additive in a cell
    store = on_grid.weight * on_grid.data.pieces["storage"][:, 0]
    held = contents.total(store)
    weight = np.where(held[contents.slot(cut.cells)] > 0, store, on_grid.weight)
    mean = contents.total(weight * pi) / contents.total(weight)
    wanted = pressure_at(pressure, grid.base + grid.midpoints[contents.filled] + contents.centroid[contents.filled])
    pi = pi + (mass_potential(wanted, bulk) - mean)[contents.slot(cut.cells)]
    p = pressure_of(pi, bulk)
    water = on_grid.pore_water(points)
    if water is not None:
        offset = p - wanted[water.slot]
        p = water.level(water.of_cells(wanted[water.slot] + on_grid.heads), wanted, offset)[water.slot] + offset
    p = cut.to_pieces(p)
    pieces, bounds = cut.pieces, np.stack([p, p], axis=1)
    return PiecePressures(points.id[pieces.point], pieces.cell, pieces.fraction, p, pieces.x, 0 * pieces.x, bounds)


def balanced(scene: Scene, state: State) -> State:
    """Return a state with stresses in equilibrium with the loads at its time, at its pore pressures.

    A displacement w of the grid is balanced with the strains of the pieces; points keep the mean strain of their
    domains. The steps are thus a fixed-point iteration, w <- w + u(w), with Anderson mixing (Walker and Ni 2011). Mean
    strains cannot balance all nodes: nodal forces hold the remainder, `State.held`. Support forces are evaluated at the
    displacement w, `State.rest`: the sides keep their seeded positions, whatever is prescribed at the start.

    Raises
    ------
    ValueError
        The laws admit no such equilibrium.
    """
    forms, materials = scene.momentum, scene.materials
    try:
        start = set_up(scene, state, 0.0)
        seeded = _as_reset(scene, start)
        if scene.storage is not None:  # as after a step
            pressure = scene.motion.pressures(start.on_grid, state.stage, state.t)
            seeded = replace(seeded, points=replace(seeded.points, pressure=pressure))
        unknowns = start.matrices.momentum.unknowns
        best = (np.inf, 0)
        count = 0
        scheme = scene.scheme
        momentum = start.matrices.momentum
        report = Report()
        solvers = LinearSolvers(planned(scheme, momentum, None, start.matrices.symmetric), scheme, momentum, None)
        seen = []
        w = np.zeros_like(forms.u.x.array)
        points = seeded.points
        while count - best[1] < PATIENCE:
            forms.u.x.array[:] = w
            problem = _problem(scene, start, replace(seeded, points=points))
            residual, scale = problem.assemble_residual()
            left = residual.norm() / max(scale, start.matrices.round_off)
            if left < LESS * best[0]:
                unknowns.add(forms.u, 1.0, residual)
                held, forms.u.x.array[:] = forms.u.x.array.copy(), 0.0
                best = left, count, points, held, w, problem.outcome()
            if left <= scene.scheme.tolerance:
                break
            solve_substep(solvers, problem, None, partial(start.on_grid.as_reset, seeded), count, report, Kept())
            for one in problem.loads:
                seeded = replace(seeded, points=one.gripped(problem.at, seeded.points))
            seen = [*seen[-DEPTH:], (w, forms.u.x.array.copy())]
            w, count = _mixed(unknowns, seen), count + 1
            forms.u.x.array[:] = w
            forms.internal(start.data)  # sets the mean dilatation at w
            points = strained(materials, seeded.points, scene.motion.strained(seeded.points, start.on_grid, start.data))
    except StepFailed as error:
        scene.forget()
        raise ValueError(f"initial_stress: must be in equilibrium with the loads at the start: {error}") from error
    left, count, points, held, rest, outcome = best
    _report(scene, seeded, points, count, left, any(one.touches for one in problem.loads))
    rest = _rest(scene, problem.loads, rest) if any(one.stiff for one in problem.loads) else None
    reactions = {name: values for name, values in outcome.items() if name == "reactions"}
    return replace(start.state, points=points, held=held, rest=rest, outcome={**state.outcome, **reactions})


def _report(scene: Scene, seeded: State, points: MaterialPoints, count: int, left: float, touches: bool) -> None:
    """Log the changes of the balance; refuse a large relative residual.

    Contact (touches) is found in the first step only: a residual is then a warning.
    """
    materials, comm = scene.materials, scene.grid.comm
    if left > REMARKABLE and not touches:
        scene.forget()
        what = "initial_stress: must be in equilibrium with loads and supports at the start"
        raise ValueError(f"{what}: {100 * left:.2g} % of the forces remain")
    before, after = (np.nan_to_num(materials.effective_stress_3d(of)) for of in (seeded.points, points))
    largest, changed = (over_all(comm, float(np.abs(v).max(initial=0.0)), MPI.MAX) for v in (before, after - before))
    what = "initial_stress: balanced after %d iterations, changed by at most %.3g of %.3g Pa; %.2g of its forces remain"
    if changed > REMARKABLE * largest or left > REMARKABLE:
        warn(comm, ConditionWarning, what, count, changed, largest, left)
    else:
        log(comm, what, count, changed, largest, left)


def _rest(scene: Scene, loads: Sequence[Loads], w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a displacement of the nodes, m, a local array; it is zero outside the cells of supported sides."""
    nodes = scene.momentum.active_nodes(np.unique(np.concatenate([one.held_cells for one in loads])))
    return np.where(np.repeat(nodes, scene.grid.dim), w, 0.0)


def _problem(scene: Scene, start: Start, state: State) -> MomentumProblem:
    """Return the balance of momentum at zero displacement and zero rates, for points strained by u."""
    matrices, data = start.matrices, start.on_grid.data_of(state)
    on_grid = start.on_grid
    place = Place(on_grid.cut, on_grid.fill, state.points, data, state.t, 0.0, state.t, state.outcome)
    loads = [one.moved(scene.momentum.u) for one in state.stage.placed(place)]
    when = When(state.t, FOREVER, start.acting[-1].gravity, FOREVER, 0.0)
    return scene.balance(when, matrices.momentum, data, loads, 0.0)


def _as_reset(scene: Scene, start: Start) -> State:
    """Return the state at the start, as after a reset of the grid without motion."""
    cut, pieces = start.on_grid.cut, None
    if scene.storage is not None:
        p = cut.to_pieces(scene.storage.p_n.x.array[start.data.pieces.cells])
        of_cut = (cut.points.id[cut.pieces.point], cut.pieces.cell, cut.pieces.fraction)
        pieces = PiecePressures(*of_cut, None, cut.pieces.x, None, None, p, p)
    return replace(start.state, pieces=pieces, stay=Stay(cut.points))


def _mixed(unknowns: Unknowns, seen: Sequence[tuple[NDArray, NDArray]]) -> NDArray[np.float64]:
    """Return the next displacement of a fixed-point iteration from earlier ones and their steps; local arrays, m."""
    (w, u), owned = seen[-1], unknowns.owned
    if len(seen) == 1:
        return w + u
    dw, du = (np.stack([b - a for a, b in pairwise(values)]) for values in zip(*seen, strict=True))
    rows = du[:, owned]
    sums = over_all(unknowns.comm, np.column_stack([rows @ rows.T, rows @ u[owned]]))
    share = np.linalg.lstsq(sums[:, :-1], sums[:, -1], rcond=ROUND_OFF)[0]
    return w + u - share @ (dw + du)
