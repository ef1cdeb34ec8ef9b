# SPDX-License-Identifier: MIT
"""Run times of the poroelastic beam, with material points and with finite elements.

The beam of `poroelastic_beam.py` takes 60 steps. Material points are run with the default scheme, with fixed-stress
iterations, with backward Euler, and in adaptive steps. The finite element methods are Q1/DG0 on cells of equal size,
and Taylor-Hood. Both finite element methods solve monolithic systems with MUMPS. All methods have the same tolerance.

Each case runs `--repeat` times, in turn with the other cases. The demo prints the shortest time of each case. Compile
times are given separately. Three errors of the tip deflection are given: at 0.02 s, at 0.06 s, and the largest error
after 0.1 s. The reference is a solution with Taylor-Hood elements, converged in time (`beam.TRUTH`).
"""

from __future__ import annotations

import common
import numpy as np
import poroelastic_beam as beam

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM

RTOL = 6e-3
CASES = {
    "mpm": "",
    "mpm fixed-stress": "--coupling fixed-stress",
    "mpm backward-euler": "--method backward-euler",
    f"mpm rtol {RTOL:g}": f"--rtol {RTOL}",
    "q1-dg0": "",
    "taylor-hood": "",
}


def run(name: str, options: str) -> tuple[mpm.Result, float]:
    """Run one case and return its result and its compile time, in s."""
    o, probe = beam.arguments(f"{options} {CASES[name]}".split()), np.array([[beam.LENGTH, beam.HEIGHT / 2]])
    if name.startswith("mpm"):
        simulation, bottom = beam.scene(o)
        probes = mpm.probes(simulation.bodies, np.add(probe, [0, bottom]))
        return simulation.run(o.t_end, **beam.output_times(o), probes=probes), simulation.jit
    cells = [round(beam.LENGTH / o.h), round(beam.HEIGHT / o.h)]
    fem = BiotFEM(
        mpm.Grid([0, 0], [beam.LENGTH, beam.HEIGHT], cells), beam.material(o), element=name, **beam.physics(o)
    )
    return fem.run(o.t_end, o.dt, probes=probe), fem.jit


def errors(result: mpm.Result) -> list[float]:
    """Return three relative errors of the tip deflection: at 0.02 s, at 0.06 s, and the largest from 0.1 s on."""
    found = {round(t, 9): u[0, 1] for t, u in zip(result.t, result.displacement, strict=True)}
    off = {t: abs(found.get(t, np.nan) / u - 1) for t, u in zip(beam.TIMES, beam.TRUTH, strict=True)}
    late = [error for t, error in off.items() if t >= 0.1 and error == error]
    return [off[0.02], off[0.06], max(late, default=np.nan)]


def main(argv: list[str] | None = None) -> dict:
    """Run the benchmark and return its results."""
    parser = common.Parser(__doc__, __file__, writes=False)
    parser.add_argument("--h", type=float, default=0.015, help="cell size, m")
    parser.add_argument("--t-end", type=float, default=1.2, help="end time, s")
    parser.add_argument("--repeat", type=int, default=2, help="runs of each case")
    o = parser.parse_args(argv)
    with common.results(o) as out:
        options = f"--h {o.h} --t-end {o.t_end}"
        rounds = [{name: run(name, options) for name in CASES} for _ in range(o.repeat)]
        times = {name: min(one[name][0].wall for one in rounds) for name in CASES}
        rows = [["case", "steps", "Newton", "compile (s)", "time (s)", "/ q1-dg0", "/ backward Euler"]]
        rows[0] += ["tip, 0.02 s", "0.06 s", "0.1 s on"]
        out |= {"h": o.h, "cases": {}, "converged": True}
        for name, wall in times.items():
            result, jit = rounds[0][name][0], max(one[name][1] for one in rounds)
            ratios, off = [wall / times[other] for other in ("q1-dg0", "mpm backward-euler")], errors(result)
            numbers = [f"{x:.2f}" for x in (jit, wall, *ratios)] + [f"{x:.3%}" for x in off]
            rows.append([name, f"{result.steps}", f"{result.newton}", *numbers])
            out["cases"][name] = {"wall_s": wall, "ratios": ratios, "jit_s": jit, "tip_errors": off}
            out["converged"] &= result.converged
        common.table(rows)
    return out


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
