# SPDX-License-Identifier: MIT
"""Vibration of a beam and of a bar: frequencies and energy loss against exact values.

1. A clamped beam, 1 m x 0.3 m, in plane strain, receives a small transverse and a small axial impulse. The reference of
   the first bending frequency is 3.24419 Hz, computed with spectral elements that are graded towards the corners of the
   clamp. The first axial frequency is exactly c / (4 L) = 17.67767 Hz, with the axial wave velocity c and the length L.
   The computed frequencies are fitted to the motion of the tip over three periods.
2. A free bar of length L has the law `P = E (F - 1)`, with the first Piola-Kirchhoff stress P. The bar vibrates with
   strains of A = 5 % and moves over fifty cells in 25 periods. In the exact solution the ends oscillate about the
   uniform motion by `(A L / pi) sin(pi c t / L)`, without loss of energy. In each step dt, SDIRK2 loses the fraction
   `gamma^4 y^4 / (1 + gamma^2 y^2)^2` of the energy. Here y is omega dt, with the angular frequency omega, and gamma is
   the coefficient of SDIRK2. The remaining loss is due to grid resets.
"""

from __future__ import annotations

from argparse import Namespace

import common
import numpy as np
from scipy.optimize import curve_fit

import mpm_dolfinx as mpm
from mpm_dolfinx.base.time_integration import GAMMA

LENGTH, DEPTH = 1.0, 0.3  # m, of the beam
BEAM = mpm.LinearElastic(bulk=1e7 / 3, shear=5e6, grain_density=4000.0, porosity=0.5)  # nu = 0, 2000 kg/m³
EXACT = {"across": 3.2441904, "along": 17.6776695}  # Hz
AMPLITUDE = 0.05  # velocity of the bar, divided by its wave velocity
LOST = 0.02  # allowed energy loss of the bar in 25 periods of 40 steps


class Bar(mpm.LinearElastic):
    """Law with `P = E (F - 1)` along each axis, so that waves of any amplitude keep their shape."""

    @staticmethod
    def energy(F, bulk, shear):
        """Return the energy (UFL), in Pa."""
        return shear * ((F[0, 0] - 1) ** 2 + (F[1, 1] - 1) ** 2 + F[0, 1] ** 2 + F[1, 0] ** 2)


def struck(h: float, way: str, steps: int = 80) -> tuple[np.ndarray, np.ndarray, float]:
    """Return times (s), displacements of the tip (m), and the frequency (Hz) of a beam after an impulse."""
    grid = mpm.Grid([0, 0], [LENGTH + 3 * h, DEPTH + 4 * h], [round(LENGTH / h) + 3, round(DEPTH / h) + 4])
    beam, axis = mpm.box(grid, [0, 2 * h], [LENGTH, DEPTH + 2 * h]), ("along", "across").index(way)

    def velocity(x: np.ndarray) -> np.ndarray:
        shape = x[:, 0] ** 2 if axis else np.sin(np.pi * x[:, 0] / (2 * LENGTH))
        return 1e-3 * shape[:, None] * np.eye(2)[axis]

    s = mpm.Simulation(grid, [beam], [BEAM], walls={"left": "xy"}, inertia=mpm.Moving(velocity))
    period, tip = 1 / EXACT[way], mpm.probes([beam], [[LENGTH, DEPTH / 2 + 2 * h]])
    result = s.run(3 * period, period / steps, probes=tip, progress=False)
    t, u = result.t, result.displacement[:, 0, axis]

    def swing(t: np.ndarray, a: float, b: float, f: float) -> np.ndarray:
        return a * np.sin(2 * np.pi * f * t) + b * np.cos(2 * np.pi * f * t)

    (_, _, f), _ = curve_fit(swing, t, u, [u.max(), 0.0, EXACT[way]])
    return t, u, float(f)


def flown(cells: int, periods: int, steps: int) -> dict[str, np.ndarray]:
    """Move the free bar. Return times (in periods), the oscillation of its end (m), and its energy, divided by the
    initial energy.
    """
    h, count = 1 / cells, 3 * cells + 8 + round(2.5 * cells)
    grid = mpm.Grid([0, 0], [count * h, h], [count, 1])
    low, speed = 2.3 * h, 2.5 / (2 * periods)  # over 2.5 lengths
    body = mpm.box(grid, [low, 0], [low + 1, h])
    law = Bar(bulk=1 / 3, shear=0.5, grain_density=2.0, porosity=0.5)  # c = 1 m/s

    def velocity(x: np.ndarray) -> np.ndarray:
        return np.stack([speed + AMPLITUDE * np.cos(np.pi * (x[:, 0] - low)), 0 * x[:, 1]], axis=1)

    walls = {"bottom": "y", "top": "y"}
    s = mpm.Simulation(grid, [body], [law], walls=walls, inertia=mpm.Moving(velocity))
    end = mpm.probes([body], [[low, h / 2]])
    result = s.run(2.0 * periods, 2.0 / steps, probes=end, energies=True, progress=False)
    t, e = result.t, result.energies
    energy = e["kinetic"] + e["elastic"] - speed**2 * h / 2
    swing = result.displacement[:, 0, 0] - speed * t
    return {"t": t / 2, "swing": swing, "energy": energy / energy[0]}


def own_loss(t: np.ndarray, steps: int) -> np.ndarray:
    """Return the fraction of the energy that SDIRK2 retains after t periods, with `steps` steps in a period."""
    y = (GAMMA * 2 * np.pi / steps) ** 2
    return (1 - (y / (1 + y)) ** 2) ** (t * steps)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument(
        "--h", type=float, nargs="+", default=[0.1, 0.05], help="cell sizes of the beam, m; 0.3 / h must be an integer"
    )
    parser.add_argument("--cells", type=int, default=20, help="cells over the bar")
    parser.add_argument("--periods", type=int, default=25, help="periods of the moving bar")
    parser.add_argument("--steps", type=int, default=40, help="steps in a period of the bar")
    o = parser.parse_args(argv)
    if min(o.cells, o.periods) < 1 or o.steps < 8 or any(abs(DEPTH / h % 1 - 0.5) < 0.49 or h > 0.1 for h in o.h):
        options = f"--h {o.h}: 0.3 m / h must be an integer, h <= 0.1 m; --cells {o.cells}, --periods {o.periods}"
        parser.error(f"{options}: must be >= 1; --steps {o.steps}: must be >= 8")
    with common.results(o) as out:
        beams = {(way, h): struck(h, way) for h in o.h for way in EXACT}
        out["frequency_errors"] = {way: [beams[way, h][2] / EXACT[way] - 1 for h in o.h] for way in EXACT}
        rows = [[f"{h:g} m", *(f"{beams[way, h][2] / EXACT[way] - 1:+.3%}" for way in EXACT)] for h in o.h]
        common.table([["cells", *EXACT], *rows])
        bar = flown(o.cells, o.periods, o.steps)
        own = own_loss(bar["t"], o.steps)
        out["energy_lost"], out["own_loss"] = float(1 - bar["energy"][-1]), float(1 - own[-1])
        lost = f"{out['energy_lost']:.2%} of its energy is lost, SDIRK2's own {out['own_loss']:.2%}"
        print(f"bar after {o.periods} periods: {lost}")
        draw(o, beams, bar, own)
        usual = (o.cells, o.periods, o.steps) == (20, 25, 40)
        out["converged"] = not usual or out["energy_lost"] < LOST
    return out


def draw(o: Namespace, beams: dict, bar: dict[str, np.ndarray], own: np.ndarray) -> None:
    """Draw the tip of the beam, the end of the bar and its energy, with the exact curves."""
    fig, ((tip, end, left),) = common.figure(1, 3, (14, 4.2))
    for k, h in enumerate(o.h):
        t, u, f = beams["across", h]
        label = f"h = {h:g} m: {f / EXACT['across'] - 1:+.2%}"
        tip.plot(
            t * EXACT["across"], u / np.abs(u).max(), "o", ms=3, mfc="none" if k else None, color=f"C{k}", label=label
        )
    t = np.linspace(0, 3, 400)
    tip.plot(t, np.sin(2 * np.pi * t), color="black", lw=1, label="sine of the exact frequency", zorder=0)
    tip.set(
        xlabel="time / exact period",
        ylabel="deflection of the tip / its largest",
        title="Beam after a transverse impulse",
    )
    last = bar["t"] > o.periods - min(3, o.periods)
    fine = np.linspace(bar["t"][last][0], o.periods, 400)
    end.plot(fine, AMPLITUDE / np.pi * np.sin(2 * np.pi * fine), color="black", lw=1, label="exact")
    end.plot(bar["t"][last], bar["swing"][last], "o", ms=3, label="material points")
    end.set(
        xlabel="time / period",
        ylabel="swing of the end / length",
        title=f"Bar in flight, {o.cells} cells: last periods",
    )
    left.plot(bar["t"], 100 * bar["energy"], lw=1, label="material points")
    left.plot(bar["t"], 100 * own, color="black", lw=1, label="SDIRK2 without resets of the grid")
    left.set(xlabel="time / period", ylabel="energy (% of the first)", title=f"Energy, {o.steps} steps a period")
    for ax in (tip, end, left):
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    tip.set(xlim=(0, 3), ylim=(-1.15, 1.75))
    end.set_ylim(-0.019, 0.026)
    common.save(fig, o.out / "vibration.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
