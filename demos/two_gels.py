# SPDX-License-Identifier: MIT
"""Two gels are pressed together, slide along each other with friction, and separate.

Each of two half-discs is a group of bodies with its own displacements. The lower gel is fixed, and the upper gel
follows a prescribed path. While the gels are apart, no force acts between them, however narrow the gap is. As the upper
gel passes over the top of the lower gel, the contact surface inclines. The ratio of horizontal to vertical force is
then less than the friction coefficient.

A second scene is the contact of a curved and a flat elastic body. Largest pressure and half-width are compared with
Hertz's solution for the computed force.
"""

from __future__ import annotations

from pathlib import Path

import common
import numpy as np

import mpm_dolfinx as mpm

FRICTION, RADIUS, GAP = 0.3, 1.0, 0.05
GEL = mpm.Hencky(bulk=8e4, shear=4e4)
DOWN, ALONG, UP = 0.12, 0.4, 0.3  # m
TIMES = (1.0, 2.0, 3.0)  # s: pressed, slid, lifted
SHOWN = (0.0, 1.0, 2.0, 3.0)


def half_disc(grid: mpm.Grid, centre: tuple[float, float], up: float):
    """Return a half-disc with this centre of its flat side, in m; its round side faces up (1) or down (-1)."""
    flat = mpm.box(grid, [centre[0] - RADIUS, min(centre[1], centre[1] + up)], np.add(centre, [RADIUS, max(up, 0)]))
    return mpm.mapped(grid, flat, lambda x: centre + _round((x - centre) / RADIUS) * RADIUS)


def _round(x: np.ndarray) -> np.ndarray:
    return x * np.sqrt(1 - x[:, ::-1] ** 2 / 2)


def path(t: float) -> tuple[float, float]:
    """Return the displacement (x, y) of the upper gel, in m."""
    down = -DOWN * min(t / TIMES[0], 1) - GAP * min(t / TIMES[0], 1)
    along = ALONG * np.clip((t - TIMES[0]) / (TIMES[1] - TIMES[0]), 0, 1)
    return along, down + UP * np.clip((t - TIMES[1]) / (TIMES[2] - TIMES[1]), 0, 1)


def scene(cells: int) -> mpm.Simulation:
    """Return the two gels, with `cells` cells over a radius."""
    grid = mpm.Grid([0, 0], [4.5, 2.25], [round(4.5 * cells), round(2.25 * cells)])
    low, high = (1.5, 0.0), (1.5, 2 * RADIUS + GAP)
    bodies = [half_disc(grid, low, 1.0), half_disc(grid, high, -1.0)]
    above = ([0, high[1]], [4.5, 2.25])
    return mpm.Simulation(
        grid,
        bodies,
        [GEL],
        walls={"bottom": "xy"},
        conditions=[mpm.Displacement("top", lambda t, X: path(t), region=above), mpm.Contact(1, 0, friction=FRICTION)],
    )


def hertz(cells: int) -> dict[str, float]:
    """Return the number of cells over the half-width, and the relative errors of largest pressure and half-width."""
    E, nu, R, L = 1e6, 0.3, 20.0, 4.0
    stiff, top, n = E / (1 - nu**2) / 2, L + 0.3 / cells, [round(L * cells), round((2 * L + 2) * cells)]
    grid = mpm.Grid([0, 0], [L, 2 * L + 2], n)

    def bend(x: np.ndarray) -> np.ndarray:
        return x + np.column_stack([0 * x[:, 0], (1 - (x[:, 1] - top) / L) * x[:, 0] ** 2 / (2 * R)])

    bodies = [mpm.box(grid, [0, 0], [L, top]), mpm.mapped(grid, mpm.box(grid, [0, top], [L, top + L]), bend)]
    held = mpm.Displacement("top", lambda t, X: (0, -0.041 * t), components="y", region=([0, top + L / 2], [L, 10]))
    soil = mpm.Hencky(bulk=E / (3 - 6 * nu), shear=E / (2 + 2 * nu))
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, bodies, [soil], walls=walls, conditions=[held, mpm.Contact(0, 1)])
    s.run(1.0, 1.0, progress=False)
    force = 2 * abs(s.tool_forces["contact"][1])
    half, most = 2 * np.sqrt(force * R / (np.pi * stiff)), np.sqrt(force * stiff / (np.pi * R))
    p, x = s.points.data["contact_pressure"], s.points.x[:, 0]
    on = (p > 0) & (x < 0.8 * half)
    slope, square = np.polyfit(x[on] ** 2, p[on] ** 2, 1)
    off = {"pressure": np.sqrt(square) / most - 1, "half_width": np.sqrt(-square / slope) / half - 1}
    return {"cells": float(half * cells), **{name: float(value) for name, value in off.items()}}


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=10, help="cells over the radius of a gel")
    parser.add_argument("--hertz", type=int, default=18, help="cells per metre of the elastic bodies")
    o = parser.parse_args(argv)
    if min(o.cells, o.hertz) < 4:
        parser.error(f"--cells {o.cells} --hertz {o.hertz}: must be >= 4")
    with common.results(o) as out:
        s, shown = scene(o.cells), []

        def see(s: mpm.Simulation) -> None:
            if min(abs(s.t - t) for t in SHOWN) < 1e-6:
                shown.append((s.t, s.points.corners.copy(), -s.effective_stress()[:, 1, 1]))

        see(s)
        result = s.run(TIMES[-1], 0.05, observe=see)
        force = result.tool_forces["contact"][:, :2]
        t = np.array(result.t)
        slides = (t > 1.5) & (t <= 2.0)
        ratio = float(np.abs(force[slides, 0]).sum() / force[slides, 1].sum())
        out |= {"steps": result.steps, "ratio": ratio}
        out |= {"largest": float(force[:, 1].max()), "parted": float(np.abs(force[-1]).max()), "hertz": hertz(o.hertz)}
        print(f"largest force {out['largest']:.4g} N/m; force after separation {out['parted']:.3g} N/m")
        print("Hertz, {cells:.1f} cells: pressure {pressure:+.1%}, half-width {half_width:+.1%}".format(**out["hertz"]))
        draw(o.out, shown, t, force)
        out["converged"] = bool(result.converged and out["parted"] == 0)
    return out


def draw(out: Path, shown: list, t: np.ndarray, force: np.ndarray) -> None:
    """Draw the gels with their stresses, and the forces."""
    fig, axes = common.figure(3, 2, (11, 9))
    most = np.quantile(shown[1][2], 0.998) / 1e3
    for ax, (when, corners, p) in zip(axes.ravel(), shown, strict=False):
        domains = common.domains(ax, corners, p / 1e3, cmap="viridis", clim=(-most / 4, most))
        ax.set(aspect="equal", xlim=(0.3, 4.0), ylim=(0, 2.25), title=f"t = {when:g} s", xlabel="x (m)", ylabel="y (m)")
    fig.colorbar(domains, ax=axes[:2].ravel().tolist(), label="vertical pressure (kPa)", shrink=0.7)
    axes[2, 0].plot(t, force[:, 1] / 1e3, label="up")
    axes[2, 0].plot(t, force[:, 0] / 1e3, label="along")
    axes[2, 0].set(xlabel="time (s)", ylabel="force on the upper gel (kN/m)")
    with np.errstate(invalid="ignore", divide="ignore"):
        axes[2, 1].plot(t, np.where(force[:, 1] > 0, -force[:, 0] / force[:, 1], np.nan), label="gels")
    gap = np.array([(x, 2 * RADIUS + GAP + y) for x, y in map(path, t)])  # between the centres
    rigid = np.tan(np.arctan(FRICTION) - np.arctan2(*gap.T))
    axes[2, 1].plot(
        t, np.where((t > TIMES[0]) & (force[:, 1] > 0), rigid, np.nan), "k--", label="rigid gels that slide"
    )
    axes[2, 1].set(xlabel="time (s)", ylabel="force along / force up (-)")
    axes[2, 1].set_title(f"Friction {FRICTION}, inclination of the contact grows", fontsize=10)
    for ax in axes[2]:
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    common.save(fig, out / "two_gels.png", dpi=90)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
