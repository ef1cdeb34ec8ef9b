# SPDX-License-Identifier: MIT
"""A slope at rest loses strength, slides and comes to rest: speed, energies, and run-out with and without inertia.

A slope of 2:1, H = 10 m high, stands on a layer of 5 m. Slope and layer are Mohr-Coulomb soil, with the friction angle
phi = 20 degrees and the cohesion c = 0.05 gamma H (unit weight gamma). The slope settles under its weight without
inertia. The factor of safety of the slope is 1.4. Then the strength of the soil is suddenly divided by 1.6.

With inertia the slope accelerates until its shape is stable, and then moves on until friction stops it. Without
inertia, as in the demo `slope`, a viscous stress controls the motion. The slope then stops at the first stable shape,
so the run-out is shorter than with inertia. Friction dissipates the work of gravity that is not stored elastically.
"""

from __future__ import annotations

from argparse import Namespace

import common
import numpy as np
import slope as still

import mpm_dolfinx as mpm

GRAVITY = 9.81  # m/s²
LASTS, REST = 7.0, 0.05  # s; m/s: below this speed the slope counts as at rest
BALANCE = 0.01  # allowed error of the energy balance, relative to the work of the weight


def slope(cells: int) -> mpm.Simulation:
    """Return the slope at rest, with `cells` cells over its height."""
    grid, bodies = still.shape(cells)
    soil = mpm.MohrCoulomb(
        bulk=still.YOUNG / (3 - 6 * still.POISSON),
        shear=still.YOUNG / (2 + 2 * still.POISSON),
        friction=lambda X: np.full(len(X), still.FRICTION),
        dilation=0.0,
        cohesion=lambda X: np.full(len(X), still.COHESION),
        porosity=0.4,
        grain_density=still.WEIGHT / GRAVITY / 0.6,
    )
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, bodies, [soil], walls=walls, gravity=(0, -GRAVITY), inertia=False)
    s.run(1.0, 1.0, progress=False)
    s.stage(reset_displacement=True)
    s.t = 0.0
    return s


def slide(s: mpm.Simulation, dt: float) -> tuple[mpm.Result, np.ndarray]:
    """Divide the strength by `still.WEAKER`, let the slope slide, and return result and largest speeds (m/s)."""
    friction = np.degrees(np.arctan(np.tan(np.radians(still.FRICTION)) / still.WEAKER))
    s.stage(inertia=True, fields={"friction": friction, "cohesion": still.COHESION / still.WEAKER})
    speeds = [0.0]

    def look(s: mpm.Simulation) -> None:
        speeds.append(float(np.linalg.norm(s.points.velocity, axis=1).max()))

    return s.run(LASTS, dt, energies=True, observe=look, progress=False), np.array(speeds)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=10, help="cells over the slope's height, even")
    parser.add_argument("--dt", type=float, default=0.05, help="step of the slide, s")
    o = parser.parse_args(argv)
    if o.cells < 2 or o.cells % 2 or not 0.01 <= o.dt <= 0.2:
        parser.error(f"--cells {o.cells}: must be even and >= 2; --dt {o.dt:g}: must be in [0.01, 0.2]")
    with common.results(o) as out:
        s, other = slope(o.cells), still.slope(o.cells)
        before = s.points.corners.copy()
        result, speed = slide(s, o.dt)
        start = other.points.corners.copy()
        still.slide(other, 40)
        moved, crept = (
            np.linalg.norm((after - first).mean(axis=1), axis=1)
            for after, first in ((s.points.corners, before), (other.points.corners, start))
        )
        e = result.energies
        out |= {"moved": float(moved.max()), "without": float(crept.max()), "speed": float(speed.max())}
        out |= {"energy": common.unbalanced(e) / float(e["external"][-1]), "last_speed": float(speed[-1])}
        with_inertia = f"{out['moved']:.2f} m at up to {out['speed']:.2f} m/s"
        print(f"largest displacement: with inertia {with_inertia}, without {out['without']:.2f} m")
        print(f"error of the energy balance: {out['energy']:.2%} of the work of the weight")
        bounds = out["energy"] <= BALANCE and out["last_speed"] < REST and out["moved"] > out["without"]
        out["converged"] = bounds or (o.cells, o.dt) != (10, 0.05)
        draw(o, result, speed, s.points.corners, moved, before)
    return out


def draw(
    o: Namespace, result: mpm.Result, speed: np.ndarray, corners: np.ndarray, moved: np.ndarray, before: np.ndarray
) -> None:
    """Draw the slope before and after its slide, the speed and the energies."""
    fig, ((after, moves, energy),) = common.figure(1, 3, (15, 3.8))
    quads = common.domains(after, corners, moved, cmap="viridis", linewidth=0.1)
    common.domains(after, before, facecolor="none", edgecolors="grey", linewidth=0.1, alpha=0.5)
    fig.colorbar(quads, ax=after, label="displacement (m)", shrink=0.7)
    after.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="After the slide; grey: before")
    after.autoscale_view()
    moves.plot(result.t, speed, lw=1)
    moves.set(xlabel="time (s)", ylabel="largest speed (m/s)", title="Speed", ylim=(0, None))
    e = result.energies
    energy.plot(result.t, e["external"] / 1e6, color="black", lw=1, label="work of gravity")
    energy.plot(result.t, (e["dissipated"] + e["kinetic"]) / 1e6, lw=1, label="dissipated + kinetic")
    energy.plot(result.t, e["dissipated"] / 1e6, lw=1, label="dissipated by friction")
    energy.plot(result.t, 10 * e["kinetic"] / 1e6, lw=1, label="kinetic × 10")
    energy.set(xlabel="time (s)", ylabel="energy (MJ/m)", title="Energies")
    energy.legend(fontsize=8)
    for ax in (moves, energy):
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "landslide.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
