# SPDX-License-Identifier: MIT
"""A cone penetrometer is pushed from the surface into weightless clay, and the pore pressures then dissipate.

The cone has a tip angle of 60 degrees and an adhesion of 0.3 s_u, where s_u is the strength of the clay. The smooth
shaft behind the cone is a second tool, so that the force on the cone is known separately. The scene is axisymmetric.
The clay is undrained and follows Tresca's law. The option --mises replaces it by von Mises's law, with the strength s_u
in pure shear. The shear modulus of the clay is G = 100 s_u. The resistance is F / (pi R^2 s_u), with the force F on the
cone and the radius R of the shaft. The resistance is compared with a formula for a deep cone in Tresca clay under
isotropic initial stress (Lu, Randolph, Hu and Bugarski 2004, Geotechnique 54):

    N_c = 3.4 + 1.6 ln(G / s_u) + 1.3 alpha,

where alpha = 0.3 is the adhesion divided by s_u. Domains of clay longer than a cell are replaced by new domains
(renewal). The shaft and the surface of the clay lie in the middle of cells, because renewal does not refill cells that
a surface crosses several times. The edge between cone and shaft has a radius of one cell.

The cone is also pushed fast into saturated ("wet") clay, which remains undrained. Then the cone stops, and the excess
pressure at the edge between cone and shaft dissipates. The fraction of the excess pressure that remains is compared
with the curve of Teh and Houlsby (1991, Geotechnique 41) for a deep cone. The time factor of this curve is `T* = c_v t
/ (R^2 sqrt(G / s_u))`, with the coefficient of consolidation c_v and the time t. Near the surface pressures dissipate
faster than around a deep cone. Half of the pressure has dissipated at T* = 0.03 if the tip is three radii deep, and at
T* = 0.08 if the tip is five radii deep.

With --follow, the cone is pushed once more into undrained clay, on grid lines that follow the cone.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np

import mpm_dolfinx as mpm

R, WIDE, BELOW = 1.0, 20.0, 12.0  # m: radius of the shaft and of the clay; clay below the final depth
STRENGTH, ROUGH, INDEX = 1e3, 0.3, 100.0  # s_u, Pa; adhesion and G, divided by s_u
SHEAR = INDEX * STRENGTH
HALF_ANGLE = 30.0  # degrees, between axis and flank of the cone
FINE, ABOVE, RATIO = 2.0, 6.5, 1.3  # m: radius of the fine region; cells above the clay; ratio of neighbouring cells
AROUND = 1.0, 2.5  # m: small cells below and above the tip, if grid lines follow the cone
WAY = np.linspace(0.5, 1, 101)  # depths, divided by the final depth, at which runs are compared
STEP, WET_STEP = 1 / 6, 1 / 12  # motion of the cone in a step, in cell sizes: undrained and saturated clay
LAST = 3.0  # distance, in radii, over which the steady resistance is averaged
FAST = 1000.0  # V = v 2 R / c_v, of the push in wet clay
UNDRAINED = {"bulk": 50 * SHEAR, "shear": SHEAR, "friction": 0.0, "dilation": 0.0, "cohesion": STRENGTH}
WET = mpm.MohrCoulomb(**UNDRAINED | {"bulk": 2 * SHEAR}, conductivity=1e-9)
WATER = mpm.Fluid()
CV = WET.conductivity / WATER.unit_weight * WET.oedometric  # m²/s
TIMES = np.logspace(-3, 0.2, 25)  # T*, of the outputs while pressures dissipate
DISSIPATED = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
TEH = np.array([0.038, 0.078, 0.142, 0.245, 0.439, 0.804, 1.60])
"""Degrees of dissipation at the edge between cone and shaft, and time factors T*, by Teh and Houlsby (1991)."""


def published() -> float:
    """Return the resistance N_c of a deep cone by Lu, Randolph, Hu and Bugarski (2004)."""
    return 3.4 + 1.6 * np.log(INDEX) + 1.3 * ROUGH


@dataclass
class Push:
    """Results of a push into undrained clay.

    depth: depth of the tip after each step, divided by R.
    N: resistance after each step.
    frame: final corners (n, 4, 2) of the domains (m), the values (n,) to draw, and the outline (k, 2) of the cone (m).
    seeded: number of points at the start.
    cells: number of grid cells, and number of cells of the smallest size that would fill the grid.
    """

    depth: list[float] = field(default_factory=list)
    N: list[float] = field(default_factory=list)
    frame: tuple = ()
    seeded: int = 0
    cells: tuple[int, int] = (0, 0)
    result: mpm.Result | None = None


def scene(
    cells: int,
    depth: float,
    clay: mpm.Skeleton,
    speed: float,
    end: float,
    fluid: mpm.Fluid | None,
    follow: bool = False,
):
    """Return a simulation of the cone on the surface of the clay, and half of the cone's outline (k, 2), in m.

    cells: number of cells over the radius R, minus one half.
    depth: greatest depth of the cone, in m.
    speed: velocity of the cone until the time `end`, in m/s.
    """
    h = R / (cells + 0.5)
    low, fine = -(np.ceil(depth / h) + 2 * cells + 0.5) * h, np.ceil(FINE / h) * h
    start, wide = [0, low - BELOW], [WIDE, ABOVE * h]
    grid = mpm.Grid(lines=mpm.graded(start, wide, [[[0, low], [fine, ABOVE * h]]], h, RATIO), axisymmetric=True)
    body = mpm.box(grid, start, [WIDE, 0])
    beta = np.radians(HALF_ANGLE)
    centre = np.array([R - h, ((R - h) * np.cos(beta) + h) / np.sin(beta)])
    angle = np.linspace(-beta, 0, 4)
    edge = centre + h * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    top = depth + 2 * ABOVE * h

    def whole(half) -> np.ndarray:
        return np.concatenate([half, np.array(half)[::-1] * [-1, 1]])

    def moved(t: float) -> tuple[float, float]:
        return 0.0, -speed * min(t, end)

    tip = [(0.0, 0.0), *edge]
    cone = mpm.Tool(mpm.Convex(whole(tip)[1:]), moved, adhesion=ROUGH * STRENGTH, name="cone")
    shaft = mpm.Tool(mpm.Convex(whole([edge[-1], (R, top)])), moved, name="shaft")
    if follow:
        below, above = ((np.ceil(far / h) + 0.5) * h for far in AROUND)
        lines = mpm.graded(start, [WIDE, above + ABOVE * h], [[[0, -below], [fine, above]]], h, RATIO)
        grid = mpm.Grid(lines=lines, follow=cone, axisymmetric=True)
    acting = {"walls": {"left": "x", "right": "x", "bottom": "y"}, "conditions": [cone, shaft], "fluid": fluid}
    if fluid is not None:
        acting["conditions"] += [mpm.Drained("right")]
    numerics = mpm.Numerics(renewal=True)
    return mpm.Simulation(grid, [body], [clay], numerics=numerics, **acting), np.array([*tip, (R, top)])


def push(cells: int, depth: float, clay: mpm.Skeleton, follow: bool = False) -> Push:
    """Push the cone into undrained clay to `depth`, in m."""
    out = Push()
    simulation, outline = scene(cells, depth, clay, 1.0, depth, None, follow)
    lines = simulation.grid.lines
    equal = np.prod([round(np.ptp(x) / np.diff(x).min()) for x in lines])
    out.cells = int(simulation.grid.shape.prod()), int(equal)
    out.seeded = len(simulation.points)

    def see(s: mpm.Simulation) -> None:
        out.depth.append(s.t / R)
        out.N.append(-float(s.tool_forces["cone"][1]) / (np.pi * R**2 * STRENGTH))

    out.result = simulation.run(depth, R / (cells + 0.5) * STEP, observe=see, progress=False)
    points = simulation.points
    out.frame = points.corners, np.linalg.norm(points.displacement, axis=1) / R, outline - [0, depth]
    return out


@dataclass
class Dissipation:
    """Results in wet clay. excess: excess pressure at the cone's edge when the cone stops, divided by s_u.

    rest: fraction of the excess pressure that remains at the times T* of `TIMES`.
    frame: when the cone stops, corners of the domains, excess pressures divided by s_u, and outline of the cone.
    """

    N: float = 0.0
    excess: float = 0.0
    rest: list[float] = field(default_factory=list)
    balance: float = 0.0
    frame: tuple = ()

    def time_of(self, degree: np.ndarray) -> np.ndarray:
        """Return the time factors T* at these degrees of dissipation, by interpolation."""
        return np.exp(np.interp(degree, 1 - np.array(self.rest), np.log(TIMES)))


def push_wet(cells: int, depth: float) -> Dissipation:
    """Push the cone into saturated clay to `depth` (m), then let the pore pressures dissipate."""
    out = Dissipation()
    speed = FAST * CV / (2 * R)
    end = depth / speed
    simulation, outline = scene(cells, depth, WET, speed, end, WATER)
    h = R / (cells + 0.5)
    edge = np.array([R, outline[-2, 1] - depth])

    def excess(s: mpm.Simulation) -> float:
        """Return the mean excess pressure of the points within one cell size of the edge, divided by s_u."""
        near = np.linalg.norm(s.points.x - edge, axis=1) < h
        volume = s.points.volume0[near]
        return float(volume @ s.points.pressure[near] / volume.sum() / STRENGTH)

    result = simulation.run(end, end / np.ceil(depth / (WET_STEP * h)), progress=False)
    out.N = -float(simulation.tool_forces["cone"][1]) / (np.pi * R**2 * STRENGTH)
    out.excess, out.balance = excess(simulation), result.balance
    out.frame = simulation.points.corners, simulation.points.pressure / STRENGTH, outline - [0, depth]

    def look(s: mpm.Simulation) -> None:
        out.rest.append(excess(s) / out.excess)

    times = end + TIMES * R**2 * np.sqrt(INDEX) / CV
    after = simulation.run(times[-1], rtol=2e-2, t_eval=times, observe=look, progress=False)
    out.balance = max(out.balance, after.balance)
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=2, help="whole cells over the radius, which has half a cell more")
    parser.add_argument("--depth", type=float, default=10.0, help="depth of the tip, divided by R")
    parser.add_argument("--wet-depth", type=float, default=5.0, help="the same depth in saturated clay; 0: no run")
    parser.add_argument("--mises", action="store_true", help="von Mises's law in place of Tresca's, in undrained clay")
    parser.add_argument("--follow", action="store_true", help="push the cone again, on grid lines that follow it")
    o = parser.parse_args(argv)
    if not 2 <= o.cells <= 16 or not 0 < o.depth <= 20:
        parser.error(f"--cells {o.cells}: must be 2 to 16; --depth {o.depth}: must be in (0, 20]")
    if o.wet_depth and not 2 <= o.wet_depth <= 20:
        parser.error(f"--wet-depth {o.wet_depth}: must be 0, or in [2, 20]")
    clay = (mpm.DruckerPrager if o.mises else mpm.MohrCoulomb)(**UNDRAINED)
    with common.results(o) as out:
        run = push(o.cells, o.depth * R, clay)
        depth, N = np.array(run.depth), np.array(run.N)
        last = N[depth > o.depth - LAST]
        out |= {"N": float(last.mean()), "error": float(last.mean() / published() - 1)}
        thirds = [part.mean() for part in np.array_split(last, 3)]
        out["drift"] = float((max(thirds) - min(thirds)) / last.mean())
        out |= {"steps": run.result.steps, "cuts": run.result.cuts, "renewals": run.result.renewals}
        found = f"N = {last.mean():.2f} in the last {LAST:g} radii, Lu et al. {published():.2f}"
        found += f"; {run.result.cuts} of {run.result.steps} steps cut"
        print(f"{found}; {run.result.points} points, {run.seeded} seeded", flush=True)
        if o.follow:
            out["follow"] = following(o, clay, run)
        wet = None
        if o.wet_depth:
            wet = push_wet(o.cells, o.wet_depth * R)
            out["wet"] = {"N": wet.N, "excess": wet.excess, "T50": float(wet.time_of(np.array(0.5)))}
            out["balance"] = wet.balance
            found = f"wet clay: N = {wet.N:.2f}, excess pressure at the edge {wet.excess:.2f} s_u"
            print(f"{found}, half dissipated at T* = {out['wet']['T50']:.3f} (Teh and Houlsby {TEH[3]})", flush=True)
        draw(o, run, wet)
        out["converged"] = run.result.cuts <= 0.1 * run.result.steps
    return out


def following(o: Namespace, clay: mpm.Skeleton, fixed: Push) -> dict[str, float]:
    """Push the cone on grid lines that follow it, and compare the run with the run on fixed grid lines.

    load: relative difference of the mean N in the second half of the push.
    last: relative difference of the final N.
    cells: number of cells, divided by the number of cells of the smallest size that would fill the grid.
    fixed: number of cells, divided by the number with fixed grid lines.
    """
    run, halfway = push(o.cells, o.depth * R, clay, follow=True), o.depth / 2
    mean, beside = (np.interp(WAY * o.depth, each.depth, each.N).mean() for each in (run, fixed))
    out = {"load": float(mean / beside - 1), "last": run.N[-1] / fixed.N[-1] - 1, "cuts": run.result.cuts}
    out |= {"cells": run.cells[0] / run.cells[1], "fixed": run.cells[0] / fixed.cells[0]}
    found = (
        f"lines that follow: mean N from {halfway:g} radii on {mean:.2f}, fixed lines {beside:.2f} ({out['load']:+.1%})"
    )
    print(
        f"{found}; final N {out['last']:+.1%}; {run.cells[0]} cells, fixed {fixed.cells[0]}, equal {run.cells[1]}; ",
        end="",
    )
    print(f"{run.result.cuts} of {run.result.steps} steps cut", flush=True)
    return out


def draw(o: Namespace, run: Push, wet: Dissipation | None) -> None:
    """Draw the resistance, the displacements, and the dissipation of pore pressures in wet clay."""
    columns = 2 if wet is None else 4
    fig, axes = common.figure(1, columns, (4.25 * columns, 6))
    ax = axes[0, 0]
    ax.plot(run.N, run.depth)
    ax.axvline(published(), color="k", ls="--", lw=0.8)
    ax.set(xlabel="F / (π R² s_u) (-)", ylabel="depth / R (-)", title="dashed: Lu et al. (2004)", ylim=(o.depth, 0))
    show(axes[0, 1], run.frame, o.depth, "displacement / R (-)", "undrained clay", (0, 2))
    if wet is not None:
        most = np.abs(wet.frame[1]).max()
        show(axes[0, 2], wet.frame, o.wet_depth, "excess pore pressure / s_u (-)", "saturated clay", (-most, most))
        ax = axes[0, 3]
        ax.semilogx(TIMES, wet.rest, label="computed")
        ax.semilogx(TEH, 1 - DISSIPATED, "ko", label="Teh and Houlsby (1991)")
        ax.set(xlabel="T* (-)", ylabel="remaining excess pressure (-)", ylim=(0, None), title="at the edge")
        ax.legend(fontsize=9)
    for ax in axes[0, ::3]:
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "cone.png", dpi=80)


def show(ax, frame: tuple, depth: float, label: str, title: str, clim: tuple[float, float]) -> None:
    """Draw the clay and the cone of a `frame`."""
    corners, values, outline = frame
    domains = common.domains(ax, corners, values, cmap="viridis" if clim[0] == 0 else "RdBu_r", clim=clim)
    inside = np.concatenate([outline, [[0, outline[-1, 1]]]])
    ax.fill(*inside.T, facecolor="0.6", edgecolor="0.4")
    ax.set(aspect="equal", xlim=(0, 5), ylim=(-depth - 2, 1.5), xlabel="r (m)", ylabel="z (m)", title=title)
    ax.figure.colorbar(domains, ax=ax, label=label, shrink=0.8)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
