# SPDX-License-Identifier: MIT
"""Numbers of iterations that couple displacement and pore pressure, from drained to undrained steps.

The scenes are a cantilever (the poroelastic beam, undeformed and bent) and a footing on a column. The linear system of
the first Newton step is solved to a relative residual of 1e-8. Only the product of conductivity and step length
matters. This product is 1e-23 to 1e11 m. The bulk modulus K_w of the water ranges from 1e4 Pa to infinity.

Three schemes are compared. An iteration of each scheme consists of one solve of the storage and one solve of the
momentum.

1. Conjugate gradients on the Schur complement `S = C + B K^-1 B^T`, as in the package. C is the matrix of storage and
   flow, K is the stiffness matrix, and B is the coupling matrix. The preconditioner is the filtered fixed-stress
   operator `C + beta (V - 3/4 L)`. Here beta is a number, V contains the cell volumes, and L is a five-point Laplacian.
2. Conjugate gradients with the plain operator `C + beta V` as preconditioner.
3. The plain fixed-stress (Richardson) iteration with beta = 0.5, 0.75 and 1 times alpha²/K_dr, where alpha is Biot's
   coefficient and K_dr is the drained bulk modulus. With beta = 1/K_w this iteration diverges.

In undrained bodies, Q1/DG0 elements have checkerboard modes of the pressure. The damping of pressure jumps
(`mpm_dolfinx/flow/storage.py`) limits these modes. The second picture shows the pressure with and without damping.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from petsc4py import PETSc

import common
import numpy as np
import poroelastic_beam as beam
from numpy.typing import NDArray

import mpm_dolfinx as mpm
from mpm_dolfinx.flow.storage import FILTER, StorageProblem
from mpm_dolfinx.solve.schur import LinearSolvers
from mpm_dolfinx.stepping import step
from mpm_dolfinx.stepping.balances import balances

K_DT = np.array([-23, -16, -12, -10, -9, -8, -7, -6, -5, -4, -3, -2, 0, 3, 7, 11])  # log10 of k dt in m
BULK = (1e4, 1e6, 2.2e9, np.inf)  # bulk modulus of the water, Pa
SCHEMES = {
    "Schur-CG": ("cg", 0.75, FILTER),
    "Schur-CG, plain operator": ("cg", 0.75, 0.0),
    "fixed stress, 1/2": ("richardson", 0.5, 0.0),
    "fixed stress, 3/4": ("richardson", 0.75, 0.0),
    "fixed stress, 1": ("richardson", 1.0, 0.0),
    "fixed stress, 1/K_w": ("richardson", None, 0.0),
}
"""For each scheme: Krylov method, beta divided by alpha^2/K_dr, and the factor of L in the preconditioner.

The entry None stands for beta = 1/K_w.
"""
MOST = 200  # iterations after which a scheme counts as divergent
RAMP_STEP = 0.02  # s: the load of all systems increases as in a step of this length, for any dt
CLEAR = 0.1  # m from the corners of the clamp, where the pressure is singular
GOAL = 15  # iterations


class Undamped(mpm.Hencky):
    """Hencky's law without the damping of pressure jumps."""

    def pressure_damping(self) -> float:
        """Return tau = 0."""
        return 0.0


LAWS = {"damped": mpm.Hencky, "undamped": Undamped}


@dataclass(frozen=True)
class Count:
    """Number of iterations of a scheme for one linear system, or None if the scheme diverges.

    lowest, highest: extreme eigenvalues of P^-1 S, with preconditioner P and Schur complement S; nan if not computed.
    """

    scene: str
    h: float
    fluid_bulk: float
    k_dt: float
    scheme: str
    iterations: int | None
    lowest: float = np.nan
    highest: float = np.nan


def cantilever(h: float) -> mpm.Simulation:
    """Return the poroelastic beam with cells of size h, in m."""
    return beam.scene(beam.arguments(["--h", str(h)]))[0]


def bent(h: float) -> mpm.Simulation:
    """Return the poroelastic beam after two steps, when its tip has sagged by half the height of the beam."""
    simulation = cantilever(h)
    simulation.run(2 * RAMP_STEP, RAMP_STEP, progress=False)
    return simulation


def column(h: float) -> mpm.Simulation:
    """Return a drained column of 0.5 m x 1 m between smooth walls, with a load on half of its top."""
    cells = np.rint(np.array([0.5, 1.2]) / h).astype(int)
    grid = mpm.Grid([0, 0], [0.5, 1.2], cells)
    soil = beam.material(beam.arguments([]))
    footing = mpm.Traction("top", lambda t: (0, -1e6 * t), region=((0, 0), (0.25, 2)))
    return mpm.Simulation(
        grid,
        [mpm.box(grid, [0, 0], [0.5, 1.0])],
        [soil],
        fluid=mpm.Fluid(),
        walls={"left": "x", "right": "x", "bottom": "xy"},
        conditions=[footing, mpm.Drained("top")],
    )


SCENES = {"beam": cantilever, "bent beam": bent, "column": column}


@dataclass(frozen=True)
class System:
    """Linear system of a Newton step, with its solvers."""

    solvers: LinearSolvers
    storage: StorageProblem
    bulk: float
    soil: mpm.Skeleton


def with_water(s: mpm.Simulation, bulk: float) -> mpm.Simulation:
    """Return a copy of the scene in its present state, with water of the bulk modulus `bulk`, in Pa.

    Pressures are scaled to at most a tenth of the bulk modulus, so that the density of the water stays physical.
    """
    soils, walls = s.scene.materials.materials, s.state.stage.conditions["walls"]
    other = mpm.Simulation(s.grid, s.bodies, soils, fluid=mpm.Fluid(bulk=bulk), walls=walls, conditions=s.conditions)
    pieces = s.state.pieces
    rows = {name: pieces.arrays[name] for name in ("pressure", "bounds", "of_cell", "start") if name in pieces.arrays}
    share = min(1.0, bulk / 10 / max(1e-300, *(np.abs(values).max() for values in rows.values())))
    rows |= {} if pieces.slope is None else {"slope": pieces.slope}
    pieces = replace(pieces, **{name: share * values for name, values in rows.items()})
    other.state = replace(s.state, stage=other.state.stage, pieces=pieces)
    return other


def linearise(s: mpm.Simulation, dt: float) -> System:
    """Return the linear system of the first Newton step, for a time step of length dt (s)."""
    start = step.set_up(s.scene, s.state, RAMP_STEP)
    momentum = balances(s.scene, start, start.acting[-1]).momentum
    matrices, pieces, contents = start.matrices, start.data.pieces, start.on_grid.contents
    acting = start.acting[-1]
    fed = matrices.flow(start.state, None, start.data, acting.t, dt, acting.loads, momentum.at)
    storage = StorageProblem(s.scene.storage, matrices.storage, pieces, contents, *fed, dt)
    momentum.assemble_residual()
    storage.assemble_residual()
    solvers = matrices.solvers
    solvers.linearise(momentum, storage)
    return System(solvers, storage, s.scene.fluid.bulk, s.scene.materials.materials[0])


def count(s: System, scheme: str) -> tuple[int | None, float, float]:
    """Return the number of iterations for a linear system, and the extreme eigenvalues of P^-1 S (see `Count`)."""
    method, factor, share = SCHEMES[scheme]
    if factor is None:
        factor = s.soil.drained_modulus(2) / s.soil.biot**2 / s.bulk
    g, (schur, preconditioned) = s.solvers.condense(), s.solvers.schur
    solver = PETSc.KSP().create(g.comm)
    solver.setType(method)
    solver.setPC(preconditioned.pc)
    solver.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    solver.setTolerances(rtol=1e-8, atol=0.0, divtol=1e5, max_it=MOST)
    solver.setComputeEigenvalues(method == "cg")
    solver.setOperators(schur, s.storage.assemble_preconditioner(factor, share))
    solver.solve(g, g.duplicate())
    iterations = solver.getIterationNumber() if solver.getConvergedReason() > 0 else None
    if method != "cg":
        return iterations, np.nan, np.nan
    values = solver.computeEigenvalues().real
    return iterations, values.min(), values.max()


def scan(scene: str, h: float, bulks=BULK, k_dt=K_DT, schemes=tuple(SCHEMES)) -> list[Count]:
    """Count the iterations of each scheme for all fluids and all values of k dt."""
    start, out = SCENES[scene](h), []
    for bulk in bulks:
        s = with_water(start, bulk)
        for exponent in k_dt:
            system = linearise(s, 10.0**exponent / s.scene.materials.materials[0].conductivity)
            out += [Count(scene, h, bulk, 10.0**exponent, scheme, *count(system, scheme)) for scheme in schemes]
    return out


def worst(counts: list[Count]) -> float:
    """Return the largest number of iterations, or infinity if a scheme diverges or needs more than `MOST`."""
    return max(np.inf if c.iterations is None else c.iterations for c in counts)


def cells(s: mpm.Simulation) -> NDArray[np.float64]:
    """Return the pressures of the cells (nx, ny), in Pa; they are nan in empty cells and near the clamp's corners."""
    p = np.full(s.grid.shape.prod(), np.nan)
    body = s.bodies[0]
    corners = [[0, body.lower[:, 1].min()], [0, (body.lower + body.spacing)[:, 1].max()]]
    apart = np.linalg.norm(s.grid.midpoints[:, None] - corners, axis=2).min(axis=1)
    filled = s.scene.last[0].contents.filled
    shown = filled[apart[filled] > CLEAR]
    p[s.grid.cell_number[shown]] = s.scene.storage.p.x.array[shown]
    return p.reshape(s.grid.shape)


def roughness(p: NDArray[np.float64]) -> float:
    """Return the rms difference of pressures (nx, ny) from means of neighbours, divided by the largest pressure."""
    deviation = p[1:-1, 1:-1] - (p[:-2, 1:-1] + p[2:, 1:-1] + p[1:-1, :-2] + p[1:-1, 2:]) / 4
    return float(np.sqrt(np.nanmean(deviation**2)) / np.nanmax(np.abs(p)))


def undrained(h: float, law: type[mpm.Hencky]) -> tuple[mpm.Simulation, mpm.Result]:
    """Load the undrained beam in three steps."""
    o, like = beam.arguments([]), cantilever(h)
    soil = law(bulk=o.bulk, shear=o.shear, porosity=o.porosity, conductivity=1e-12)
    s = mpm.Simulation(like.grid, like.bodies, [soil], **beam.physics(o))
    return s, s.run(3 * RAMP_STEP, RAMP_STEP, progress=False)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--h", type=float, nargs="+", default=[0.06, 0.03, 0.015], help="cell sizes, m")
    parser.add_argument("--quick", action="store_true", help="fewer cases: every other k dt, stiff water only")
    o = parser.parse_args(argv)
    if not min(o.h) > 0:
        parser.error(f"--h {min(o.h)}: must be > 0")
    with common.results(o) as out:
        bulks, k_dt = (BULK[2:], K_DT[::2]) if o.quick else (BULK, K_DT)
        counts = [c for scene in SCENES for h in o.h for c in scan(scene, h, bulks, k_dt)]
        runs = {(h, name): undrained(h, law) for h in o.h for name, law in LAWS.items()}
        write(o, counts)
        write_roughness(o, runs)
        draw(o, counts)
        draw_pressure(o, runs)
        own = worst([c for c in counts if c.scheme == "Schur-CG"])
        out |= {
            "worst_iterations": own if np.isfinite(own) else None,
            "worst_plain_operator": worst([c for c in counts if c.scheme == "Schur-CG, plain operator"]),
            "roughness": {name: [roughness(cells(runs[h, name][0])) for h in o.h] for name in LAWS},
            "converged": bool(own <= GOAL),
        }
    return out


def shown(iterations: float) -> str:
    """Return a number of iterations as text."""
    return f"{iterations:.0f}" if np.isfinite(iterations) else "none"


def write(o: Namespace, counts: list[Count]) -> None:
    """Write all counts as CSV, and the largest counts as Markdown."""
    head = ["scene", "h_m", "fluid_bulk_Pa", "k_dt_m", "scheme", "iterations", "lowest", "highest"]
    common.write_csv(o.out / "iterations.csv", head, (asdict(c).values() for c in counts))
    rows = [["scene", "h (m)", *SCHEMES, "eigenvalues of P⁻¹S"]]
    for scene, h in dict.fromkeys((c.scene, c.h) for c in counts):
        here = [c for c in counts if (c.scene, c.h) == (scene, h)]
        each = [shown(worst([c for c in here if c.scheme == scheme])) for scheme in SCHEMES]
        own = [c for c in here if c.scheme == "Schur-CG"]
        rows.append([scene, f"{h:g}", *each, f"{min(c.lowest for c in own):.2f} to {max(c.highest for c in own):.2f}"])
    print(f"most iterations to 1e-8 over all k dt and K_w (none: diverges, or more than {MOST})")
    tabulate(o.out / "iterations.md", rows)


def write_roughness(o: Namespace, runs: dict) -> None:
    """Write the roughness of the undrained pressure and the numbers of iterations as Markdown."""
    rows = [["h (m)", *(f"roughness, {name}" for name in LAWS), *(f"iterations to 1e-3, {name}" for name in LAWS)]]
    for h in o.h:
        here = [runs[h, name] for name in LAWS]
        rough, solves = [roughness(cells(s)) for s, _ in here], [r.coupling / r.newton for _, r in here]
        rows.append([f"{h:g}", *(f"{x:.2%}" for x in rough), *(f"{x:.1f}" for x in solves)])
    print("undrained beam: rms difference of a cell's pressure from its neighbours' mean / largest pressure")
    tabulate(o.out / "roughness.md", rows)


def tabulate(path: Path, rows: list[list[str]]) -> None:
    """Print a table, and write it as Markdown."""
    path.write_text(common.markdown(rows) + "\n")
    common.table(rows)
    print()


def draw(o: Namespace, counts: list[Count]) -> None:
    """Draw iterations against k dt, with one panel for each scene."""
    fig, ((*axes, side),) = common.figure(1, len(SCENES) + 1, (16, 4.6))
    styles = dict(zip(o.h, ("-", "--", ":", "-."), strict=False))
    for ax, scene in zip(axes, SCENES, strict=True):
        for colour, scheme in enumerate(SCHEMES):
            for h, style in styles.items():
                line = [c for c in counts if (c.scene, c.h, c.scheme, c.fluid_bulk) == (scene, h, scheme, 2.2e9)]
                n = [np.nan if c.iterations is None else c.iterations for c in line]
                ax.loglog([c.k_dt for c in line], n, style, color=f"C{colour}")
        goal = ax.axhline(GOAL, color="black", lw=0.8, label=f"bound of Schur-CG: {GOAL}")
        ax.set(xlabel="k Δt (m)", ylabel="iterations to 1e-8", title=scene, ylim=(0.9, MOST))
        ax.grid(alpha=0.3)
    handles = [axes[0].plot([], [], color=f"C{colour}", label=name)[0] for colour, name in enumerate(SCHEMES)]
    handles += [axes[0].plot([], [], style, color="black", label=f"h = {h:g} m")[0] for h, style in styles.items()]
    side.legend(handles=[*handles, goal], loc="center left")
    side.set_axis_off()
    fig.suptitle(
        "Iterations of a linear solve, water of 2.2 GPa; lines end where schemes diverge; fixed stress: β K_dr / α²"
    )
    common.save(fig, o.out / "iterations.png")


def draw_pressure(o: Namespace, runs: dict) -> None:
    """Draw the undrained pressure of the cells with and without damping."""
    h = o.h[len(o.h) // 2]
    fig, (axes,) = common.figure(1, len(LAWS), (13, 3.9))
    limit = np.nanmax(np.abs(cells(runs[h, "damped"][0]))) / 1e3
    for ax, name in zip(axes, LAWS, strict=True):
        s = runs[h, name][0]
        extent = np.stack([s.grid.lower, s.grid.upper], axis=1).ravel()
        image = ax.imshow(cells(s).T / 1e3, origin="lower", extent=extent, cmap="RdBu_r", clim=(-limit, limit))
        low, high = s.points.corners.min(axis=(0, 1)), s.points.corners.max(axis=(0, 1))
        ax.set(xlim=(0, high[0] + 0.05), ylim=(low[1] - 0.05, high[1] + 0.05))
        ax.set(xlabel="x (m)", ylabel="y (m)", title=f"{name}, h = {h:g} m: roughness {roughness(cells(s)):.2%}")
        fig.colorbar(image, ax=ax, shrink=0.8).set_label("pore pressure (kPa)")
    fig.suptitle("Undrained beam after three steps, without the corners of the clamp")
    common.save(fig, o.out / "checkerboard.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
