# SPDX-License-Identifier: MIT
"""Rain on slopes that suction stabilises: factors of safety against time, and a bank that slides.

A slope of b = 35 degrees is much longer than deep, so a column normal to the slope is computed. The column reaches from
the surface to a water table at a depth of 5 m. Only the component of gravity normal to the slope acts on the column.
Vertical rain of nine tenths of the conductivity falls until the flow is steady. At a vertical depth d the factor of
safety is

    FS = tan phi / tan b + 2 c / (gamma d sin 2b) + chi s (tan b + cot b) tan phi / (gamma d)

with friction angle phi, cohesion c, Bishop's suction stress chi s and a constant unit weight gamma. At rest and in
steady flow the suction s of exponential soil is known exactly:

    exp(-alpha s / gamma_w) = q / k + (1 - q / k) exp(-alpha z cos(b)^2).

Here alpha is Gardner's constant, gamma_w is the unit weight of water, q is the rain, and k is the conductivity. The
height above the water table is z. The error is the largest relative error of FS at depths of 1, 2, 3 and 5 m, at rest
and in steady flow. Source: Lu and Godt (2008) for vertical flow.

With `--slope 10` rain falls on a bank of soil, 5 m high and inclined at 60 degrees, on rough rock. Suction and cohesion
stabilise the bank. The cohesion decreases with slip to a tenth of its initial value. The suction decreases until
equilibrium is impossible. Then the bank slides with inertia, runs out over the rock and comes to rest. With 6 cells
over its height, the bank fails after 1.7 h and runs out by 3.2 m. With 10 cells the bank fails after 1.5 h and runs out
by 2.6 m. The demo checks the balances of energy and water. The demo runs on one process.
"""

from __future__ import annotations

from argparse import Namespace
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np

import mpm_dolfinx as mpm

WATER, UNIT = 9810.0, 18e3  # N/m³: of water, and of the soil in the factor of safety
SLOPE, FRICTION, COHESION = np.radians(35.0), np.radians(32.0), 2e3  # -, -, Pa
ALPHA, K, TABLE = 1.5, 1e-5, 5.0  # 1/m, m/s, m below the surface
DEPTHS = np.array([1.0, 2.0, 3.0, 5.0])  # m
DAY = 86400.0  # s
TIMES = (0.25, 0.5, 1.0, 2.0, 20.0)  # days
BANK, BANK_ANGLE, CREST, RANGE = 5.0, np.radians(60.0), 3.0, 11.0  # m, -, m, m
RAIN, LONGEST = 6e-5, 60e3  # m/s; longest time until failure, s
SLIDES, MOVES, FAILS = 6.0, 0.2, 0.05  # duration of the slide, s; smallest displacement in it, m; speed at failure, m/s
REST = 1e-3  # allowed kinetic energy at the end of the slide, divided by its largest value
LEAKS = 2e-8  # allowed error of the water balance, relative to the water in the bank
BALANCE = 0.01  # allowed error of the energy balance, relative to the work of the weight


def column(cells: int) -> mpm.Simulation:
    """Return a column normal to the slope, at rest, with its base at the water table."""
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


class Shot(NamedTuple):
    """State of the bank: time (s), corners (m) and saturations of the domains, and largest speed (m/s)."""

    t: float
    corners: np.ndarray
    saturation: np.ndarray
    speed: float


def bank(cells: int) -> mpm.Simulation:
    """Return a bank on rough rock, with rain on its top and its slope."""
    h = BANK / cells
    toe = CREST + BANK / np.tan(BANK_ANGLE)
    width = np.ceil(RANGE / h) * h
    grid = mpm.Grid([0, 0], [width, BANK + 2 * h], [round(width / h), cells + 2])
    outline = [[0, 0], [toe, 0], [CREST, BANK], [0, BANK]]
    law = {"conductivity": 5e-5, "retention": mpm.VanGenuchten(10e3, residual=0.05, n=2.0), "porosity": 0.4}
    strength = {"friction": 25.0, "dilation": 0.0, "cohesion": 5e3, "residual": 500.0, "slip": 0.1}
    soil = mpm.SofteningDruckerPrager(bulk=17e6, shear=7.7e6, viscosity=300.0, **strength, **law)
    steep = RAIN * np.cos(BANK_ANGLE)
    return mpm.Simulation(
        grid,
        [mpm.polygon(grid, outline, ["bottom", "slope", "top", "left"])],
        [soil],
        fluid=mpm.Fluid(),
        gravity=(0, -9.81),
        walls={"left": "x", "bottom": "xy"},
        conditions=[mpm.Rain("top", RAIN), mpm.Rain("slope", steep, name="on_slope")],
        pressure=mpm.hydrostatic(-1.0),
        initial_stress=mpm.K0(0.5),
        inertia=False,
    )


def slide(o: Namespace) -> dict:
    """Run the bank in the rain until it has failed and come to rest, draw the bank, and return the results."""
    s = bank(o.slope)
    start = float(s.cells().water.sum())
    film = [shot(s)]

    def look(s: mpm.Simulation) -> None:
        film.append(shot(s))

    with suppress(mpm.GaveUp):  # without inertia, a step in which the bank fails has no solution
        s.run(LONGEST, 600, observe=look, progress=False)
    s.stage(inertia=True)
    s.run(LONGEST, 10, until=lambda s: shot(s).speed > FAILS, observe=look, progress=False)
    if film[-1].speed <= FAILS:
        raise SystemExit("the bank does not fail")
    failed, rained = s.t, len(film)
    crept = float(np.linalg.norm(s.points.displacement, axis=1).max())
    result = s.run(failed + SLIDES, o.slide_step, energies=True, observe=look, progress=False)
    moved = np.linalg.norm(s.points.displacement, axis=1)
    e = result.energies
    came = -s.outcome("flowed").array.sum()
    draw_slide(o, film, rained)
    return {
        "failed": failed,
        "crept": crept,
        "speed": max(one.speed for one in film),
        "kinetic": float(e["kinetic"][-1] / e["kinetic"].max()),
        "moved": float(moved.max()),
        "run_out": float(s.points.corners[moved > MOVES][:, :, 0].max() - CREST - BANK / np.tan(BANK_ANGLE)),
        "energy": common.unbalanced(e) / float(e["external"][-1]),
        "water": abs(float(s.cells().water.sum()) - start - came) / start,
    }


def shot(s: mpm.Simulation) -> Shot:
    """Return the present state of the bank."""
    speed = np.linalg.norm(s.points.velocity, axis=1).max() if "velocity" in s.points.data else 0.0
    return Shot(s.t, s.points.corners.copy(), s.point_fields().saturation, float(speed))


def draw_slide(o: Namespace, film: list[Shot], rained: int) -> None:
    """Draw the bank before rain, at failure and at rest, and an animation."""
    fig, (panels,) = common.figure(1, 3, (13, 3.2))
    failed = film[rained - 1].t
    titles = ("before the rain", f"{failed / 3600:.1f} h: it fails", f"{film[-1].t - failed:.0f} s later")
    for ax, one, title in zip(panels, (film[0], film[rained - 1], film[-1]), titles, strict=True):
        drawn = bank_in(ax, one)
        ax.set_title(title)
    fig.colorbar(drawn, ax=panels, label="saturation (-)", shrink=0.8)
    common.save(fig, o.out / "rain_slide.png", dpi=100)
    animate(o.out / "rain_slide.gif", film, rained)


def bank_in(ax, one: Shot):
    """Draw a state of the bank, and return its collection of domains."""
    import matplotlib.pyplot as plt

    cmap = plt.get_cmap("viridis_r", 9)  # few colours: a small animation
    drawn = common.domains(ax, one.corners, one.saturation, cmap=cmap, clim=(0.1, 1.0), linewidth=0.4)
    ax.axhspan(-0.3, 0, color="0.6")
    ax.set(xlim=(0, RANGE), ylim=(-0.3, BANK + 0.3), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    return drawn


def animate(path: Path, film: list[Shot], rained: int) -> None:
    """Draw the rain and the slide as an animation."""
    from PIL import Image

    fig, ((ax,),) = common.figure(1, 1, (5.6, 3.3))
    fig.set_dpi(100)
    drawn = bank_in(ax, film[0])
    fig.colorbar(drawn, ax=ax, label="saturation (-)", shrink=0.9)
    title = ax.set_title(" ")
    fig.canvas.draw()
    fig.set_layout_engine("none")  # laid out once
    failed, step = film[rained - 1].t, film[-1].t - film[-2].t
    sliding = range(rained, len(film), max(1, round(0.2 / step)))
    shown = [*np.linspace(0, rained - 1, 12, dtype=int), *sliding, len(film) - 1]
    frames = []
    for k in shown:
        one = film[k]
        drawn.remove()
        drawn = bank_in(ax, one)
        slides = f"failure + {one.t - failed:.1f} s: {one.speed:.1f} m/s"
        title.set_text(f"rain for {one.t / 3600:.1f} h" if k < rained else slides)
        fig.canvas.draw()
        frames.append(Image.fromarray(np.asarray(fig.canvas.buffer_rgba())[:, :, :3]))
    colours = frames[-1].quantize(24, method=Image.Quantize.MAXCOVERAGE)
    flat = [one.quantize(palette=colours, dither=Image.Dither.NONE) for one in frames]
    lasts = [1200 if k in (0, rained - 1) else 150 for k in shown[:-1]] + [2500]  # ms
    flat[0].save(path, save_all=True, append_images=flat[1:], duration=lasts, loop=0, optimize=True)


def exact(depth: np.ndarray, share: float) -> np.ndarray:
    """Return the exact factors of safety (n,) at depths (n,) in m for rain of `share` times the conductivity."""
    filled = share + (1 - share) * np.exp(-ALPHA * (TABLE - depth) * np.cos(SLOPE) ** 2)
    return safety(depth, -filled * np.log(filled) / ALPHA * WATER)


def safety(depth: np.ndarray, suction_stress: np.ndarray) -> np.ndarray:
    """Return the factors of safety (n,) at depths (n,) in m for suction stresses (n,) in Pa."""
    angles = np.tan(SLOPE) + 1 / np.tan(SLOPE)
    held = 2 * COHESION / (UNIT * depth * np.sin(2 * SLOPE)) + np.tan(FRICTION) / np.tan(SLOPE)
    return held + suction_stress / (UNIT * depth) * angles * np.tan(FRICTION)


def found(s: mpm.Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depths, heads and suction stresses of the cells, from the surface downwards."""
    cell = s.cells()
    depth = TABLE - cell.x[::-1, 1] / np.cos(SLOPE)
    p = cell.pressure[::-1]
    felt = (cell.effective_stress - cell.stress)[::-1, 1, 1]
    return depth, p / WATER, -felt


def error(depth: np.ndarray, suction_stress: np.ndarray, share: float) -> float:
    """Return the largest relative error of the factors of safety at `DEPTHS`."""
    at = np.interp(DEPTHS, np.append(depth, TABLE), np.append(suction_stress, 0.0))
    return float(np.abs(safety(DEPTHS, at) / exact(DEPTHS, share) - 1).max())


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=50, help="cells across the slope")
    parser.add_argument("--step", type=float, default=1800.0, help="step in the first two days, s")
    parser.add_argument(
        "--slope", type=int, default=0, help="cells over the height of a bank that fails, even; 0: no bank"
    )
    parser.add_argument("--slide-step", type=float, default=0.0125, help="step of the slide, s")
    o = parser.parse_args(argv)
    if o.cells < 5:
        parser.error(f"--cells {o.cells}: must be >= 5")
    if o.slope < 0 or o.slope % 2 or not 0.005 <= o.slide_step <= 0.2:
        parser.error(f"--slope {o.slope}: must be 0, 2, 4, ...; --slide-step {o.slide_step:g}: must be in [0.005, 0.2]")
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
            out |= (of := slide(o))
            print(
                f"the bank fails after {of['failed'] / 3600:.2f} h, slides at up to {of['speed']:.1f} m/s, and runs "
                f"out by {of['run_out']:.1f} m; the largest displacement is {of['moved']:.1f} m"
            )
            print(f"errors: energy balance {of['energy']:.2%} of the weight's work, water balance {of['water']:.1e}")
            within = of["energy"] <= BALANCE and of["kinetic"] < REST and of["water"] < LEAKS
            out["converged"] = bool(out["converged"] and (within or (o.slope, o.slide_step) != (10, 0.0125)))
    return out


def draw(o: Namespace, curves: list) -> None:
    """Draw heads and factors of safety against depth, with exact curves."""
    fig, ((left, right),) = common.figure(1, 2, (11, 4.6))
    for days, depth, head, felt in curves:
        left.plot(head, depth, lw=1.4, label=f"{days:g} d")
        right.plot(safety(depth, felt), depth, lw=1.4, label=f"{days:g} d")
    depth = np.linspace(0.4, TABLE, 200)
    for share in (0.0, 0.9):
        right.plot(exact(depth, share), depth, "k--", lw=0.9, label="exact" if share else None)
    right.axvline(1, color="grey", lw=0.8)
    left.set(xlabel="head (m)", ylabel="depth (m)", title="Suction", ylim=(TABLE, 0))
    right.set(xlabel="factor of safety", title="Factor of safety", ylim=(TABLE, 0), xlim=(0.9, 1.5))
    for ax in (left, right):
        ax.grid(alpha=0.3)
        ax.legend()
    common.save(fig, o.out / "rain.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
