# SPDX-License-Identifier: MIT
"""Functions that several demos share: options, printed lines, tables, pictures, and two terms in UFL."""

from __future__ import annotations

import argparse
import csv
import json
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl

import mpm_dolfinx as mpm

GALLERY = Path(__file__).with_name("README.md")
COLOURS = "#0072B2 #E69F00 #009E73 #D55E00 #CC79A7 #56B4E9 #882255 #7F7F7F #999933 #332288".split()
"""Colours of lines, distinct even for the colour-blind (Okabe and Ito 2008, Tol 2021)."""


class Parser(argparse.ArgumentParser):
    """Command line of a demo, with the options --json and, if the demo writes files, --out.

    processes: whether the demo also runs on several processes.
    """

    class Formatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
        """Help text with unchanged line breaks and the default of each option."""

    def __init__(self, description: str, file: str, writes: bool = True, processes: bool = False):
        super().__init__(description=description, formatter_class=self.Formatter)
        self.demo, self.processes = Path(file).stem, processes
        if writes:
            self.add_argument("--out", type=Path, default=Path("out") / self.demo, help="folder for pictures, tables")
        self.add_argument("--json", action="store_true", help="print the results as one line of JSON at the end")

    def parse_args(self, args: Sequence[str] | None = None, namespace=None) -> argparse.Namespace:
        """Return the options; the option `takes` is the run time of the demo, as text.

        The run time comes from the table Gallery of README.md, or is None if the table has no row with these options.
        """
        args = sys.argv[1:] if args is None else list(args)
        o = super().parse_args(args, namespace)
        if not self.processes:
            self.refuse_processes()
        given = re.sub(r"--(json|out[ =]\S+)", "", " ".join(args)).split()
        row = rf"^\| \[`{self.demo}`\].*?\| (\d+ (?:s|min))(?: <!-- \w+([^;]*);)? "
        row = re.search(row, GALLERY.read_text(), re.M)
        o.takes = row[1] if row and (row[2] or "").split() == given else None
        return o

    def refuse_processes(self, what: str = "") -> None:
        """Refuse to run on several processes, where the output would contain only a part of the points."""
        if (size := MPI.COMM_WORLD.size) == 1:
            return
        if not first():
            sys.exit(2)
        self.error(f"{self.demo}{what}: runs on one process, not {size}")


@contextmanager
def results(o: argparse.Namespace) -> Iterator[dict]:
    """Yield a dict for the results, and print it at the end with --json.

    The expected run time is printed at the start. If the run fails (`mpm.GaveUp`), `converged` is False in the dict.
    """
    out, start = {}, time.perf_counter()
    if first() and o.takes:
        print(f"The demo takes about {o.takes}, and longer in its first run, which compiles the forms.", flush=True)
    try:
        yield out
        out.setdefault("converged", True)
        if first() and not out["converged"]:
            print("error: results are outside the bounds that the demo checks", file=sys.stderr)
    except mpm.GaveUp as error:
        out |= {"wall_s": error.result.wall, "converged": False}
        if first():
            print(f"error: {error}", file=sys.stderr)
    if first():
        written = f"; pictures and tables: {o.out}/" if "out" in o and o.out.exists() else ""
        print(f"{time.perf_counter() - start:.1f} s in all{written}")
        if o.json:
            print(json.dumps(out))


def first() -> bool:
    """Return whether this process prints and draws."""
    return MPI.COMM_WORLD.rank == 0


def whole(s: mpm.Simulation, *names: str) -> list[np.ndarray]:
    """Return named fields of the points of all processes, ordered by the identifiers of the points."""
    parts = s.grid.comm.allgather([getattr(s.points, name) for name in ("id", *names)])
    ids, *values = map(np.concatenate, zip(*parts, strict=True))
    return [each[np.argsort(ids)] for each in values]


def table(rows: Iterable[Iterable[str]]) -> None:
    """Print rows of text as a table; the first row is the head."""
    rows = [list(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for name, *entries in rows:
        line = [name.ljust(widths[0]), *(x.rjust(w) for x, w in zip(entries, widths[1:], strict=True))]
        print("  ".join(line).rstrip(), flush=True)


def markdown(rows: Iterable[Iterable[str]]) -> str:
    """Return rows of text as a Markdown table; the first row is the head."""
    head, *body = ("| " + " | ".join(row) + " |" for row in rows)
    return "\n".join([head, "|" + "---|" * (head.count(" | ") + 1), *body])


def write_csv(path: Path, head: Iterable[str], rows: Iterable[Iterable]) -> None:
    """Write a table as a CSV file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([head, *rows])


def figure(rows: int, columns: int, size: tuple[float, float]):
    """Return a figure of matplotlib and its axes (rows, columns); `size` is in inches."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams["axes.prop_cycle"] = plt.cycler(color=COLOURS)
    fig, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    fig.get_layout_engine().set(w_pad=0.1)  # inches: no label touches the next panel
    return fig, axes


def save(fig, path: Path, dpi: int = 130) -> None:
    """Write a figure as a picture of at most 256 colours, so that the file is small."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=dpi)
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


def weight(unit_weight: float) -> Callable:
    """Return a term for `terms=`: a downward weight (N) per volume (m³) of undeformed ground."""

    def weight(points, v):
        return unit_weight / ufl.det(points.F) * points.value(v)[1] * points.dx

    return weight


def viscous(viscosity: float) -> Callable:
    """Return a term for `terms=`: the viscous stress `2 eta D`, with the viscosity eta, in Pa s.

    D is the rate of deformation, `sym(grad(u)) / dt`.
    """

    def viscous(points, u, dt):
        strain = ufl.sym(points.grad(u))
        return viscosity / dt * ufl.inner(strain, strain) * points.dx

    return viscous


def unbalanced(energies: dict[str, np.ndarray]) -> float:
    """Return the largest error of the energy balance (J), from the `energies` of a result."""
    names = ("kinetic", "elastic", "dissipated", "viscous", "friction", "renewal")
    total = sum(energies[name] for name in names if name in energies) - energies["external"]
    return float(np.abs(total - total[0]).max())


def domains(ax, corners: np.ndarray, values: np.ndarray | None = None, **style):
    """Draw particle domains with corners (n, 4, 2), coloured by values (n,)."""
    from matplotlib.collections import PolyCollection

    style = {"edgecolors": "face", "linewidth": 0.2} | style
    drawn = PolyCollection(corners[:, [0, 1, 3, 2]], array=values, **style)
    return ax.add_collection(drawn)
