# SPDX-License-Identifier: MIT
"""Storage of the pore fluid: a finite volume method with constant pressures (DG0) in the cells.

The fluid balance of an active cell, with J_Delta = det(I + grad u), is

    int r [zeta(J_Delta, p) - zeta_n] dV_n  +  int sum_faces Q dt  =  0,      d zeta = alpha dJ + S J dp,
    Q = T r [p+ - p- + rho_w g . (x- - x+)],   T = A / (d+ / kappa+ + d- / kappa-),   kappa = k / (rho_w g).

The fluid content is zeta (`fluid_content`), and `time_integration` defines the time integral.  A is the area
of the body on the face, and k is the conductivity.  The material in the two cells of a face has the centroids x+ and
x-, at the distances d+ and d- from the face.  `layers` defines kappa and d of cells with several soils,
`nonorthogonal` corrects the fluxes, and `drained_sides` adds open sides.

The factor `r = exp(p / K_w)` is the fluid density divided by the density rho_w at zero pressure.  In the storage term,
the pressure in r is `(p_n + p) / 2`.  On a face, r is the logarithmic mean over both cells.  With this mean,
`r [p+ - p-]` is the jump of the mass potential (`fluid_content`), and fluxes conserve mass.

The volume of a particle domain drifts away from the volume that its fluid content implies.  Each point stores this
volume defect (`owed`).  Each step corrects a part of the defect (`stepping/advance.py`).

Without flow, Q1 displacements with DG0 pressures violate the inf-sup condition.  Jumps of the pressure increment are
therefore stabilised by the term `max(0, tau d - dt kappa / d) A [p - p_n]`.  Here tau (1/Pa) is the strength of the
stabilisation, and d is d+ plus d-.  In this term, dt is the time weight of the flux at the end of the substep.  The
term conserves fluid, and it is zero in steady states.

For elastic soil, tau is a quarter of the value of Silvester and Kechkar for patches of elements (Camargo, White and
Borja 2021).  In yielding soil, tau is up to a hundred times larger than this value.  The increase of tau acts only on
second differences of the pressure (`second_differences`).

With inertia, tau has the factor `min(1, 1 / (1 + m) + s)`, with `s = kappa rho_w / dt`.  Here m is the ratio of
inertial to elastic resistance of 2 x 2 cells (`OnGrid.resisting_mass`).  Without this factor, waves in undrained soil
would be too slow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import change_of_content, mass_potential
from mpm_dolfinx.base.tolerances import EPSILON, ROUND_OFF, SAME
from mpm_dolfinx.flow.feeding import Feeding, Feeds, Fluid
from mpm_dolfinx.flow.fluxes import CellContents, Conduction, FluxForms, OpenSides
from mpm_dolfinx.flow.nonorthogonal import Gradients, NonorthogonalFlow
from mpm_dolfinx.flow.second_differences import second_differences
from mpm_dolfinx.flow.unsaturated import Relative
from mpm_dolfinx.forms.cell_matrices import along_shapes, insert_rows
from mpm_dolfinx.forms.point_forms import CellSums, FacetSum, FormPoints, PointData, PointForm
from mpm_dolfinx.forms.unknowns import Unknowns, matrix, sum_ghosts, zero
from mpm_dolfinx.materials.evaluate import ConductivityAtPieces
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.skeleton import filled
from mpm_dolfinx.parallel.exchange import over_all
from mpm_dolfinx.points.active import Active
from mpm_dolfinx.points.parts import OfParts, Parts
from mpm_dolfinx.pores.retention import logarithm, restrained

FILTER = 0.75
"""Fraction, in [0, 1], of the fixed-stress term `beta V` that is omitted for checkerboard pressures.  Here beta is the
fixed-stress coefficient, and V is the volume.  Sensitivity (scene "beam" of tests/plateaus.py): half this value changes
the result by 5.2e-11, and twice this value by 1.3e-10.  Finer cells change it by 1.5e-02.
"""


FluxSlope = Callable[[PETSc.Vec], NDArray[np.float64]]
"""Function that maps a change of the displacements u to changes of outflow volumes, see `StorageProblem.flux_slope`."""


class CellPressure(NamedTuple):
    """Pore pressure of the cells (DG0) in a step, Pa."""

    now: fem.Function  # at the current iterate
    before: fem.Function  # at the start of the substep
    start: fem.Function  # at the start of the step


class StorageForms:
    """Compiled forms of the fluid balance of a scene.

    `pieces`: quadrature points with the fields for `change_of_content`.  With a specific yield, the points also have
    the field `drainage`: specific yield and suction (Pa), see `skeleton.unsaturated`.
    `displacement`: increment of the displacement since the start of the step.
    `pressure`: pore pressure of the cells, positive in compression.
    `materials`: materials and fluid of the scene.
    `weight` (d,), N/m^3: unit weight rho_w g of the pore fluid, as UFL, or None without gravity.
    `symmetric`: whether to approximate the derivative of the fluid content with respect to J_Delta by alpha.  The
    Jacobian is then symmetric.  The neglected term is of the order of `(p - p_n) / K_w`.
    `feeding`: sources and open sides of all stages.
    `inertial`: data for the inertia force `-rho_w a` on the pore fluid, see `FluxForms`, or None without inertia.
    """

    def __init__(
        self,
        pieces: FormPoints,
        displacement: fem.Function,
        pressure: CellPressure,
        active: Active,
        materials: SceneMaterials,
        weight: ufl.core.expr.Expr | None,
        symmetric: bool,
        feeding: Sequence[Feeding],
        inertial: tuple[fem.Function, ufl.core.expr.Expr] | None = None,
    ):
        self.grid = pieces.grid
        self.p, self.p_n = pressure.now, pressure.start
        self.p_before = pressure.before
        self.bulk = bulk = materials.fluid.bulk
        self.rounding = ROUND_OFF * bulk if np.isfinite(bulk) else 0.0
        """Rounding error of pressures, in Pa, in bodies that fly without stress."""
        retentions, laws = materials.retentions, materials.conductivity_laws
        Q = self.p.function_space
        self.conductivity = None
        """Evaluation of the conductivity laws, or None without such laws."""
        if laws:
            self.conductivity = ConductivityAtPieces(materials.materials, laws, pieces, displacement, self.p_before)
        self._work = fem.Function(Q)
        self._sums = self._work.x.array
        q = ufl.TestFunction(Q)
        p, delta = ufl.variable(self.p), ufl.variable(pieces.increment(displacement))
        J = ufl.det(delta)
        stored = change_of_content(pieces.biot, pieces.storage_at_one, pieces.storage, J, p - self.p_n)
        self.drains = "drainage" in pieces.sizes
        """Whether any soil has a specific yield, so that its pores drain when the water table falls."""
        if self.drains:
            yielded, suction = pieces.drainage
            stored += yielded * (filled(p, suction) - filled(self.p_n, suction))
        coupling = 1.0
        self.retains = retentions is not None
        """Whether the soils have retention curves, so that pores drain under suction."""
        if self.retains:
            full, before = (retentions.of("saturation", at, pieces) for at in (p, self.p_n))
            denser = ufl.exp(-fem.Constant(self.grid.mesh, 1 / (2 * bulk)) * (p - self.p_n))
            drained = (full - before) * pieces.pores
            stored = full * stored + drained * denser
            coupling = ufl.diff(p * retentions.of("bishop", p, pieces), p)
            self._capacity = CellSums([ufl.diff(drained, p), full * coupling], pieces)
        self._change = PointForm(stored * q * pieces.dx, pieces)
        by_u = [pieces.biot * coupling * ufl.diff(J, delta), *([] if symmetric else [ufl.diff(stored, delta)])]
        along = [along_shapes(slope, pieces) for slope in by_u]
        self._derivatives = CellSums([ufl.diff(stored, p), *(part for slope in along for part in slope)], pieces)
        self.symmetric, self.softens = symmetric, materials.evolves
        relative = Relative(pieces.grid, retentions) if self.retains and materials.conducts else None
        of_fluid = (self.p, bulk, inertial, relative)
        self.fluxes = FluxForms(pieces.grid, active, weight, materials.conducts, *of_fluid)
        self.feeding = tuple(feeding)
        """Sources and open sides of all stages."""

    def change(self, data: PointData) -> NDArray[np.float64]:
        """Return the changes of the fluid volume in filled cells in the step, in m^d, as an array over local cells."""
        b = self._sums
        b[data.places.filled] = 0.0
        self._change.assemble_vector(b, data)
        return b

    def derivatives(self, data: PointData) -> list[NDArray[np.float64]]:
        """Return derivatives of the fluid volume in filled cells.

        The first array (filled cells,), in m^d/Pa, is the derivative of `change` with respect to p.  The second array
        (filled cells, n), in m^(d-1), is the derivative of `int alpha J_Delta dV` with respect to nodal displacements.
        If `symmetric` is False, a third array is the derivative of `change` with respect to nodal displacements.
        """
        sums, count = self._derivatives(data), self.grid.dim * 2**self.grid.dim
        return [sums[:, 0], *[sums[:, start : start + count] for start in range(1, sums.shape[1], count)]]

    def drained(self, data: PointData) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the storage by drainage (m^d/Pa) and `int S d(chi p)/dp dV` (m^d) of each cell, with saturation S."""
        capacity, coupled = self._capacity(data).T
        return capacity, coupled

    def driven(
        self, assembled: FacetSum, active: NDArray[np.int64], force: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Return the outflow of active cells to other cells due to pressures and weight of the fluid, in m^d/s.

        `force` (c, d), N/m^3: inertia force on the fluid in the local cells; None without inertia or in saturated soil.
        """
        relative, borders = self.fluxes.relative, None
        if relative is not None:
            borders = relative.set_pressures(self.p.x.array, force, self.fluxes.gradients)
        self._sums[active] = 0.0
        assembled.assemble_vector(self._sums)
        if borders is not None:
            borders.add_fluxes(self._sums)
        return sum_ghosts(self._work)


class Outflow(NamedTuple):
    """Conductances of the n active owned cells at the current displacements."""

    at: Sequence[Any]  # data of the conditions on the fluid, see `Feeds.conducting`
    total: NDArray[np.float64]  # outflow to other cells per unit of mass potential (n,), m^d/(Pa s)
    mobility: NDArray[np.float64]  # mobility along the axes (n, d), m^2/(Pa s)
    nonorthogonal: NonorthogonalFlow | None  # non-orthogonal correction


class Rates(NamedTuple):
    """Outflow rates of the owned cells, in m^d/s.  The result of `integrated` contains outflow volumes, in m^d."""

    cells: NDArray[np.float64]  # outflow of each cell minus its sources
    net: NDArray[np.float64]  # outflow from the bodies minus sources
    turnover: NDArray[np.float64]  # sum of absolute inflows and outflows
    gain: NDArray[np.float64]  # absolute value of sources

    def integrated(self, seconds: float) -> Rates:
        """Return the outflow volumes in the time `seconds`."""
        return Rates(seconds * self.cells, seconds * self.net, seconds * self.turnover, seconds * self.gain)


class StorageSystem:
    """Vectors and matrices of the pressure unknowns, for one set of active cells.

    `forms`: compiled forms, with the material in the cells.
    `cells`: active local cells, including ghosts.  `facets`: faces between two of these cells.
    `momentum`: unknowns of the displacement.
    `parts`: connected parts of the bodies.
    `joins`: functions that return the sparsity pattern of couplings between cell pressures, see `Loads.joins`.
    """

    def __init__(
        self,
        forms: StorageForms,
        cells: NDArray[np.int32],
        facets: NDArray[np.int32],
        momentum: Unknowns,
        parts: Parts,
        joins: Sequence[Callable[[Unknowns], PETSc.Mat]] = (),
    ):
        self._forms = forms
        self.symmetric = not forms.retains
        """Whether the matrix of the pressure unknowns is symmetric."""
        grid, d = forms.grid, forms.grid.dim
        fluxes = forms.fluxes
        self.unknowns = own = Unknowns(forms.p, cells.astype(np.int64), (grid.midpoints, grid.near_others[1]))
        self.of_parts = OfParts(forms.grid.comm, parts.cells[own.owned], parts.count)
        """Connected part of the bodies that contains each unknown."""
        self.L = matrix(own, own, 2 * d + 1)
        self.moves = moves = fluxes.by_motion is not None
        """Whether the matrix B contains the derivative of the outflow due to inertia, see `set_by_motion`."""
        self.B_momentum = matrix(own, momentum, 2**d * d)
        self.B = matrix(own, momentum, d * (d * moves + 1) * 2**d) if moves or not forms.symmetric else self.B_momentum
        self.residual, self.step, self._potentials, self._outflow = (own.vector() for _ in range(4))
        self.damp, self._alternation = (form.on(facets) for form in (fluxes.damp, fluxes.alternation))
        self._facets = facets
        self._uniform = self._over_uniform() if fluxes.relative is None else None
        self.set_alternation()
        _add_diagonal(self.L, np.zeros(own.size))  # has entries even for a cell without faces
        self.T, self.D = self.L.duplicate(), self.L.duplicate()
        pattern = self.L
        if forms.softens:
            zeros = np.zeros((grid.num_local, d, 2))
            pattern = second_differences(own, grid, zeros[: own.size, :, 0], zeros[:, :, 0], zeros)
            pattern.axpy(1.0, self.L, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        for join in joins:
            more = join(own)
            more.axpy(1.0, pattern, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
            pattern = more
        self.C, self.P = pattern.duplicate(), pattern.duplicate()

    @property
    def gravity(self) -> FacetSum | None:
        """Form of the fluxes between cells of the same soil.  None in saturated soil without gravity."""
        return (self._uniform or self._over_uniform())[1]

    def _over_uniform(self) -> tuple[FacetSum | None, FacetSum | None]:
        """Return the forms of the flux matrix and of `gravity`, over the faces between cells of the same soil."""
        fluxes, facets = self._forms.fluxes, self._facets
        facets = facets if fluxes.relative is None else fluxes.relative.uniform(facets)
        return tuple(form and form.on(facets) for form in (fluxes.flux, fluxes.gravity))

    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the grid positions of local unknowns and of prescribed pressures; the second array is always empty."""
        places = self._forms.grid.cell_places(self.unknowns.owned)
        return places, places[:0]

    def change_by(self, u: PETSc.Vec, out: PETSc.Vec, *slopes: FluxSlope) -> None:
        """Set `out` to the change (m^d) of the residual due to an increment u.

        `slopes`: functions that return the changes of outflow volumes due to u, at fixed accelerations.
        """
        self.B.mult(u, out)
        for slope in slopes:
            out.array_w[:] += slope(u)

    def between(self, pi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the outflow to other cells due to the mass potentials pi, in m^d/s."""
        self._potentials.array_w[:] = pi
        self.T.mult(self._potentials, self._outflow)
        return self._outflow.array_r

    def set_alternation(self) -> None:
        """Assemble the matrix L of `StorageProblem.assemble_preconditioner`."""
        zero(self.L)
        self._alternation.assemble_matrix(self.L)
        self.L.assemble()

    def set_fluxes(
        self,
        contents: CellContents,
        feeds: Sequence[Feeds],
        flow: Conduction,
        off: tuple[FacetSum, Gradients, OpenSides] | None,
    ) -> Outflow:
        """Assemble the fluxes between cells.  `off`: arguments of `NonorthogonalFlow`, or None."""
        fluxes = self._forms.fluxes
        mobility = fluxes.set_conduction(contents, flow)
        if (relative := self._forms.fluxes.relative) is not None:
            p = self._forms.p.x.array[contents.filled]
            mobility = mobility * relative.at(contents.filled, p)[:, None]
            flow = flow._replace(relative=relative)
        self.assemble_fluxes()
        total = self.T.getDiagonal(self._outflow).array_r.copy()
        nonorthogonal = None
        if off is not None:
            facets, gradients, sides = off
            nonorthogonal = NonorthogonalFlow(self._forms.fluxes, facets, gradients, contents, sides, flow.weight)
        return Outflow([one.conducting(flow) for one in feeds], total, mobility, nonorthogonal)

    def set_by_motion(self, dt: float, filled: NDArray[np.int64], rows: NDArray[np.float64]) -> None:
        """Set the matrix B to the derivative (m^(d-1)), with respect to displacements, of the outflow due to inertia.

        `dt`, s: time weight of the outflow.
        `rows` (n, k), m^(d-1)/s: derivative of the outflow through open sides with respect to the nodal displacements,
        in the owned cells `filled`.
        """
        fluxes = self._forms.fluxes
        facets = self._facets if fluxes.relative is None else fluxes.relative.uniform(self._facets)
        fluxes.by_motion.on(facets).assemble_matrix(self.B)
        insert_rows(self.B, self._forms.grid, filled, rows)
        self.B.assemble()
        self.B.scale(dt)

    def assemble_fluxes(self, force: NDArray[np.float64] | None = None) -> None:
        """Assemble the matrix of fluxes, in unsaturated soil at the current pressures.

        `force`: see `StorageForms.driven`.
        """
        self.T.zeroEntries()
        relative, borders = self._forms.fluxes.relative, None
        if relative is not None:
            borders = relative.set_pressures(self._forms.p.x.array, force, self._forms.fluxes.gradients)
        if (flux := (self._uniform or self._over_uniform())[0]) is not None:
            flux.assemble_matrix(self.T)
        if borders is not None:
            borders.add_slopes(self.T, self.unknowns)
        self.T.assemble()


class StorageResidual(NamedTuple):
    """Residuals of the fluid balance in the cells, with sums (parts,) of terms over each connected part, in m^d."""

    vector: PETSc.Vec
    exchanged: NDArray[np.float64]  # sum of absolute values: changes of content, and sources
    round_off: NDArray[np.float64]  # sum of the bounds of rounding errors
    off: NDArray[np.float64]  # sum of absolute mass errors of the cells
    gain: NDArray[np.float64]  # change of content plus outflow minus sources
    rates: Rates  # at (u, p)


class FluidInertia(NamedTuple):
    """Inertia in a substep, in the n active owned cells."""

    move: Callable[[], None]  # sets the acceleration in the forms to its value at u
    forces: Callable[[NDArray[np.int64] | slice], NDArray[np.float64]]  # see `Fluid.force`
    resists: NDArray[np.float64]  # (n,) see `OnGrid.resisting_mass`
    density: float  # of the fluid, kg/m^3
    rate: float  # acceleration divided by the displacement, 1/s^2


class StorageProblem:
    """The fluid balance in one substep.  The pressure at the start of the step is `forms.p_n`.

    `system`: vectors and matrices, with the assembled fluxes.
    `flow`: function that assembles the outflow at (u, p).  Its argument is True at the start of a substep.
    `dt`: time weight, s, of the outflow rate at (u, p).
    `before`: contribution of the previous substep's rates to the outflow volumes.
    `softness` (m,): ratio of elastic to tangent shear modulus of the pieces, 1 if no law can yield.
    `defect` (n,), m^d: volume defect that is corrected until the end of the substep, in each active owned cell.
    `inertial`: inertia of the bodies, or None.
    `scale`: suctions (n,), Pa, at which the pores of the active owned cells drain, or None in saturated scenes.
    """

    def __init__(
        self,
        forms: StorageForms,
        system: StorageSystem,
        data: PointData,
        contents: CellContents,
        feeds: Sequence[Feeds],
        flow: Callable[[bool], Outflow],
        dt: float,
        before: Rates | None = None,
        softness: NDArray[np.float64] | float = 1.0,
        defect: NDArray[np.float64] | float = 0.0,
        inertial: FluidInertia | None = None,
        scale: NDArray[np.float64] | None = None,
    ):
        self._scale = scale
        self.forms, self._p = forms, (forms.p.x.array, forms.p_n.x.array)
        self.system = system
        self.data = data
        self._defect = defect
        self._inertial = inertial
        self._contents = contents
        self._feeds = feeds
        self._flow = flow
        self.dt = dt
        self._before = before or Rates(*np.zeros((4, system.unknowns.size)))
        forms.fluxes.slope.x.array[:] = 0.0
        if inertial is not None:
            inertial.move()
        outflow = flow(before is None)
        least, static = dt * outflow.mobility.min(axis=1), 1.0
        if inertial is not None:
            static = np.minimum(1.0, 1 / (1 + inertial.resists) + least * inertial.density / dt**2)
        squared = 4 * forms.grid.most**2  # the distance of two centroids is at most 2 h
        tau = contents.set_damping(static)
        if forms.retains:  # dry pores hardly couple both balances, and their storage stabilises as well
            capacity, coupled = (values / contents.volume for values in forms.drained(data))
            tau, least = contents.set_damping(static * np.maximum(coupled, 0.0), capacity), 0.0 * least
        softest = contents.softest(softness) if forms.softens else np.array([1.0])
        softest = 1 / (static / softest + (1 - static))  # yield does not change the mass
        known = [(tau * squared > least).any(), (softest * tau * squared > least).any() and softest.max() > 1]
        somewhere = over_all(forms.grid.comm, np.array([*known, any([one.settles for one in feeds])], dtype=float)) > 0
        self.damped, flows, self._settles = somewhere.tolist()
        """Whether jumps of the pressure are damped in any cell."""
        self._softer = self._damping_of_soft_soil(tau, softest, outflow.mobility) if flows else None
        self._correction = self._begin(outflow)
        """Non-orthogonal correction (m^d/s) of the fluxes, constant in the substep."""
        if self.damped:
            forms.fluxes.dt.value = dt
            system.D.zeroEntries()
            system.damp.assemble_matrix(system.D)
            system.D.assemble()

    def _damping_of_soft_soil(
        self, tau: NDArray[np.float64], softest: NDArray[np.float64], mobility: NDArray[np.float64]
    ) -> PETSc.Mat:
        """Return the matrix of the additional damping in yielding soil."""
        contents, grid = self._contents, self.forms.grid
        flow = self.dt * mobility / grid.sizes(contents.filled) ** 2
        more = np.maximum((softest * tau)[:, None] - flow, 0) - np.maximum(tau[:, None] - flow, 0)
        strength = np.array(grid.volumes(contents.filled)).reshape(-1, 1) * more
        return second_differences(self.system.unknowns, grid, strength, contents.centroid, contents.open)

    @property
    def _fluid(self) -> Fluid:
        """The fluid in the active owned cells at the pressures p."""
        p = self._p[0][self.system.unknowns.owned]
        return Fluid(p, mass_potential(p, self.forms.bulk), np.exp(p / self.forms.bulk))

    @property
    def _density(self) -> NDArray[np.float64]:
        """Density of the fluid in the active owned cells at mid-step, divided by its density at zero pressure."""
        (p, p_n), owned = self._p, self.system.unknowns.owned
        return np.exp((p[owned] + p_n[owned]) / (2 * self.forms.bulk))

    def outcome(self) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the results of the conditions at (u, p), by quantity and name, see `Feeds.outcome`."""
        fluid, out = self._fluid, {"outflows": {}}
        for one, at in zip(self._feeds, self._flow(False).at, strict=True):
            for quantity, values in one.outcome(at, fluid).items():
                out[quantity] = out.get(quantity, {}) | values
        return out

    def volumes(self, now: Mapping[str, Mapping]) -> dict[str, dict[str, NDArray[np.float64]]]:
        """Return the additional volumes (m^d) at the end of a step, by quantity and name, see `Feeds.volumes`."""
        out: dict[str, dict[str, NDArray[np.float64]]] = {}
        for one in self._feeds:
            for quantity, values in one.volumes(now).items():
                out[quantity] = out.get(quantity, {}) | values
        return out

    @property
    def linear(self) -> bool:
        """Whether the tangent of the fluid balance is independent of the pressure."""
        drains = self.forms.drains or self.forms.retains
        return not drains and not self._settles and all(one.linear for one in self._feeds)

    @property
    def fill(self) -> NDArray[np.float64]:
        """Volume fraction of material in each cell, by which pressure errors are weighted."""
        return self._contents.fill

    def undrained(self, volumes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressure increases (Pa) of cells at fixed total stress, if `volumes` (m^d) of fluid are added."""
        return volumes / (self.forms.derivatives(self.data)[0] + self._contents.fixed_stress)

    def filling(self, error: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return errors of the water content due to `error` in pressures (Pa), and its absolute changes in the step."""
        capacity, _ = self.forms.drained(self.data)
        change = self.forms.change(self.data)[self.system.unknowns.owned]
        share = self.fill / self._contents.volume
        return share * capacity * error, share * np.abs(change)

    @property
    def ring(self) -> float:
        """Mean circumference of the material in axisymmetry, m."""
        whole, area = over_all(self.forms.grid.comm, np.array([self._contents.volume.sum(), self._contents.area.sum()]))
        return float(whole / area)

    def _begin(self, outflow: Outflow) -> NDArray[np.float64] | float:
        """Start the substep, and return the non-orthogonal correction (m^d/s) of fluxes between cells."""
        p, fluid = self._p[0], self._fluid
        sides = [0 if one.sides is None else len(one.sides.cells) for one in self._feeds]
        between, difference = 0.0, np.zeros(sum(sides))
        if outflow.nonorthogonal is not None:
            between, difference = outflow.nonorthogonal(p, self.forms.bulk)
        start = 0
        for one, at, count in zip(self._feeds, outflow.at, sides, strict=True):
            one.begin(at, fluid, difference[start : start + count])
            start += count
        return between

    @property
    def accuracy(self) -> float:
        """Largest relative tolerance of linear solvers that this balance allows."""
        return SAME if self.forms.retains else 1.0

    def restrained(
        self, dp: NDArray[np.float64], previous: NDArray[np.float64] | float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | float]:
        """Return limited pressure decreases (Pa), and the resulting changes of the logarithm of the suction.

        `dp` (n,), Pa: pressure decreases in the Newton step.
        `previous` (n,): change of the logarithm of the suction in the previous iteration.
        """
        p = self._p[0][self.system.unknowns.owned]
        dp = restrained(p, dp, self._scale, previous)
        return dp, logarithm(p - dp, self._scale) - logarithm(p, self._scale)

    def settle(self) -> bool:
        """Update the active sets for the flow at (u, p), and return whether any set has changed."""
        if not self._settles:
            return False
        fluid, both = self._fluid, zip(self._feeds, self._flow(False).at, strict=True)
        return over_all(self.forms.grid.comm, sum(one.settle(at, fluid) for one, at in both)) > 0

    def set_fluxes(self) -> None:
        """Assemble the fluxes at u."""
        self._flow(False)

    def flux_slope(self, u: fem.Function, unknowns: Unknowns, dofs: NDArray[np.int64]) -> FluxSlope:
        """Return a function that maps a change of displacements to the changes (n,) of outflow volumes, in m^d.

        The function computes a matrix-free finite difference (Knoll and Keyes 2004) of the conductivity laws and of the
        geometry of the fluxes, at fixed accelerations.  After the last call of the function, `set_fluxes` must assemble
        the fluxes again.

        `dofs`: active dofs of u.
        """
        h = self.forms.grid.least
        base, density = self._rates(self._flow(False)).cells, self._density

        def along(v: PETSc.Vec) -> NDArray[np.float64]:
            largest = v.norm(PETSc.NormType.NORM_INFINITY)
            if not 0 < largest < np.inf:
                return np.zeros(len(base))
            step, now = np.sqrt(np.finfo(float).eps) * h / largest, u.x.array[dofs]
            unknowns.add(u.x, step, v)
            moved = self._rates(self._flow(False)).cells
            u.x.array[dofs] = now
            return self.dt * (moved - base) / step / density

        return along

    def assemble_residual(self) -> StorageResidual:
        """Return the residual of the fluid balance at (u, p)."""
        forms = self.forms
        system = self.system
        before = self._before
        outflow = self._flow(False)
        if self._inertial is not None:
            self._inertial.move()
        b = forms.change(self.data)
        owned = system.unknowns.owned
        density = self._density
        b[owned] = change = density * b[owned] + self._defect
        r = system.unknowns.gather(b, system.residual)
        step = system.step
        step.array_w[:] = self._p[0][owned] - self._p[1][owned]
        if self.damped:
            system.D.multAdd(step, r, r)
        if self._softer is not None:
            self._softer.multAdd(step, r, r)
        rates, dt = self._rates(outflow), self.dt
        mass = r.array_r + dt * rates.cells + before.cells
        r.array_w[:] = mass / density
        # bound of the rounding errors of volumes, and of fluxes that cancel
        round_off = 8 * EPSILON * (self._contents.volume + dt * rates.turnover + before.turnover)
        exchanged, gain = np.abs(change) + dt * rates.gain + before.gain, change + dt * rates.net + before.net
        rows = exchanged, round_off, np.abs(mass), gain
        return StorageResidual(r, *system.of_parts.sums(np.array(rows)), rates)

    def _rates(self, outflow: Outflow) -> Rates:
        """Return the outflow rates at (u, p)."""
        system, fluid = self.system, self._fluid
        force = None
        if self._inertial is not None:
            fluid = fluid._replace(force=self._inertial.forces)
            force = self._local_force()
        if system.gravity is None:
            cells = system.between(fluid.pi)
        else:
            cells = self.forms.driven(system.gravity, self._contents.active, force)[system.unknowns.owned]
        cells = cells + self._correction
        net, gain = np.zeros((2, len(cells)))
        turnover = np.abs(outflow.total * fluid.pi)
        for one, at in zip(self._feeds, outflow.at, strict=True):
            leaving = one.leaving(at, fluid)
            net, gain = net + leaving.cells, gain + leaving.gain
            turnover = turnover + leaving.turnover
        return Rates(cells + net, net, turnover, gain)

    def _local_force(self) -> NDArray[np.float64] | None:
        """Return the inertia forces on the fluid in local cells, see `StorageForms.driven`."""
        if self._inertial is None or self.forms.fluxes.relative is None:
            return None
        out = np.zeros((self.forms.grid.num_local, self.forms.grid.dim))
        out[self.system.unknowns.owned] = self._inertial.forces(slice(None))
        return out

    def net_inflow(self, rates: Rates) -> NDArray[np.float64]:
        """Return the net inflow by fluxes and sources into each filled owned cell in the step, in m^d.

        `rates`: outflow rates at the end of the last substep.
        """
        return (-self.dt * rates.cells - self._before.cells) / self._density

    def assemble_tangent(
        self, data: PointData | None = None, of_suction: Sequence[tuple[NDArray, NDArray]] = ()
    ) -> None:
        """Assemble the derivatives `C = d/dp` and `B = d/du` of the residual at (u, p).

        `data`: quadrature points of the pieces, by default the points of the problem.
        `of_suction`: cells (c,), and derivatives (c, n), m^(d-1), of their nodal forces with respect to p, for laws
        that depend on suction.
        """
        forms = self.forms
        system = self.system
        data = data or self.data
        if self._inertial is not None:
            self._inertial.move()
        if forms.fluxes.relative is not None:
            self._flow(False)
            system.assemble_fluxes(self._local_force())
        capacity, *by_u = forms.derivatives(data)
        system.C.zeroEntries()
        system.C.axpy(self.dt, system.T, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        if self.damped:
            system.C.axpy(1.0, system.D, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        if self._softer is not None:
            system.C.axpy(1.0, self._softer, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        fluid, both = self._fluid, [*zip(self._feeds, self._flow(False).at, strict=True)]
        slope = 0.0
        for one, at in both:
            slope = slope + one.slope(at, fluid)
            if (coupling := one.coupling(at, fluid, system.unknowns)) is not None:
                system.C.axpy(self.dt, coupling, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        _add_diagonal(system.C, capacity + self.dt * slope)
        couplings = [(system.B_momentum, by_u[0])]
        if system.B is not system.B_momentum:
            couplings.append((system.B, by_u[-1]))
        for B, _ in couplings:
            zero(B)
        if system.moves and self._inertial is not None:
            by_force = sum(one.by_force(at, fluid) for one, at in both) + np.zeros((len(capacity), forms.grid.dim))
            shapes = -self._inertial.density * self._inertial.rate * self._contents.shape_values
            rows = shapes[:, :, None] * by_force[:, None]
            system.set_by_motion(self.dt, self._contents.filled, rows.reshape(len(rows), -1))
        for cells, more in of_suction:
            insert_rows(system.B_momentum, forms.grid, cells, -more)
        for B, rows in couplings:
            insert_rows(B, forms.grid, data.places.filled, rows)
            B.assemble()

    def assemble_preconditioner(self, factor: float, share: float) -> PETSc.Mat:
        """Return the fixed-stress operator `C + factor (beta V - share L)` for the current C.

        Parameters
        ----------
        factor
            Factor on beta, >= 0.
        share
            Weight of L, in [0, 1].  For a checkerboard pressure, `beta V - L` is zero.  L is the sum of
            `min(beta V+, beta V-) / (4 d) [p][q]` over the faces.
        """
        system = self.system
        system.C.copy(system.P, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        system.P.axpy(-factor * share, system.L, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        _add_diagonal(system.P, factor * self._contents.fixed_stress)
        return system.P


def _add_diagonal(A: PETSc.Mat, values: NDArray[np.float64]) -> None:
    """Add values to the diagonal of a matrix."""
    d = A.getDiagonal()
    d.array_w[:] += values
    A.setDiagonal(d)
