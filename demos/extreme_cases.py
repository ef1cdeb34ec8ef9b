# SPDX-License-Identifier: MIT
"""Stiff and extreme scenes: each converges, recovers or is refused, and none is silently wrong.

Every scene is tiny and has one extreme property. Scenes with the same extreme property form a family. Each scene has
one of these outcomes:

* converged: the error is below the bound of the family. The reference is exact, or a solution with finite elements, or
  the same scene with a moderate property. The residuals of momentum and fluid, and the error of the fluid balance, are
  below 1e-8.
* recovered: the run has converged, but some steps were cut.
* refused: the run ends with an error that gives the reason. A scene without equilibrium must be refused.
* warned: the error is above the bound, and the package has issued a warning.
* wrong, nan or hung: a defect, which the exit status reports. An unexpected exception counts as wrong.

Errors are relative to the largest exact value, or the docstring of the family defines them. The condition number refers
to the last stiffness matrix, scaled to a unit diagonal. The demo runs on one process.
"""

from __future__ import annotations

import signal
import time
import warnings
from collections import Counter
from dataclasses import asdict, dataclass, fields
from math import isnan, nan
from pathlib import Path

import common
import numpy as np
from extreme.motion import FAMILIES
from extreme.scenes import Make, Scene
from scipy.sparse import csr_matrix

import mpm_dolfinx as mpm

LIMIT = 100  # s, for a case; processor time, so that other work on the machine does not count
CLOSED = 1e-8  # bound of the residuals and of the error of the fluid balance
SHOWN = {
    "fluid-bulk": "water's bulk modulus",
    "poisson": "Poisson's ratio",
    "steps": "number of load steps",
    "combined": "conductivity and step",
    "filling": "nearly empty cells",
    "thin": "thin beams",
}  # labels in the picture; other families have their names as labels
OUTCOMES = ("converged", "recovered", "refused", "warned", "wrong", "nan", "hung")


@dataclass
class Row:
    """Outcome of a scene, with its largest residual and its total numbers of iterations."""

    family: str
    setting: str
    outcome: str = ""
    error: float = nan
    residual: float = nan
    balance: float = nan
    steps: int = 0
    cuts: int = 0
    newton: int = 0
    coupling: int = 0
    condition: float = nan
    seconds: float = nan
    note: str = ""


class Hung(Exception):
    """Error that ends a scene after the time limit."""


def hang(*_) -> None:
    raise Hung


def judge(row: Row, make: Make, bound: float, rtol: float | None = None) -> Row:
    """Run a case and fill in its row.

    rtol: tolerance of adaptive steps. Adaptive steps are not longer than the scene's steps.
    """
    signal.signal(signal.SIGPROF, hang)
    signal.setitimer(signal.ITIMER_PROF, LIMIT)
    began, result = time.process_time(), mpm.Result()
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", mpm.ResultWarning)
            scene = make()
            dt = scene.end / scene.steps
            steps = {"dt": dt} if rtol is None else {"rtol": mpm.Adaptive(rtol, max_step=dt), "t_eval": [scene.end]}
            result = scene.simulation.run(scene.end, **steps, probes=scene.probes, progress=False)
        row.outcome = "recovered" if result.cuts else "converged"
    except (mpm.GaveUp, ValueError) as refusal:
        row.outcome, row.note, result = "refused", str(refusal), getattr(refusal, "result", result)
    except Exception as error:  # an error that does not explain the problem
        hung = isinstance(error, Hung) or time.process_time() - began >= LIMIT  # some stop within PETSc
        row.outcome, row.note = ("hung", f"more than {LIMIT} s") if hung else ("wrong", repr(error))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    row.seconds = time.process_time() - began
    for name in ("residual", "balance", "steps", "cuts", "newton", "coupling"):
        setattr(row, name, getattr(result, name))
    if row.outcome in ("converged", "recovered"):
        check(row, scene, result, bound)
        said = [str(one.message) for one in warned if issubclass(one.category, mpm.ResultWarning)]
        if row.outcome == "wrong" and said and row.error > bound:
            row.outcome, row.note = "warned", "; ".join(said)
    return row


def check(row: Row, scene: Scene, result: mpm.Result, bound: float) -> None:
    """Compare a completed run with its reference, and store the outcome and the error in the row."""
    s = scene.simulation
    row.condition = condition(s.scene.last[1].momentum.K)
    try:
        row.error = nan if scene.error is None else scene.error(s, result)
    except mpm.GaveUp as failed:
        row.outcome, row.note = "wrong", f"the reference {failed}"
        return
    points = s.points
    values = (points.x, points.F, points.pressure, result.residual, result.balance, *result.displacement[-1:])
    if not all(np.isfinite(v).all() for v in values):
        row.outcome = "nan"
    elif not (row.error <= bound and max(row.residual, row.balance) <= CLOSED):
        row.outcome, row.note = "wrong", "" if scene.error else "there is no equilibrium"


def condition(K) -> float:
    """Return the condition number of a matrix scaled to a unit diagonal, or nan if no matrix was assembled."""
    if not K.assembled:
        return nan
    A = csr_matrix(K.getValuesCSR()[::-1], shape=K.getSize()).toarray()
    scale = 1 / np.sqrt(np.abs(A.diagonal()))
    size = np.abs(np.linalg.eigvalsh(scale[:, None] * A * scale))
    return float(size.max() / size.min())


def worst(rows: list[Row], name: str) -> float:
    """Return the largest value of one attribute over all rows, or nan if no row has a value."""
    return max((v for r in rows if not isnan(v := getattr(r, name))), default=nan)


def table(head: list[str], rows: list[list]) -> str:
    """Return a Markdown table, with blanks for missing numbers."""

    def cell(v) -> str:
        if isinstance(v, float):
            return "" if isnan(v) else f"{v:.2g}"
        return str(v).replace("|", "/")

    return common.markdown([head, *([cell(v) for v in row] for row in rows)])


def summary(rows: list[Row]) -> str:
    """Return a table with one row for each family."""
    names = ("error", "residual", "balance", "condition")
    lines = []
    for name, f in FAMILIES.items():
        if mine := [r for r in rows if r.family == name]:
            count = Counter(r.outcome for r in mine)
            figures = [worst(mine, n) for n in names]
            lines.append(
                [name, f.cases.__doc__.splitlines()[0].rstrip("."), f.bound, *(count[n] for n in OUTCOMES), *figures]
            )
    return table(["family", "property, and reference", "bound", *OUTCOMES, *(f"worst {n}" for n in names)], lines)


def write(out: Path, rows: list[Row]) -> None:
    """Write the tables of all cases and of the families to the folder `out`."""
    head = [f.name for f in fields(Row)]
    common.write_csv(out / "cases.csv", head, (asdict(r).values() for r in rows))
    (out / "cases.md").write_text(table(head, [list(asdict(r).values()) for r in rows]) + "\n")
    (out / "summary.md").write_text(summary(rows) + "\n")


def draw(out: Path, rows: list[Row]) -> None:
    """Draw errors, condition numbers and numbers of Newton iterations for each family."""
    names = [name for name in FAMILIES if any(r.family == name for r in rows)]
    colours = dict(zip(OUTCOMES, ("C0", "C2", "0.5", "C1", "C3", "black", "C4"), strict=True))
    fig, (axes,) = common.figure(1, 3, (13, 1.5 + 0.34 * len(names)))
    rng = np.random.default_rng(1)
    for r in rows:
        y = -names.index(r.family) + rng.uniform(-0.28, 0.28)
        style = {"color": colours[r.outcome], "ms": 4, "alpha": 0.6, "mew": 0}
        refused = isnan(r.error)
        axes[0].plot(3e2 if refused else max(r.error, 1e-12), y, "s" if refused else "o", **style)
        axes[1].plot(r.condition, y, "o", **style)
        axes[2].plot(r.newton / max(r.steps, 1) if r.steps else nan, y, "o", **style)
    for i, name in enumerate(names):
        axes[0].plot([FAMILIES[name].bound] * 2, [-i - 0.4, -i + 0.4], color="black", lw=1.5)
    axes[0].axvline(30, color="0.8", lw=1)
    axes[0].set(
        xlim=(5e-13, 2e3), xlabel="error (-); black: the family's bound", title="Error (1e-12 at least); right: refused"
    )
    axes[1].set(xlabel="condition number (-)", title="Conditioning of the momentum's tangent")
    axes[2].set(xlabel="Newton iterations per step (-)", title="Newton iterations")
    for ax in axes:
        ax.set(xscale="log", yticks=-np.arange(len(names)), ylim=(0.6 - len(names), 0.6))
        ax.set_yticklabels([SHOWN.get(name, name.replace("-", " ")) for name in names] if ax is axes[0] else [])
        ax.grid(alpha=0.3)
    axes[0].set_xticks(10.0 ** np.arange(-12, 1, 2))
    for name, n in Counter(r.outcome for r in rows).items():
        axes[1].plot([], [], "s" if name == "refused" else "o", color=colours[name], label=f"{name}: {n}")
    axes[1].legend(loc="upper right", fontsize=9)
    common.save(fig, out / "extreme_cases.png")


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--families", nargs="+", choices=tuple(FAMILIES), default=list(FAMILIES), metavar="NAME")
    parser.add_argument("--quick", action="store_true", help="four cases of each family, the first and last among them")
    parser.add_argument("--rtol", type=float, help="tolerance of adaptive steps, at most as long as the equal steps")
    o = parser.parse_args(argv)
    with common.results(o) as out:
        rows = []
        for name in o.families:
            cases = list(FAMILIES[name].cases())
            chosen = sorted({round(i) for i in np.linspace(0, len(cases) - 1, 4 if o.quick else len(cases))})
            for setting, make in (cases[i] for i in chosen):
                rows.append(r := judge(Row(name, setting), make, FAMILIES[name].bound, o.rtol))
                print(
                    f"{name:25} {setting:44} {r.outcome:10} {r.error:8.1e} {r.seconds:6.2f} s {r.note[:90]}", flush=True
                )
            write(o.out, rows)
        draw(o.out, rows)
        print(summary(rows))
        counts = Counter(r.outcome for r in rows)
        out |= {"cases": len(rows), **{name: counts[name] for name in OUTCOMES}}
        out["converged"] = not out["wrong"] + out["nan"] + out["hung"]
    return out


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
