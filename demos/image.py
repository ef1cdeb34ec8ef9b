# SPDX-License-Identifier: MIT
"""Tissue from an image is compressed by a plate and drains; grey values give the stiffness, black pixels are holes.

The image is smoothed noise; an array from a scanner can be used instead. Each pixel is a cell of the grid. `mpm.shape`
keeps all pixels that are not black. The constants of the law depend on the grey value: white tissue is ten times as
stiff as black tissue, and less permeable. A rigid permeable plate compresses the tissue between smooth walls by an
eighth of its height. No water flows into the holes. The demo runs on one process.

`modulus` is the error of the drained modulus (stress / strain under a small load). The reference has one Taylor-Hood
element per pixel. The elements in holes have a millionth of the stiffness of black tissue. `drained` is the relative
difference between the final settlements of saturated and of dry tissue. The errors `modulus` and `drained` decrease
with the size of the pixels.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass, field

import common
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

EDGE, HOLES, CONTRAST, POROSITY = 1e-3, 0.12, 10.0, 0.8  # m; fraction of holes; stiffness ratio white to black; -
BULK, SHEAR, CONDUCTIVITY = 2e4, 1.5e4, 1e-9  # Pa, Pa, m/s: of black tissue
LOAD, RAMP, SMALL = 1.2e4, 1.0, 1.0  # load, Pa; time of loading, s; load for the modulus, Pa
WALLS = {"left": "x", "right": "x", "bottom": "y"}
TOP = ((0.0, 0.999 * EDGE), (EDGE, EDGE))  # region of the upper edge, because holes also have sides that face up


def picture(pixels: int, seed: int = 9) -> NDArray[np.float64]:
    """Return grey values from 0 to 1, indexed by (x, y). Pixels outside the largest connected part are 0 (holes)."""
    noise = np.random.default_rng(seed).standard_normal((pixels, pixels))
    smooth = gaussian_filter(noise, pixels / 16, mode="reflect")
    smooth += 3 * smooth.std() * np.exp(-np.arange(pixels)[::-1] / (0.06 * pixels))  # no holes near the plate
    grey = smooth.ravel().argsort().argsort().reshape(smooth.shape) / (smooth.size - 1)
    parts, _ = label(grey >= HOLES)
    return np.where(parts == np.bincount(parts[parts > 0]).argmax(), grey, 0.0)


@dataclass(frozen=True)
class Tissue:
    """Tissue with grey values indexed by (x, y); grey values below `HOLES` are holes."""

    grey: NDArray[np.float64]

    def at(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the grey values at positions (n, 2), in m."""
        return self.grey[tuple(np.floor(x / EDGE * len(self.grey)).astype(int).clip(0, len(self.grey) - 1).T)]

    def inside(self, x: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether positions (n, 2) in m are in the tissue."""
        return (x[:, 1] < EDGE) & (self.at(x) >= HOLES)

    def law(self, holes: float = 1.0) -> mpm.Hencky:
        """Return the law of the tissue. Holes have `holes` times the stiffness of black tissue."""

        def scaled(value: float, power: int) -> mpm.Field:
            return lambda X: value * np.where(self.at(X) < HOLES, holes**power, CONTRAST ** (power * self.at(X)))

        constants = {"bulk": scaled(BULK, 1), "shear": scaled(SHEAR, 1), "conductivity": scaled(CONDUCTIVITY, -1)}
        return mpm.Hencky(**constants, porosity=POROSITY)

    def scene(self, load: float, wet: bool) -> tuple[mpm.Simulation, mpm.Probes]:
        """Return the tissue under a load (Pa), with or without pore water, and a probe on its top."""
        n = len(self.grey)
        grid = mpm.Grid([0, 0], [EDGE, EDGE * (n + 2) / n], [n, n + 2])
        body = mpm.shape(grid, self.inside)
        simulation = mpm.Simulation(
            grid,
            [body],
            [self.law()],
            fluid=mpm.Fluid() if wet else None,
            walls=WALLS,
            conditions=[
                mpm.RigidPlate("top", lambda t: load * EDGE * min(1, t / RAMP), TOP),
                *([mpm.Drained("top", region=TOP)] if wet else []),
            ],
        )
        highest = body.centre[body.centre[:, 1] > EDGE - grid.h[1]]
        return simulation, mpm.probes([body], [[highest[0, 0], EDGE]])


@dataclass
class Outcome:
    """Histories: times (s), settlements divided by `EDGE`, and highest pore pressures (Pa).

    frames: time (s), and corners (m), pressures (Pa) and grey values of the points.
    drained: settlement of dry tissue divided by `EDGE`.
    """

    t: list[float] = field(default_factory=list)
    settlement: list[float] = field(default_factory=list)
    pressure: list[float] = field(default_factory=list)
    frames: list[tuple[float, NDArray, NDArray, NDArray]] = field(default_factory=list)
    drained: float = 0.0
    wall: float = 0.0
    steps: int = 0


def modulus(tissue: Tissue) -> tuple[float, float, float]:
    """Return three moduli, in Pa: by material points, by finite elements, and at uniform strain (Voigt)."""
    simulation, top = tissue.scene(SMALL, wet=False)
    points = simulation.run(RAMP, RAMP, probes=top, progress=False).displacement[-1][0, 1]
    n = len(tissue.grey)
    plate = mpm.RigidPlate("top", SMALL * EDGE)
    elements = BiotFEM(mpm.Grid([0, 0], [EDGE, EDGE], [n, n]), tissue.law(1e-6), walls=WALLS, conditions=[plate])
    elements.step(1.0)
    moved = elements.displacement(np.array([[EDGE / 2, EDGE]]))[0, 1]
    factor = np.where(tissue.grey < HOLES, 0.0, CONTRAST**tissue.grey).mean()
    return -SMALL * EDGE / points, -SMALL * EDGE / moved, float(factor * (BULK + 4 / 3 * SHEAR))


def run(tissue: Tissue, rtol: float) -> Outcome:
    """Compress the tissue and let it drain, in adaptive steps, then compress dry tissue."""
    out, (simulation, top) = Outcome(), tissue.scene(LOAD, wet=True)
    slow = EDGE**2 * mpm.Fluid().unit_weight / (CONDUCTIVITY * BULK)  # s: of the order of the consolidation time
    times = np.append(RAMP * np.linspace(0.25, 1, 4), RAMP + slow * np.logspace(-3, 0.5, 15))

    def observe(s: mpm.Simulation) -> None:
        p = s.points.pressure
        out.t.append(s.t)
        out.settlement.append(-s.result.displacement[-1][0, 1] / EDGE)
        out.pressure.append(float(p.max()))
        if s.t in (times[3], times[-1]):
            out.frames.append((s.t, s.points.corners.copy(), p, tissue.at(s.points.origin.mean(axis=1))))

    result = simulation.run(times[-1], rtol=rtol, t_eval=times, probes=top, observe=observe)
    dry, top = tissue.scene(LOAD, wet=False)
    last = dry.run(RAMP, RAMP / 10, probes=top, progress=False)
    out.drained = float(-last.displacement[-1][0, 1] / EDGE)
    out.wall, out.steps = result.wall + last.wall, result.steps
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--pixels", type=int, default=48, help="pixels along the edge of the image")
    parser.add_argument("--seed", type=int, default=9, help="seed of the random image")
    parser.add_argument("--rtol", type=float, default=1e-2, help="relative error of the adaptive steps")
    o = parser.parse_args(argv)
    if not 8 <= o.pixels <= 200:
        parser.error(f"--pixels {o.pixels}: must be 8 to 200")
    with common.results(o) as out:
        tissue = Tissue(picture(o.pixels, o.seed))
        points, elements, voigt = modulus(tissue)
        moduli = (("material points", points), ("finite elements", elements), ("even strain (Voigt)", voigt))
        rows = ([name, f"{value / 1e3:.2f}"] for name, value in moduli)
        common.table([["modulus of the drained tissue", "(kPa)"], *rows])
        seen = run(tissue, o.rtol)
        final = seen.settlement[-1]
        settlements = (("when loaded", seen.settlement[3]), ("drained", final), ("dry tissue", seen.drained))
        common.table([["settlement", "(% of the height)"], *([name, f"{100 * v:.2f}"] for name, v in settlements)])
        draw(o, tissue, seen)
        print(f"{seen.steps} steps, {seen.wall:.1f} s")
        errors = {"modulus": points / elements - 1, "drained": final / seen.drained - 1}
        if (o.pixels, o.seed, o.rtol) == (48, 9, 1e-2):
            out["converged"] = bool(max(map(abs, errors.values())) < 0.02)
        out |= {"errors": errors, "over_voigt": points / voigt, "settlement": final, "wall_s": seen.wall}
    return out


def draw(o: Namespace, tissue: Tissue, out: Outcome) -> None:
    """Draw the image, pressures, the drained tissue, and settlement and pressure against time."""
    fig, (axes, below) = common.figure(2, 3, (13, 7.6))
    mm, (loaded, last) = 1e3 * EDGE, out.frames
    grey = np.where(tissue.grey < HOLES, np.nan, tissue.grey)
    axes[0].imshow(grey.T, origin="lower", extent=(0, mm, 0, mm), cmap="cividis", clim=(0, 1))
    shown = ((1, loaded, 2, 1e-3, "viridis", "pore pressure (kPa)"), (2, last, 3, 1.0, "cividis", "grey value (-)"))
    for k, frame, values, scale, colours, name in shown:
        limits = (0, 1) if k == 2 else None
        domains = common.domains(axes[k], 1e3 * frame[1], scale * frame[values], cmap=colours, clim=limits)
        fig.colorbar(domains, ax=axes[k], label=name, shrink=0.8)
    for ax, title in zip(
        axes, ("the picture", f"loaded, t = {loaded[0]:.2g} s", f"drained, t = {last[0]:.0f} s"), strict=False
    ):
        ax.set(aspect="equal", xlim=(0, mm), ylim=(0, 1.03 * mm), xlabel="x (mm)", ylabel="y (mm)", title=title)
    below[0].semilogx(out.t, 100 * np.array(out.settlement), label="wet tissue")
    below[0].axhline(100 * out.drained, color="black", ls=":", label="dry tissue")
    below[0].set(xlabel="t (s)", ylabel="settlement (% of the height)")
    below[0].legend()
    below[1].semilogx(out.t, 1e-3 * np.array(out.pressure))
    below[1].set(xlabel="t (s)", ylabel="highest pore pressure (kPa)")
    below[2].set_axis_off()
    for ax in below[:2]:
        ax.grid(alpha=0.3)
    common.save(fig, o.out / "image.png")


if __name__ == "__main__":
    main()
