# SPDX-License-Identifier: MIT
"""Amplification of a shear wave in a soft layer, and sliding of a clay bank on a shaken base.

**Layer.** Shear waves have a velocity of 100 m/s in a layer of 10 m, and of 300 m/s in the ground below the layer. The
computed ground ends at an absorbing base, 5 m below the layer. A shear pulse enters through this base, and reflections
from layer and surface leave through it. The sides have no vertical displacement, as in an infinite layer. The reference
is the motion of the ground's free surface without a layer, which is twice the incoming wave. The spectrum of the
surface motion, divided by the spectrum of the reference motion, is

    1 / abs(cos(w H / c) + i a sin(w H / c)),    a = rho c / (rho_g c_g),

with the angular frequency w, the thickness H, the wave velocity c and the density rho of the layer. The wave velocity
and the density of the ground are c_g and rho_g. The energy balance includes the work of the incoming wave and of the
absorbing base.

**Bank.** A bank of undrained clay, 5 m high with a slope of 1:1, stands on a rough base. Its strength increases with
depth. The base moves horizontally with three periods of a harmonic acceleration. The bank fails under the acceleration
k g, at which its factor of safety is one. The amplitude is 2 k g, so the bank slides in each period, and comes to rest
again. The reference is the sliding block of Newmark (1965, Geotechnique 15, 139). The outward velocity V of the block
follows

    dV/dt = C (a - k g)    while a > k g or V > 0,

with the acceleration a of the base towards the bank. The coefficient C is one for a block on a horizontal plane. For
the bank, the balance of power gives C = sum(m phi_x) / sum(m phi.phi). Here m is the mass of a point, and phi is its
final displacement, divided by the final displacement of the crest.
"""

from __future__ import annotations

from argparse import Namespace
from typing import NamedTuple

import common
import numpy as np

import mpm_dolfinx as mpm

LAYER, GROUND = 10.0, 5.0  # m: thickness of the layer, and of the ground in the scene
SPEEDS, DENSITIES, POISSON = (300.0, 100.0), (2100.0, 1900.0), 0.3  # ground, layer: m/s, kg/m³; both: -
PULSE, CENTRE, LENGTH = 3.0, 0.4, 3.0  # Hz, s, s: frequency and middle of Ricker's wavelet, duration of the run
BAND = (0.5, 6.5)  # Hz: range in which spectra are compared
HEIGHT, CREST, TOE, SPEED = 5.0, 10.0, 3.0, 200.0  # m: bank; width of the crest, and of the grid beyond the toe; m/s
STRENGTH, STRONGER = 10e3, 5e3  # Pa, Pa/m: undrained strength at the crest, and its increase with depth
DENSITY, GRAVITY = 2000.0, 9.81  # kg/m³, m/s²
NEAR = (0.2, 0.28)  # horizontal accelerations / g, for which the factor of safety is computed
LOUD, PERIOD, PERIODS = 2.0, 1.0, 3  # amplitude / (k g), s, -: acceleration of the base
BOUNDS = {"amplification": 0.03, "energy": 0.01, "bank": 0.1, "bank_energy": 0.01}


def soil(speed: float, density: float) -> mpm.LinearElastic:
    """Return a soil with this velocity of shear waves (m/s) and this density (kg/m³)."""
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


def bank(cells: int, lateral: float) -> mpm.Simulation:
    """Return the bank in static equilibrium.

    cells: cells over the height.
    lateral: horizontal acceleration towards the toe, divided by g.
    """
    h = HEIGHT / cells
    middle, columns = round((CREST + HEIGHT / 2) / h) * h, round((CREST + HEIGHT + TOE) / h)
    grid = mpm.Grid([-2 * h, -h], [(columns + 2) * h, HEIGHT + 2 * h], [columns + 4, cells + 3])

    def sloping(X: np.ndarray) -> np.ndarray:
        return np.stack([X[:, 0] / middle * (CREST + HEIGHT - X[:, 1]), X[:, 1]], axis=1)

    body = mpm.mapped(grid, mpm.box(grid, [0, 0], [middle, HEIGHT]), sloping)
    shear, poisson = DENSITY * SPEED**2, 0.49
    clay = mpm.MohrCoulomb(
        bulk=2 * shear * (1 + poisson) / (3 - 6 * poisson),
        shear=shear,
        friction=0.0,
        dilation=0.0,
        cohesion=lambda X: STRENGTH + STRONGER * (HEIGHT - X[:, 1]),
        porosity=0.4,
        grain_density=DENSITY / 0.6,
    )
    held = [mpm.Displacement("bottom", (0, 0)), mpm.Displacement("left", (0, 0), "x")]
    gravity = (lateral * GRAVITY, -GRAVITY)
    s = mpm.Simulation(grid, [body], [clay], walls={}, conditions=held, gravity=gravity, inertia=False)
    s.run(1.0, 1.0, progress=False)
    return s


def yield_acceleration(cells: int) -> float:
    """Return the horizontal acceleration, divided by g, at which the bank's factor of safety is one.

    The inverse of the factor of safety is almost linear in the acceleration.
    """
    shares = [1 / mpm.factor_of_safety(bank(cells, k), rtol=0.005, progress=False).factor for k in NEAR]
    return NEAR[0] + (1 - shares[0]) * (NEAR[1] - NEAR[0]) / (shares[1] - shares[0])


class Slide(NamedTuple):
    """Motion of the bank: times (n,) in s, and sliding displacements (n,) of the crest and of Newmark's block, in m.

    base: displacement (n,) of the base, in m.
    corners, moved: final corners of the particle domains, and their displacements relative to the base, in m.
    energy: largest error of the energy balance, divided by the largest work.
    """

    t: np.ndarray
    crest: np.ndarray
    block: np.ndarray
    base: np.ndarray
    corners: np.ndarray
    moved: np.ndarray
    energy: float


def sliding(cells: int, steps: int, k: float) -> Slide:
    """Shake the bank's base with `steps` steps a period; k g is the acceleration at which the bank fails."""
    s = bank(cells, 0.0)
    s.stage(reset_displacement=True)
    s.t = 0.0
    before = s.points.corners.mean(axis=1)
    t = np.linspace(0, PERIODS * PERIOD, 200 * PERIODS + 1)
    quake = np.stack([t, LOUD * k * GRAVITY * np.sin(2 * np.pi * t / PERIOD)], axis=1)
    record = mpm.Record(quake, (1, 0), at_rest=True)
    s.stage(inertia=True, conditions=[mpm.Displacement("bottom", record), mpm.Displacement("left", record, "x")])
    end = (PERIODS + 0.3) * PERIOD
    crest = mpm.probes(s.bodies, [[CREST, HEIGHT]])
    result = s.run(end, PERIOD / steps, probes=crest, energies=True, progress=False)
    base = np.array([record(time) for time in result.t])
    slid = np.linalg.norm(result.displacement[:, 0] - base, axis=1)
    moved = s.points.corners.mean(axis=1) - before - base[-1]
    phi, mass = moved / slid[-1], s.points.volume0
    shape = (mass @ phi[:, 0]) / (mass @ (phi**2).sum(axis=1))
    fine = np.linspace(0, end, 50 * len(result.t))
    velocity = np.array([record.velocity(time)[0] for time in fine])
    speed = shape * (-velocity - k * GRAVITY * fine)
    speed -= np.minimum.accumulate(speed)  # a block that would slide inwards rests
    block = np.interp(result.t, fine, np.cumsum(speed) * fine[1])
    work = result.energies["external"]
    energy = common.unbalanced(result.energies) / np.abs(work - work[0]).max()
    return Slide(result.t, slid, block, base[:, 0], s.points.corners, np.linalg.norm(moved, axis=1), energy)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=20, help="cells over the layer, even")
    parser.add_argument("--steps", type=int, default=500, help="steps of the layer's run")
    parser.add_argument("--bank-cells", type=int, default=10, help="cells over the height of the bank")
    parser.add_argument("--bank-steps", type=int, default=100, help="steps in a period of the bank's base")
    o = parser.parse_args(argv)
    if o.cells < 4 or o.cells % 2 or o.steps < 50:
        parser.error(f"--cells {o.cells}: must be even and >= 4; --steps {o.steps}: must be >= 50")
    if o.bank_cells < 4 or o.bank_steps < 20:
        parser.error(f"--bank-cells {o.bank_cells}: must be >= 4; --bank-steps {o.bank_steps}: must be >= 20")
    with common.results(o) as out:
        result, surface = shaken(o.cells, o.steps)
        came = incoming(result.t)
        f = np.fft.rfftfreq(8 * len(came), result.t[1])
        found = np.abs(np.fft.rfft(surface, 8 * len(came)) / np.fft.rfft(came, 8 * len(came))) / 2
        band = (BAND[0] <= f) & (f <= BAND[1])
        out["amplification"] = float(np.abs(found[band] / exact(f[band]) - 1).max())
        e = result.energies
        out["energy"] = common.unbalanced(e) / float(e["external"][-1])
        out["left"] = float((e["kinetic"] + e["elastic"])[-1] / e["external"][-1])
        rows = [["amplification, largest error", f"{out['amplification']:.2%}"]]
        rows += [["error of the energy balance / work of the wave", f"{out['energy']:.2%}"]]
        rows += [["remaining energy / work of the wave", f"{out['left']:.1e}"]]
        out["k"] = k = yield_acceleration(o.bank_cells)
        slide = sliding(o.bank_cells, o.bank_steps, k)
        out |= {"slid": float(slide.crest[-1]), "newmark": float(slide.block[-1]), "bank_energy": slide.energy}
        out["bank"] = abs(out["slid"] / out["newmark"] - 1)
        rows += [["acceleration at which the bank fails / g", f"{k:.3f}"]]
        rows += [["sliding of the bank's crest", f"{out['slid']:.3f} m"]]
        rows += [["sliding of Newmark's block", f"{out['newmark']:.3f} m"]]
        rows += [["error of the bank's energy balance / work", f"{out['bank_energy']:.2%}"]]
        common.table([["", ""], *rows])
        usual = (o.cells, o.steps, o.bank_cells, o.bank_steps) == (20, 500, 10, 100)
        out["converged"] = not usual or all(out[name] <= most for name, most in BOUNDS.items())
        draw(o, result, surface, f[band], found[band], slide)
    return out


def draw(o: Namespace, result: mpm.Result, surface: np.ndarray, f: np.ndarray, found: np.ndarray, slide: Slide) -> None:
    """Draw velocities, amplification and energies of the layer, and the sliding bank."""
    fig, ((moves, over, energy), (shape, slid, base)) = common.figure(2, 3, (14, 7.8))
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
    quads = common.domains(shape, slide.corners, slide.moved, cmap="viridis")
    fig.colorbar(quads, ax=shape, label="displacement relative to the base (m)", shrink=0.7)
    shape.plot([0, CREST, CREST + HEIGHT], [HEIGHT, HEIGHT, 0], color="grey", lw=0.8)
    shape.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="Clay bank after shaking; grey: before")
    shape.autoscale_view()
    slid.plot(slide.t, slide.crest, lw=1.2, label="crest, material points")
    slid.plot(slide.t, slide.block, "k--", lw=1, label="Newmark's block")
    slid.set(xlabel="time (s)", ylabel="displacement relative to the base (m)", title="Sliding of the bank")
    base.plot(slide.t, slide.base, color="black", lw=1, label="base")
    base.plot(slide.t, slide.base + slide.crest, lw=1, label="base, plus sliding of the crest")
    base.set(xlabel="time (s)", ylabel="displacement (m)", title="Motion of the base")
    for ax in (moves, over, energy, slid, base):
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    common.save(fig, o.out / "shaking.png", dpi=100)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
