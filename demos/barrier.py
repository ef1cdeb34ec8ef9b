# SPDX-License-Identifier: MIT
"""A bank of clay loses strength and slides against a rigid barrier: run-out, and force on the barrier.

By symmetry, half of the bank is computed, H = 10 m high and 10 m long. The bank has a vertical side and stands on a
rough floor. The clay is undrained. The strength c of the clay decreases within ten minutes from 0.3 to 0.07 gamma H,
where gamma is the unit weight. The bank is stable while c > 0.26 gamma H. A viscous stress (a term in UFL) limits the
velocity and vanishes at rest. Inertia is neglected. A wall with an adhesion of c / 2 stops the clay.

The final force on the wall is compared with limit analysis (Culmann 1866). After the slide, the shear stress on any
plane is at most c. Consider a plane through the foot of the wall, with inclination theta and length l. The clay between
the plane and the wall is a wedge of weight W. The shear force V on the wall is at most c D / 2, where D is the depth of
the clay at the wall. The equilibrium of the wedge bounds the force F normal to the wall:

    F >= ((W - V) sin(theta) - c l) / cos(theta),        F <= ((W + V) sin(theta) + c l) / cos(theta).

Coulomb's active force is the largest lower bound of all planes. Coulomb's passive force is the smallest upper bound.
The computed force lies between these two forces.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np

import mpm_dolfinx as mpm

HEIGHT, LENGTH = 10.0, 26.0  # m: height of the bank, also its length; length of the floor
WALL, TOP, THICK = 14.25, 8.0, 1.0  # m: position, height and thickness of the barrier
WEIGHT = 20e3  # N/m³
SCALE = WEIGHT * HEIGHT  # Pa
STRONG, WEAK = 0.3 * SCALE, 0.07 * SCALE  # Pa: strength before and after
ADHESION = 0.5 * WEAK  # Pa: of the barrier
DURATION = 600.0  # s: time in which the strength decreases
VISCOSITY = 0.01 * SCALE * DURATION  # Pa s
SHEAR = 30 * SCALE
ANGLES = np.radians(np.linspace(20, 85, 261))  # angles of the planes of wedges


def bank(cells: int, barrier: bool) -> mpm.Simulation:
    """Return the bank in equilibrium at t = 0, with `cells` cells over its height."""
    h = HEIGHT / cells
    grid = mpm.Grid([0, 0], [LENGTH, HEIGHT + h], [round(LENGTH / h), cells + 1])
    clay = mpm.DruckerPrager(
        bulk=50 * SHEAR, shear=SHEAR, friction=0.0, dilation=0.0, cohesion=lambda X: np.full(len(X), STRONG)
    )
    corners = [(x, y) for x in (WALL, WALL + THICK) for y in (-THICK, TOP)]
    tools = [mpm.Tool(mpm.Convex(corners), adhesion=ADHESION, centre=(WALL, 0))] if barrier else []
    body = mpm.box(grid, [0, 0], [HEIGHT, HEIGHT])
    walls = {"left": "x", "bottom": "xy"}
    s = mpm.Simulation(
        grid, [body], [clay], walls=walls, terms=[common.weight(WEIGHT), common.viscous(VISCOSITY)], conditions=tools
    )
    s.run(1e9, 1e9, progress=False)  # time after which viscous stresses are negligible
    s.stage(reset_displacement=True)
    s.t = 0.0
    return s


@dataclass
class Frame:
    """State of the bank at the time t, in s.

    corners (n, 4, 2): corners of the domains, in m.
    moved (n,): magnitudes of the displacements of the points, in m.
    force (3,): normal force and shear force on the barrier (N/m) and moment about the foot of the barrier (N).
    bounds: active and passive force on the barrier, in N/m.
    depth: depth of the clay at the barrier, in m.
    """

    t: float
    corners: np.ndarray
    moved: np.ndarray
    force: np.ndarray
    bounds: tuple[float, float]
    depth: float

    @property
    def run_out(self) -> float:
        """Distance of the toe of the bank from the axis of symmetry, in m."""
        return float(self.corners[:, :, 0].max())


def bounds(s: mpm.Simulation, depth: float) -> tuple[float, float]:
    """Return the active and the passive force on the barrier for the present strength of the clay, in N/m."""
    x, c = s.points.x, s.points.data["cohesion"][0]
    sin, cos, rubs = np.sin(ANGLES), np.cos(ANGLES), ADHESION * depth
    off = x[:, 1, None] * cos - (WALL - x[:, 0, None]) * sin  # (n, planes), m
    W = WEIGHT * s.points.volume0 @ (off > 0)
    near = np.abs(off) < 0.5 * s.grid.h[0]
    length = np.where(near, (WALL - x[:, 0, None]) * cos + x[:, 1, None] * sin, 0.0).max(axis=0)
    ends = WALL * np.tan(ANGLES) > s.points.corners[:, :, 1].max()
    least, most = (((W + way * rubs) * sin + way * c * length) / cos for way in (-1, 1))
    return max(0.0, float(least[ends].max())), float(most[ends].min())


@dataclass
class Slump:
    """Results of a run: the bank after each step, the number of steps, and the number of cut steps."""

    frames: list[Frame] = field(default_factory=list)
    steps: int = 0
    cuts: int = 0


def slump(cells: int, steps: int, barrier: bool) -> Slump:
    """Reduce the strength of the bank in a number of steps, and let the bank come to rest."""
    s, out, dt = bank(cells, barrier), Slump(), DURATION / steps
    start = s.points.x

    def look(s: mpm.Simulation) -> None:
        corners, moved = s.points.corners, np.linalg.norm(s.points.x - start, axis=1)
        force, between, at = np.zeros(3), (0.0, 0.0), corners[np.abs(corners[..., 0] - WALL) < s.grid.h[0] / 2]
        depth = float(at[:, 1].max(initial=0))
        if barrier and s.t > 0:
            force, between = s.tool_forces["tool"] * [-1, -1, 1], bounds(s, depth)
        out.frames.append(Frame(s.t, corners, moved, force, between, depth))

    def weaken(s: mpm.Simulation) -> None:
        """Give the clay the strength that it will have at the end of the next step."""
        s.stage(fields={"cohesion": STRONG + min(1.0, (s.t + dt) / DURATION) * (WEAK - STRONG)})

    def go(t_end: float, dt: float, *observers) -> None:
        result = s.run(t_end, dt, observe=observers, progress=False)
        out.steps, out.cuts = out.steps + result.steps, out.cuts + result.cuts

    look(s)
    weaken(s)
    go(DURATION, dt, look, weaken)
    go(2 * DURATION, dt, look)
    go(20 * DURATION, 20 * dt, look)
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=20, help="cells over the height")
    parser.add_argument("--steps", type=int, default=60, help="steps in which the cohesion is lost")
    o = parser.parse_args(argv)
    if not 5 <= o.cells <= 40 or o.cells % 5 or o.steps < 10:
        parser.error(f"--cells {o.cells}: must be a multiple of 5 from 5 to 40; --steps {o.steps}: must be >= 10")
    with common.results(o) as out:
        free, held = slump(o.cells, o.steps, False), slump(o.cells, o.steps, True)
        before, end = held.frames[-2:]
        F, V, M = end.force
        least, most = end.bounds
        pushes = [f.force[0] for f in held.frames]
        out |= {"run_out": free.frames[-1].run_out, "held": end.run_out, "depth": end.depth, "arm": M / F / end.depth}
        out |= {"force": F, "most": max(pushes), "active": least, "passive": most, "shear": V / (ADHESION * end.depth)}
        out |= {"over_active": F / least, "over_passive": F / most}
        out |= {"creep": abs(F / before.force[0] - 1), "cuts": free.cuts + held.cuts, "steps": free.steps + held.steps}
        report(out)
        draw(o, free, held)
        out["converged"] = bool(least < F < most and out["creep"] < 0.01)
    return out


def report(out: dict) -> None:
    """Print the results."""
    print(f"run-out: {out['run_out']:.2f} m, with the barrier at {WALL:g} m {out['held']:.3f} m")
    print(f"depth of the clay at the barrier: {out['depth']:.2f} m; height of the force / depth: {out['arm']:.3f}")
    kN = {name: out[name] / 1e3 for name in ("force", "most", "active", "passive")}
    print(f"force on the barrier: final {kN['force']:.1f} kN/m, largest {kN['most']:.1f} kN/m; ", end="")
    print(f"Coulomb's forces: active {kN['active']:.1f}, passive {kN['passive']:.0f} kN/m")
    liquid = WEIGHT * out["depth"] ** 2 / 2
    change = f"relative change in the last step: {out['creep']:.0e}"
    print(f"final force / force of a liquid of the same depth: {out['force'] / liquid:.2f}; {change}")


def draw(o: Namespace, free: Slump, held: Slump) -> None:
    """Draw the bank with and without barrier, and the force against time."""
    fig, axes = common.figure(2, 2, (13, 6.6))
    meets = next(k for k, f in enumerate(held.frames) if f.force[0] > 0)
    shown = [
        (axes[0, 0], held.frames[meets], f"First contact after {held.frames[meets].t / 60:.1f} minutes"),
        (axes[0, 1], held.frames[-1], "At rest against the barrier"),
        (axes[1, 0], free.frames[-1], "At rest without a barrier"),
    ]
    top = max(f.moved.max() for _, f, _ in shown)
    for ax, frame, title in shown:
        drawn = common.domains(ax, frame.corners, frame.moved, cmap="viridis", clim=(0, top), linewidth=0.1)
        ax.plot([0, HEIGHT, HEIGHT], [HEIGHT, HEIGHT, 0], color="grey", lw=0.8, ls=":", label="before")
        ax.legend(fontsize=9, loc="upper right")
        if frame is not free.frames[-1]:
            ax.fill([WALL, WALL + THICK, WALL + THICK, WALL], [0, 0, TOP, TOP], color="0.3")
        ax.axhline(0, color="0.3", lw=1)
        limits = {"xlim": (0, 24), "ylim": (-0.3, 1.05 * HEIGHT)}
        ax.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=title, **limits)
    fig.colorbar(drawn, ax=axes[0], label="displacement (m)", shrink=0.8)
    ax, after = axes[1, 1], held.frames[meets:]
    t, F = np.array([f.t for f in held.frames]) / 60, np.array([f.force[0] for f in held.frames]) / 1e3
    ax.plot(t, F, label="on the barrier")
    for k, name in enumerate(("active", "passive")):
        values = [f.bounds[k] / 1e3 for f in after]
        ax.plot([f.t / 60 for f in after], values, color="k", ls=("--", ":")[k], lw=1, label=f"{name}, of wedges")
    ax.set(xlabel="time (minutes)", ylabel="force (kN/m)", title="Normal force", xlim=(0, 2 * DURATION / 60))
    ax.set(ylim=(0, 2.5 * F.max()))
    ax.legend(fontsize=9)
    ax.grid(alpha=0.3)
    common.save(fig, o.out / "barrier.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
