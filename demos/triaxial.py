# SPDX-License-Identifier: MIT
"""Triaxial tests of soil laws at a point, compared with closed-form solutions, to check a law before its use.

Modified Cam Clay is tested at three overconsolidation ratios R, drained and undrained, from the isotropic stress p_0.
The parameters of Modified Cam Clay are M, lambda and kappa. The mean and the deviatoric Kirchhoff stress are P and Q.
The mean and the deviatoric Cauchy stress are p and q. The size of the yield surface is P_c. During yield,
`Q = M sqrt(P (P_c - P))`. In an undrained test the volume is constant, so the test ends at
`P = P_cs = p_0 (R/2)^(1 - kappa/lambda)` and `Q = M P_cs`. In a drained test the stress path is `q = 3 (p - p_0)`, and
ends at `q = M p`. Mohr-Coulomb sand is tested in compression and in extension. These tests end at
`t_1 (1 + sin(phi)) - t_3 (1 - sin(phi)) = 2 c cos(phi)`, with the friction angle phi, the cohesion c, and the largest
and smallest principal Kirchhoff stresses t_1 and t_3. Errors are relative, and refer to the final states.

With --cost N, blocks of N x N cells are compressed until all of their soil yields. The laws are Drucker-Prager,
Mohr-Coulomb and Cam Clay. The laws are timed in turn, one step each. The demo prints the processor time of a step,
divided by the time of Drucker-Prager soil.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import common
import numpy as np

import mpm_dolfinx as mpm

P0 = 1e5  # Pa
CLAY = mpm.ModifiedCamClay(M=1.2, lambda_=0.0726, kappa=0.0145, shear=30 * P0, initial_stress=(-P0,) * 3)
SAND = mpm.MohrCoulomb(bulk=2e7, shear=1e7, friction=30.0, dilation=10.0, cohesion=5e3)
RATIOS = (1.0, 2.5, 8.0)
KINDS = ("triaxial drained", "triaxial undrained")


def clays(steps: int) -> dict[tuple[str, float], mpm.ElementTest]:
    """Return the tests of the clay by kind of test (drained or undrained) and overconsolidation ratio."""
    ends = {"triaxial drained": 1.5, "triaxial undrained": 0.6}
    return {(k, R): mpm.element_test(replace(CLAY, OCR=R), k, ends[k], steps=steps) for k in KINDS for R in RATIOS}


def end_of(kind: str, R: float) -> float:
    """Return the exact mean effective stress at the end of a test of the clay, in Pa."""
    if kind == "triaxial drained":
        return 3 * P0 / (3 - CLAY.M)
    return P0 * (R / 2) ** (1 - CLAY.kappa / CLAY.lambda_)


def sand_errors(tests: dict[float, mpm.ElementTest]) -> dict[str, float]:
    """Return the distance of the final stresses of the sand from the Mohr-Coulomb surface, divided by P0."""
    out = {}
    for strain, r in tests.items():
        tau = np.sort(np.diag(r.stress[-1])) * np.linalg.det(r.F[-1])
        s = np.sin(np.radians(SAND.friction))
        out[f"sand_{strain:+g}"] = float(abs((1 + s) * tau[2] - (1 - s) * tau[0] - SAND.strength) / P0)
    return out


def block(soil: mpm.Skeleton, cells: int) -> mpm.Simulation:
    """Return a block that is compressed by a thousandth of its height in 1 s, with the pressure P0 on its free side."""
    h = 1 / cells
    grid = mpm.Grid([0] * 2, [1 + 2 * h] * 2, [cells + 2] * 2)
    squeeze = mpm.Displacement("top", lambda t, X: (0, -1e-3 * t), components="y")
    walls, load = {"left": "x", "bottom": "y"}, mpm.Pressure("right", P0)
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [soil], walls=walls, conditions=[squeeze, load])
    if not isinstance(soil, mpm.ModifiedCamClay):  # the initial pressure of sand is given as elastic strain
        s.stage(fields={"plastic": np.exp(-2 * P0 / (3 * soil.bulk)) * np.eye(3)})
    return s


def costs(cells: int, steps: int = 30) -> dict[str, float]:
    """Return the processor time of a step of each law, divided by the time with Drucker and Prager's law.

    Sands have associated flow, because otherwise shear bands form in the block.
    """
    sand = replace(SAND, dilation=SAND.friction)
    same = {name: getattr(sand, name) for name in ("bulk", "shear", "friction", "dilation", "cohesion")}
    soils = {"Drucker-Prager": mpm.DruckerPrager(**same), "Mohr-Coulomb": sand, "Cam Clay": CLAY}
    blocks = {name: block(soil, cells) for name, soil in soils.items()}
    spent, newton = {name: [] for name in blocks}, dict.fromkeys(blocks, 0)
    for k in range(1, steps + 1):
        for name, s in blocks.items():
            begun = time.process_time()
            newton[name] += s.run(float(k), 1.0, progress=False).newton
            spent[name].append(time.process_time() - begun)
    medians = {name: float(np.median(seconds[2:])) for name, seconds in spent.items()}  # the first two steps compile
    for name, seconds in medians.items():
        ratio = seconds / medians["Drucker-Prager"]
        times = f"{seconds:.3f} s per time step, {ratio:.2f} times that of Drucker-Prager"
        print(f"{name:16} {times}, {newton[name] / steps:.1f} Newton steps per time step")
    return {name: seconds / medians["Drucker-Prager"] for name, seconds in medians.items()}


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--steps", type=int, default=100, help="steps of a test")
    parser.add_argument("--cost", type=int, metavar="N", help="also print the cost of a step, N x N cells")
    o = parser.parse_args(argv)
    for name, value in (("steps", o.steps), ("cost", o.cost)):
        if value is not None and value < 1:
            parser.error(f"--{name} {value}: must be >= 1")
    with common.results(o) as out:
        tests = clays(o.steps)
        sands = {e: mpm.element_test(SAND, KINDS[0], e, steps=o.steps, confinement=P0) for e in (0.1, -0.1)}
        errors = {f"{k}, OCR {R:g}": float(abs(r.p[-1] / end_of(k, R) - 1)) for (k, R), r in tests.items()}
        errors |= sand_errors(sands)
        common.table([["", "error"], *([name, f"{error:.0e}"] for name, error in errors.items())])
        draw(o.out, tests, sands)
        out |= {"errors": errors, "converged": max(errors.values()) < 1e-6}
        if o.cost:
            out["cost"] = costs(o.cost)
    return out


def draw(out: Path, tests: dict[tuple[str, float], mpm.ElementTest], sands: dict[float, mpm.ElementTest]) -> None:
    """Draw stress paths, and stresses, pore pressures and volumes against strain."""
    fig, ((path, curve), (water, sand)) = common.figure(2, 2, (11, 7.5))
    for (kind, R), r in tests.items():
        drained, colour = kind == KINDS[0], f"C{RATIOS.index(R)}"
        style = {"color": colour, "ls": "-" if drained else "--", "label": f"OCR {R:g}, {kind.split()[1]}"}
        path.plot(r.p / P0, r.q / P0, **style)
        path.plot(end_of(kind, R) / P0, CLAY.M * end_of(kind, R) / P0, "o", color=colour, mfc="white")
        curve.plot(r.strain, r.q / P0, **style)
        if not drained:
            water.plot(r.strain, r.pressure / P0, **style)
    p = np.array([0, 3.2])
    path.plot(p, CLAY.M * p, "k:", lw=0.8, label="critical state")
    path.set(xlabel="p' / p0 (-)", ylabel="q / p0 (-)", title="Clay: stress paths; circles: exact ends")
    curve.set(xlabel="axial strain (-)", ylabel="q / p0 (-)", title="Clay: stress and strain", xlim=(0, 0.6))
    water.set(xlabel="axial strain (-)", ylabel="excess pore pressure / p0 (-)", title="Clay: pore pressure, undrained")
    for k, (strain, r) in enumerate(sands.items()):
        name = "compression" if strain > 0 else "extension"
        sand.plot(np.abs(r.strain), r.q / P0, color=f"C{k}", label=f"{name}: q / p0")
        sand.plot(np.abs(r.strain), -10 * r.volume_strain, color=f"C{k}", ls="--", label=f"{name}: 10 x volume growth")
    sand.set(xlabel="axial strain (-)", ylabel="q / p0, 10 x volume growth (-)", title="Mohr-Coulomb sand, drained")
    for ax in (path, curve, water, sand):
        ax.grid(alpha=0.3)
    path.legend(fontsize=8)  # the legend for all three panels
    sand.legend(fontsize=8, loc=(0.45, 0.45))
    common.save(fig, out / "triaxial.png", dpi=90)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
