# SPDX-License-Identifier: MIT
"""Large consolidation under a strip load: a layer settles by an eighth of its height, and its porosity decreases.

A layer between smooth walls, on a smooth, impervious base, carries a dead load q on a fifth of its drained surface. By
symmetry half of the layer is computed, as wide as its height H. The soil is elastic (Hencky, nu = 0) with Young's
modulus E and porosity 0.6. The conductivity of the soil, `k0 10^(5 (J - 1))` with the volume ratio J, decreases as
pores close. Grains and water are incompressible. The reduced time is `T = k0 E t / (gamma_w H²)`, with the time t and
the unit weight gamma_w of water. The load increases until T = 0.01. Source: Carter, Small and Booker (1977), as in
Abaqus' benchmark 1.14.3. With q = E/2 (--load 0.5) the pores under the strip close at T = 0.37. The law has no
stiffness of the grains, so the run fails at this time.

The references for q/E = 0.25 are results of Taylor-Hood elements, extrapolated in the step length and the cell size.
All errors are relative to the displacement of the strip's middle. `at_once` is the error of the middle's settlement at
T = 0.01. Three errors are maxima over T >= 0.1: `settlement` in the middle, `edge` at the strip's edge, and `beside` at
the far end of the drained surface. --reference also runs Taylor-Hood elements on the same cells. The demo runs on one
process.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np
import ufl
from numpy.typing import NDArray

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

HEIGHT, STRIP, E, K0 = 1.0, 0.2, 1e6, 1e-6  # m: height of the layer, half-width of the strip; Pa; m/s
WATER = mpm.Fluid(bulk=np.inf)
SOIL = mpm.Hencky(
    bulk=E / 3,
    shear=E / 2,
    porosity=0.6,
    conductivity=K0,
    conductivity_law=lambda conductivity, J: conductivity * ufl.exp(5 * np.log(10) * (J - 1)),
)
UNIT = WATER.unit_weight * HEIGHT**2 / (K0 * E)  # s, T = 1
RAMP = 0.01  # T
PLACES = np.array([[0.0, HEIGHT], [STRIP, HEIGHT], [HEIGHT, HEIGHT]])
TIMES = (0.01, 0.1, 10**-0.5, 1.0, 10**0.5)
"""Reduced times T of the reference values."""
ELEMENTS = np.array(
    [
        [-0.058309, -0.032099, 0.020442],
        [-0.089512, -0.053990, 0.019367],
        [-0.108609, -0.070466, 0.011497],
        [-0.124774, -0.085915, -0.002056],
        [-0.129321, -0.090335, -0.006179],
    ]
)
"""Upward displacements at `TIMES` and `PLACES` by Taylor-Hood elements (extrapolated), divided by `HEIGHT`, for q/E =
0.25.
"""
WALLS = {"left": "x", "right": "x", "bottom": "y"}


def conditions(load: float) -> dict:
    """Return the fluid, walls and conditions for a load, which is given as a fraction of E."""
    strip = mpm.Traction("top", lambda t: (0, -load * E * min(1, t / (RAMP * UNIT))), ((0, 0), (STRIP, 2 * HEIGHT)))
    return {"fluid": WATER, "walls": WALLS, "conditions": [strip, mpm.Drained("top")]}


def times(a_decade: int) -> NDArray[np.float64]:
    """Return the reduced times at which steps end.

    a_decade: number of steps in which T grows tenfold after `RAMP`.
    """
    ramp = RAMP * np.linspace(0, 1, 1 + 2 * a_decade // 3)[1:]
    return np.append(ramp, RAMP * 10 ** (np.arange(1, 5 * a_decade // 2 + 1) / a_decade))


@dataclass
class Outcome:
    """After each step: reduced times `T`, and upward displacements `moved` at `PLACES`, divided by `HEIGHT`.

    frames: T, corners, pressures divided by E, and porosities of the points.
    why: reason if the run ended early.
    """

    T: list[float] = field(default_factory=list)
    moved: list[NDArray[np.float64]] = field(default_factory=list)
    frames: list[tuple[float, NDArray, NDArray, NDArray]] = field(default_factory=list)
    why: str = ""
    wall: float = 0.0
    steps: int = 0
    balance: float = 0.0


def run(cells: int = 40, load: float = 0.25, a_decade: int = 30) -> Outcome:
    """Consolidate a layer, `cells` cells high, under the load q = load * E."""
    h = HEIGHT / cells
    grid = mpm.Grid([0, 0], [HEIGHT, HEIGHT + 4 * h], [cells, cells + 4])
    body = mpm.box(grid, [0, 0], [HEIGHT, HEIGHT])
    simulation, top = mpm.Simulation(grid, [body], [SOIL], **conditions(load)), mpm.probes([body], PLACES)
    out, shown = Outcome(), [0.1, 10**0.5]
    try:
        for T in times(a_decade):
            result = simulation.run(T * UNIT, T * UNIT - simulation.t, probes=top, progress=False)
            out.T.append(float(T))
            out.moved.append(result.displacement[-1][:, 1] / HEIGHT)
            out.wall, out.steps = out.wall + result.wall, out.steps + result.steps
            out.balance = max(out.balance, result.balance)
            if shown and T > 0.999 * shown[0]:
                out.frames.append(seen(simulation, shown.pop(0)))
    except mpm.GaveUp as error:
        out.why = str(error)
        out.frames.append(seen(simulation, simulation.t / UNIT))
    return out


def seen(s: mpm.Simulation, T: float) -> tuple[float, NDArray, NDArray, NDArray]:
    """Return the present frame at the reduced time T, see `Outcome`."""
    return T, s.points.corners.copy(), s.points.pressure / E, s.point_fields().porosity


def elements(cells: int, load: float, a_decade: int) -> NDArray[np.float64]:
    """Return the upward displacements by Taylor-Hood elements at `TIMES` and `PLACES`, divided by `HEIGHT`."""
    fem, out = BiotFEM(mpm.Grid([0, 0], [HEIGHT] * 2, [cells] * 2), SOIL, **conditions(load)), []
    for T in times(a_decade):
        fem.step(T * UNIT - fem.t)
        if np.isclose(T, TIMES).any():
            out.append(fem.displacement(PLACES)[:, 1] / HEIGHT)
    return np.array(out)


def errors(out: Outcome) -> dict[str, float]:
    """Return the errors by name; the docstring of this file explains the names."""
    at = [int(np.argmin(np.abs(np.array(out.T) - T))) for T in TIMES]
    wrong = np.abs((np.array(out.moved)[at] - ELEMENTS) / ELEMENTS[:, :1])
    late = dict(zip(("settlement", "edge", "beside"), wrong[1:].max(axis=0).tolist(), strict=True))
    return {**late, "at_once": float(wrong[0, 0])}


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=40, help="cells over the height")
    parser.add_argument("--load", type=float, default=0.25, help="load divided by Young's modulus, q/E")
    parser.add_argument("--steps", type=int, default=30, help="steps in each decade of T from 0.01 on")
    parser.add_argument("--reference", action="store_true", help="also run Taylor-Hood elements on the same cells")
    o = parser.parse_args(argv)
    if o.cells < 5 or not 0 < o.load <= 1 or o.steps < 4 or o.steps % 2:
        cells, load = f"--cells {o.cells}: must be >= 5", f"--load {o.load}: must be in (0, 1]"
        parser.error(f"{cells}; {load}; --steps {o.steps}: must be even and >= 4")
    with common.results(o) as out:
        outcome = run(o.cells, o.load, o.steps)
        found = errors(outcome) if o.load == 0.25 and not outcome.why else {}
        if outcome.why:
            print(f"T = {outcome.frames[-1][0]:.3g}: {outcome.why}")
        if outcome.T:
            print(f"settlement of the middle at T = {outcome.T[-1]:.3g}: {-outcome.moved[-1][0]:.5f} of the height")
        if found:
            common.table([["displacement", "error"], *([name, f"{error:.3%}"] for name, error in found.items())])
        if o.reference:
            print("Taylor-Hood elements:", *elements(o.cells, o.load, o.steps)[:, 0].round(5))
        draw(o, outcome)
        print(f"{outcome.steps} steps, {outcome.wall:.1f} s, balance {outcome.balance:.1e}")
        out |= {"errors": found, "balance": outcome.balance, "wall_s": outcome.wall}
        kept = (o.cells, o.load, o.steps) != (40, 0.25, 30) or found.get("settlement", 1.0) < 1e-3
        out |= {"ended": outcome.frames[-1][0], "converged": kept and not outcome.why}
    return out


def draw(o: Namespace, out: Outcome) -> None:
    """Draw the initial pressure, the final porosity, and the displacements of the surface."""
    fig, ((left, middle, right),) = common.figure(1, 3, (14, 4.4))
    kinds = (("pore pressure / E (-)", 2, "viridis"), ("porosity (-)", 3, "cividis"))
    for ax, (T, *values), (label, k, colours) in zip(
        (left, middle), (out.frames[0], out.frames[-1]), kinds, strict=True
    ):
        domains = common.domains(ax, values[0], values[k - 1], cmap=colours)
        ax.plot([0, HEIGHT, HEIGHT], [HEIGHT, HEIGHT, 0], color="grey", lw=0.8, ls=":")
        ax.set(
            aspect="equal", xlim=(0, 1.02), ylim=(0, 1.06), xlabel="x / H (-)", ylabel="y / H (-)", title=f"T = {T:.3g}"
        )
        fig.colorbar(domains, ax=ax, label=label, shrink=0.85)
    for k, name in enumerate(("middle of the strip", "its edge", "far end")):
        right.semilogx(out.T, np.array(out.moved)[:, k], color=f"C{k}", label=name)
        if o.load == 0.25:
            right.plot(TIMES, ELEMENTS[:, k], "o", ms=4, color="black", label=None if k else "finite elements")
    right.set(xlabel="reduced time T (-)", ylabel="displacement of the surface, up / H (-)")
    right.grid(alpha=0.3)
    right.legend()
    common.save(fig, o.out / "strip.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
