# SPDX-License-Identifier: MIT
"""A rigid cylinder is pressed into a saturated gel and stays there; the force relaxes as the gel drains.

The scene is in plane strain, and by symmetry half of the gel is computed, 5 m wide and high. The gel lies on a smooth
base, and drains at its side, far from the cylinder.

* At first no water has flowed, and the gel is incompressible. By Hertz's theory the pressure under the cylinder is

      p = p_0 sqrt(1 - x^2 / a^2),    a = 2 sqrt(F R / (pi E*)),    p_0 = sqrt(F E* / (pi R)),

  at a distance x from the middle, with the half-width a of the contact, the computed force F per length, the radius R
  of the cylinder, and E* = 4 G for the shear modulus G.
* In the end the pore pressure has dissipated. Hertz's theory then holds with `E* = E / (1 - nu^2)` of the drained gel.
  The force must equal the force on a dry gel, which the demo also computes.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

import common
import numpy as np

import mpm_dolfinx as mpm

RADIUS, SIZE = 20.0, 5.0  # m: of the cylinder, and of the gel
E, NU = 1e6, 0.2
GEL = mpm.Hencky(bulk=E / (3 - 6 * NU), shear=E / (2 + 2 * NU), porosity=0.6, conductivity=1e-8)
DEPTH = 0.03  # m
UNDRAINED, DRAINED = 4 * GEL.shear, E / (1 - NU**2)  # Pa: E*
TIME = SIZE**2 * mpm.Fluid().unit_weight / (GEL.conductivity * GEL.oedometric)  # s: time of consolidation
INSTANT = 1e-8  # duration of the first step, divided by TIME
TIMES = np.geomspace(1e-4, 10, 21)  # times at which the force is recorded, divided by TIME


@dataclass
class Contact:
    """State of the contact at one time, with the force in N/m.

    x, p: positions (m) and pressures (Pa) of points at the gel's surface.
    most, half: largest pressure (Pa) and half-width (m) of the ellipse fitted to these pressures.
    """

    force: float
    x: np.ndarray
    p: np.ndarray
    most: float
    half: float

    def errors(self, stiff: float) -> tuple[float, float]:
        """Return the relative errors of half-width and largest pressure. Reference: Hertz's solution for this force.

        stiff: modulus E* of the gel, in Pa.
        """
        half = 2 * np.sqrt(self.force * RADIUS / (np.pi * stiff))
        return self.half / half - 1, self.most / np.sqrt(self.force * stiff / (np.pi * RADIUS)) - 1


def contact(s: mpm.Simulation) -> Contact:
    """Return the present `Contact`, with a linear fit of p^2 against x^2."""
    p, x = s.points.data["ball_pressure"], s.points.x[:, 0]
    on = p > 0
    order = np.argsort(x[on])
    x, p = x[on][order], p[on][order]
    inner = x < 0.8 * x.max()
    slope, square = np.polyfit(x[inner] ** 2, p[inner] ** 2, 1)
    return Contact(-2 * s.tool_forces["ball"][1], x, p, np.sqrt(square), np.sqrt(-square / slope))


def scene(cells: int, wet: bool) -> mpm.Simulation:
    """Return half of the gel under the cylinder, with `cells` cells per metre."""
    n, h = round(SIZE * cells), 1 / cells
    grid = mpm.Grid([0, 0], [SIZE, SIZE + 4 * h], [n, n + 4])
    top = SIZE + 0.3 * h  # the surface is not on a grid line
    at_once = INSTANT * TIME
    shape = mpm.Ball((0, top + RADIUS), RADIUS)
    ball = mpm.Tool(shape, displacement=lambda t: (0, -DEPTH * min(1, t / at_once)), name="ball")
    water = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("right")]} if wet else {}
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [SIZE, top])],
        [GEL],
        walls=walls,
        conditions=[ball, *water.pop("conditions", [])],
        **water,
    )


@dataclass
class Pressed:
    """Results of a run.

    contacts: the initial contact and, in wet gel, also the final contact.
    forces: forces at the start and at `TIMES`, in N/m.
    frame: initial corners, pore pressures, and shape of the cylinder.
    balance: largest error of the fluid balance.
    cuts: number of cut steps.
    """

    contacts: list[Contact]
    forces: list[float]
    frame: tuple[np.ndarray, np.ndarray, np.ndarray]
    balance: float
    cuts: int


def pressed(cells: int, wet: bool) -> Pressed:
    """Press the cylinder into the gel, and let wet gel drain."""
    s = scene(cells, wet)
    tool = s.conditions[0]
    result = s.run(INSTANT * TIME, INSTANT * TIME, progress=False)
    out = Pressed([contact(s)], [], (s.points.corners, s.points.pressure, tool.drawn(s.grid, s.t)), 0.0, result.cuts)
    out.forces.append(out.contacts[0].force)
    if wet:
        out.balance = result.balance
        result = s.run(TIME * TIMES[-1], rtol=1e-2, t_eval=TIME * TIMES, progress=False)
        out.forces += [-2 * float(force) for force in result.tool_forces["ball"][1:, 1]]
        out.contacts.append(contact(s))
        out.balance, out.cuts = max(out.balance, result.balance), out.cuts + result.cuts
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=12, help="cells per metre; the contact is about 1.5 m wide")
    o = parser.parse_args(argv)
    if not 4 <= o.cells <= 64:
        parser.error(f"--cells {o.cells}: must be 4 to 64")
    with common.results(o) as out:
        coarse, wet, dry = pressed(o.cells // 2, True), pressed(o.cells, True), pressed(o.cells, False)
        at_once, end = wet.contacts[0], dry.contacts[0]
        force, rough = np.array(wet.forces), np.array(coarse.forces)
        errors = dict(zip(["half, at once", "pressure, at once"], at_once.errors(UNDRAINED), strict=True))
        errors |= dict(zip(["half, drained", "pressure, drained"], end.errors(DRAINED), strict=True))
        errors["force in the end, beside a dry gel"] = force[-1] / end.force - 1
        errors["force at any time, beside half as many cells"] = np.abs(rough - force).max() / force[0]
        common.table([["quantity", "error"], *([name, f"{error:+.2%}"] for name, error in errors.items())])
        out |= {"errors": errors, "balance": wet.balance, "force": wet.forces, "cuts": wet.cuts}
        print(f"force: initial {force[0]:.0f}, drained {force[-1]:.0f} N/m; fluid balance {out['balance']:.0e}")
        draw(o, wet, (at_once, end))
        # with few cells the half-width is too coarse for a check
        worst = max(abs(error) for name, error in errors.items() if not name.startswith("half"))
        out["converged"] = bool(worst < 0.03 and out["balance"] < 1e-8)
    return out


def draw(o: Namespace, wet: Pressed, contacts: tuple[Contact, Contact]) -> None:
    """Draw pore pressures, contact pressures with Hertz's solution, and the force against time."""
    fig, ((left, middle, right),) = common.figure(1, 3, (13, 4))
    corners, p, tool = wet.frame
    domains = common.domains(left, corners, p / 1e3, cmap="viridis")
    common.domains(left, tool, facecolor="0.8", edgecolor="0.8")
    fig.colorbar(domains, ax=left, label="pore pressure (kPa)", shrink=0.8)
    left.set(
        aspect="equal",
        xlim=(0, SIZE),
        ylim=(0, SIZE + 0.25),
        title="Just after the indentation",
        xlabel="x (m)",
        ylabel="y (m)",
    )
    named = zip(("undrained", "drained"), contacts, (UNDRAINED, DRAINED), strict=True)
    for k, (name, seen, stiff) in enumerate(named):
        half = 2 * np.sqrt(seen.force * RADIUS / (np.pi * stiff))
        most = np.sqrt(seen.force * stiff / (np.pi * RADIUS))
        x = np.linspace(0, half, 200)
        middle.plot(x, most * np.sqrt(1 - (x / half) ** 2) / 1e3, color=f"C{k}", lw=1, label=f"Hertz, {name}")
        middle.plot(seen.x, seen.p / 1e3, "o", color=f"C{k}", mfc="none", ms=4, label=name)
    middle.set(title="Contact pressure", xlabel="x (m)", ylabel="contact pressure (kPa)")
    right.semilogx(TIMES, np.array(wet.forces[1:]) / 1e3, "o-", ms=3, label="wet gel")
    right.axhline(contacts[1].force / 1e3, color="C1", ls="--", label="dry gel")
    right.set(title="Force on the cylinder", xlabel="t c_v / (5 m)² (-)", ylabel="force (kN/m)", ylim=(0, None))
    for ax in (middle, right):
        ax.legend(fontsize=9)
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "indentation.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
