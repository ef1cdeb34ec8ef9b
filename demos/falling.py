# SPDX-License-Identifier: MIT
"""A box slides, a ball rolls and a second ball bounces down an incline, compared with the motion of rigid bodies.

The incline has an angle of b = 30 degrees to the grid. The friction coefficient is mu = 0.3. In the time t a rigid box
slides by `g t^2 (sin(b) - mu cos(b)) / 2`, with gravity g. A rigid disc rolls by `g t^2 sin(b) / 3`, if
`mu > tan(b) / 3`. A second disc falls on the incline from a height of its radius, bounces and rotates. Box and discs
are stiff rubber, and touch only the incline. The final energy is the work of gravity, minus the energy that friction
and elastic waves dissipate. The demo needs gmsh.
"""

from __future__ import annotations

from argparse import Namespace

import common
import numpy as np

import mpm_dolfinx as mpm

GRAVITY, ANGLE, FRICTION = 9.81, np.pi / 6, 0.3  # m/s², rad, -
RADIUS, BOX, DROP = 0.15, (0.3, 0.2), 0.15  # m
RUBBER = {"bulk": 1e6, "shear": 6e5, "grain_density": 2000.0}
ALONG = np.array([np.cos(ANGLE), -np.sin(ANGLE)])
NORMAL = np.array([np.sin(ANGLE), np.cos(ANGLE)])
FOOT = np.array([0.2, 1.25])  # m: initial position of the box
NAMES = ("box that slides", "ball that rolls", "ball that bounces")
LASTS = 0.5  # s
BOUNDS = {"slides": 0.005, "rolls": 0.01, "flies": 0.001, "energy": 0.03}


def scene(cells: int) -> tuple[mpm.Simulation, list[np.ndarray]]:
    """Return the scene, with `cells` cells over a radius, and a mask (n,) of the points of each body."""
    h = RADIUS / cells
    size = np.array([2.3, 1.75])
    grid = mpm.Grid([0, 0], (np.ceil(size / h) * h).tolist(), np.ceil(size / h).astype(int).tolist())

    def placed(along: float, corners: np.ndarray, above: float = 0.0) -> np.ndarray:
        return FOOT + (along + corners[:, :1]) * ALONG + (above + corners[:, 1:]) * NORMAL

    around = np.linspace(0, 2 * np.pi, round(2 * np.pi * 4 * cells), endpoint=False)
    disc = RADIUS * np.stack([np.cos(around), 1 + np.sin(around)], axis=1)
    box = np.array([[0, 0], [BOX[0], 0], BOX, [0, BOX[1]]])
    shapes = [placed(0.0, box), placed(0.8, disc), placed(1.3, disc, DROP)]
    bodies = [mpm.polygon(grid, corners, sides="rim") for corners in shapes]
    incline = mpm.Tool(mpm.HalfSpace(tuple(FOOT), tuple(NORMAL)), friction=FRICTION, name="incline")
    options = {"walls": {}, "conditions": [incline], "gravity": (0, -GRAVITY), "inertia": True}
    s = mpm.Simulation(grid, bodies, [mpm.Hencky(**RUBBER)], **options)
    ends = np.cumsum([len(body) for body in bodies])
    return s, [(s.points.id >= end - len(body)) & (s.points.id < end) for end, body in zip(ends, bodies, strict=True)]


def fall(s: mpm.Simulation, parts: list[np.ndarray], dt: float) -> tuple[mpm.Result, np.ndarray, list]:
    """Release the bodies, and return the result, the paths (times, 7), and the corners of the domains at some times.

    Each row of the paths has the time (s) and the positions (x, y) of three centres of mass (m).
    """
    mass = s.scene.materials.density(s.points) * s.points.volume0 * s.points.J
    rows, shapes = [], []

    def look(s: mpm.Simulation) -> None:
        centres = [mass[on] @ s.points.x[on] / mass[on].sum() for on in parts]
        rows.append([s.t, *np.concatenate(centres)])
        if len(rows) % max(1, round(LASTS / dt / 4)) == 1:
            shapes.append(s.points.corners.copy())

    look(s)
    result = s.run(LASTS, dt, energies=True, observe=look, progress=False)
    return result, np.array(rows), shapes


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=5, help="cells over a ball's radius")
    parser.add_argument("--dt", type=float, default=0.005, help="step, s")
    o = parser.parse_args(argv)
    if o.cells < 3 or not 1e-4 <= o.dt <= 0.05:
        parser.error(f"--cells {o.cells}: must be >= 3; --dt {o.dt:g}: must be in [1e-4, 0.05]")
    with common.results(o) as out:
        s, parts = scene(o.cells)
        result, rows, shapes = fall(s, parts, o.dt)
        t, centres = rows[:, 0], rows[:, 1:].reshape(-1, 3, 2)
        way, above = (centres - centres[0]) @ ALONG, (centres[:, 2] - centres[0, 2]) @ NORMAL
        pulls, presses = GRAVITY * np.sin(ANGLE), GRAVITY * np.cos(ANGLE)
        rigid = [pulls - FRICTION * presses, 2 / 3 * pulls]
        for k, name in enumerate(("slides", "rolls")):
            out[name] = float(way[-1, k] / (rigid[k] * t[-1] ** 2 / 2) - 1)
        flight = t < 0.95 * np.sqrt(2 * DROP / presses)
        out["flies"] = float(np.abs(above + presses * t**2 / 2)[flight].max() / DROP)
        struck = np.argmin(above)
        out["height"] = float((above[struck:].max() + DROP) / DROP)
        e = result.energies
        out["energy"] = common.unbalanced(e) / float(e["external"][-1])
        out["friction"] = float(e["friction"][-1] / e["external"][-1])
        print(f"error of the distance: sliding box {out['slides']:+.2%}, rolling ball {out['rolls']:+.2%}")
        print(f"falling ball: rebounds to {out['height']:.0%} of its height; error of the flight {out['flies']:.2%}")
        balance = f"energy balance {out['energy']:.2%}, friction {out['friction']:.0%}"
        print(f"relative to the work of the weight: error of the {balance}")
        within = all(abs(out[name]) <= most for name, most in BOUNDS.items())
        out["converged"] = within or (o.cells, o.dt) != (5, 0.005)
        draw(o, result, t, way, above, shapes, rigid)
    return out


def draw(o: Namespace, result: mpm.Result, t, way, above, shapes, rigid) -> None:
    """Draw the bodies, their distances against those of rigid bodies, and the energies."""
    fig, ((scene_, ways, energy),) = common.figure(1, 3, (15, 4.2))
    for k, corners in enumerate(shapes):
        shade = 0.25 + 0.75 * k / max(1, len(shapes) - 1)
        common.domains(scene_, corners, facecolor="C0", edgecolors="white", linewidth=0.1, alpha=shade)
    ends = np.array([FOOT - 0.1 * ALONG, FOOT + 2.2 * ALONG])
    scene_.fill_between(ends[:, 0], ends[:, 1], 0, color="tan")
    scene_.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="Four moments")
    for k, (name, a) in enumerate(zip(NAMES, [*rigid, None], strict=True)):
        ways.plot(t, way[:, k], lw=1, color=f"C{k}", label=name)
        if a is not None:
            ways.plot(t[::8], a * t[::8] ** 2 / 2, "o", ms=3, color=f"C{k}", label="rigid")
    ways.plot(t, above + DROP, "--", lw=1, color="C2", label="its height above the incline")
    ways.set(xlabel="time (s)", ylabel="distance along the incline (m)", title="Distance", ylim=(0, None))
    e = result.energies
    for name, label in (("external", "work of the weight"), ("kinetic",) * 2, ("friction",) * 2, ("elastic",) * 2):
        energy.plot(result.t, e[name], lw=1, label=label)
    energy.set(xlabel="time (s)", ylabel="energy (J/m)", title="Energies")
    for ax in (ways, energy):
        ax.legend(fontsize=8)
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "falling.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
