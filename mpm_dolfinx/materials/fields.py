# SPDX-License-Identifier: MIT
"""Materials of a scene at its material points.

Parameters may depend on position, and materials may have different laws.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from inspect import signature
from itertools import pairwise
from operator import attrgetter, itemgetter

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import SAME, TINY
from mpm_dolfinx.base.validation import line, numbers
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.forms.point_forms import FormPoints, PointData
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.materials.evaluate import LawAtPoints, SoftnessAtPoints, knows_space, mean_size, sampled
from mpm_dolfinx.materials.prestressed import AT_REST, stressed
from mpm_dolfinx.materials.skeleton import BY_SCENE, DRIED, Fluid, Skeleton, constants_of
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all, together
from mpm_dolfinx.points.material_points import ACROSS, MaterialPoints
from mpm_dolfinx.pores.pore_water import PoreWater
from mpm_dolfinx.pores.retention import Retentions, SaturationAt, scale_of
from mpm_dolfinx.pores.retention import sampled as drained

RESERVED = frozenset(
    "F dF softness owed due storage storage_at_one density position displacement porosity0 gradient drainage retention "
    "pores".split()
)
"""Reserved names of fields at quadrature points.  No parameter or state variable may have such a name."""
WHAT_IS_NAMED = "parameters, state and unknowns"
EVOLVED = 1e-3
"""Soil has yielded if a state variable differs from its initial value by more than this number.  Sensitivity (scene
"soil" of tests/plateaus.py): half this value changes the result by 6.6e-05, and twice this value by 1.4e-04.  Finer
cells change it by 3.0e-02.
"""
STIFFEST = 100.0
"""Upper limit of (alpha^2 / S) / (lambda + 2G), the ratio of the pore fluid's stiffness to the skeleton's stiffness.  S
is the storage coefficient.  The limit keeps rounding errors small.  Sensitivity (scene "soil" of tests/plateaus.py):
half this value changes the result by 1.2e-07, and twice this value by 1.0e-07.  Finer cells change it by 3.0e-02.
"""


class SceneMaterials:
    """Materials of a scene.  Values that vary from point to point are stored in `points.data`.

    Parameters
    ----------
    grid
        Background grid.
    materials
        Materials, to which the bodies refer by index.
    bodies
        All bodies.
    points
        Material points of this process, as seeded.  Constants are evaluated at the points' reference positions.
    fluid
        Pore fluid, or None in a scene without fluid.
    prestressed
        Whether points may have an initial stress.
    """

    def __init__(
        self,
        grid: Grid,
        materials: Sequence[Skeleton],
        bodies: Sequence[Body],
        points: MaterialPoints,
        fluid: Fluid | None,
        prestressed: bool = False,
    ):
        self.grid = grid
        self.fluid = fluid
        self._used = _used(bodies, len(materials))  # a material without a body has no effect
        rows = {i: (points.material == i).nonzero()[0] for i in self._used}
        places = {i: _places(bodies, i, points.id[own]) for i, own in rows.items()}

        def at_points(of: Sequence[Skeleton]) -> list[tuple[Skeleton, Skeleton]]:
            """Return two copies of each used material: one for this process's points, and one for a single point."""
            return [_evaluated(grid, of[i], places[i], points.id[rows[i]]) for i in self._used]

        evaluated, at_first = zip(*at_points(materials), strict=True)
        locks = [over_all(grid.comm, bool(np.any(m.nearly_incompressible)), MPI.LOR) for m in evaluated]
        in_space = [grid.stretches == 2 and (prestressed or lock) for lock in locks]
        known = [not needed or knows_space(grid, m) for m, needed in zip(at_first, in_space, strict=True)]
        self.stretches = 3 if any(np.logical_and(locks, known)) else grid.stretches
        """Number of rows of the deformation gradients that laws receive, 2 or 3."""
        if prestressed:
            whole = dict(zip(self._used, known, strict=True))
            materials = [stressed(m, whole.get(i, True)) for i, m in enumerate(materials)]
            evaluated = [m for m, _ in at_points(materials)]
        self.materials, self._evaluated = materials, evaluated
        used = [materials[i] for i in self._used]
        self._fields = [_by_place(m) for m in materials]
        self.laws = list(dict.fromkeys(map(type, used)))
        kinds = list(zip(map(type, used), locks, known, strict=True))
        self._parts = list(dict.fromkeys(kinds))
        own = dict(zip(self._used, kinds, strict=True))
        self._part = np.array([self._parts.index(own[i]) if i in own else 0 for i in range(len(materials))])
        self.symmetric = all(m.symmetric for m in used)
        """Whether the tangents of all materials are symmetric."""
        moduli = [m.oedometric for m in evaluated], [m.shear for m in evaluated]
        self.varied = any(most > 2 * least for least, most in (_ends(grid, of) for of in moduli))
        """Whether stiffness differs between points by more than a factor of two."""
        self.conductivity_laws = list(dict.fromkeys(m.conductivity_law for m in used if m.conductivity_law))
        """Distinct conductivity laws of the scene."""
        self.conducts = any(map(_conducts, [*evaluated, *used]))
        """Whether fluid flows in the scene, or may flow in a later stage."""
        least, most = _ends(grid, [m.conductivity for m in evaluated])
        self.layered = most > least or _layered(used)
        """Whether the conductivity may differ between points."""
        self.checksums: dict[str, int | list[float]] = _samples(dict(zip(self._used, used, strict=True)))
        """For checkpoints: checksums of varying constants, and samples of conductivity laws and retention curves."""
        self.check_cells()
        self.shapes: dict[str, tuple[int, ...]] = {}
        """Shapes of parameters and state variables at a point, by name."""
        seeded = dict(points.data)
        for i, m in zip(self._used, evaluated, strict=True):
            values = {name: getattr(m, name) for name in self._fields[i]}
            count = max(1, len(rows[i]))
            together(grid.comm, partial(self._add_shapes, _expanded(m, values, count), seeded, len(points)))
            for name, value in values.items():
                filled, own = np.zeros((len(points), *value.shape[1:])), rows[i]
                filled[own] = value[: len(own)]
                checksum = _checksum(grid, points.id[own], filled[own], sum(map(len, bodies)))
                self.checksums[f"checksum of {name} of material {i}"] = checksum
                seeded[name] = filled + seeded[name] if name in seeded else filled
        self.seeded = replace(points, data=seeded | self._at_start(points, seeded, prestressed))
        """Material points with their initial state, and with the parameters that are functions of position."""
        given = [
            (grid, law, {name: self.shapes[name] for name in _takes(law)}, self._stretches_of(law)) for law in self.laws
        ]
        self._at_points = [LawAtPoints(*of) for of in given]
        soft = "softness" in self.seeded.data
        self._softness = {k: SoftnessAtPoints(*of) for k, of in enumerate(given) if soft and self.laws[k].state}

    def _at_start(
        self, points: MaterialPoints, state: dict[str, NDArray[np.float64]], prestressed: bool
    ) -> dict[str, NDArray[np.float64]]:
        """Return the initial values of the fields that the scene adds to the state variables `state` of its laws."""
        out = {name: np.maximum(-points.pressure, 0.0) for name in DRIED if name in state}
        if self.across:
            out[ACROSS] = np.ones(len(points))
        if prestressed and "plastic" in state:
            out["plastic" + AT_REST] = state["plastic"]
        if self.fluid is not None:
            out |= {"owed": np.zeros(len(points)), "due": np.zeros(len(points))}
            out |= {"softness": np.ones(len(points))} if self.evolves else {}
        return out

    def seeds_no_more(self) -> None:
        """Delete the seeded points, which are needed only to add bodies."""
        self.seeded = self.seeded.of(np.empty(0, dtype=np.int64))

    def check_cells(self) -> None:
        """Raise ValueError if cells are too large for a softening law."""
        size = mean_size(self.grid)
        together(self.grid.comm, lambda: [m.check_cells(size) for m in self._evaluated])

    @property
    def across(self) -> bool:
        """Whether any law of a scene in plane strain receives the out-of-plane stretch of F-bar."""
        return self.stretches > self.grid.stretches

    def _stretches_of(self, law: type[Skeleton]) -> int:
        """Return the number of rows of the deformation gradients that a law receives."""
        return self.stretches if (law, True, True) in self._parts else self.grid.stretches

    def _add_shapes(self, m: Skeleton, seeded: dict[str, NDArray[np.float64]], count: int) -> None:
        """Check a law, add the shapes of its parameters and state to `shapes`, and its initial state to `seeded`."""
        law = type(m)
        if (law.energy is None) == (law.kirchhoff is None):
            which = "neither" if law.energy is None else "both"
            raise ValueError(f"{law.__name__}: defines {which} of energy and kirchhoff, must define one of them")
        given = (law.residual is not None) + (law.solution is not None)
        if given != bool(law.unknowns):
            has = f"{'' if law.unknowns else 'no '}unknowns, and {given} of residual and solution"
            allowed = "one of residual and solution if it has unknowns, else neither"
            raise ValueError(f"{law.__name__}: has {has}; must define {allowed}")
        own, others = (*constants_of(m), *law.state), {*constants_of(m), *law.state, *BY_SCENE, "F", "trial"}
        if clashes := [name for name in own if name in BY_SCENE] + [name for name in law.unknowns if name in others]:
            raise ValueError(f"{law.__name__}: the name {clashes[0]!r} is taken; {WHAT_IS_NAMED} must have other names")
        for name, value in law.unknowns.items():
            _known(f"{law.__name__}: unknown {name!r}", value)
        if self.fluid is None and m.retention is not None:
            raise ValueError(f"{law.__name__}: retention = {line(m.retention)}, must be None without a fluid")
        if "suction" in law.state and self.fluid is not None and m.retention is None:
            raise ValueError(f"{law.__name__}: retention = None, must be a retention curve for a law with suction")
        if law.unknowns and "cell_size" in law.by_scene and not self.grid.even:
            what = "has unknowns and depends on cell_size, must not be used with cells of several sizes"
            raise ValueError(f"{law.__name__}: {what}")
        for name in law.parameters:
            if not hasattr(m, name):
                known = ", ".join([*constants_of(m), *law.state])
                raise ValueError(f"{law.__name__}: argument {name!r} of its functions, must be F or one of {known}")
            value = _known(f"{law.__name__}: {name}", getattr(m, name))
            self._set_shape(law, name, value.shape[1:])
        for name, value in law.state.items():
            value = _known(f"{law.__name__}: state {name!r}", value)
            self._set_shape(law, name, value.shape)
            seeded[name] = np.tile(value, (count, *[1] * value.ndim))

    def _set_shape(self, law, name: str, shape: tuple[int, ...]) -> None:
        if name in RESERVED or hasattr(FormPoints(self.grid), name):
            raise ValueError(f"{law.__name__}: the name {name!r} is taken; {WHAT_IS_NAMED} must have other names")
        other = self.shapes.setdefault(name, shape)
        if other != shape:
            raise ValueError(f"{law.__name__}: {name} has shape {shape}, in another law {other}; must be equal")

    def parts(self, pieces: FormPoints, common: Sequence[str]) -> list[tuple[type[Skeleton], FormPoints, bool]]:
        """Return the parts of the soil: their law, integration points, and whether Q1 cells would lock without F-bar.

        Materials form one part if they have the same law, and all or none of them are nearly incompressible.  If there
        is only one part, its integration points are `pieces`.  If there are several parts, each has its own integration
        points, with the fields named in `common`, and with the law's parameters and state variables.
        """
        if len(self._parts) == 1:
            return [(law, pieces, locks) for law, locks, _ in self._parts]
        names = [
            [name for name in dict.fromkeys([*common, *_takes(law)]) if name != ACROSS or (locks and known)]
            for law, locks, known in self._parts
        ]
        shapes = [{name: getattr(pieces, name).ufl_shape for name in some} for some in names]
        points = [FormPoints(pieces.grid, **s) for s in shapes]
        return [(law, own, locks) for (law, locks, _), own in zip(self._parts, points, strict=True)]

    def part_of(self, points: MaterialPoints) -> NDArray[np.int64]:
        """Return the index (n,) of the part of the soil to which each point belongs, see `parts`."""
        return self._part[points.material]

    def law_of(self, points: MaterialPoints) -> NDArray[np.int64]:
        """Return the index (n,) of each point's law in the list `laws`."""
        return np.array([self.laws.index(law) for law, *_ in self._parts])[self.part_of(points)]

    def locking(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of the points in whose material Q1 cells would lock without F-bar."""
        return np.array([locks for _, locks, _ in self._parts])[self.part_of(points)]

    def stretched(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of the points whose law uses the out-of-plane stretch of F-bar."""
        return self.across & self.locking(points) & self.knows_across(points)

    def knows_across(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of the points whose law accepts an out-of-plane stretch."""
        return np.array([known for *_, known in self._parts])[self.part_of(points)]

    def conducting(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return (n, 2): conductivity in m/s, and one number for both the conductivity law and the retention curve."""
        laws, known = [m.conductivity_law for m in self.materials], self.conductivity_laws
        law = np.array([known.index(law) if law in known else -1 for law in laws])[points.material]
        by_place = np.array([law is not None and _names_place(law) for law in laws])[points.material]
        conductivity = self.table(points, attrgetter("conductivity"))
        number = np.where(by_place, len(known) + points.id, law)
        if self.retentions is not None:
            number = number + self.retention_of(points) / (1 + len(self.retentions.laws))
        return np.stack([conductivity, number], axis=1)

    def retention_of(self, points: MaterialPoints) -> NDArray[np.int64]:
        """Return the index of each point's retention curve, counted from 1, or 0 if the pores stay saturated."""
        return np.array([self.retentions.number(m.retention) for m in self.materials])[points.material]

    def saturation(
        self, points: MaterialPoints, p: NDArray[np.float64], of: NDArray[np.int64] | slice = slice(None)
    ) -> tuple[NDArray[np.float64], ...]:
        """Return saturation S, dS/dp, Bishop's chi and relative permeability at pressures p, in Pa, for points `of`."""
        return self.saturations(self.retention_rows(points)[of], p)

    @cached_property
    def retentions(self) -> Retentions | None:
        """Retention curves of the scene, or None if all pores stay saturated."""
        laws = list(dict.fromkeys(self.materials[i].retention for i in self._used))
        some = [law for law in laws if law is not None]
        return Retentions(some, None not in laws, self.grid) if some and self.fluid is not None else None

    @cached_property
    def _saturation(self) -> SaturationAt:
        return SaturationAt(self.grid, self.retentions)

    def saturations(self, rows: NDArray[np.float64], p: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return the results of `saturation` at p, in Pa.  `rows`: a row of `retention_rows` for each pressure."""
        return self._saturation(rows, p)

    def retention_scale(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the characteristic suction of each point's retention curve, in Pa; infinite without a curve."""
        scales = [np.inf if m.retention is None else scale_of(m.retention) for m in self.materials]
        return np.array(scales)[points.material]

    def pore_water(
        self,
        points: MaterialPoints,
        at_pieces: Callable[[NDArray], NDArray],
        volume: NDArray[np.float64] | float,
        slot: NDArray[np.int64],
        scale: NDArray[np.float64] | None = None,
    ) -> PoreWater:
        """Return the pore water of k pieces in n groups, such as cells.

        `at_pieces`: function that returns the values (k, ...) of the pieces from the values of the points.
        `volume` (k,), m^d: volume of each piece.
        `slot` (k,): index of the group of each piece.
        `scale`: see `scales`, which is the default.
        """
        full = partial(self.saturations, at_pieces(self.retention_rows(points)))
        store, pores = (volume * at_pieces(values(points)) for values in (self.storage, self.porosity))
        scale = self.scales(points, at_pieces, slot, slot.max(initial=-1) + 1) if scale is None else scale
        return PoreWater(full, slot, store, pores, self.fluid.bulk, scale)

    def scales(
        self, points: MaterialPoints, at_pieces: Callable[[NDArray], NDArray], slot: NDArray[np.int64], count: int
    ) -> NDArray[np.float64]:
        """Return the suctions (count,), at most 1 / `TINY` Pa, at which groups of pieces drain, see `pore_water`."""
        scale = np.full(count, 1 / TINY)
        np.minimum.at(scale, slot, at_pieces(self.retention_scale(points)))
        return scale

    def pore_stress(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return alpha chi p at the points, in Pa, with the coefficients alpha of Biot and chi of Bishop."""
        pressure = self.table(points, attrgetter("biot")) * points.pressure
        return pressure if self.retentions is None else pressure * self.saturation(points, points.pressure)[2]

    def retention_rows(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the index and the constants of each point's retention curve (n, ...), see `Retentions.row`."""
        return np.stack([self.retentions.row(m.retention) for m in self.materials])[points.material]

    def table(self, points: MaterialPoints, value: Callable[..., float], *columns: NDArray) -> NDArray[np.float64]:
        """Evaluate a function of the material at each point, and return the values (n, ...).

        The function is called as `value(material, *columns)` and returns values (n, ...) or one number.  If the
        material is uniform and there are no `columns`, the function may also return one value (...) for all points.

        `columns` (n,): arguments of the function after the material, with one value for each point.
        """
        each, shapes = [], set()
        for i in self._used:
            alone = slice(None) if not self._fields[i] else np.arange(len(points.id))
            rows = (points.material == i).nonzero()[0] if len(self._used) > 1 else alone
            at = self._at(points, i, rows) if self._fields[i] else self.materials[i]
            found = np.asarray(value(at, *[column[rows] for column in columns]) if columns else value(at))
            each.append((rows, found))
            shapes.add(found.shape[bool(columns or self._fields[i]) :])
        out = np.zeros((len(points.id), *(shapes.pop() if len(shapes) == 1 else np.broadcast_shapes(*shapes))))
        for rows, found in each:
            out[rows] = found
        return out

    def changed(self, what: str, points: MaterialPoints, named: Collection[str]) -> MaterialPoints:
        """Update all constants that follow from the changed constants `named`, and return the points.

        Raises
        ------
        ValueError
            A constant is out of its range.
        """
        data = dict(points.data)
        for i in self._used:
            rows, m = (points.material == i).nonzero()[0], self.materials[i]
            follow = [k for k in self._fields[i] if getattr(getattr(m, k), "follows", False)]
            own = [name for name in self._fields[i] if name in named or name not in follow]
            try:
                made = replace(m, **{name: data[name][rows] for name in own})
            except ValueError as error:
                raise ValueError(f"{what}: {error}") from error
            for name in follow:
                data[name] = data[name].copy()
                data[name][rows] = getattr(made, name)
        return replace(points, data=data)

    def _at(self, points: MaterialPoints, i: int, rows: NDArray[np.int64]) -> Skeleton:
        """Return a copy of material `i` whose constants are arrays, with one value for each of the points `rows`."""
        if not self._fields[i]:
            return self.materials[i]
        values = {name: points.data[name][rows] for name in self._fields[i]}
        return _expanded(self.materials[i], values, len(rows))

    def parameters(self, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return each parameter at the points, with zeros as placeholders where the law does not have the parameter."""
        out = {name: np.zeros((len(points), *s)) for name, s in self.shapes.items() if name not in self.state_names}
        for i in self._used:
            rows = (points.material == i).nonzero()[0]
            at = self._at(points, i, rows)
            for name in self.materials[i].parameters:
                out[name][rows] = getattr(at, name)
        return out

    @property
    def constants(self) -> dict[str, Skeleton]:
        """Dictionary from the name of each material constant in the scene to one material that has this constant."""
        return {name: self.materials[i] for i in self._used for name in constants_of(self.materials[i])}

    @cached_property
    def field_names(self) -> list[str]:
        """Names of material constants that are functions of position."""
        return list(dict.fromkeys(name for i in self._used for name in self._fields[i]))

    @property
    def evolves(self) -> bool:
        """Whether any law has state variables."""
        return any(law.state for law in self.laws)

    @cached_property
    def state_names(self) -> list[str]:
        """Names of the laws' state variables."""
        return list(dict.fromkeys(name for law in self.laws for name in law.state))

    def porosity(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the porosity n = 1 - (1 - n_0) / J of the points."""
        return 1 - (1 - self.table(points, attrgetter("porosity"))) / points.J

    def storage(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the storage coefficient of the points, in 1/Pa.  The scene must have a fluid."""
        return self.table(points, lambda m, n: m.storage(self.fluid.bulk, n), self.porosity(points))

    def storage_at_one(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the storage coefficient, in 1/Pa, that the points would have at a porosity of 1."""
        return self.table(points, lambda m: m.storage(self.fluid.bulk, 1.0))

    @property
    def drains(self) -> bool:
        """Whether the scene has drainable pores, which empty as the phreatic surface falls."""
        return any(getattr(law, "specific_yield", 0.0) > 0 for law in self.conductivity_laws)

    def drainage(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return (n, 2): the specific yield, and the suction, in Pa, at which drainable pores are empty."""
        names = {"specific_yield": 0.0, "suction": 1.0}
        return np.stack(
            [self.table(points, lambda m, k=k, v=v: getattr(m.conductivity_law, k, v)) for k, v in names.items()],
            axis=1,
        )

    def density(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the density of the points' soil with saturated pores, in kg/m^3."""
        n, wet = self.porosity(points), self.fluid.density if self.fluid else 0.0
        return (1 - n) * self.table(points, attrgetter("grain_density")) + n * wet

    def present_density(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the density of the points' soil with its present pore water, in kg/m^3."""
        density = self.density(points)
        if self.retentions is None:
            return density
        empty = 1 - self.saturation(points, points.pressure)[0]
        return density - empty * self.porosity(points) * self.fluid.density

    def masses(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the masses of the points, in kg, with their present pore water."""
        return self.present_density(points) * points.volume0 * points.J

    def confined_modulus(self, points: MaterialPoints, most: float = STIFFEST) -> NDArray[np.float64]:
        """Return the undrained confined modulus lambda + 2G + alpha^2 / S of the points, in Pa.

        alpha^2 / S is limited to `most` times (lambda + 2G).
        """
        modulus = self.table(points, attrgetter("oedometric"))
        if self.fluid is None:
            return modulus
        fluid = self.table(points, attrgetter("biot")) ** 2 / np.maximum(self.storage(points), TINY)
        return modulus + np.minimum(fluid, most * modulus)

    def state(self, points: MaterialPoints) -> dict[str, NDArray[np.float64]]:
        """Return the values of each state variable at the points."""
        return {name: points.data[name] for name in self.state_names}

    def evolved(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of the points that have yielded, see `EVOLVED`.  Changes of suction are ignored."""
        out, law_of = np.zeros(len(points), dtype=bool), self.law_of(points)
        for number, law in enumerate(self.laws):
            rows = (law_of == number).nonzero()[0]
            for name, at_rest in law.state.items():
                if name in DRIED:
                    continue
                rest = points.data[name + AT_REST][rows] if name + AT_REST in points.data else at_rest
                off = np.abs(points.data[name][rows] - np.asarray(rest))
                out[rows] |= off.max(axis=tuple(range(1, off.ndim)), initial=0.0) > EVOLVED
        return out

    @property
    def some_elastic(self) -> bool:
        """Whether any law is elastic, that is, has no state variables."""
        return any(not law.state for law in self.laws)

    def elastic(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of the points whose law is elastic, that is, has no state variables."""
        return np.array([not m.state for m in self.materials])[points.material]

    def soil_rows(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return (n, ...): material index, and the constants that vary with position, except the initial stretch."""
        fields = [points.data[name] for name in self.field_names if name != "seeded_stretch"]
        fields = [rows.reshape(len(rows), int(np.prod(rows.shape[1:]))) for rows in fields]
        return np.column_stack([points.material, *fields])

    @property
    def dilates(self) -> bool:
        """Whether the plastic flow of any soil may change its volume.  All processes return the same value."""
        used = [self.materials[i] for i in self._used]
        return any(m.dilates and (callable(m.dilation) or np.any(m.dilation)) for m in used)

    def dilating(self, points: MaterialPoints) -> NDArray[np.bool_]:
        """Return a mask (n,) of the points whose soil has yielded and has a dilation angle > 0."""
        return self.evolved(points) & (self.table(points, lambda m: m.dilation if m.dilates else 0.0) > 0)

    def effective_stress(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, d, d), in Pa, at the points; in axisymmetry (n, 3, 3).

        All processes must call this method.
        """
        out, d = np.zeros_like(points.F), self.grid.stretches
        for law, rows, data in self._placed(points):
            out[rows] = law.stress(data)[:, :d, :d]
        return out

    def effective_stress_3d(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the effective Cauchy stress (n, 3, 3), in Pa, at the points.  All processes must call this method."""
        out = np.zeros((len(points), 3, 3))
        for law, rows, data in self._placed(points):
            out[rows] = law.stress_3d(data)
        return out

    def stored(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the elastic energy of the skeleton per reference volume, in Pa, at the points.

        All processes must call this method.  For laws with `elastic_hencky` that define no energy, the result is
        Hencky's energy with constant moduli.  For other laws that define no energy, it is zero.
        """
        out = np.zeros(len(points))
        bulk, shear = (self.table(points, lambda m, name=name: getattr(m, name)) for name in ("bulk", "shear"))
        for law, rows, data in self._placed(points):
            if law.law.energy is not None:
                out[rows] = law.energy(data)
            elif law.law.elastic_hencky:
                tau = law.stress_3d(data) * points.J[rows][:, None, None]
                p = np.trace(tau, axis1=1, axis2=2) / 3
                s2 = ((tau - p[:, None, None] * np.eye(3)) ** 2).sum(axis=(1, 2))
                out[rows] = p**2 / (2 * bulk[rows]) + s2 / (4 * shear[rows])
        return out

    def total_stress(self, points: MaterialPoints) -> NDArray[np.float64]:
        """Return the total Cauchy stress, in Pa, shaped as `effective_stress`.  All processes must call this method."""
        return self.effective_stress(points) - self.pore_stress(points)[:, None, None] * np.eye(self.grid.stretches)

    def updated_state(
        self, points: MaterialPoints, before: MaterialPoints, dt: float
    ) -> dict[str, NDArray[np.float64]]:
        """Return the fields of the points, by name, with the state after a step of length dt, in s.

        `points`: points with F at the end of the step, and with the state at its start.
        `before`: points at the start of the step.

        Raises
        ------
        NotConverged
            The new state is not finite.
        """
        if all(law.update is None for law in self.laws) and not self._softness:
            return points.data
        placed = self._placed(points)
        new = [(law.law, rows, name, v) for law, rows, at in placed for name, v in law.new_state(at, dt)]
        finite = [np.isfinite(values).all(axis=tuple(range(1, np.ndim(values)))) for *_, values in new]
        invalid = [(law, name, rows[~good]) for (law, rows, name, _), good in zip(new, finite, strict=True)]
        messages = [
            f"{law.__name__}.update: {name!r} is not finite at {points.x[i[0]] + self.grid.base}"
            for law, name, i in invalid
            if len(i)
        ]
        if message := first(self.grid.comm, "".join(messages[:1])):
            raise NotConverged(message)
        out = {name: values.copy() if name in self.state_names else values for name, values in points.data.items()}
        for _, rows, name, values in new:
            out[name][rows] = values
        if self._softness:
            out["softness"], dF = np.ones(len(points)), points.F_of_laws - before.F_of_laws
            shear = self.table(points, attrgetter("shear"))
            for number, softness in self._softness.items():
                _, rows, at = placed[number]
                out["softness"][rows] = softness(at, dF[rows], shear[rows], dt, before.data["softness"][rows])
        return out

    def _placed(self, points: MaterialPoints) -> list[tuple[LawAtPoints, NDArray[np.int64], PointData]]:
        """Return triples: a law, the indices of its points, and the values that its forms need at these points."""
        number, values = self.law_of(points), {**self.parameters(points), **self.state(points)}
        values["F"] = points.F_of_laws
        rows = [(number == k).nonzero()[0] for k in range(len(self.laws))]
        return [(law, own, law.data(points, own, values)) for law, own in zip(self._at_points, rows, strict=True)]


def _known(name: str, value) -> NDArray[np.float64]:
    """Return a parameter or state variable as an array.  Raise ValueError if it contains NaN."""
    out = numbers(name, value, None, allowed="numbers", test=np.isreal)
    if np.isnan(out).any():
        raise ValueError(f"{name} = nan, must be numbers")
    return out


def _names_place(law: Callable) -> bool:
    return "x" in signature(law).parameters


def _conducts(m: Skeleton) -> bool:
    """Return whether fluid may flow in a material."""
    return bool(m.conductivity_law or callable(m.conductivity) or np.any(np.asarray(m.conductivity) > 0))


def _layered(materials: Sequence[Skeleton]) -> bool:
    """Return whether the conductivity of materials depends on position, or follows more than one law."""
    laws = {m.conductivity_law for m in materials}
    by_place = any(callable(m.conductivity) for m in materials) or any(map(_names_place, laws - {None}))
    return by_place or len(laws) > 1 or len({m.retention for m in materials}) > 1


def _samples(materials: dict[int, Skeleton]) -> dict[str, int | list[float]]:
    """Return samples of the conductivity laws and retention curves of materials, by name.  Keys: their indices."""
    out: dict[str, int | list[float]] = {}
    for i, m in materials.items():
        if m.conductivity_law:
            out[f"conductivity law of material {i}"] = sampled(m.conductivity_law)
        if m.retention is not None:
            out[f"retention of material {i}"] = drained(m.retention)
    return out


def _takes(law: type[Skeleton]) -> list[str]:
    """Return the names of the parameters and state variables of a law."""
    return [*law.parameters, *law.state]


def _used(bodies: Sequence[Body], count: int) -> list[int]:
    """Return the indices of the materials of all bodies, in ascending order."""
    for body in bodies:
        if not 0 <= body.material < count:
            raise ValueError(f"body: material = {body.material!r}, must be an index of the {count} materials")
    return sorted({int(body.material) for body in bodies})


def _by_place(m: Skeleton) -> list[str]:
    """Return the names of the constants of a material that are functions of position."""
    return [name for name in constants_of(m) if callable(getattr(m, name))]


def _evaluated(grid: Grid, m: Skeleton, X: NDArray[np.float64], ids: NDArray[np.int64]) -> tuple[Skeleton, Skeleton]:
    """Return two copies of a material: one for this process's points, and one for the material's point of lowest id.

    `X` (n, d), in m: reference positions of this process's points with the material.
    `ids` (n,): ids of these points.
    """
    names = _by_place(m)

    def at_points() -> Skeleton:
        made = m.at(X) if len(X) or not names else m
        if grid.comm.size > 1 and len(X) and names:
            _check_local(made, m.at(X[::2]), names)
        return made

    out = together(grid.comm, at_points)
    row = [(int(ids[0]), {name: getattr(out, name)[:1] for name in names})] if len(X) else []
    found = over_all(grid.comm, row) if names else []
    values = min(found, key=itemgetter(0))[1] if found else {}
    out = out if len(X) else replace(out, **values)
    return out, _expanded(out, values, 1)


def _check_local(all_points: Skeleton, half: Skeleton, names: Sequence[str]) -> None:
    """Raise ValueError if the value of a field at a point depends on the positions of other points."""
    for name in names:
        value, alone = getattr(all_points, name)[::2], getattr(half, name)
        if np.abs(value - alone).max() > SAME * np.abs(value).max():
            what = f"{type(all_points).__name__}: {name}: the value at a position depends on other positions"
            raise ValueError(f"{what}, must depend on each position alone if there are several processes")


def _places(bodies: Sequence[Body], material: int, ids: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the reference positions (n, d), in m, of the points `ids`, whose material has the index `material`."""
    starts = np.cumsum([0, *map(len, bodies)])
    at = ids.searchsorted(starts)
    each = zip(bodies, starts[:-1], pairwise(at), strict=True)
    own = [body.centre_of(ids[slice(*of)] - start) for body, start, of in each if body.material == material]
    return np.concatenate(own)


def _ends(grid: Grid, values: Sequence) -> tuple[float, float]:
    """Return the smallest and the largest of all values, over all processes."""
    flat = np.concatenate([np.ravel(one) for one in values])
    least, most = over_all(grid.comm, np.array([flat.min(), -flat.max()]), MPI.MIN)
    return float(least), -float(most)


def _checksum(grid: Grid, ids: NDArray[np.int64], rows: NDArray[np.float64], total: int) -> int:
    """Return one checksum of the values `rows` at all points of all processes, in the order of the point ids."""
    exchange, checksum = Exchange(grid.comm, (ids * grid.comm.size // total).astype(np.int32)), 0
    content = exchange.send(rows)[exchange.send(ids).argsort()].tobytes()
    for rank in range(grid.comm.size):
        checksum = grid.comm.bcast(zlib.crc32(content, checksum), root=rank)
    return checksum


def _expanded(m: Skeleton, values: dict[str, NDArray[np.float64]], n: int) -> Skeleton:
    """Return a copy of a material with an array of n values for each constant."""
    out = copy(m)
    for name in constants_of(m):
        value = getattr(m, name)
        if name in values:
            value = values[name]
        elif not (callable(value) or isinstance(value, str) or value is None):
            value = np.broadcast_to(np.asarray(value, dtype=float), (n, *np.shape(value)))
        vars(out)[name] = value  # the values have been checked
    return out
