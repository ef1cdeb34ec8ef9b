# SPDX-License-Identifier: MIT
"""Your own physics in a few lines of UFL: ten columns with exact solutions.

Each example is a column of 1 m between smooth walls on a floor, in plane strain, with one additional feature. Seven
features concern the skeleton: a stored energy, fibres, an elastic foundation, damage, plastic flow, an implicit stress,
and a return mapping in numpy. Three features concern
the fluid: two conductivities that depend on the deformation, and a source. The parameter names of a user function
select its arguments. `mpm_dolfinx/materials/skeleton.py` and `mpm_dolfinx/materials/user_functions.py` list all
arguments.

The error is the largest difference from the exact solution, divided by the largest exact value. With 20 cells, errors
of displacements and pressures are at most 3e-3, and decrease with the cell size. Errors of stresses are at most 1e-5.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import common
import numpy as np
import ufl
from scipy.optimize import brentq

import mpm_dolfinx as mpm

LOAD = 2e5  # Pa
WATER = mpm.Fluid()


def column(cells: int, material: mpm.Skeleton, load: float = LOAD, **scene) -> mpm.Simulation:
    """Return the column under a load on its top that grows from t = 0 to 1 s."""
    grid = mpm.Grid([0, 0], [1 / cells, 1.0 + 2 / cells], [1, cells + 2])
    body = mpm.box(grid, [0, 0], [1 / cells, 1])
    top = mpm.Traction("top", lambda t: (0, -load * min(1, t)))
    walls = {"left": "x", "right": "x", "bottom": "y"}
    return mpm.Simulation(
        grid, [body], [material], walls=walls, conditions=[top, *scene.pop("conditions", [])], **scene
    )


@dataclass
class Example:
    """Computed values (n,) and exact values (n,) of a column, with their abscissas x (n,)."""

    title: str
    xlabel: str
    ylabel: str
    x: np.ndarray
    found: np.ndarray
    exact: np.ndarray

    @property
    def error(self) -> float:
        """Largest difference between computed and exact values, divided by the largest exact value."""
        return float(np.abs(self.found - self.exact).max() / np.abs(self.exact).max())


def displacements(s: mpm.Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the initial heights of the points, in ascending order, and their vertical displacements, in m."""
    Y = s.bodies[0].centre[:, 1]
    order = np.argsort(Y)
    return Y[order], (s.points.x[:, 1] - Y)[order]


def pressures(s: mpm.Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights of the cells, in ascending order (m), and the pore pressures of the cells (Pa)."""
    cells = s.cells()
    order = np.argsort(cells.x[:, 1])
    return cells.x[order, 1], cells.pressure[order]


def stretch(stress: Callable[[float], float]) -> float:
    """Return the stretch at which the first Piola-Kirchhoff stress balances the load."""
    return brentq(lambda s: stress(s) + LOAD, 0.3, 2.0, xtol=1e-15)


def settlement(s: mpm.Simulation, stretches: np.ndarray) -> tuple:
    """Return labels of the axes, heights of the points, and computed and exact displacements of four layers."""
    Y, u = displacements(s)
    exact = np.interp(Y, np.linspace(0, 1, 5), np.concatenate([[0], np.cumsum(stretches - 1) / 4]))
    return "height at the start (m)", "displacement (m)", Y, u, exact


# ---- your own stored energy, stiffer from layer to layer -----------------------------------


class SaintVenantKirchhoff(mpm.Skeleton):
    """Law with the energy `psi = lambda/2 (tr E)^2 + G E:E`, with Green's strain `E = (F^T F - I)/2`."""

    @staticmethod
    def energy(F, bulk, shear):
        E = (F.T * F - ufl.Identity(2)) / 2
        return (bulk - 2 * shear / 3) / 2 * ufl.tr(E) ** 2 + shear * ufl.inner(E, E)


def layered(X: np.ndarray) -> np.ndarray:
    """Return a modulus at reference positions (n, 2) in Pa which doubles from layer to layer."""
    return 1e6 * 2.0 ** np.floor(4 * (1 - X[:, 1]))


def energy(cells: int) -> Example:
    soil = SaintVenantKirchhoff(bulk=layered, shear=lambda X: 0.6 * layered(X))
    s = column(cells, soil)
    s.run(1, 1)
    moduli = 1.8 * layered(np.array([[0, 0.125 + k / 4] for k in range(4)]))
    layers = np.array([stretch(lambda a, M=M: M / 2 * (a**3 - a)) for M in moduli])
    return Example("energy, layered", *settlement(s, layers))


# ---- fibres: a direction at each point - ------------------------------------------------------------


@dataclass(frozen=True)
class Fibrous(mpm.NeoHookean):
    """Neo-Hookean matrix with fibres of direction a, which add the energy `c/4 (I_4 - 1)^2` with `I_4 = (F a)^2`."""

    fibre: float = 0.0  # c, Pa
    direction: mpm.Field = (1.0, 0.0)

    @staticmethod
    def energy(F, bulk, shear, fibre, direction):
        along = F * direction
        return mpm.NeoHookean.energy(F, bulk, shear) + fibre / 4 * (ufl.inner(along, along) - 1) ** 2


def direction(X: np.ndarray) -> np.ndarray:
    """Return the direction of the fibres at reference positions (n, 2): vertical in every second layer."""
    return np.where(np.floor(4 * X[:, [1]]) % 2, (0.0, 1.0), (1.0, 0.0))


def fibres(cells: int) -> Example:
    s = column(cells, Fibrous(bulk=1e6, shear=6e5, fibre=2e6, direction=direction))
    s.run(1, 1)

    def matrix(a):
        return 6e5 * (a - 1 / a) + 6e5 * np.log(a) / a

    layers = np.array([stretch(matrix), stretch(lambda a: matrix(a) + 2e6 * (a**2 - 1) * a)])
    return Example("fibres on the points", *settlement(s, layers[[0, 1, 0, 1]]))


# ---- a conductivity that depends on the deformation ----------------------------------------------


def of_strain(conductivity, J):
    """Return the conductivity k0 exp(8 (J - 1))."""
    return conductivity * ufl.exp(8 * (J - 1))


def flow(cells: int, law: Callable, exact_law: Callable, title: str) -> Example:
    """Let water flow upwards through a column of two layers, which the load compresses unequally."""

    def modulus(X):
        return np.where(X[:, 1] < 0.5, 1e6, 4e6)

    soil = mpm.Hencky(bulk=modulus, shear=modulus, conductivity=1e-4, conductivity_law=law)
    drained = [mpm.Drained("top"), mpm.Drained("bottom", pressure=1.0)]
    s = column(cells, soil, fluid=WATER, conditions=drained)
    s.run(2000, 100)
    J = np.array([stretch(lambda a, M=M: M * 7 / 3 * np.log(a) / a) for M in (1e6, 4e6)])
    n = 1 - 0.6 / J
    resistance = 0.5 * J / exact_law(J, n)
    drop = resistance / resistance.sum()
    heights = np.array([0, 0.5 * J[0], 0.5 * J.sum()])
    y, p = pressures(s)
    exact = np.interp(y, heights, [1, 1 - drop[0], 0])
    return Example(title, "height (m)", "p / p at the foot (-)", y, p, exact)


def kozeny_carman(cells: int) -> Example:
    return flow(cells, mpm.kozeny_carman, lambda J, n: n**3 / (1 - n) ** 2, "Kozeny-Carman")


def strain_law(cells: int) -> Example:
    return flow(cells, of_strain, lambda J, n: np.exp(8 * (J - 1)), "conductivity from strain")


# ---- an elastic foundation: one more term in the balance of momentum ------------------------------

STIFFNESS = 4e6  # Pa/m per m of displacement: force per volume


def foundation(points, u):
    """Return the energy (UFL) of springs between the points of the body and their initial positions."""
    U = points.displacement + points.value(u)
    return STIFFNESS / 2 * ufl.inner(U, U) / ufl.det(points.F) * points.dx


def springs(cells: int) -> Example:
    soil, load = mpm.LinearElastic(bulk=3e5, shear=1e5), 10.0
    s = column(cells, soil, load=load, terms=[foundation])
    s.run(1, 0.25)
    Y, u = displacements(s)
    M, kappa = soil.oedometric, np.sqrt(STIFFNESS / soil.oedometric)
    exact = -load / (M * kappa) * np.sinh(kappa * Y) / np.cosh(kappa)
    return Example("elastic foundation", "height (m)", "displacement (mm)", Y, 1e3 * u, 1e3 * exact)


# ---- a source of fluid ----------------------------------------------------------------------------

RATE = 1e-7  # 1/s


def source(points, q):
    """Return the form (UFL) of a uniform source of water."""
    return RATE * q * points.dx


def well(cells: int) -> Example:
    soil = mpm.Hencky(bulk=1e9, shear=1e9, conductivity=1e-6)
    s = column(cells, soil, fluid=WATER, conditions=[mpm.Drained("top")], terms=[mpm.Source(source)])
    s.run(100, 10)
    y, p = pressures(s)
    exact = RATE * WATER.unit_weight / soil.conductivity / 2 * (1 - y**2)
    return Example("source of fluid", "height (m)", "pore pressure (Pa)", y, p, exact)


# ---- a law with a state variable: damage, updated after each step -------------------------------------------


@dataclass(frozen=True)
class Damaged(mpm.NeoHookean):
    """Neo-Hookean law with the energy `(1 - D) psi`.

    The damage is `D = 1 - exp(-m / 0.5)`, where m is the largest `abs(ln(J))` so far.
    """

    state: ClassVar = {"damage": 0.0}

    @staticmethod
    def energy(F, bulk, shear, damage):
        return (1 - damage) * mpm.NeoHookean.energy(F, bulk, shear)

    @staticmethod
    def update(F, damage):
        return {"damage": ufl.max_value(damage, 1 - ufl.exp(-abs(ufl.ln(ufl.det(F))) / 0.5))}


PATH = "logarithmic compression (-)", "axial pressure (kPa)"


def path(s: mpm.Simulation, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Run to t = 1 s, and return logarithmic compression and axial Kirchhoff pressure (Pa) after each step."""
    out = []
    s.run(1, 1 / steps, observe=lambda s: out.append((s.points.J, s.points.J * s.effective_stress()[:, 1, 1])))
    J, stress = np.array(out).mean(axis=2).T
    return -np.log(J), -stress


def damage(cells: int) -> Example:
    """Compress the column, unload it, and compress it further."""

    def top(t, X):
        return 0, 0.3 * np.interp(t, [0, 0.4, 0.7, 1], [0, -0.6, -0.1, -1])

    soft = Damaged(bulk=1e6, shear=6e5)
    s = column(cells, soft, load=0.0, conditions=[mpm.Displacement("top", top, "y")])
    _, stress = path(s, 40)
    strain = -np.log([1 + top(t, None)[1] for t in np.arange(1, 41) / 40])
    sound = 6e5 * (1 - np.exp(-2 * strain)) + 6e5 * strain
    exact = sound * np.exp(-np.maximum.accumulate(strain) / 0.5)
    return Example("damage", *PATH, strain, stress / 1e3, exact / 1e3)


# ---- plastic flow: a law that gives its stress and returns to a yield surface ----------------------


def plasticity(cells: int) -> Example:
    """Load sand in an oedometer."""
    sand = mpm.DruckerPrager(bulk=1e7, shear=1e7, friction=20.0, dilation=5.0, cohesion=5e4)
    strain, stress = path(column(cells, sand, load=1e6), 20)
    shear = 2 * sand.shear / np.sqrt(3)  # growth of sqrt(J_2) with the compression; -p grows by K
    toward = shear - sand.eta * sand.bulk  # the strain at yield is xi c / toward
    beyond = np.maximum(0, strain - sand.xi * sand.cohesion / toward)
    gamma = toward * beyond / (sand.shear + sand.bulk * sand.eta * sand.eta_flow)
    exact = sand.oedometric * strain - (shear - sand.bulk * sand.eta_flow) * gamma
    return Example("plastic flow", *PATH, strain, stress / 1e3, exact / 1e3)


# ---- stresses that no formula gives: an equation for them in UFL, or their values in numpy ----------


@dataclass(frozen=True)
class Hardening(mpm.Skeleton):
    """Law with the pressure `K y`, where Newton's method solves `y + power y^3 = ln J` for y."""

    power: mpm.Field = 100.0

    unknowns: ClassVar = {"y": 0.0}

    @staticmethod
    def trial(F):
        return {"volume": ufl.ln(ufl.det(F))}

    @staticmethod
    def residual(trial, power, y):
        return {"y": y + power * y**3 - trial["volume"]}

    @staticmethod
    def kirchhoff(F, bulk, shear, y):
        I = ufl.Identity(F.ufl_shape[0])
        return bulk * y * I + shear * (F * F.T - I)


@dataclass(frozen=True)
class Crushable(mpm.Skeleton):
    """Foam that is crushed irreversibly above a limit pressure, with a return mapping in numpy."""

    limit: mpm.Field = 1e5  # Pa

    state: ClassVar = {"crushed": 0.0}
    unknowns: ClassVar = {"pressure": 0.0}

    trial = Hardening.trial

    @staticmethod
    def solution(trial, bulk, limit, crushed):
        elastic = bulk * (trial["volume"] - crushed)
        crushes = elastic < -limit
        return {"pressure": (np.where(crushes, -limit, elastic), {"volume": np.where(crushes, 0.0, bulk)})}

    @staticmethod
    def kirchhoff(F, shear, pressure):
        I = ufl.Identity(F.ufl_shape[0])
        return pressure * I + shear * (F * F.T - I)

    @staticmethod
    def update(trial, bulk, pressure):
        return {"crushed": trial["volume"] - pressure / bulk}


def local_unknown(cells: int) -> Example:
    soil = Hardening(bulk=1e6, shear=6e5)
    strain, stress = path(column(cells, soil), 10)
    root = np.sqrt(3 * soil.power)
    y = 2 / root * np.sinh(np.arcsinh(1.5 * root * strain) / 3)
    exact = soil.bulk * y + soil.shear * (1 - np.exp(-2 * strain))
    return Example("local unknown", *PATH, strain, stress / 1e3, exact / 1e3)


def numpy_law(cells: int) -> Example:
    """Crush the foam, unload it, and compress it further."""
    foam = Crushable(bulk=1e6, shear=2e5)

    def load(t: float) -> float:
        return float(np.interp(t, [0, 0.4, 0.7, 1], [0, 1.5e5, 0.5e5, 2e5]))

    top = [mpm.Traction("top", lambda t: (0, -load(t)))]
    s = column(cells, foam, load=0.0)
    s.stage(conditions=top)
    strain, stress = path(s, 20)
    crushed, exact = 0.0, []
    for e in strain:
        pressure = max(-foam.limit, foam.bulk * (-e - crushed))
        crushed = -e - pressure / foam.bulk
        exact.append(-pressure + foam.shear * (1 - np.exp(-2 * e)))
    return Example("return in numpy", *PATH, strain, stress / 1e3, np.array(exact) / 1e3)


EXAMPLES = (energy, fibres, kozeny_carman, strain_law, springs, well, damage, plasticity, local_unknown, numpy_law)


def main(argv: list[str] | None = None) -> dict:
    """Run the demo and return its results."""
    parser = common.Parser(__doc__, __file__)
    parser.add_argument("--cells", type=int, default=20, help="cells over the height, a multiple of 4")
    o = parser.parse_args(argv)
    if o.cells < 4 or o.cells % 4:
        parser.error(f"--cells {o.cells}: must be a multiple of 4, >= 4")
    with common.results(o) as out:
        examples = [example(o.cells) for example in EXAMPLES]
        out["errors"] = {f.__name__: e.error for f, e in zip(EXAMPLES, examples, strict=True)}
        common.table([[f"{o.cells} cells", "error"], *([e.title, f"{e.error:.1e}"] for e in examples)])
        draw(o, examples)
    return out


def draw(o: Namespace, examples: list[Example]) -> None:
    """Draw every example with its exact solution."""
    fig, axes = common.figure(5, 2, (6.5, 11))
    for ax, e in zip(axes.flat, examples, strict=True):
        ax.plot(e.x, e.exact, color="black", lw=1, label="exact")
        ax.plot(e.x, e.found, "o", ms=3, label="material points")
        ax.set(xlabel=e.xlabel, ylabel=e.ylabel)
        ax.set_title(f"{e.title}: {e.error:.0e}", fontsize=11)
        ax.locator_params(nbins=4)
        ax.grid(alpha=0.3)
    axes[0, 0].legend()
    fig.suptitle("User-defined physics: largest relative error of each example")
    common.save(fig, o.out / "extending_with_ufl.png")


if __name__ == "__main__":
    raise SystemExit(0 if main()["converged"] else 1)
