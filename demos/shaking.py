# SPDX-License-Identifier: MIT
"""A shear wave from the ground enters a soft layer: amplification at the surface against the exact solution.

Shear waves have a velocity of 100 m/s in a layer of 10 m, and of 300 m/s in the ground below the layer. The computed
ground ends at an absorbing base, 5 m below the layer. A shear pulse enters through this base, and reflections from
layer and surface leave through it. The sides have no vertical displacement, as in an infinite layer. The reference is
the motion of the ground's free surface without a layer, which is twice the incoming wave. The spectrum of the surface
motion, divided by the spectrum of the reference motion, is

    1 / |cos(w H / c) + i a sin(w H / c)|,        a = rho c / (rho_g c_g),

with the angular frequency w, the thickness H, the wave velocity c and the density rho of the layer. The wave velocity
and the density of the ground are c_g and rho_g. The energy balance includes the work of the incoming wave and of the
absorbing base.
"""

from __future__ import annotations

from argparse import Namespace

import common
import numpy as np

import mpm_dolfinx as mpm

LAYER, GROUND = 10.0, 5.0  # m: thickness of the layer, and of the ground in the scene
SPEEDS, DENSITIES, POISSON = (300.0, 100.0), (2100.0, 1900.0), 0.3  # ground, layer: m/s, kg/m³; both: -
PULSE, CENTRE, LENGTH = 3.0, 0.4, 3.0  # Hz, s, s: frequency and middle of Ricker's wavelet, duration of the run
BAND = (0.5, 6.5)  # Hz: range in which spectra are compared
BOUNDS = {"amplification": 0.03, "energy": 0.01}


def soil(speed: float, density: float) -> mpm.LinearElastic:
    """Return a soil with this velocity of shear waves, in m/s, and this density, in kg/m³."""
    shear = density * speed**2
    bulk = 2 * shear * (1 + POISSON) / (3 - 6 * POISSON)
    return mpm.LinearElastic(bulk=bulk, shear=shear, porosity=0.4, grain_density=density / 0.6)


def incoming(t: np.ndarray) -> np.ndarray:
    """Return the velocity of the incoming wave, Ricker's wavelet, in m/s."""
    s = (np.pi * PULSE * (t - CENTRE)) ** 2
    return 0.1 * (1 - 2 * s) * np.exp(-s)


def shaken(cells: int, steps: int) -> tuple[mpm.Result, np.ndarray]:
    """Return the result of a run, and the velocity of the surface, in m/s."""
    h = LAYER / cells
    rows = round(GROUND / h)
    grid = mpm.Grid([0, -GROUND - h], [4 * h, LAYER + h], [4, cells + rows + 2])
    bodies = [
        mpm.box(grid, [h, -GROUND], [3 * h, 0]),
        mpm.box(grid, [h, 0], [3 * h, LAYER], material=1),
    ]
    t = np.linspace(0, LENGTH, 2 * steps + 1)
    record = mpm.Record(np.stack([t, incoming(t)], axis=1), (1, 0), "velocity")
    base = mpm.Quiet("bottom", record.velocity, region=([0, -GROUND], [4 * h, -GROUND]))
    level = [mpm.Displacement(side, (0, 0), "y") for side in ("left", "right")]
    soils = [soil(*each) for each in zip(SPEEDS, DENSITIES, strict=True)]
    s = mpm.Simulation(grid, bodies, soils, walls={}, conditions=[base, *level], inertia=True)
    top = mpm.probes(bodies, [[2 * h, LAYER]])
    result = s.run(LENGTH, LENGTH / steps, probes=top, energies=True, progress=False)
    return result, np.gradient(result.displacement[:, 0, 0], result.t)


def exact(f: np.ndarray) -> np.ndarray:
    """Return the exact amplification at the frequencies f, in Hz."""
    phase = 2 * np.pi * f * LAYER / SPEEDS[1]
    a = DENSITIES[1] * SPEEDS[1] / (DENSITIES[0] * SPEEDS[0])
    return 1 / np.abs(np.cos(phase) + 1j * a * np.sin(phase))


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=20, help="cells over the layer, even")
    parser.add_argument("--steps", type=int, default=500, help="steps of the run")
    o = parser.parse_args(argv)
    if o.cells < 4 or o.cells % 2 or o.steps < 50:
        parser.error(f"--cells {o.cells}: must be even and >= 4; --steps {o.steps}: must be >= 50")
    with common.results(o) as out:
        result, surface = shaken(o.cells, o.steps)
        came = incoming(result.t)
        f = np.fft.rfftfreq(8 * len(came), result.t[1])
        found = np.abs(np.fft.rfft(surface, 8 * len(came)) / np.fft.rfft(came, 8 * len(came))) / 2
        band = (BAND[0] <= f) & (f <= BAND[1])
        out["amplification"] = float(np.abs(found[band] / exact(f[band]) - 1).max())
        e = result.energies
        total = e["kinetic"] + e["elastic"] + e["dissipated"] + e["viscous"] - e["external"]
        out["energy"] = float(np.abs(total - total[0]).max() / e["external"][-1])
        out["left"] = float((e["kinetic"] + e["elastic"])[-1] / e["external"][-1])
        rows = [["amplification, largest error", f"{out['amplification']:.2%}"]]
        rows += [["error of the energy balance / work of the wave", f"{out['energy']:.2%}"]]
        common.table([["", ""], *rows, ["remaining energy / work of the wave", f"{out['left']:.1e}"]])
        usual = (o.cells, o.steps) == (20, 500)
        out["converged"] = not usual or all(out[name] <= most for name, most in BOUNDS.items())
        draw(o, result, surface, f[band], found[band])
    return out


def draw(o: Namespace, result: mpm.Result, surface: np.ndarray, f: np.ndarray, found: np.ndarray) -> None:
    """Draw velocities, amplification and energies."""
    fig, ((moves, over, energy),) = common.figure(1, 3, (14, 4.2))
    moves.plot(result.t, surface, lw=1, label="surface of the layer")
    moves.plot(result.t, incoming(result.t), color="black", lw=1, label="incoming wave, at the base")
    moves.set(xlabel="time (s)", ylabel="velocity (m/s)", title="Shear wave from below", xlim=(0, 2))
    over.plot(f, exact(f), color="black", lw=1, label="exact")
    over.plot(f[::4], found[::4], "o", ms=3, label="material points")
    over.set(xlabel="frequency (Hz)", ylabel="surface / twice the incoming wave", title="Amplification")
    e = result.energies
    scale = e["external"][-1]
    energy.plot(result.t, e["external"] / scale, color="black", lw=1, label="work of the wave at the base")
    energy.plot(result.t, e["viscous"] / scale, lw=1, label="work against the quiet base")
    energy.plot(result.t, (e["kinetic"] + e["elastic"]) / scale, lw=1, label="kinetic and elastic")
    energy.set(xlabel="time (s)", ylabel="energy / work of the wave", title="Energies", xlim=(0, 2))
    for ax in (moves, over, energy):
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    common.save(fig, o.out / "shaking.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
