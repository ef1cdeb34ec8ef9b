# SPDX-License-Identifier: MIT
"""Rain on slopes that suction stabilises: factors of safety in time, with exact limits, and a bank that slides.

A slope of 35 degrees is much longer than deep, so the problem is one-dimensional across it.  A column stands on a water
table 5 m below the surface, under the component of gravity across the slope.  It starts at rest.  Then rain falls
vertically, nine tenths of the conductivity, until the flow is steady.  At a depth d (vertical)

    FS = tan phi / tan b + 2 c / (gamma d sin 2b) + chi s / (gamma d) (tan b + cot b) tan phi

with the suction stress chi s of Bishop and a constant unit weight gamma.  Before and after the storm this is exact for
exponential soil: exp(-alpha s / gamma_w) = q / k + (1 - q / k) exp(-alpha z cos^2 b), z above the table.

Source: Lu and Godt (2008) for vertical flow; across the slope, gravity is its component.  Errors: the largest error
of FS at 1, 2, 3 and 5 m, at rest and at the end.

With `--slope 8` a bank of sand 1 m high stands by its suction, and a storm falls on it.  Once its toe is wet, no
equilibrium is found.  With inertia it goes on, slides and slows down.  Checks: its water is what came in.  When it
fails, and how far it goes before, depends on the cells.  On one process.
"""

from __future__ import annotations

from argparse import Namespace

import common
import numpy as np

import mpm_dolfinx as mpm

WATER, UNIT = 9810.0, 18e3  # N/m³: of water, and of the soil in the factor of safety
SLOPE, FRICTION, COHESION = np.radians(35.0), np.radians(32.0), 2e3  # -, -, Pa
ALPHA, K, TABLE = 1.5, 1e-5, 5.0  # 1/m, m/s, m below the surface
DEPTHS = np.array([1.0, 2.0, 3.0, 5.0])  # m
DAY = 86400.0  # s
TIMES = (0.25, 0.5, 1.0, 2.0, 20.0)  # days


def column(cells: int) -> mpm.Simulation:
    """Return the column at rest with cells across the slope, and its foot at the water table."""
    height = TABLE * np.cos(SLOPE)
    h = height / cells
    grid = mpm.Grid([0, 0], [h, height + 2 * h], [1, cells + 2])
    law = {"conductivity": K, "retention": mpm.Gardner(WATER / ALPHA)}
    soil = mpm.Hencky(bulk=1e10, shear=5e9, porosity=0.35, **law)
    return mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [h, height])],
        [soil],
        fluid=mpm.Fluid(gravity=9.81),
        gravity=(0, -9.81 * np.cos(SLOPE)),
        walls={"left": "x", "right": "x", "bottom": "y"},
        conditions=[mpm.Drained("bottom"), mpm.Rain("top", lambda t: 0.9 * K * np.cos(SLOPE) * (t > 0), name="rain")],
        pressure=lambda x: -WATER * np.cos(SLOPE) * x[:, 1],
        initial_stress=mpm.K0(0.5),
    )


def bank(cells: int) -> mpm.Simulation:
    """Return a bank of sand with cells over its height, in a storm three times as strong as its conductivity."""
    grid = mpm.Grid([0, 0], [3.5, 1.25], [7 * cells // 2, 5 * cells // 4])
    law = {"conductivity": 1e-4, "retention": mpm.VanGenuchten(5e3, residual=0.05, n=2.5), "porosity": 0.4}
    soil = mpm.MohrCoulomb(bulk=3e6, shear=1.5e6, friction=25.0, dilation=0.0, cohesion=100.0, **law)
    sides = ["bottom", "slope", "top", "left"]
    return mpm.Simulation(
        grid,
        [mpm.polygon(grid, [[0, 0], [1.9, 0], [1, 1], [0, 1]], sides)],
        [soil],
        fluid=mpm.Fluid(),
        gravity=(0, -9.81),
        walls={"left": "x", "bottom": "xy"},
        conditions=[mpm.Rain("top", 3e-4, name="rain")],
        pressure=mpm.hydrostatic(-0.35),
        initial_stress=mpm.K0(0.5),
        inertia=False,
    )


def water(s: mpm.Simulation) -> float:
    """Return the water in the pores, m²."""
    return float(s.cells().water.sum())


def slide(o: Namespace) -> dict:
    """Let the bank fail and run out; return what came of it, and draw it."""
    s = bank(o.slope)
    start = water(s)
    fig, (axes,) = common.figure(1, 3, (13, 3.6))
    mpm.plot(s, "saturation", ax=axes[0], clim=(0.2, 1.0))
    try:
        s.run(4000, 100)
        raise SystemExit("the bank stands")
    except mpm.GaveUp:
        failed = s.t
    mpm.plot(s, "saturation", ax=axes[1], clim=(0.2, 1.0))
    s.stage(inertia=True)
    speeds = []
    for _ in range(8):
        s.run(s.t + 0.25, 0.025)
        speeds.append(float(np.linalg.norm(s.points.data["velocity"], axis=1).max()))
    mpm.plot(s, "saturation", ax=axes[2], clim=(0.2, 1.0))
    for ax, title in zip(axes, ("before the storm", f"{failed:.0f} s: it fails", "2 s later"), strict=True):
        ax.set(title=title, xlim=(0, 3), ylim=(0, 1.15))
    common.save(fig, o.out / "rain_slide.png")
    came = -s.outcome("flowed").array.sum()
    moved = float(np.linalg.norm(s.points.displacement, axis=1).max())
    return {"failed": failed, "speeds": speeds, "moved": moved, "water": abs(water(s) - start - came) / start}


def exact(depth: np.ndarray, share: float) -> np.ndarray:
    """Return the exact factors of safety at depths (m), of a rain that is a share of the conductivity."""
    filled = share + (1 - share) * np.exp(-ALPHA * (TABLE - depth) * np.cos(SLOPE) ** 2)
    return safety(depth, -filled * np.log(filled) / ALPHA * WATER)


def safety(depth: np.ndarray, suction_stress: np.ndarray) -> np.ndarray:
    """Return the factors of safety at depths (m), by chi s (Pa)."""
    angles = np.tan(SLOPE) + 1 / np.tan(SLOPE)
    held = 2 * COHESION / (UNIT * depth * np.sin(2 * SLOPE)) + np.tan(FRICTION) / np.tan(SLOPE)
    return held + suction_stress / (UNIT * depth) * angles * np.tan(FRICTION)


def found(s: mpm.Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depths, m, heads, m, and chi s, Pa, of the cells from the surface down."""
    cell = s.cells()
    depth = TABLE - cell.x[::-1, 1] / np.cos(SLOPE)
    p = cell.pressure[::-1]
    felt = (cell.effective_stress - cell.stress)[::-1, 1, 1]
    return depth, p / WATER, -felt


def error(depth: np.ndarray, suction_stress: np.ndarray, share: float) -> float:
    """Return the largest error of the factors of safety at `DEPTHS`; at the table itself there is no suction."""
    at = np.interp(DEPTHS, np.append(depth, TABLE), np.append(suction_stress, 0.0))
    return float(np.abs(safety(DEPTHS, at) / exact(DEPTHS, share) - 1).max())


def main(argv: list[str] | None = None) -> dict:
    """Run the demo; return the results of --json."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=50, help="cells across the slope")
    parser.add_argument("--step", type=float, default=1800.0, help="step in the first two days, s")
    parser.add_argument(
        "--slope", type=int, default=0, help="cells over the height of a bank that fails, a multiple of 4; 0: no bank"
    )
    o = parser.parse_args(argv)
    if o.cells < 5:
        parser.error(f"--cells {o.cells}: must be >= 5")
    if o.slope < 0 or o.slope % 4:
        parser.error(f"--slope {o.slope}: must be 0, 4, 8, ...")
    with common.results(o) as out:
        s = column(o.cells)
        curves = [(0.0, *found(s))]
        for days in TIMES:
            s.run(days * DAY, o.step if days <= 2 else DAY)
            curves.append((days, *found(s)))
        errors = [error(*curve[1::2], share) for curve, share in ((curves[0], 0.0), (curves[-1], 0.9))]
        least = [float(safety(depth, felt)[depth <= 3.5].min()) for _, depth, _, felt in curves]
        out |= {"errors": errors, "least": least, "converged": s.result.converged}
        rows = [[f"{days:g} d", f"{factor:.3f}"] for (days, *_), factor in zip(curves, least, strict=True)]
        common.table([["time", "least factor in the upper 3.5 m"], *rows])
        print(f"error of the factor at rest {errors[0]:.1e}, in steady rain {errors[1]:.1e}")
        draw(o, curves)
        if o.slope:
            out |= (found_of := slide(o))
            print(
                f"the bank fails after {found_of['failed']:.0f} s, slides at up to {max(found_of['speeds']):.2f} m/s, "
                f"and has moved by {found_of['moved']:.2f} m at most (last speed {found_of['speeds'][-1]:.3f} m/s); "
                f"its water is balanced to {found_of['water']:.1e}"
            )
    return out


def draw(o: Namespace, curves: list) -> None:
    """Draw heads and factors of safety over the depth, with the exact ones at rest and in steady rain."""
    fig, ((left, right),) = common.figure(1, 2, (11, 4.6))
    for days, depth, head, felt in curves:
        left.plot(head, depth, lw=1.4, label=f"{days:g} d")
        right.plot(safety(depth, felt), depth, lw=1.4, label=f"{days:g} d")
    depth = np.linspace(0.4, TABLE, 200)
    for share in (0.0, 0.9):
        right.plot(exact(depth, share), depth, "k--", lw=0.9, label="exact" if share else None)
    right.axvline(1, color="grey", lw=0.8)
    left.set(xlabel="head, m", ylabel="depth, m", title="Suction fades from above", ylim=(TABLE, 0))
    right.set(xlabel="factor of safety", title="and with it the strength", ylim=(TABLE, 0), xlim=(0.9, 1.5))
    for ax in (left, right):
        ax.grid(alpha=0.3)
        ax.legend()
    common.save(fig, o.out / "rain.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
