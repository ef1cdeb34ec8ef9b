# SPDX-License-Identifier: MIT
"""A submarine bank loses its strength and slumps: large plastic deformation with pore pressures.

A bank of saturated soil with a vertical side stands on a rough floor under water. By symmetry, half of the bank is
computed, 10 m high and 10 m long, with the plane of symmetry at x = 0. Pressures are in excess of the hydrostatic
pressure outside. The weight is a term in UFL, with the buoyant unit weight `gamma' = (1 - n) (rho_s - rho_w) g`. Here n
is the porosity, rho_s the density of the grains, and rho_w the density of the water. Inertia is neglected. The demo
runs on one process.

1. Critical strength. The soil has no friction and does not drain. The strength c of the soil is reduced by 1 % in each
   step. A vertical side of height H is stable while gamma' H / c < 3.78. Limit analysis gives 3.76 to 3.79 (Pastor,
   Thai and Francescato 2000), and the critical slip circle 3.83 (Fellenius 1927). The bank has failed when the crest
   settles 20 times as much in a step as in each of the first steps. With 10 cells over the height the bank fails at
   gamma' H / c = 3.94, which is 4.2 % too large. With 20 cells it fails at 3.86, which is 2.0 % too large.
2. Run-out. The consolidated bank, with friction, loses its cohesion within T = 10 minutes, far faster than it drains.
   The bank slumps. In front of the initial toe, the water carries more than half of the soil's weight. At rest the bank
   is twice as long as before. Then the excess pressure drains. The final inclination of the slope is 23.5 degrees. The
   friction angle is 25 degrees, but without dilation the soil mobilises only 24.2 degrees. Twice the number of cells or
   steps, or half the viscosity, changes run-out and height by less than 2 %.

The points carry the cohesion (`points.data["cohesion"]`), because it is a function of position. A function in `observe`
reduces the cohesion after each step. A viscous stress of 2 eta times the strain rate, also a term in UFL, limits the
velocity of the bank in part 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import common
import numpy as np

import mpm_dolfinx as mpm

HEIGHT = 10.0  # m; also the length of half the bank
POROSITY, DENSITY = 0.4, 2650 - 1000  # -, kg/m³: of the grains in water
WEIGHT = (1 - POROSITY) * DENSITY * 9.81  # N/m³
SCALE = WEIGHT * HEIGHT  # Pa
SHEAR = 30 * SCALE
FRICTION, CONDUCTIVITY = 25.0, 1e-9  # degrees, m/s
STRONG, WEAK = 0.3 * SCALE, 0.01 * SCALE  # cohesion before and after, Pa
DURATION = 600.0  # s: time in which the cohesion is lost
VISCOSITY = 0.01 * SCALE * DURATION  # Pa s
THEORY, RUNAWAY = 3.78, 20
CV = CONDUCTIVITY / mpm.Fluid().unit_weight * (2 + 4 / 3) * SHEAR  # m²/s


def bank(cells: int, length: float, room: float, friction: float, cohesion: float, conductivity: float, **scene):
    """Return the consolidated bank, with a probe on its crest and `room` metres of free floor."""
    h = HEIGHT / cells
    grid = mpm.Grid([0, 0], [length + room, HEIGHT + h], [round((length + room) / h), cells + 1])
    body = mpm.box(grid, [0, 0], [length, HEIGHT])
    soil = mpm.DruckerPrager(
        bulk=2 * SHEAR,
        shear=SHEAR,
        friction=friction,
        dilation=0.0,
        cohesion=lambda X: np.full(len(X), cohesion),
        porosity=POROSITY,
        conductivity=conductivity,
    )
    walls = {"left": "x", "bottom": "xy"}
    simulation = mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(), walls=walls, **scene)
    simulation.run(1e12, 1e12, progress=False)  # long compared with the time of drainage
    simulation.stage(reset_displacement=True)
    simulation.t = 0.0
    return simulation, mpm.probes([body], [[length, HEIGHT]])


# ---- 1. the strength at failure - ------------------------------------------------------------


@dataclass
class Failure:
    """Stability numbers and settlements of the crest in n steps. number (n,): stability numbers gamma' H / c.

    rate (n,): settlement in each step, divided by the mean settlement in the first five steps.
    critical: stability number at which the bank fails.
    """

    cells: int
    number: np.ndarray
    rate: np.ndarray
    critical: float


def fail(cells: int, start: float = 3.0, ratio: float = 0.99) -> Failure:
    """Reduce the strength of an undrained bank without friction until the bank fails."""
    s, crest = bank(cells, 2 * HEIGHT, HEIGHT / 2, 0.0, SCALE / start, 0.0, terms=[common.weight(WEIGHT)])
    number, settlement, rate = [start], [0.0], np.zeros(0)
    while len(rate) < 10 or rate[-1] < 2 * RUNAWAY:
        s.stage(fields={"cohesion": ratio * s.points.data["cohesion"]})
        s.run(s.t + 1, 1, progress=False)
        number.append(number[-1] / ratio)
        settlement.append(-crest.displacement(s.points, s.grid.comm)[0, 1])
        rate = np.diff(settlement) / np.mean(np.diff(settlement[:6]))
    middle = np.sqrt(np.multiply(number[1:], number[:-1]))
    k = int(np.argmax(rate > RUNAWAY))
    at = np.interp(np.log(RUNAWAY), np.log(rate[k - 1 : k + 1]), middle[k - 1 : k + 1])
    return Failure(cells, middle, rate, float(at))


# ---- 2. the slump ---------------------------------------------------------------------------------


@dataclass
class Frame:
    """State of the bank at the time t, in s.

    corners: corners of the domains, in m.
    surface (k, 2): positions from the crown to the toe, in m.
    pressure, strain: excess pore pressures (Pa) and plastic strains of the points.
    volume, cohesion: volume (m²) and cohesion (Pa) of the bank.
    """

    t: float
    corners: np.ndarray
    surface: np.ndarray
    pressure: np.ndarray
    strain: np.ndarray
    volume: float
    cohesion: float

    @property
    def run_out(self) -> float:
        """Distance of the toe of the bank from the plane of symmetry, in m."""
        return float(self.corners[:, :, 0].max())

    @property
    def slope(self) -> float:
        """Slope from the crown to the toe, in degrees."""
        return float(np.degrees(np.arctan2(self.surface[:, 1].max(), self.run_out)))

    def steepest(self, length: float) -> float:
        """Return the steepest inclination of a part of the surface with this horizontal length, in degrees."""
        x, y = self.surface[: np.argmax(self.surface[:, 0]) + 1].T
        at = np.linspace(0, self.run_out - length, 200)
        fall = np.interp(at, x, y) - np.interp(at + length, x, y)
        return float(np.degrees(np.arctan(fall.max() / length)))


@dataclass
class Slump:
    """Results of a run; `rest` and `drained` are the indices of the last frames of slumping and of drainage.

    alternating: largest rms of the `alternating` part of the pressures in front of the bank, in Pa.
    """

    frames: list[Frame] = field(default_factory=list)
    rest: int = 0
    drained: int = 0
    alternating: float = 0.0
    balance: float = 0.0
    steps: int = 0
    cuts: int = 0
    wall: float = 0.0


def alternating(p: np.ndarray) -> np.ndarray:
    """Return the part (n - 2, m - 2) of cell values (n, m) that alternates from cell to cell along both axes."""
    for axis in (0, 1):
        q = np.moveaxis(p, axis, 0)
        p = np.moveaxis((2 * q[1:-1] - q[:-2] - q[2:]) / 4, 0, axis)
    return p


def at_toe(s: mpm.Simulation) -> float:
    """Return the rms of the alternating part of the pressures in front of the initial side of the bank, in Pa."""
    cells, p = s.cells(), np.full(tuple(s.grid.shape), np.nan)
    p[tuple(s.grid.index(cells.x).T)] = cells.pressure
    found = alternating(p)[round(HEIGHT / s.grid.h[0]) - 1 :]
    return float(np.sqrt(np.nanmean(found**2))) if np.isfinite(found).any() else 0.0


def slump(cells: int, steps: int) -> Slump:
    """Let the bank lose its cohesion in a number of steps, come to rest, and drain."""
    sides = [mpm.Drained("top"), mpm.Drained("right")]
    s, _ = bank(
        cells,
        HEIGHT,
        2 * HEIGHT,
        FRICTION,
        STRONG,
        CONDUCTIVITY,
        terms=[common.weight(WEIGHT), common.viscous(VISCOSITY)],
        conditions=sides,
    )
    out = Slump()

    def look(s: mpm.Simulation) -> None:
        p, body = s.points, s.bodies[0]
        top, front = p.corners[body.sides[:, 1, 1]][:, [2, 3]], p.corners[body.sides[:, 0, 1]][::-1, [3, 1]]
        line = np.concatenate([top, front]).reshape(-1, 2)
        fields = p.corners.copy(), line, p.pressure.copy(), p.data["hardened"].copy()
        out.frames.append(Frame(s.t, *fields, float(p.J @ p.volume0), float(p.data["cohesion"][0])))
        out.alternating = max(out.alternating, at_toe(s))

    def weaken(s: mpm.Simulation) -> None:
        """Give the soil the cohesion that it will have at the end of the next step."""
        lost = min(1.0, (s.t + dt) / DURATION)
        s.stage(fields={"cohesion": STRONG + lost * (WEAK - STRONG)})

    def go(t_end: float, dt: float, *observers: Callable, rtol: float | None = None) -> int:
        result = s.run(t_end, dt, rtol=rtol, observe=observers)
        out.balance = max(out.balance, result.balance)
        out.steps, out.cuts, out.wall = out.steps + result.steps, out.cuts + result.cuts, out.wall + result.wall
        return len(out.frames) - 1

    look(s)
    dt = DURATION / steps
    weaken(s)
    go(DURATION, dt, look, weaken)
    go(2 * DURATION, dt, look)
    out.rest = go(20 * DURATION, 10 * dt, look)
    out.drained = go(s.t + 2 * HEIGHT**2 / CV, HEIGHT**2 / CV / 20, look, rtol=1e-2)  # from minutes to months
    return out


# ---- results -----------------------------------------------------------------------------


def errors(failures: list[Failure], run: Slump) -> dict[str, float]:
    """Return relative errors of the results, and slopes in degrees."""
    coarse, fine = (f.critical for f in failures)
    start, rest, end = run.frames[0], run.frames[run.rest], run.frames[run.drained]
    return {
        "critical_coarse": coarse / THEORY - 1,
        "critical": fine / THEORY - 1,
        "critical_extrapolated": (2 * fine - coarse) / THEORY - 1,
        "volume": rest.volume / start.volume - 1,
        "fluid_balance": run.balance,
        "slope_above_friction": end.slope - FRICTION,
        "steepest_above_friction": end.steepest(HEIGHT / 3) - FRICTION,
        "creep_at_rest": rest.run_out / run.frames[run.rest - 1].run_out - 1,
        "pressure_left": float(np.abs(end.pressure).max() / np.abs(rest.pressure).max()),
    }


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=20, help="cells over the height")
    parser.add_argument("--steps", type=int, default=100, help="number of steps in which the cohesion decreases")
    o = parser.parse_args(argv)
    if o.cells < 4 or o.cells % 2 or o.steps < 10:
        parser.error(f"--cells {o.cells}: must be even and >= 4; --steps {o.steps}: must be >= 10")
    with common.results(o) as out:
        failures = []
        for cells in (o.cells // 2, o.cells):
            failures.append(f := fail(cells))
            print(
                f"{cells} cells: fails at gamma' H / c = {f.critical:.3f} ({f.critical / THEORY - 1:+.1%})", flush=True
            )
        run = slump(o.cells, o.steps)
        out |= {"errors": errors(failures, run), "alternating_kPa": run.alternating / 1e3, "wall_s": run.wall}
        report(run, out["errors"])
        draw(o.out / "slump.png", run)
        draw_failure(o.out / "failure.png", failures)
        animate(o.out / "slump.gif", run)
        print(f"{run.steps} steps, {run.cuts} cuts, {run.wall:.1f} s")
    return out


def report(run: Slump, found: dict[str, float]) -> None:
    """Print the stages of the slump and the errors."""
    rows = [["", "t (s)", "run-out (m)", "height (m)", "slope", "p (kPa)"]]
    for name, k in stages(run).items():
        f = run.frames[k]
        p = f"{f.pressure.min() / 1e3:.2f} to {f.pressure.max() / 1e3:.2f}"
        height = f.surface[:, 1].max()
        rows.append([name, f"{f.t:.3g}", f"{f.run_out:.2f}", f"{height:.2f}", f"{f.slope:.1f}°", p])
    common.table(rows)
    print(f"critical strength, extrapolated to h = 0: {found['critical_extrapolated']:+.1%} of gamma' H / c")
    print(f"change of the volume until rest: {found['volume']:+.1e}; fluid balance {found['fluid_balance']:.1e}")
    steepest = run.frames[run.drained].steepest(HEIGHT / 3)
    print(f"steepest final slope over {HEIGHT / 3:.1f} m: {steepest:.1f}°, friction angle {FRICTION:g}°")
    print(f"alternating part of the pressures at the toe: at most {run.alternating / 1e3:.2f} kPa rms")
    print(f"relative growth of the run-out in the last step before rest: {found['creep_at_rest']:.1e}")


def stages(run: Slump) -> dict[str, int]:
    """Return names of the drawn stages, each with the index of its frame."""
    lost = np.array([f.cohesion for f in run.frames])
    weak = int(np.argmax(lost <= 1.001 * WEAK))
    return {"failing": int(0.6 * weak), "slumping": int(0.9 * weak), "at rest": run.rest, "drained": run.drained}


class Panel:
    """Picture of a frame: domains coloured by values, and the surface."""

    def __init__(self, ax, frame: Frame, values: np.ndarray, **style):
        from matplotlib.collections import PolyCollection

        self.domains = PolyCollection([], edgecolors="face", linewidth=0.2, **style)
        ax.add_collection(self.domains)
        (self.line,) = ax.plot([], [], color="black", lw=0.6)
        ax.plot([0, HEIGHT, HEIGHT], [HEIGHT, HEIGHT, 0], color="grey", lw=0.8, ls=":")
        ax.set(aspect="equal", xlim=(0, 2.4 * HEIGHT), ylim=(0, 1.08 * HEIGHT))
        self.show(frame, values)

    def show(self, frame: Frame, values: np.ndarray) -> None:
        """Show another frame."""
        self.domains.set(verts=frame.corners[:, [0, 1, 3, 2]], array=values)
        self.line.set_data(*frame.surface.T)


def shown(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return the drawn values of the points: pressures (kPa) and plastic strains."""
    return frame.pressure / 1e3, np.maximum(frame.strain, 1e-3)


def panels(axes, run: Slump, frame: Frame) -> list[Panel]:
    """Draw pressure and plastic strain of a frame on two axes."""
    from matplotlib.colors import LogNorm

    limit = np.quantile(np.abs(run.frames[run.rest].pressure), 0.98) / 1e3
    styles = {"cmap": "RdBu_r", "clim": (-limit, limit)}, {"cmap": "viridis", "norm": LogNorm(0.01, 10)}
    return [Panel(ax, frame, values, **style) for ax, values, style in zip(axes, shown(frame), styles, strict=True)]


def draw(path: Path, run: Slump) -> None:
    """Draw pressures and plastic strain at several stages."""
    chosen = stages(run)
    fig, axes = common.figure(len(chosen), 2, (10, 2.55 * len(chosen)))
    for row, (name, k) in zip(axes, chosen.items(), strict=True):
        frame = run.frames[k]
        left, right = panels(row, run, frame)
        first = " (dotted: at the start)" if row is axes[0] else ""
        row[0].set(title=f"{name}, t = {time(frame.t)}{first}", ylabel="y (m)")
        row[1].set(title=rf"$\gamma' H / c$ = {SCALE / frame.cohesion:.3g}, slope {frame.slope:.0f}°")
    for ax in axes[-1]:
        ax.set(xlabel="x (m)")
    bars = {"location": "bottom", "shrink": 0.8, "aspect": 40, "pad": 0.02}
    fig.colorbar(left.domains, ax=axes[:, 0], label="excess pore pressure (kPa)", extend="both", **bars)
    fig.colorbar(right.domains, ax=axes[:, 1], label="accumulated plastic strain (-)", extend="both", **bars)
    common.save(fig, path, dpi=85)


def time(seconds: float) -> str:
    """Return a time as text, in a suitable unit."""
    units = {"years": 365.25 * 86400, "days": 86400, "h": 3600, "min": 60}
    name = next((name for name, unit in units.items() if seconds >= unit), "min")
    return f"{seconds / units[name]:.3g} {name}"


def draw_failure(path: Path, failures: list[Failure]) -> None:
    """Draw the settlement rate of the crest against the stability number."""
    fig, ((ax,),) = common.figure(1, 1, (6.5, 4))
    for f in failures:
        (line,) = ax.semilogy(f.number, f.rate, ".-", label=f"{f.cells} cells over the height")
        ax.plot(f.critical, RUNAWAY, "o", mfc="none", ms=9, color=line.get_color(), label=f"fails at {f.critical:.2f}")
    ax.axvline(THEORY, color="black", lw=1, ls="--", label=f"limit analysis: {THEORY}")
    ax.set(xlabel=r"$\gamma' H / c$ (-)", ylabel="settlement per step / first step (-)")
    ax.set_title("Undrained, without friction: the strength falls by 1 % in each step", fontsize=11)
    ax.grid(alpha=0.3)
    ax.legend()
    common.save(fig, path, dpi=110)


def animate(path: Path, run: Slump) -> None:
    """Draw the slump as an animation; each later part runs faster."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    weak = int(np.argmax([f.cohesion <= 1.001 * WEAK for f in run.frames]))
    ends = (weak // 2, weak, 3 * weak // 2, run.rest, run.drained)
    parts = [np.linspace(a, b, n, dtype=int) for a, b, n in zip(ends, ends[1:], (20, 10, 12, 6), strict=False)]
    fig, axes = common.figure(2, 1, (6, 6))
    axes = axes[:, 0]
    both = panels(axes, run, run.frames[0])
    for ax, panel, label in zip(axes, both, ("excess pore pressure (kPa)", "plastic strain (-)"), strict=True):
        fig.colorbar(panel.domains, ax=ax, label=label, shrink=0.8, extend="both")
        ax.set(ylabel="y (m)")
    title = axes[0].set_title(" ")
    axes[1].set(xlabel="x (m)")
    fig.canvas.draw()
    fig.set_layout_engine("none")  # laid out once

    def show(k: int) -> None:
        frame = run.frames[k]
        for panel, values in zip(both, shown(frame), strict=True):
            panel.show(frame, values)
        title.set_text(rf"$t$ = {time(frame.t)}, $\gamma' H / c$ = {SCALE / frame.cohesion:.3g}")

    FuncAnimation(fig, show, frames=np.unique(np.concatenate(parts))).save(path, PillowWriter(fps=6), dpi=70)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
