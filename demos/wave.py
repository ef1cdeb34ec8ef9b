# SPDX-License-Identifier: MIT
"""Waves in soil columns, dry and saturated, against exact solutions.

1. A sudden load q acts on a dry column of height L = 10 m. The base is rigid and reflects the wave, or it absorbs the
   wave. The stress on the base is zero until the time L / c, with the wave velocity c. Then the stress is 2 q on a
   rigid base (until 3 L / c), and q on an absorbing base. Behind the front the velocity of the soil is q / (rho c),
   with the density rho. Stresses oscillate behind a front, so their means are compared.
2. A slow or a fast harmonic load acts on a saturated column of 10 m, drained at its top (Zienkiewicz, Chang and Bettess
   1980). Amplitudes and phases of settlement and pore pressures are compared. In the slow case, water drains only from
   a layer of 0.3 m below the top.
3. The column of part 2 carries a sudden load q (after de Boer, Ehlers and Liu 1993). Here water and grains are
   incompressible, and the conductivity is k = 0.01 m/s. Until a wave returns from the base, the settlement of the top
   at the time t is `q / (M a^(1/2)) int_0^t exp(-r s) I_0(r s) ds`. Here `r = b / (2 a)`, I_0 is the modified Bessel
   function, `a = n_s (rho_s - rho_w) / M` and `b = g rho_w / (k M)`. M is the oedometric modulus, and n_s is the volume
   fraction of the grains. The densities of grains and water are rho_s and rho_w.

The equations are the u-p form: water accelerates with the grains. In the saturated columns each cell is 1.05 times as
high as the cell above, so that cells resolve the layer that drains.
"""

from __future__ import annotations

from argparse import Namespace
from functools import partial

import common
import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.special import ive

import mpm_dolfinx as mpm

LENGTH = 10.0  # m
YOUNG, POISSON, POROSITY, GRAINS, WATER = 50e6, 0.3, 0.3, 2700.0, 1000.0  # Pa, -, -, kg/m³, kg/m³
MODULUS = YOUNG * (1 - POISSON) / (1 + POISSON) / (1 - 2 * POISSON)  # Pa, confined
MIXED = (1 - POROSITY) * GRAINS + POROSITY * WATER  # kg/m³
STORED, GRAVITY, LOAD = POROSITY / 2.2e9, 9.81, 1e3  # 1/Pa, m/s², Pa
SOIL = partial(mpm.LinearElastic, bulk=YOUNG / (3 - 6 * POISSON), shear=YOUNG / (2 + 2 * POISSON), porosity=POROSITY)
SMOOTH = {"left": "x", "right": "x"}
HARD = {"young": 14.515e6, "porosity": 0.33, "grains": 2000.0, "conductivity": 1e-2, "load": 3e3}
SWINGS = {"slow": (0.1, 1e-3), "fast": (1.0, 0.1)}  # Π₁, Π₂
BOUNDS = {"stress": 0.02, "velocity": 0.02, "u": 0.01, "p": 0.002, "settlement": 0.01}
GROWTH = 1.05  # height of a cell of saturated columns, divided by that of the cell above


def column(
    cells: int, conditions: list, soil: mpm.Skeleton, growth: float = 1.0, **options
) -> tuple[mpm.Simulation, np.ndarray]:
    """Return a column, one cell wide, and the base and the top of its middle line, in m.

    growth: height of a cell divided by the height of the cell above.
    """
    h = growth ** np.arange(cells)[::-1]
    h *= LENGTH / h.sum()
    y = np.cumsum([0, h[0], *h, h[-1], h[-1]])
    grid = mpm.Grid(lines=[[0, h[-1]], y]) if growth != 1 else mpm.Grid([0, 0], [h[0], y[-1]], [1, cells + 3])
    ends = np.array([[h[-1] / 2, h[0]], [h[-1] / 2, h[0] + LENGTH]])
    body = mpm.box(grid, [0, ends[0, 1]], [h[-1], ends[1, 1]])
    return mpm.Simulation(grid, [body], [soil], walls=SMOOTH, conditions=conditions, inertia=True, **options), ends


def sudden(cells: int, base: str) -> dict[str, np.ndarray]:
    """Return histories of the stress on the base divided by q, and of the top's velocity divided by q / (rho c)."""
    soil, h = SOIL(grain_density=GRAINS), LENGTH / cells
    c = np.sqrt(MODULUS / ((1 - POROSITY) * GRAINS))
    foot = mpm.Quiet("bottom") if base == "quiet" else mpm.Displacement("bottom", (0, 0), "y")
    s, ends = column(cells, [mpm.Traction("top", (0, -LOAD)), foot], soil)
    result = s.run(4 * LENGTH / c, h / c, probes=mpm.probes(s.bodies, ends), progress=False)
    foot_v, top_v = (np.gradient(u, result.t) / (-LOAD * c / MODULUS) for u in result.displacement[:, :, 1].T)
    stress = foot_v if base == "quiet" else result.reactions.array[0, :, 1] / (LOAD * h)
    return {"t": result.t * c / LENGTH, "stress": stress, "velocity": top_v}


def harmonic(w: float, conductivity: float, z: np.ndarray) -> tuple[complex, np.ndarray]:
    """Return the exact amplitudes of settlement (m) and pressures (Pa) at depths z (m), for a load of 1 Pa."""
    k = conductivity / (WATER * GRAVITY)
    # u, p ~ exp(i w t + l z), x = l²
    A = np.array([-k * MODULUS, 0, 0], dtype=complex)
    A[1] = MODULUS * 1j * w * STORED - k * w**2 * MIXED + 1j * w + k * WATER * w**2
    A[2] = w**2 * MIXED * 1j * w * STORED
    roots = np.sqrt(np.roots(A))
    powers = np.concatenate([roots, -roots])
    ratio = (MODULUS * powers**2 + w**2 * MIXED) / powers  # p over u
    at_foot = np.exp(powers * LENGTH)
    rows = [powers, ratio, at_foot, (ratio * powers - w**2 * WATER) * at_foot]
    scale = np.maximum(np.abs(at_foot), 1.0)
    u = np.linalg.solve(np.array(rows) / scale, [-1 / MODULUS, 0, 0, 0]) / scale
    return u.sum(), np.exp(np.outer(z, powers)) @ (u * ratio)


def swinging(
    cells: int, steps: int, periods: int, w: float, conductivity: float, growth: float = GROWTH
) -> tuple[complex, np.ndarray, np.ndarray]:
    """Return the computed amplitudes of settlement (m) and pressures (Pa) for a load of 1 Pa, and their depths (m)."""
    soil = SOIL(grain_density=GRAINS, conductivity=conductivity)
    load = mpm.Traction("top", lambda t: (0, -np.cos(w * t)))
    foot = mpm.Displacement("bottom", (0, 0), "y")
    fluid = mpm.Fluid(density=WATER, bulk=2.2e9)
    s, (_, top) = column(cells, [load, foot, mpm.Drained("top")], soil, growth, fluid=fluid)
    depth = np.array([1.0, 2.5, 5.0, 7.5, 9.999])
    places = [top - [0, z] for z in (0.0, *depth)]
    dt = 2 * np.pi / w / steps
    result = s.run(periods * steps * dt, dt, probes=mpm.probes(s.bodies, places), progress=False)
    wave = 2 / steps * np.exp(-1j * w * result.t[-steps:])
    return -wave @ result.displacement[-steps:, 0, 1], wave @ result.probe_pressure[-steps:, 1:], depth


def hard_exact(t: np.ndarray) -> np.ndarray:
    """Return the exact settlement (m) of a half-space of incompressible water and grains at times t (s)."""
    young, n, k = HARD["young"], HARD["porosity"], HARD["conductivity"]
    M = young * 0.7 / 1.3 / 0.4
    a, b = (1 - n) * (HARD["grains"] - WATER) / M, 1e4 / (k * M)
    fine = np.linspace(0, np.sqrt(t[-1]), 4001) ** 2
    kernel = ive(0, b * fine / (2 * a))
    return np.interp(t, fine, HARD["load"] / (M * np.sqrt(a)) * cumulative_trapezoid(kernel, fine, initial=0))


def hard(cells: int, steps: int, growth: float = GROWTH) -> dict[str, np.ndarray]:
    """Return times (s), and computed and exact settlements (m), of a saturated column under a sudden load."""
    soil = mpm.LinearElastic(
        bulk=HARD["young"] / 1.2,
        shear=HARD["young"] / 2.6,
        porosity=HARD["porosity"],
        grain_density=HARD["grains"],
        conductivity=HARD["conductivity"],
    )
    fluid, foot = mpm.Fluid(density=WATER, bulk=np.inf, gravity=10.0), mpm.Displacement("bottom", (0, 0), "y")
    load = mpm.Traction("top", (0, -HARD["load"]))
    s, (_, top) = column(cells, [load, foot, mpm.Drained("top")], soil, growth, fluid=fluid)
    top = mpm.probes(s.bodies, [top])
    result = s.run(0.1, 0.1 / steps, probes=top, progress=False)
    return {"t": result.t, "u": -result.displacement[:, 0, 1], "exact": hard_exact(result.t)}


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=40, help="cells over the height of the columns")
    parser.add_argument("--steps", type=int, default=50, help="steps in a period of the harmonic load")
    parser.add_argument("--periods", type=int, default=6, help="periods of the harmonic load")
    o = parser.parse_args(argv)
    if min(o.cells, o.steps) < 8 or o.periods < 2:
        parser.error(f"--cells {o.cells}, --steps {o.steps}: must be >= 8; --periods {o.periods}: must be >= 2")
    with common.results(o) as out:
        dry = {base: sudden(o.cells, base) for base in ("rigid", "quiet")}
        found = {base: run["stress"][(run["t"] > 1.3) & (run["t"] < 2.7)] for base, run in dry.items()}
        moves = dry["quiet"]["velocity"][dry["quiet"]["t"] > 0.4]
        out["sudden"] = {
            "stress": max(abs(found["rigid"].mean() / 2 - 1), abs(found["quiet"].mean() - 1)),
            "velocity": abs(moves.mean() - 1),
        }
        swings, out["harmonic"] = {}, {}
        for name, (one, other) in SWINGS.items():
            w = np.sqrt(other * (MODULUS + 1 / STORED) / MIXED) / LENGTH
            k = one * GRAVITY * WATER / MIXED * w * LENGTH**2 / ((MODULUS + 1 / STORED) / MIXED)
            u, p, depth = swinging(o.cells, o.steps, o.periods, w, k)
            exact_u, exact_p = harmonic(w, k, depth)
            swings[name] = w, k, p, depth
            off = {"u": abs(u / exact_u - 1), "p": abs(p - exact_p).max() / abs(exact_p).max()}
            out["harmonic"][name] = {key: float(value) for key, value in off.items()}
        loaded = hard(o.cells, 4 * o.steps)
        late = loaded["t"] > 0.01
        out["hard"] = {"settlement": float(abs(loaded["u"][late] / loaded["exact"][late] - 1).max())}
        out["sudden"] = {key: float(value) for key, value in out["sudden"].items()}
        every = {"sudden": out["sudden"], **out["harmonic"], "hard": out["hard"]}
        rows = [[case, key, f"{off:.2%}"] for case, errors in every.items() for key, off in errors.items()]
        common.table([["load", "quantity", "error"], *rows])
        usual = (o.cells, o.steps, o.periods) == (40, 50, 6)
        out["converged"] = not usual or all(
            off <= BOUNDS[key] for errors in every.values() for key, off in errors.items()
        )
        draw(o, dry, swings, loaded)
    return out


def draw(o: Namespace, dry: dict, swings: dict, loaded: dict[str, np.ndarray]) -> None:
    """Draw stresses on the base, pressure amplitudes against depth, and settlements, with exact solutions."""
    fig, ((base, depth, top),) = common.figure(1, 3, (14, 4.4))
    steps = {"rigid": [0, 0, 2, 2, 0, 0], "quiet": [0, 0, 1, 1, 1, 1]}
    for k, (name, run) in enumerate(dry.items()):
        base.plot(run["t"], run["stress"], color=f"C{k}", lw=1.2, label=f"{name} base")
        base.plot([0, 1, 1, 3, 3, 4], steps[name], "k--", lw=0.8, label=None if k else "exact")
    base.set(xlabel="time / (length / wave speed)", ylabel="stress on the base / load", title="Sudden load, dry column")
    z = np.linspace(0, LENGTH, 201)
    for k, (name, (w, conductivity, p, at)) in enumerate(swings.items()):
        depth.plot(np.abs(harmonic(w, conductivity, z)[1]), z, color="black", lw=1, label=None if k else "exact")
        label = f"$\\Pi_1$ = {SWINGS[name][0]:g}, $\\Pi_2$ = {SWINGS[name][1]:g}"
        depth.plot(np.abs(p), at, "o", ms=5, label=label)
    depth.set(
        xlabel="amplitude of pore pressure / load", ylabel="depth (m)", title="Oscillating load, saturated column"
    )
    depth.invert_yaxis()
    top.plot(1e3 * loaded["t"], 1e3 * loaded["exact"], color="black", lw=1, label="exact")
    every = max(1, len(loaded["t"]) // 40)
    top.plot(1e3 * loaded["t"][::every], 1e3 * loaded["u"][::every], "o", ms=3, label="material points")
    top.set(xlabel="time (ms)", ylabel="settlement (mm)", title="Sudden load, saturated column")
    for ax in (base, depth, top):
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    common.save(fig, o.out / "wave.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
