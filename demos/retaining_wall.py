# SPDX-License-Identifier: MIT
"""Active and passive pressure on a rigid retaining wall that tilts about its toe, away from the sand or into it.

The weightless sand lies on a rough floor and carries a surcharge q. The friction angle phi and the dilation angle of
the sand are 30 degrees. The friction angle of the wall is delta. The wall tilts until a wedge of the sand flows. The
effect of a cohesion c is removed: c cot(phi) is added to q and to the normal pressure on the wall. The normal pressure
is then K q, with

    K = (1 ± sin(phi) cos(w)) / (1 ∓ sin(phi)) exp(± w tan(phi)),    w = asin(sin(delta) / sin(phi)) ± delta,

where the upper sign is for passive pressure (Prandtl, Sokolovskii). The flowing sand consists of a zone at the wall, a
fan about the crest of the wall, and Rankine's zone. Without wall friction, K is Rankine's
`(1 ± sin(phi)) / (1 ∓ sin(phi))`. Coulomb's solution is the critical wedge with a plane slip surface.

The moment about the toe also gives K. The sand is so stiff that it yields at a small tilt.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

import common
import numpy as np

import mpm_dolfinx as mpm

PHI, COHESION, LOAD = 30.0, 1e3, 1e4  # degrees, Pa, Pa
SOIL = mpm.MohrCoulomb(bulk=1e8, shear=6e7, friction=PHI, dilation=PHI, cohesion=COHESION)
REST = COHESION / np.tan(np.radians(PHI))  # Pa: c cot(phi)
WAYS = {"active": -1, "passive": 1}
LENGTH = {"active": 1.5, "passive": 4.0}  # m: of the sand behind a wall of 1 m
TILT = {"active": 2e-4, "passive": 5e-3}  # rad, at the end
STEPS = {"active": 5, "passive": 12}


def exact(delta: float, way: int) -> float:
    """Return the exact K for a wall with friction angle delta, in degrees; `way` is -1 (active) or 1 (passive)."""
    p, d = np.radians([PHI, delta])
    w = np.arcsin(np.sin(d) / np.sin(p)) + way * d
    return (1 + way * np.sin(p) * np.cos(w)) / (1 - way * np.sin(p)) * np.exp(way * w * np.tan(p))


def coulomb(delta: float, way: int) -> float:
    """Return K of Coulomb's wedge; for the parameters see `exact`."""
    (p, d), angle = np.radians([PHI, delta]), np.radians(np.linspace(5, 85, 8001))
    K = np.cos(d) / np.tan(angle) * np.tan(angle + way * p)
    K /= np.cos(d) - way * np.sin(d) * np.tan(angle + way * p)
    return float(K[K > 0].min() if way > 0 else K.max())


def slip_line(delta: float, way: int) -> np.ndarray:
    """Return the edge (n, 2) of the yielding sand from the toe to the surface, in m."""
    p, d = np.radians([PHI, delta])
    fan, rankine = (np.arcsin(np.sin(d) / np.sin(p)) + way * d) / 2, np.pi / 4 - way * p / 2
    at_wall, apex = np.pi / 2 - rankine - fan, np.pi / 2 - way * p
    turn = np.linspace(0, fan, 50)
    r = np.sin(at_wall + apex) / np.sin(apex) * np.exp(way * turn * np.tan(p))
    spiral = np.stack([r * np.sin(at_wall + turn), 1 - r * np.cos(at_wall + turn)], axis=1)
    return np.vstack([[0, 0], spiral, [r[-1] * np.sin(apex) / np.sin(rankine), 1]])


@dataclass
class Tilted:
    """Results of a run: tilts (n,) in rad, K (n,) from the thrust, and K (n,) from the moment.

    frame: final corners of the domains (m), plastic shear strains, and shape of the wall.
    """

    tilt: np.ndarray
    thrust: np.ndarray
    moment: np.ndarray
    frame: tuple[np.ndarray, np.ndarray, np.ndarray]
    steps: int
    cuts: int


def tilted(name: str, delta: float, cells: int) -> Tilted:
    """Load the sand, then tilt the wall."""
    way, length, h, mu = WAYS[name], LENGTH[name], 1 / cells, np.tan(np.radians(delta))
    grid = mpm.Grid([-4 * h, -2.5 * h], [length, 1 + 5.5 * h], [round(length / h) + 4, cells + 8])
    turn = {"rotation_rad": lambda t: -way * TILT[name] * max(0, t - 1)}
    wall = mpm.Tool(mpm.HalfSpace((0, 0), (1, 0)), **turn, friction=mu, adhesion=mu * REST, name="wall")
    floor = mpm.Tool(mpm.HalfSpace((0, 0), (0, 1)), friction=np.tan(np.radians(PHI)), adhesion=COHESION)
    load = mpm.Pressure("top", lambda t: LOAD * min(1, t))
    sand = mpm.box(grid, [0, 0], [length, 1])
    s = mpm.Simulation(grid, [sand], [SOIL], walls={"right": "x"}, conditions=[load, wall, floor])
    s.run(1.0, 1 / STEPS[name], progress=False)
    result = s.run(2.0, 1 / STEPS[name], progress=False)
    forces = result.tool_forces["wall"]
    thrust, moment = ((value + REST) / (LOAD + REST) for value in (forces[:, 0], -2 * forces[:, 2]))
    stretch = np.linalg.eigvalsh(s.points.data["plastic"])
    frame = s.points.corners, np.log(stretch[:, -1] / stretch[:, 0]) / 2, wall.drawn(grid, s.t)
    return Tilted(TILT[name] * (np.array(result.t) - 1), thrust, moment, frame, result.steps, result.cuts)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=10, help="cells over the height of the wall")
    parser.add_argument("--delta", nargs="*", type=float, default=[0, 15], help="friction angles of the wall, degrees")
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=WAYS)
    o = parser.parse_args(argv)
    if not 4 <= o.cells <= 40 or any(not 0 <= delta <= 20 for delta in o.delta):
        parser.error(f"--cells {o.cells}: must be 4 to 40; --delta {o.delta}: must be 0 to 20 degrees")
    with common.results(o) as out:
        out |= {"errors": {}, "moments": {}, "cuts": 0, "steps": 0}
        rows, runs = [["wall", "exact", "Coulomb", "thrust", "moment"]], {}
        for name, way in WAYS.items():
            for delta in o.delta if name in o.ways else []:
                run = runs[name, delta] = tilted(name, delta, o.cells)
                K, case = exact(delta, way), f"{name} {delta:g}"
                out["errors"][case], out["moments"][case] = (float(v[-1] / K - 1) for v in (run.thrust, run.moment))
                out["cuts"], out["steps"] = out["cuts"] + run.cuts, out["steps"] + run.steps
                found = [f"{v[-1]:.4f} ({v[-1] / K - 1:+.1%})" for v in (run.thrust, run.moment)]
                rows.append([f"{name}, delta = {delta:g}°", f"{K:.4f}", f"{coulomb(delta, way):.4f}", *found])
        common.table(rows)
        draw(o, runs)
        out["converged"] = all(abs(error) < 0.03 for error in out["errors"].values())
    return out


def draw(o: Namespace, runs: dict[tuple[str, float], Tilted]) -> None:
    """Draw the flowing sand with its exact boundary, and K against the tilt."""
    fig, axes = common.figure(len(runs), 2, (12, 2.5 * len(runs)))
    for (left, right), ((name, delta), run) in zip(axes, runs.items(), strict=True):
        corners, strain, wall = run.frame
        title = f"{name}, δ = {delta:g}°"
        drawn = common.domains(left, corners, 100 * strain, cmap="viridis", clim=(0, 100 * np.quantile(strain, 0.98)))
        fig.colorbar(drawn, ax=left, label="plastic shear (%)", shrink=0.9)
        common.domains(left, wall, facecolor="0.6", edgecolor="0.6")
        left.plot(*slip_line(delta, WAYS[name]).T, "w--", lw=1, label="exact edge")
        left.set(aspect="equal", xlim=(-0.2, LENGTH[name]), ylim=(0, 1.1), xlabel="x (m)", ylabel="y (m)")
        left.set_title(title)
        left.legend(fontsize=9, loc="lower right", labelcolor="w", framealpha=0)
        right.plot(1e3 * run.tilt, run.thrust, "o-", ms=3, label="thrust")
        right.plot(1e3 * run.tilt, run.moment, "s-", ms=3, mfc="none", label="moment about the toe")
        right.axhline(exact(delta, WAYS[name]), color="k", ls="--", lw=0.8, label="exact")
        right.axhline(coulomb(delta, WAYS[name]), color="C3", ls=":", lw=1.2, label="Coulomb's wedge")
        right.set(xlabel="tilt (10⁻³ rad)", ylabel="K (-)", title=title)
        right.legend(fontsize=9)
        right.grid(alpha=0.3)
    common.save(fig, o.out / "retaining_wall.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
