# SPDX-License-Identifier: MIT
"""Water infiltrates unsaturated soil: comparison with exact and converged solutions.

The first scene is rain on exponential soil (`Gardner`) above a water table. At t = 0 the rain increases from a tenth to
nine tenths of the conductivity. Heads are compared with the series of Srivastava and Yeh (1991). The second scene is a
wetting front in dry soil (`VanGenuchten`), the second case of Celia, Bouloutas and Zarba (1990). The front is compared
with a converged solution of Richards' equation. Finite elements (Q1/DG0) are computed on the same cells in the same
steps.

In rain, the error after 1, 6 and 12 h is the largest error of the head, divided by the largest head. The front has two
errors after 6 and 12 h: the error of the depth at which the head is -5 m, and the error of the infiltrated water. The
demo runs on one process.
"""

from __future__ import annotations

from argparse import Namespace

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

WEIGHT = 9810.0  # N/m³
STIFF = {"bulk": 1e10, "shear": 5e9}  # Pa: soil that hardly deforms
ALPHA, K = 5.0, 1e-5  # 1/m, m/s, of the exponential soil
HOURS = (1, 6, 12)
FRONT = {6: (0.2544, 0.017406), 12: (0.375096, 0.026335)}
"""At each time (h): depth (m) where the head is -5 m, and infiltrated water (m), extrapolated from 1600 cells."""
DRY = {
    "soil": mpm.LinearElastic(
        **STIFF,
        porosity=0.368,
        conductivity=9.22e-5,
        retention=mpm.VanGenuchten(WEIGHT / 3.35, residual=0.102 / 0.368, n=2.0),
    ),
    "pressure": -10 * WEIGHT,
    "sides": [mpm.Drained("bottom", pressure=-10 * WEIGHT), mpm.Drained("top", pressure=-0.75 * WEIGHT)],
}
"""Arguments of `column` for the scene with a wetting front."""


def column(cells: int, soil: mpm.Skeleton, pressure, sides) -> mpm.Simulation:
    """Return a column of 1 m between smooth walls, with stresses in equilibrium with weight and suction."""
    h = 1 / cells
    grid = mpm.Grid([0, 0], [h, 1 + 2 * h], [1, cells + 2])
    scene = {"fluid": mpm.Fluid(), "walls": {"left": "x", "right": "x", "bottom": "y"}, "gravity": (0, -9.81)}
    scene |= {"conditions": sides, "pressure": pressure, "initial_stress": mpm.K0(0.5)}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [h, 1])], [soil], **scene)


def series(z: np.ndarray, t: float, before: float = 0.1, after: float = 0.9) -> np.ndarray:
    """Return the exact heads (m) at heights z (m) and time t (s), as a series over roots of `tan(l L) + 2 l = 0`."""
    Z, L, T = ALPHA * z, ALPHA, ALPHA * K * t / 0.35
    low = (np.arange(1, 200) - 0.5) * np.pi / L
    high = np.arange(1, 200) * np.pi / L
    for _ in range(60):  # bisection of sin(lL) + 2 l cos(lL)
        middle = (low + high) / 2
        same = np.sign(np.sin(middle * L) + 2 * middle * np.cos(middle * L)) == np.sign(
            np.sin(low * L) + 2 * low * np.cos(low * L)
        )
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    terms = np.sin(np.outer(Z, low)) * np.sin(low * L) * np.exp(-(low**2) * T) / (1 + L / 2 + 2 * low**2 * L)
    k = after - (after - 1) * np.exp(-Z)
    k -= 4 * (after - before) * np.exp((L - Z) / 2 - T / 4) * terms.sum(axis=1)
    return np.log(k) / ALPHA


def rain(cells: int, dt: float) -> tuple[list, list[float], bool]:
    """Return heights and heads of the cells at the times `HOURS`, the errors, and whether the run converged."""
    soil = mpm.LinearElastic(**STIFF, porosity=0.35, conductivity=K, retention=mpm.Gardner(WEIGHT / ALPHA))
    sides = [mpm.Drained("bottom"), mpm.Rain("top", 0.9 * K)]
    s = column(cells, soil, lambda x: WEIGHT / ALPHA * np.log(0.1 + 0.9 * np.exp(-ALPHA * x[:, 1])), sides)
    found, errors = [], []
    for hour in HOURS:
        s.run(3600 * hour, dt)
        cell = s.cells()
        z, head = cell.x[:, 1], cell.pressure / WEIGHT
        exact = series(z, s.t)
        found.append((z, head))
        errors.append(float(np.abs(head - exact).max() / np.abs(exact).max()))
    return found, errors, s.result.converged


def front(cells: int, dt: float) -> tuple[list, list[float], list[float], bool]:
    """Return depths and heads at 6 and 12 h, errors of front and water, and whether the run converged."""
    s = column(cells, **DRY)
    start = s.cells().water.sum()
    found, places, waters = [], [], []
    for hour, (depth, water) in FRONT.items():
        s.run(3600 * hour, dt)
        cell = s.cells()
        z, head = 1 - cell.x[::-1, 1], cell.pressure[::-1] / WEIGHT
        found.append((z, head))
        places.append(float(np.interp(5.0, -head, z) - depth))
        waters.append(float((cell.water.sum() - start) * cells / water - 1))
    return found, places, waters, s.result.converged


def by_elements(cells: int, dt: float) -> tuple[list[float], list[float]]:
    """Return the errors of the front (m) and the relative errors of the water, for `cells` finite elements."""
    walls, pull = {"left": "x", "right": "x", "bottom": "y"}, lambda t: (0, -9.81)
    scene = {"conditions": DRY["sides"], "pressure": DRY["pressure"], "walls": walls, "gravity": pull}
    size = [0, 0], [1 / cells, 1], [1, cells]
    fem = BiotFEM(mpm.Grid(*size), DRY["soil"], fluid=mpm.Fluid(), element="q1-dg0", **scene)
    start, middles = fem.water(), (np.indices((1, cells)).reshape(2, -1).T + 0.5) / cells
    places, waters = [], []
    for hour, (depth, water) in FRONT.items():
        fem.run(3600 * hour, dt, probes=middles[:1])
        head = fem.pressure(middles)[::-1] / WEIGHT
        places.append(float(np.interp(5.0, -head, 1 - middles[::-1, 1]) - depth))
        waters.append(float((fem.water() - start) * cells / water - 1))
    return places, waters


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=40, help="cells over the height")
    parser.add_argument("--rain-step", type=float, default=600.0, help="step under rain, s")
    parser.add_argument("--front-step", type=float, default=1800.0, help="step of the front, s")
    o = parser.parse_args(argv)
    if o.cells < 5:
        parser.error(f"--cells {o.cells}: must be >= 5")
    with common.results(o) as out:
        heads, rained, first = rain(o.cells, o.rain_step)
        depths, places, waters, second = front(o.cells, o.front_step)
        elements = by_elements(o.cells, o.front_step)
        out |= {"rain": rained, "front_m": places, "water": waters, "converged": first and second}
        out |= dict(zip(("elements_front_m", "elements_water"), elements, strict=True))
        rows = [[f"{hour} h", f"{error:.2%} of the largest head"] for hour, error in zip(HOURS, rained, strict=True)]
        common.table([["rain", "error"], *rows])
        table = [["front", "place, mm", "water", "by elements: place, mm", "water"]]
        for hour, *both in zip(FRONT, places, waters, *elements, strict=True):
            numbers = (f"{value * 1e3:+.1f}" if i % 2 == 0 else f"{value:+.2%}" for i, value in enumerate(both))
            table.append([f"{hour} h", *numbers])
        common.table(table)
        draw(o, heads, depths)
    return out


def draw(o: Namespace, heads: list, depths: list) -> None:
    """Draw heads in rain and at the wetting front, with their references."""
    fig, ((left, right),) = common.figure(1, 2, (11, 4.6))
    z = np.linspace(0, 1, 201)
    for i, (hour, (heights, head)) in enumerate(zip(HOURS, heads, strict=True)):
        left.plot(series(z, 3600 * hour), z, color="black", lw=1, label=None if i else "exact")
        left.plot(head, heights, "o", ms=3, label=f"{hour} h")
    left.set(xlabel="head (m)", ylabel="height above the water table (m)", title="Rain on exponential soil")
    for hour, (depth, head) in zip(FRONT, depths, strict=True):
        (line,) = right.plot(head, depth, "o-", ms=3, lw=1, label=f"{hour} h")
        right.axhline(FRONT[hour][0], color=line.get_color(), lw=0.8, ls="--")
    right.axvline(-5, color="black", lw=0.8, ls=":")
    right.set(xlabel="head (m)", ylabel="depth (m)", title="Front into dry soil; dashed: converged position of −5 m")
    right.set_ylim(0.6, 0)
    for ax in (left, right):
        ax.legend(frameon=False)
    common.save(fig, o.out / "infiltration.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
