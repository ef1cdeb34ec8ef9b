# SPDX-License-Identifier: MIT
"""The beam's run time beside finite elements on the same grid, measured in one run.

The beam of `poroelastic_beam.py` (60 steps) with the material point method, with body-fitted
Q1/DG0 finite elements on cells of the same size and with Taylor-Hood elements, both monolithic with
MUMPS and to the same tolerance.  Every case is run `--repeat` times in turn; the least time counts,
since other work on the machine only adds.  Compile times are listed apart.  Errors are those of
the tip against Taylor-Hood, the largest over the output times.
"""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np
import poroelastic_beam as beam

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM


def run(name: str, o: argparse.Namespace):
    """Run one case; return (result, compile seconds)."""
    probe = np.array([[beam.LENGTH, beam.HEIGHT / 2]])
    if name.startswith("mpm"):
        o.coupling = name.removeprefix("mpm ")
        simulation, bottom = beam.scene(o)
        probes = mpm.probes(simulation.bodies, np.add(probe, [0, bottom]))
        return simulation.run(o.t_end, o.dt, probes=probes), simulation.jit
    cells = [round(beam.LENGTH / o.h), round(beam.HEIGHT / o.h)]
    fem = BiotFEM([0, 0], [beam.LENGTH, beam.HEIGHT], cells, beam.material(o), element=name, **beam.physics(o))
    return fem.run(o.t_end, o.dt, probes=probe), fem.jit


def main(argv: list[str] | None = None) -> dict:
    """Run the benchmark; return what --json prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--h", type=float, default=0.015, help="cell size, m")
    parser.add_argument("--t-end", type=float, default=1.2, help="end time, s")
    parser.add_argument("--repeat", type=int, default=2, help="runs of each case")
    parser.add_argument("--json", action="store_true", help="print the results as one line of JSON at the end")
    o = parser.parse_args(argv)
    options = beam.arguments(f"--h {o.h} --t-end {o.t_end}".split())
    cases = ["mpm schur-cg", "mpm fixed-stress", "q1-dg0", "taylor-hood"]
    results = {name: [run(name, options) for _ in range(o.repeat)] for name in cases}

    truth = np.array(results["taylor-hood"][0][0].displacement)[1:, 0, 1]
    out = {"h": o.h, "cases": {}, "converged": True}
    peer = min(r.wall for r, _ in results["q1-dg0"])
    print(f"{'case':18} {'time (s)':>9} {'/ q1-dg0':>9} {'compile (s)':>12} {'Newton':>7} {'worst tip error':>16}")
    for name, runs in results.items():
        result, wall = runs[0][0], min(r.wall for r, _ in runs)
        error = float(np.abs(np.array(result.displacement)[1:, 0, 1] / truth - 1).max())
        compiled = max(jit for _, jit in runs)
        print(f"{name:18} {wall:9.2f} {wall / peer:9.2f} {compiled:12.2f} {result.newton:7d} {error:16.3%}")
        out["cases"][name] = {"wall_s": wall, "ratio": wall / peer, "jit_s": compiled, "tip_error": error}
        out["converged"] &= result.converged
    if o.json:
        print(json.dumps(out))
    return out


if __name__ == "__main__":
    sys.exit(0 if main()["converged"] else 1)
