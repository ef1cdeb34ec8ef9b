# SPDX-License-Identifier: MIT
"""Triaxial tests of soil laws at a point, beside closed forms: what a law is looked at with before a scene.

Modified Cam Clay at three overconsolidation ratios, drained and undrained from the same isotropic stress.  Undrained
the volume is closed, so that it ends at P_cs = P_0 (R/2)^(1 - kappa/lambda), Q = M P_cs; on the way
Q = M sqrt(P (P_c - P)).  Drained the path is q = 3 (p - p_0), and ends where it meets q = M p.  Mohr and Coulomb's sand
ends where t_1 (1 + sin phi) - t_3 (1 - sin phi) = 2 c cos phi in Kirchhoff stresses, in compression and in extension.

Errors are those of the ends, relative.
"""

from __future__ import annotations

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
    """Return the tests of the clay by their kind and overconsolidation ratio."""
    ends = {"triaxial drained": 1.5, "triaxial undrained": 0.6}
    return {(k, R): mpm.element_test(replace(CLAY, OCR=R), k, ends[k], steps=steps) for k in KINDS for R in RATIOS}


def end_of(kind: str, R: float) -> float:
    """Return the exact mean effective stress at the end of a test of the clay, Pa."""
    if kind == "triaxial drained":
        return 3 * P0 / (3 - CLAY.M)
    return P0 * (R / 2) ** (1 - CLAY.kappa / CLAY.lambda_)


def sand_errors(tests: dict[float, mpm.ElementTest]) -> dict[str, float]:
    """Return by how much the sand's ends are off Mohr and Coulomb's surface, over the cell pressure."""
    out = {}
    for strain, r in tests.items():
        tau = np.sort(np.diag(r.stress[-1])) * np.linalg.det(r.F[-1])
        s = np.sin(np.radians(SAND.friction))
        out[f"sand_{strain:+g}"] = float(abs((1 + s) * tau[2] - (1 - s) * tau[0] - SAND.strength) / P0)
    return out


def main(argv: list[str] | None = None) -> dict:
    """Run the demo; return what --json prints."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--steps", type=int, default=100, help="steps of a test")
    o = parser.parse_args(argv)
    if o.steps < 1:
        parser.error(f"--steps {o.steps}: must be >= 1")
    with common.results(o) as out:
        tests = clays(o.steps)
        sands = {e: mpm.element_test(SAND, KINDS[0], e, steps=o.steps, confinement=P0) for e in (0.1, -0.1)}
        errors = {f"{k}, OCR {R:g}": float(abs(r.p[-1] / end_of(k, R) - 1)) for (k, R), r in tests.items()}
        errors |= sand_errors(sands)
        common.table([["", "error"], *([name, f"{error:.0e}"] for name, error in errors.items())])
        draw(o.out, tests, sands)
        out |= {"errors": errors, "converged": max(errors.values()) < 1e-6}
    return out


def draw(out: Path, tests: dict[tuple[str, float], mpm.ElementTest], sands: dict[float, mpm.ElementTest]) -> None:
    """Draw stress paths, stress and strain, pore pressures and volumes."""
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
    path.set(xlabel="p' / p0 (-)", ylabel="q / p0 (-)", title="Clay: stress paths, and their exact ends")
    curve.set(xlabel="axial strain (-)", ylabel="q / p0 (-)", title="Clay: stress and strain", xlim=(0, 0.6))
    water.set(xlabel="axial strain (-)", ylabel="excess pore pressure / p0 (-)", title="Clay: pore pressure, undrained")
    for strain, r in sands.items():
        sand.plot(np.abs(r.strain), r.q / P0, label="compression" if strain > 0 else "extension")
        sand.plot(np.abs(r.strain), -10 * r.volume_strain, ls="--", label="10 times its volume growth")
    sand.set(xlabel="axial strain (-)", ylabel="q / p0 (-)", title="Mohr-Coulomb sand, drained")
    for ax in (path, curve, water, sand):
        ax.legend(fontsize=8)
        ax.grid(alpha=0.3)
    common.save(fig, out / "triaxial.png", dpi=90)


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
