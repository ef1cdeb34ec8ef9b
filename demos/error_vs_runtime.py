# SPDX-License-Identifier: MIT
"""Error against run time, for material points and finite elements, in one run.

Five cases have an exact or converged solution. In each case the cell size varies. For material points, the points per
cell, the quadrature and the coupling vary too. Two body-fitted finite element methods are compared: Q1/DG0 on cells of
equal size, and Taylor-Hood. The time is the shortest of `--repeat` runs of the time loop, without compilation.
Reference solutions are converged in space and in time.

* beam: the poroelastic beam. Two errors of the tip deflection are given: the largest at all output times, and the
  largest after 0.1 s. The reference has 67 x 20 Taylor-Hood elements and steps of 0.005 s.
* drained: the poroelastic beam without water, loaded in ten steps. The reference of the tip deflection is a solution
  with 67 x 20 Taylor-Hood elements.
* terzaghi: the settlement at T_v = 0.5 is compared with the exact settlement.
* mandel: the settlement of the plate at T = 0.1 is compared with the exact settlement.
* column: the height of the soft column under its own weight is compared with the exact height.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import common
import numpy as np
import poroelastic_beam as beam
import self_weight_column as column
import terzaghi

import mpm_dolfinx as mpm
from mpm_dolfinx.verification.biot_fem import BiotFEM
from mpm_dolfinx.verification.exact import Mandel, terzaghi_consolidation

PEER, TRUTH = "FEM Q1/DG0, same grid", "FEM Taylor-Hood"
BY_ERROR, EQUAL, STANDARD = "MPM, steps by error", "MPM, equal steps", "standard MPM, at the points"
RTOL = 6e-3
"""Tolerance of adaptive steps in the runs with different cell sizes."""
STYLES = {  # colour and marker of each method, the same in all cases
    BY_ERROR: ("C0", "o"),
    EQUAL: ("C5", "x"),
    PEER: ("C1", "D"),
    STANDARD: ("C3", "s"),
    "MPM, fixed-stress": ("C2", "^"),
    "MPM, backward Euler": ("C4", "v"),
    "MPM, 1x1 points a cell": ("C6", "*"),
    "MPM, 3x3 points a cell": ("C7", "P"),
    TRUTH: ("black", "s"),
}
Run = Callable[[], tuple[float | tuple[float, float], mpm.Result, float]]
"""Function that returns the error, the result, and the compile time, in s. The beam has two errors."""


@dataclass
class Row:
    """A measured run. `late` is the error of the beam from 0.1 s on."""

    case: str
    method: str
    setting: str
    error: float
    wall_s: float
    jit_s: float
    steps: int
    late: float = np.nan


# ---- the beam ------------------------------------------------------------------------------------


def beam_runs(drained: bool, quick: bool) -> Iterator[tuple[str, str, Run]]:
    """Yield the method, the setting and the function of each run of the beam, with or without water."""
    time = "--drained --ramp 1 --t-end 1 --dt 0.1" if drained else f"--t-end {0.4 if quick else 1.2}"
    times, truth = np.array(beam.TIMES), np.array(beam.TRUTH)
    if drained:
        times, truth = np.ones(1), beam_fem(time, "taylor-hood", beam.REFERENCE_CELLS)[0].displacement[-1][:, 1]

    def error(result: mpm.Result) -> tuple[float, float]:
        found = {round(t, 9): u[0, 1] for t, u in zip(result.t, result.displacement, strict=True)}
        off = np.array([abs(found[t] / u - 1) for t, u in zip(times, truth, strict=True) if t in found])
        return float(off.max()), float(off[times[: len(off)] > 0.0999].max())

    def points(options: str) -> Run:
        def run():
            simulation, bottom = beam.scene(o := beam.arguments(f"{time} {options}".split()))
            probe = mpm.probes(simulation.bodies, [[beam.LENGTH, bottom + beam.HEIGHT / 2]])
            result = simulation.run(o.t_end, **beam.output_times(o), probes=probe)
            return error(result), result, simulation.jit

        return run

    def elements(element: str, cells: tuple[int, int]) -> Run:
        def run():
            result, jit = beam_fem(time, element, cells)
            return error(result), result, jit

        return run

    sizes = (0.06, 0.03) if quick else (0.06, 0.03, 0.015)
    for h in sizes:
        if not drained:
            yield BY_ERROR, f"h = {h} m, rtol {RTOL:g}", points(f"--h {h} --rtol {RTOL}")
        yield EQUAL, f"h = {h} m", points(f"--h {h}")
        yield PEER, f"h = {h} m", elements("q1-dg0", (round(beam.LENGTH / h), round(beam.HEIGHT / h)))
        yield STANDARD, f"h = {h} m", points(f"--h {h} --quadrature point")
        if not drained:
            yield "MPM, fixed-stress", f"h = {h} m", points(f"--h {h} --coupling fixed-stress")
            yield "MPM, backward Euler", f"h = {h} m", points(f"--h {h} --method backward-euler")
    for rtol in () if drained or quick else (2e-2, 2e-3):
        yield BY_ERROR, f"h = {sizes[-1]} m, rtol {rtol:g}", points(f"--h {sizes[-1]} --rtol {rtol}")
    for n in (1, 3):
        yield f"MPM, {n}x{n} points a cell", "h = 0.03 m", points(f"--h 0.03 --points-per-cell {n}")
    for cells in ((10, 3), (20, 6)) if quick else ((10, 3), (20, 6), (40, 12)):
        yield TRUTH, f"{cells[0]} x {cells[1]} cells", elements("taylor-hood", cells)


def beam_fem(time: str, element: str, cells: tuple[int, int]) -> tuple[mpm.Result, float]:
    """Return the finite element result for the beam, and the compile time, in s."""
    o = beam.arguments(time.split())
    fem = BiotFEM(
        mpm.Grid([0, 0], [beam.LENGTH, beam.HEIGHT], cells), beam.material(o), element=element, **beam.physics(o)
    )
    return fem.run(o.t_end, o.dt, probes=[[beam.LENGTH, beam.HEIGHT / 2]]), fem.jit


# ---- columns and slabs with exact solutions --------------------------------------------------------


def scene_runs(
    physics: dict, material, size: tuple[float, float], width: int, time: tuple[float, int], exact: float, cells, steps
) -> Iterator[tuple[str, str, Run]]:
    """Yield the method, the setting and the function of each run of a rectangular body.

    width: number of cells over the width, or -1 for as many as over the height.
    time: end time (s), and number of steps in the runs that compare cell sizes.
    exact: exact displacement of the top, in m.
    cells: numbers of cells over the height.
    steps: numbers of steps, each in a run on the smallest cells.
    """

    def points(n: int, m: int, rtol: float | None = None, **options) -> Run:
        def run():
            h = size[1] / n
            grid = mpm.Grid(
                [0, 0], [size[0] + (2 * h if width < 0 else 0), size[1]], [n + 2 if width < 0 else width, n]
            )
            body = mpm.box(grid, [0, 0], size)
            probe = mpm.probes([body], [[0, size[1]]])
            simulation = mpm.Simulation(grid, [body], [material], **physics, **options)
            steps = {"dt": time[0] / m} if rtol is None else {"rtol": rtol, "t_eval": [time[0]]}
            result = simulation.run(time[0], **steps, probes=probe)
            return abs(result.displacement[-1][0, 1] / exact - 1), result, simulation.jit

        return run

    def elements(n: int, m: int, element: str) -> Run:
        def run():
            fem = BiotFEM(mpm.Grid([0, 0], size, (n if width < 0 else width, n)), material, element=element, **physics)
            result = fem.run(time[0], time[0] / m, probes=[[0, size[1]]])
            return abs(result.displacement[-1][0, 1] / exact - 1), result, fem.jit

        return run

    for n, m in [(n, time[1]) for n in cells] + [(cells[-1], m) for m in steps]:
        setting = f"{n} cells, {m} steps"
        yield EQUAL, setting, points(n, m)
        yield PEER, setting, elements(n, m, "q1-dg0")
        yield TRUTH, setting, elements(n, m, "taylor-hood")
    for n in cells:
        yield STANDARD, f"{n} cells, {time[1]} steps", points(n, time[1], numerics=mpm.Numerics(quadrature="point"))
    for n, rtol in [*((n, RTOL) for n in cells), (cells[-1], 1e-3)] if "fluid" in physics else ():
        yield BY_ERROR, f"{n} cells, rtol {rtol:g}", points(n, 0, rtol)


def terzaghi_runs(quick: bool) -> Iterator[tuple[str, str, Run]]:
    """Yield the runs of Terzaghi's column."""
    cells = (5, 20) if quick else (5, 10, 20, 50)
    load = 1e-5 * terzaghi.SOIL.oedometric
    physics = {
        "fluid": terzaghi.WATER,
        "walls": {"left": "x", "right": "x", "bottom": "y"},
        "conditions": [mpm.Traction("top", (0, -load)), mpm.Drained("top")],
    }
    end = 0.5 / terzaghi.CV
    exact = -1e-5 * float(terzaghi_consolidation(end, 1.0, terzaghi.CV))
    size = (1 / cells[-1], 1.0)
    yield from scene_runs(physics, terzaghi.SOIL, size, 1, (end, 100), exact, cells, (25,) if quick else (25, 400))


def mandel_runs(quick: bool) -> Iterator[tuple[str, str, Run]]:
    """Yield the runs of a quarter of Mandel's slab until T = 0.1."""
    soil = mpm.LinearElastic(bulk=4e6 / 3, shear=1e6, conductivity=1e-5)
    water = mpm.Fluid(bulk=np.inf)
    slab = Mandel(1.0, 1.0, soil.bulk, soil.shear, soil.conductivity / water.unit_weight, force=20.0)
    physics = {
        "fluid": water,
        "walls": {"left": "x", "bottom": "y"},
        "conditions": [mpm.RigidPlate("top", 20.0), mpm.Drained("right")],
    }
    end = 0.1 / slab.cv
    exact = float(slab.displacement(0.0, 1.0, end)[1])
    cells, steps = ((5, 10), (10,)) if quick else ((5, 10, 20), (10, 160))
    yield from scene_runs(physics, soil, (1.0, 1.0), -1, (end, 40), exact, cells, steps)


def column_runs(quick: bool) -> Iterator[tuple[str, str, Run]]:
    """Yield the runs of the soft column under its own weight."""
    soft = column.EXACT
    physics = {
        "walls": {"left": "x", "right": "x", "bottom": "y"},
        "gravity": lambda t: (0, -soft.gravity * t),
    }
    cells, steps = ((8, 16), ()) if quick else ((8, 16, 32, 64), (160,))
    exact = soft.height - soft.l0
    yield from scene_runs(physics, column.FOAM, (50 / cells[-1], 50.0), 1, (1.0, 40), exact, cells, steps)


CASES = {
    "beam": lambda quick: beam_runs(False, quick),
    "drained": lambda quick: beam_runs(True, quick),
    "terzaghi": terzaghi_runs,
    "mandel": mandel_runs,
    "column": column_runs,
}


# ---- measuring and reporting -----------------------------------------------------------------------


def measure(case: str, quick: bool, repeat: int) -> list[Row]:
    """Return the measured runs of one case; the error of a failed run is nan."""
    rows = []
    for method, setting, run in CASES[case](quick):
        try:
            runs = [run() for _ in range(repeat)]
            error, result, _ = runs[0]
            error, late = error if isinstance(error, tuple) else (error, np.nan)
            wall, jit = min(r.wall for _, r, _ in runs), max(j for *_, j in runs)
            rows.append(Row(case, method, setting, error, wall, jit, result.steps, late))
        except (mpm.GaveUp, ValueError) as failed:
            print(f"{case}, {method}, {setting}: {failed}", file=sys.stderr)
            rows.append(Row(case, method, setting, np.nan, np.nan, np.nan, 0))
        r = rows[-1]
        late = f", from 0.1 s on {r.late:.2e}" if np.isfinite(r.late) else ""
        print(
            f"{case:10} {method:24} {setting:26} {r.error:10.2e} {r.wall_s:9.3f} s, {r.steps} steps{late}", flush=True
        )
    return rows


def time_at(rows: list[Row], error: float) -> float:
    """Return the shortest time (s) of runs with at most this error, or nan if no run is so accurate."""
    return min((r.wall_s for r in rows if r.error <= error), default=np.nan)


def compare(rows: list[Row]) -> list[dict]:
    """Compare material points with Q1/DG0 elements, on equal cells and at equal error."""
    out = []
    for r in (r for r in rows if r.method in (BY_ERROR, EQUAL)):
        peers = [q for q in rows if q.case == r.case and q.method == PEER]
        same = min(peers, key=lambda q: (q.setting != r.setting, q.setting.split(",")[0] != r.setting.split(",")[0]))
        out.append(
            {
                "case": r.case,
                "setting": r.setting,
                "error": r.error,
                "peer_error": same.error,
                "time_ratio": r.wall_s / same.wall_s,
                "time_ratio_at_equal_error": r.wall_s / time_at(peers, r.error),
            }
        )
    return out


def table(comparison: list[dict]) -> list[list[str]]:
    """Return the comparison as rows of text."""
    rows = [["case", "setting", "error", "same-grid FEM's error", "time / same-grid FEM's", "at equal error"]]
    for c in comparison:
        equal = "none so exact" if np.isnan(c["time_ratio_at_equal_error"]) else f"{c['time_ratio_at_equal_error']:.2f}"
        numbers = f"{c['error']:.1e}", f"{c['peer_error']:.1e}", f"{c['time_ratio']:.2f}"
        rows.append([c["case"], c["setting"], *numbers, equal])
    return rows


def draw(out: Path, case: str, rows: list[Row]) -> None:
    """Draw error against run time for one case."""
    fig, ((ax,),) = common.figure(1, 1, (9.5, 5))
    usual = Counter(r.steps for r in rows if r.method != BY_ERROR).most_common(1)[0][0]
    for method in dict.fromkeys(r.method for r in rows):
        mine = [r for r in rows if r.method == method and np.isfinite(r.error)]
        cells = [r for r in mine if r.steps == usual or r.setting.endswith(f"rtol {RTOL:g}")]
        steps = sorted([*cells[-1:], *(r for r in mine if r not in cells)], key=lambda r: r.steps)
        style = dict(zip(("color", "marker"), STYLES[method], strict=True), lw=2 if method == BY_ERROR else 1)
        for sweep, line in ((cells, "-"), (steps, "--")):
            label = method if (line == "-") == bool(cells) else None
            if len(sweep) > 1 or label:
                ax.loglog([r.wall_s for r in sweep], [r.error for r in sweep], ls=line, label=label, **style)
    if len({r.steps for r in rows}) > 1:
        ax.plot([], [], "k--", lw=1, label="finest cells, other steps")
    ax.set(xlabel="time of the time loop (s)", ylabel="relative error (-)", title=f"{case}: error against run time")
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    name = "error_vs_runtime" if case == "beam" else f"error_vs_runtime_{case}"  # the beam's picture is on the pages
    common.save(fig, out / f"{name}.png", dpi=120)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cases", nargs="+", choices=tuple(CASES), default=list(CASES), help="cases to run")
    parser.add_argument("--quick", action="store_true", help="a few coarse runs of each case")
    parser.add_argument("--repeat", type=int, default=None, help="runs of each setting; by default 2, with --quick 1")
    o = parser.parse_args(argv)
    with common.results(o) as out:
        rows = []
        for case in o.cases:
            rows += measure(case, o.quick, o.repeat or (1 if o.quick else 2))
            draw(o.out, case, [r for r in rows if r.case == case])
            common.write_csv(o.out / "runs.csv", asdict(rows[0]), (asdict(row).values() for row in rows))
        comparison = compare(rows)
        (o.out / "comparison.md").write_text(common.markdown(table(comparison)) + "\n")
        common.table(table(comparison))
        out |= {"comparison": comparison, "converged": all(np.isfinite(r.error) for r in rows if r.method == EQUAL)}
    return out


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
