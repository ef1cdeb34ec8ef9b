# SPDX-License-Identifier: MIT
"""Expansion of a cylindrical cavity in clay and in sand, on a grid of squares.

The body is a quarter of a ring, with the initial radius a0 of the cavity and the outer radius b = 5 a0. In each step
the wall of the cavity moves by a fifth of a cell in drained soil, and by a tenth of a cell in undrained soil. Small
steps are needed because laws with history are first-order accurate in the step.

1. A cavity expands fast in saturated Modified Cam Clay, so no water flows. The initial pressure acts on the outer
   boundary. The soil is incompressible, so the motion is known exactly. When the cavity has grown to radius a, a point
   has moved from radius R to r, with `r^2 - a^2 = R^2 - a0^2`.
2. The wall is fixed after the expansion, and excess pressures dissipate through the outer boundary.
3. Drained cavities expand in Modified Cam Clay (Chen and Abousleiman 2013) and in Mohr-Coulomb sand with phi = 30
   degrees (Yu and Houlsby 1991). The sand has either no dilation or associated flow. The published solutions are for
   infinite soil. The outer boundary therefore follows a radial solution (`mpm_dolfinx.verification.cavity`).

Pressures are divided by the initial pressure p_0. Errors are relative errors of the cavity pressure, and in undrained
clay also of the pore pressure at the wall. In undrained clay errors are evaluated at the cavity radii `MARKS`, and in
drained soil at the cavity radii with published pressures.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import common
import numpy as np

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.cavity import cavity, undrained

P0, OUTER = 1e5, 5.0  # Pa, outer radius divided by that of the cavity
PUSH, PUSH_UNDRAINED = 0.2, 0.1  # fraction of a cell in each step
CLAY = mpm.ModifiedCamClay(
    M=1.2, lambda_=0.0726, kappa=0.0145, shear=30 * P0, initial_stress=(-P0,) * 3, conductivity=1e-9
)
RATIOS, MARKS = (1.0001, 2.0), (1.1, 1.5)
CV = CLAY.conductivity / mpm.Fluid().unit_weight * CLAY.oedometric  # m²/s
G = 100 * P0
SAND = mpm.MohrCoulomb(bulk=G * 2.6 / 1.2, shear=G, friction=30.0, dilation=0.0, cohesion=0.0)


def well() -> mpm.ModifiedCamClay:
    """Return the clay of Chen and Abousleiman.

    The law uses ln(specific volume) and Kirchhoff stress, so lambda and kappa are converted.
    """
    lambda_, kappa = (index / 2.064 / (1 - index / 2.064) for index in (0.15, 0.03))
    stress = (-P0, -P0, -1.6 * P0)
    clay = mpm.ModifiedCamClay(M=1.2, lambda_=lambda_, kappa=kappa, shear=43.02 * P0, initial_stress=stress)
    return mpm.ModifiedCamClay(**{**vars(clay), "OCR": 1.69 * P0 / clay.yield_pressure})


@dataclass(frozen=True)
class Drained:
    """A drained cavity in infinite soil; all radii are divided by the initial radius of the cavity.

    state: initial state variables of the soil.
    known: published cavity pressure divided by p_0, for each radius of the cavity.
    reach: outer radius of the radial solution.
    """

    soil: mpm.Skeleton
    known: Mapping[float, float]
    reach: float = 1000.0
    state: Mapping[str, np.ndarray] = field(default_factory=dict)


PRESSED = {"plastic": np.exp(-2 * P0 / (3 * SAND.bulk)) * np.eye(3)}  # elastic strain under the initial pressure
DRAINED = {
    "well": Drained(well(), {1.02: 2.0685, 1.08293: 2.8928, 1.5: 4.4063}, 100.0),
    "sand-0": Drained(SAND, {1.02: 2.812, 1.1: 4.489, 1.5: 6.531}, state=PRESSED),
    "sand-30": Drained(replace(SAND, dilation=30.0), {1.02: 3.170, 1.1: 6.041, 1.5: 10.710}, state=PRESSED),
}
SHOWN = {"well": "Modified Cam Clay", "sand-0": "Mohr–Coulomb, ψ = 0", "sand-30": "Mohr–Coulomb, ψ = 30°"}


def ray(X: np.ndarray) -> np.ndarray:
    """Return the outward direction (n, 2) at reference positions (n, 2)."""
    angle = X[:, 1:] * np.pi / (2 * (OUTER - 1))
    return np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


def ring(cells: int, soil: mpm.Skeleton, widest: float, outside: Callable | None = None, **scene) -> mpm.Simulation:
    """Return a quarter of the ring around a cavity, whose radius (m) is 1 + t at the time t (s).

    cells: number of cells over the initial radius of the cavity.
    widest: largest radius of the cavity, in m.
    outside: displacement of the outer boundary as a function of time, in m.
    """
    h = 1 / cells
    size = int(np.ceil(np.sqrt(OUTER**2 + widest**2 - 1) / h)) + 2
    grid = mpm.Grid([0] * 2, [size * h] * 2, [size] * 2)
    body = mpm.mapped(grid, mpm.box(grid, [0, 0], [OUTER - 1] * 2), lambda X: (1 + X[:, :1]) * ray(X))
    moved = [mpm.Displacement("left", lambda t, X: min(t, widest - 1) * ray(X), name="hole")]
    if outside is not None:
        moved.append(mpm.Displacement("right", lambda t, X: outside(t) * ray(X)))
    return mpm.Simulation(
        grid,
        [body],
        [soil],
        walls={"left": "x", "bottom": "y"},
        conditions=[*moved, *scene.pop("conditions", [])],
        **scene,
    )


def widen(s: mpm.Simulation, cells: int, radius: float, push: float) -> float:
    """Widen the cavity to a radius (m), in steps of at most `push` cells, and return the cavity pressure."""
    steps = max(1, int(np.ceil((radius - 1 - s.t) * cells / push - 1e-6)))
    s.run(radius - 1, (radius - 1 - s.t) / steps, progress=False)
    return pressure(s, radius)


def pressure(s: mpm.Simulation, radius: float) -> float:
    """Return the cavity pressure divided by p_0."""
    return float(s.reactions["hole"].mean() / radius / P0)


def drained(name: str, cells: int) -> dict[float, tuple[float, float]]:
    """Return the cavity pressures of the scene and of the radial solution for each radius, divided by p_0."""
    case = DRAINED[name]
    widest = max(case.known)
    reference, radii, out, p = cavity(case.soil, case.reach, 150, state=case.state), [1.0], [0.0], {}
    for a in np.unique([*np.geomspace(1, widest, 12 + int(120 * np.log(widest)))[1:], *case.known]):
        reference = reference.widened(a)
        p[a] = reference.pressure / P0
        radii.append(a)
        out.append(np.interp(OUTER, reference.R, reference.r) - OUTER)
    s = ring(cells, case.soil, widest + 1 / cells, lambda t: np.interp(1 + t, radii, out))
    if case.state:
        s.stage(fields=case.state)
    return {a: (widen(s, cells, a, PUSH), p[a]) for a in case.known}


@dataclass
class Undrained:
    """Results of an undrained expansion and of the consolidation that follows; pressures are divided by p_0.

    total: computed and exact cavity pressure minus p_0, for each radius.
    water: computed and exact pore pressure at the wall, for each radius.
    profiles: times after the expansion (s), with radii of the points (m), and pore pressures.
    balance: error of the fluid balance.
    """

    total: dict[float, tuple[float, float]]
    water: dict[float, tuple[float, float]]
    profiles: list[tuple[float, np.ndarray, np.ndarray]]
    balance: float


def at_wall(s: mpm.Simulation, radius: float, h: float) -> float:
    """Return the pore pressure at the wall divided by p_0, extrapolated from two cells linearly in ln r."""
    r = np.linalg.norm(s.points.x, axis=1)
    near = r < radius + 2 * h
    return float(np.polyfit(np.log(r[near] / radius), s.points.pressure[near] / P0, 1)[-1])


def push(OCR: float, cells: int) -> Undrained:
    """Widen the cavity in undrained clay to the last radius of `MARKS`, then let the clay drain."""
    soil = replace(CLAY, OCR=OCR, bulk=None)
    water = {"fluid": mpm.Fluid(), "conditions": [mpm.Pressure("right", P0), mpm.Drained("right")]}
    widest = MARKS[-1]
    s, out = ring(cells, soil, widest, **water), Undrained({}, {}, [], 0.0)
    for a in MARKS:
        found = widen(s, cells, a, PUSH_UNDRAINED) - 1
        drop, stress = undrained(soil, OUTER, np.geomspace(1, a, 161)[1:], 400)
        out.total[a] = found, drop / P0
        out.water[a] = at_wall(s, a, 1 / cells), 1 + (drop + stress) / P0

    def look(s: mpm.Simulation) -> None:
        r = np.linalg.norm(s.points.x, axis=1)
        order = np.argsort(r)
        out.profiles.append((s.t - widest + 1, r[order], s.points.pressure[order] / P0))

    look(s)
    result = s.result
    s.t = 0.0
    held = mpm.Displacement("left", lambda t, X: (widest - 1) * ray(X), name="hole")
    s.stage(conditions=[*(one for one in s.conditions if not isinstance(one, mpm.Displacement)), held])
    times = OUTER**2 / CV * np.array([0.003, 0.03, 0.1, 0.3, 3.0])
    before = out.balance = result.balance
    after = s.run(times[-1], rtol=2e-2, t_eval=times, observe=look, progress=False)
    out.balance = max(before, after.balance)
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=8, help="cells over the hole's radius")
    parser.add_argument("--cases", nargs="*", default=list(DRAINED), choices=list(DRAINED), help="drained cases")
    parser.add_argument("--ratios", nargs="*", type=float, default=RATIOS, help="overconsolidation ratios, undrained")
    o = parser.parse_args(argv)
    if o.cells < 2 or any(not 1 <= ratio < 10 for ratio in o.ratios):
        parser.error(f"--cells {o.cells}: must be >= 2; --ratios {o.ratios}: must be in [1, 10)")
    with common.results(o) as out:
        out |= {"errors": {}, "balance": 0.0}
        dry, wet = {}, {}
        for name in o.cases:
            dry[name] = drained(name, o.cells)
            for a, (p, radial) in dry[name].items():
                out["errors"][f"{name}, a/a0 = {a}"] = p / DRAINED[name].known[a] - 1
                known = f"published {DRAINED[name].known[a]:.3f}, radial solution {radial:.3f}"
                print(f"{name}, a/a0 = {a}: {p:.3f} p0, {known}", flush=True)
        for ratio in o.ratios:
            run = wet[ratio] = push(ratio, o.cells)
            for what, a in itertools.product(("total", "water"), MARKS):
                p, exact = getattr(run, what)[a]
                out["errors"][f"clay, OCR {ratio:g}, a/a0 = {a}, {what}"] = p / exact - 1
                print(f"undrained clay, OCR {ratio:g}, a/a0 = {a}: {what} pressure {p:.4f} p0, exact {exact:.4f}")
            left = np.abs(run.profiles[-1][2]).max()
            out["balance"] = max(out["balance"], run.balance)
            print(f"  consolidated: pore pressures up to {left:.1e} p0; fluid balance {run.balance:.0e}", flush=True)
        worst = out["worst"] = max(map(abs, out["errors"].values()), default=0.0)
        out["converged"] = worst < 0.4 / o.cells and out["balance"] < 1e-6
        print(f"largest error {worst:.2%}")
        draw(o.out, dry, wet)
    return out


def draw(out: Path, dry: dict, wet: dict[float, Undrained]) -> None:
    """Draw cavity pressures in drained soil, and dissipating pore pressures in undrained clay."""
    from matplotlib.cm import viridis

    fig, ((left, right),) = common.figure(1, 2, (12, 4.2))
    for k, (name, found) in enumerate(dry.items()):
        known = DRAINED[name].known
        left.plot(list(known), list(known.values()), "o", color=f"C{k}", mfc="white", ms=8)
        left.plot(list(found), [p for p, _ in found.values()], "x--", color=f"C{k}", lw=0.8, label=SHOWN[name])
    left.set(xlabel="radius / at start (-)", ylabel="pressure / at start (-)")
    left.set_title("Drained cavities (crosses), published (circles)")
    for mark, (ratio, run) in zip(".+x", wet.items(), strict=False):
        for i, (t, r, p) in enumerate(run.profiles):
            what = f"T = {t * CV / OUTER**2:.2g}" if i else "undrained"
            shade = viridis(0.9 * i / (len(run.profiles) - 1))
            right.plot(r, p, mark, ms=3, color=shade, label=f"OCR {ratio:.0f}, {what}")
    right.set(
        xlabel="distance from the axis / radius at start (-)",
        ylabel="pore pressure / stress at start (-)",
        title=f"Undrained to {MARKS[-1]} times the radius, then drained",
    )
    for ax in (left, right):
        if ax.has_data():
            ax.legend(fontsize=8, markerscale=2 if ax is right else 1, ncol=2 if ax is right else 1)
        ax.grid(alpha=0.3)
    common.save(fig, out / "cavity.png", dpi=90)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
