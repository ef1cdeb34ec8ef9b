# SPDX-License-Identifier: MIT
"""Liakopoulos's column: saturated sand drains at its foot under gravity, and settles under suction.

The pressure in a column of 1 m is initially zero, as in uniform downward flow. Then no more water enters at the top,
and the column drains at its foot. The retention curve is user-defined. The effective stress is the total stress plus
the product of saturation and pore pressure. The scene follows Liakopoulos (1965), with the constants of Lewis and
Schrefler (1998). The reference is a converged small-strain solution with 400 finite volumes.

Three errors are given after 5, 10, 30 and 120 minutes. The first is the largest error of the pressure at five heights,
divided by the suction at the highest of these heights. The second and the third are the relative errors of the
settlement and of the outflow at the foot. The demo runs on one process.
"""

from __future__ import annotations

from argparse import Namespace

import common
import numpy as np
import ufl

import mpm_dolfinx as mpm

WEIGHT, E, NU = 9810.0, 1.3e6, 0.4  # N/m³, Pa, -
HEIGHTS = (0.1, 0.25, 0.5, 0.75, 0.9)  # m
CONVERGED = {
    5: ((-233.53, -596.34, -1306.2, -2345.0, -3294.2), 0.54974e-3, 3.36719e-6),
    10: ((-376.79, -949.79, -1982.1, -3283.3, -4335.7), 0.77114e-3, 2.72085e-6),
    30: ((-631.67, -1582.23, -3205.4, -4983.1, -6211.2), 1.15932e-3, 1.57255e-6),
    120: ((-906.99, -2267.84, -4542.4, -6847.5, -8264.9), 1.55827e-3, 3.33066e-7),
}
"""At each time (min): pressures at the five heights (Pa), settlement (m) and outflow at the foot (m/s)."""


class Sand:
    """Del Monte sand."""

    def saturation(self, p):
        """Return the saturation (UFL) at the pore pressure p, in Pa."""
        return ufl.max_value(1 - 1.9722e-11 * ufl.max_value(-p, 0.0) ** 2.4279, 0.2)

    def relative_permeability(self, p):
        """Return the relative permeability (UFL) at the pore pressure p, in Pa."""
        return ufl.max_value(1 - 2.207 * ufl.max_value(1 - self.saturation(p), 1e-30) ** 1.0121, 0.0)


def column(cells: int) -> mpm.Simulation:
    """Return the column, with `cells` cells over its height."""
    h = 1 / cells
    grid = mpm.Grid([0, 0], [h, 1 + 2 * h], [1, cells + 2])
    moduli = {"bulk": E / 3 / (1 - 2 * NU), "shear": E / 2 / (1 + NU)}
    soil = mpm.LinearElastic(**moduli, porosity=0.2975, conductivity=4.5e-10 * WEIGHT, retention=Sand())
    scene = {"fluid": mpm.Fluid(bulk=2e9), "walls": {"left": "x", "right": "x", "bottom": "y"}}
    scene |= {"conditions": [mpm.Drained("bottom")], "gravity": (0, -9.81), "initial_stress": mpm.K0(NU / (1 - NU))}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [h, 1])], [soil], **scene)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=40, help="cells over the height")
    parser.add_argument("--step", type=float, default=60.0, help="step, s; after 10 minutes three times as long")
    o = parser.parse_args(argv)
    if o.cells < 5:
        parser.error(f"--cells {o.cells}: must be >= 5")
    with common.results(o) as out:
        s = column(o.cells)
        top = mpm.probes(s.bodies, [[0.5 / o.cells, 1.0]])
        curves, rows, errors = [], [], []
        for minutes, (pressures, settled, flows) in CONVERGED.items():
            result = s.run(60 * minutes, o.step if minutes <= 10 else 3 * o.step, probes=top)
            cell = s.cells()
            curves.append((minutes, cell.pressure, cell.x[:, 1]))
            p = np.interp(HEIGHTS, cell.x[:, 1], cell.pressure)
            found = [
                float(np.abs(p - pressures).max() / -pressures[-1]),
                float(-result.displacement[-1, 0, 1] / settled - 1),
                float(s.outflows.array[0] * o.cells / flows - 1),
            ]
            errors.append(found)
            rows.append([f"{minutes} min", f"{found[0]:.2%}", *(f"{error:+.2%}" for error in found[1:])])
        pressure, settlement, flow = (list(column) for column in zip(*errors, strict=True))
        out |= {"pressure": pressure, "settlement": settlement, "outflow": flow, "converged": result.converged}
        common.table([["error", "pressure", "settlement", "outflow"], *rows])
        draw(o, curves, settlement)
    return out


def draw(o: Namespace, curves: list, settlement: list[float]) -> None:
    """Draw pressures against height and settlements against time."""
    fig, ((left, right),) = common.figure(1, 2, (11, 4.6))
    for i, (minutes, p, z) in enumerate(curves):
        left.plot(p / 1e3, z, color=f"C{i}", lw=1.2, label=f"{minutes} min")
        left.plot(np.array(CONVERGED[minutes][0]) / 1e3, HEIGHTS, "o", ms=4, color=f"C{i}")
    left.set(xlabel="pore pressure (kPa)", ylabel="height (m)", title="Pore pressure; dots: converged")
    left.legend()
    minutes = np.array(list(CONVERGED))
    exact = 1e3 * np.array([values[1] for values in CONVERGED.values()])
    right.plot(minutes, exact * (1 + np.array(settlement)), "x-", lw=1, label="material points")
    right.plot(minutes, exact, "o", ms=4, mfc="none", color="black", label="converged")
    right.set(xlabel="time (min)", ylabel="settlement (mm)", xscale="log", title="Settlement of the top")
    right.invert_yaxis()
    right.legend()
    for ax in (left, right):
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "drainage.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
