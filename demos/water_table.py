# SPDX-License-Identifier: MIT
"""Water tables in unsaturated soil: in a slab under rain (Vauclin), and in a levee during a flood.

A slab of sand, 6 m wide and 2 m high, stands on an impervious base between ditches. By symmetry half of the slab is
computed. Rain falls on the middle metre of the slab for eight hours. Above the water table, water spreads through
unsaturated soil. Scene and soil laws follow Vauclin, Khanji and Vachaud (1979). The reference is a converged solution
of finite volumes, with cells of 1.25 cm. The side above the level of the ditch is a seepage face.

The second scene is a levee of 3 m with slopes of 1:2 on an impervious base. The water level rises by 2.5 m in two days,
is constant for two days, and falls again in two days. The soil of the levee retains water under suction, so water that
infiltrates late also drains late.

Errors after 2, 3, 4 and 8 hours are the largest errors of the height of the water table at six positions, in m. Another
error is the relative error of the final outflow into the ditch. `balance` is the error of the slab's water balance,
divided by the volume of rain. The demo runs on one process.
"""

from __future__ import annotations

from argparse import Namespace

import common
import numpy as np
import ufl

import mpm_dolfinx as mpm

WEIGHT = 9810.0  # N/m³
HOUR, DAY = 3600.0, 86400.0  # s
WIDTH, HEIGHT, DITCH, RAINED = 3.0, 2.0, 0.65, 0.5  # m
RAIN = 0.148 / HOUR  # m/s
PLACES = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)  # m from the middle
CONVERGED = {
    2: (0.8027, 0.7538, 0.7003, 0.6763, 0.6636, 0.6559),
    3: (1.0041, 0.9469, 0.8491, 0.7804, 0.7308, 0.6906),
    4: (1.1005, 1.0426, 0.9378, 0.8528, 0.7834, 0.7210),
    8: (1.2187, 1.1601, 1.0531, 0.9557, 0.8642, 0.7720),
}
"""For each time (h): heights of the water table at the six positions, in m."""
FLOW = 653.1e-4 / HOUR  # m²/s into the ditch after 8 hours
LEVEE, CREST, SLOPE, FLOOD = 3.0, 2.0, 2.0, 2.5  # m, m, slope: run divided by rise, m
SEEN = (2.0, 4.0, 6.0, 8.0)  # days


class Sand:
    """River sand of Vauclin, Khanji and Vachaud."""

    def saturation(self, p):
        """Return the saturation (UFL) at the pore pressure p, in Pa."""
        return 4e4 / (4e4 + ufl.max_value(-100 * p / WEIGHT, 1e-12) ** 2.90)

    def relative_permeability(self, p):
        """Return the relative permeability (UFL) at the pore pressure p, in Pa."""
        return 2.99e6 / (2.99e6 + ufl.max_value(-100 * p / WEIGHT, 1e-12) ** 5.0)


def slab(h: float) -> mpm.Simulation:
    """Return half of the slab at rest, on cells of size h, in m."""
    grid = mpm.Grid([0, 0], [WIDTH, HEIGHT + 2 * h], [round(WIDTH / h), round(HEIGHT / h) + 2])
    soil = mpm.LinearElastic(bulk=1e10, shear=5e9, porosity=0.3, conductivity=0.35 / HOUR, retention=Sand())
    beside = ((WIDTH - 0.1, -1), (WIDTH + 0.1, DITCH))
    return mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [WIDTH, HEIGHT])],
        [soil],
        fluid=mpm.Fluid(),
        gravity=(0, -9.81),
        walls={"left": "x", "right": "x", "bottom": "y"},
        conditions=[
            mpm.Rain("top", RAIN, region=((-1, HEIGHT - 0.1), (RAINED, HEIGHT + 0.1)), name="rain"),
            mpm.Drained("right", lambda x: WEIGHT * (DITCH - x[:, 1]), region=beside, name="ditch"),
        ],
        pressure=mpm.hydrostatic(DITCH),
        initial_stress=mpm.K0(0.5),
    )


def tables(s: mpm.Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and heights of the water table in each column of cells, in m."""
    cell = s.cells()
    columns = np.unique(np.round(cell.x[:, 0], 6))
    heights = []
    for x in columns:
        of = np.flatnonzero(np.abs(cell.x[:, 0] - x) < 1e-5)
        of = of[np.argsort(cell.x[of, 1])]
        heights.append(np.interp(0.0, -cell.pressure[of], cell.x[of, 1]))
    return columns, np.array(heights)


def level(t: float) -> float:
    """Return the water level of the flood at the time t, in m."""
    return float(np.interp(t / DAY, [0, 2, 4, 6], [0, FLOOD, FLOOD, 0]))


def levee(h: float) -> mpm.Simulation:
    """Return the levee with hydrostatic water and the water table at its base."""
    base = CREST + 2 * SLOPE * LEVEE
    grid = mpm.Grid([0, 0], [base, LEVEE + 2 * h], [round(base / h), round(LEVEE / h) + 2])
    corners = [(0, 0), (base, 0), (base - SLOPE * LEVEE, LEVEE), (SLOPE * LEVEE, LEVEE)]
    body = mpm.polygon(grid, corners, ["bottom", "land", "top", "river"])
    law = {"conductivity": 2e-6, "retention": mpm.VanGenuchten(WEIGHT / 1.5, residual=0.15, n=2.0)}
    return mpm.Simulation(
        grid,
        [body],
        [mpm.Hencky(bulk=2e7, shear=1e7, porosity=0.4, **law)],
        fluid=mpm.Fluid(),
        gravity=(0, -9.81),
        walls={"bottom": "xy"},
        conditions=[*mpm.water("river", level), mpm.Drained("land", seepage=True)],
        pressure=mpm.hydrostatic(0.0),
        initial_stress=mpm.K0(0.5),
    )


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--h", type=float, default=0.1, help="cell size of the slab, m; cell size of the levee: 2.5 h")
    parser.add_argument("--step", type=float, default=600.0, help="step of the slab, s; of the levee: 9 times as long")
    o = parser.parse_args(argv)
    if not 0.025 <= o.h <= 0.25:
        parser.error(f"--h {o.h:g}: must be in [0.025, 0.25] m")
    with common.results(o) as out:
        s = slab(o.h)
        start = s.cells().water.sum()
        curves = [(0, *tables(s))]
        for hours in CONVERGED:
            s.run(HOUR * hours, o.step)
            curves.append((hours, *tables(s)))
        found = {hours: np.interp(PLACES, x, z) for hours, x, z in curves[1:]}
        errors = [float(np.abs(found[hours] - exact).max()) for hours, exact in CONVERGED.items()]
        flow = float(s.outflows["ditch"] / FLOW - 1)
        fell = RAIN * RAINED * 8 * HOUR
        gained = s.cells().water.sum() - start
        balance = float(abs(gained + s.outcome("flowed")["ditch"] - fell) / fell)
        common.table([["hours", "table, m"], *([f"{h:g}", f"{e:.4f}"] for h, e in zip(CONVERGED, errors, strict=True))])
        print(f"errors: flow into the ditch {flow:+.2%}, water balance {balance:.1e}")
        bank = levee(2.5 * o.h)
        frames = []
        for days in SEEN:
            result = bank.run(DAY * days, 9 * o.step)
            frames.append((days, bank.points.corners, bank.points.pressure))
        out |= {"errors": errors, "flow": flow, "balance": balance}
        out["converged"] = s.result.converged and result.converged
        draw(o, curves, frames)
    return out


def draw(o: Namespace, curves: list, frames: list) -> None:
    """Draw the water tables of the slab, and pressures in the levee."""
    fig, axes = common.figure(1 + len(frames), 1, (8, 10))
    first, *others = np.ravel(axes)
    for i, (hours, x, z) in enumerate(curves):
        first.plot(x, z, lw=1.4, color=f"C{i}", label=f"{hours:g} h")
        if hours:
            first.plot(PLACES, CONVERGED[hours], "o", ms=4, mfc="none", color=f"C{i}")
    first.set(xlabel="x (m)", ylabel="height (m)", title="Water table under rain on x < 0.5 m; circles: converged")
    first.legend(ncols=5, fontsize=8)
    first.grid(alpha=0.3)
    for ax, (days, corners, pressure) in zip(others, frames, strict=True):
        patches = common.domains(ax, corners, pressure / 1e3, clim=(-20, 20), cmap="RdBu")
        ax.axhline(level(days * DAY), color="C0", lw=1)
        ax.set(title=f"Levee, day {days:g}", xlim=(0, corners[:, :, 0].max()), ylim=(0, LEVEE + 0.2))
    fig.colorbar(patches, ax=others, label="pore pressure (kPa)", shrink=0.8)
    common.save(fig, o.out / "water_table.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
