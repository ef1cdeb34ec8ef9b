# SPDX-License-Identifier: MIT
"""Initial effective stresses, prescribed or computed from the overburden, and the elastic strains that cause them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import ITERATIONS, NEAR, ROUND_OFF, SAME
from mpm_dolfinx.base.validation import at_places, line, numbers
from mpm_dolfinx.bodies.bodies import Body
from mpm_dolfinx.bodies.overburden import overburden
from mpm_dolfinx.materials.cam_clay import ModifiedCamClay
from mpm_dolfinx.materials.fields import SceneMaterials
from mpm_dolfinx.materials.prestressed import AT_REST
from mpm_dolfinx.materials.skeleton import STANDARD_GRAVITY, Field
from mpm_dolfinx.materials.trial import PLANE, SPACE
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all, together
from mpm_dolfinx.points.material_points import MaterialPoints, unstretched

LARGEST = 0.2  # largest change of a strain component in one iteration


@dataclass(frozen=True, eq=False)
class K0:
    """Initial effective stress of soil under its own weight, with the coefficient K0 of earth pressure at rest.

    The vertical effective stress is the overburden of soil and fluid plus the surcharge, minus alpha chi p.  Here alpha
    is Biot's coefficient, chi is Bishop's coefficient, and p is the pore pressure.  The horizontal effective stresses
    are K0 times the vertical effective stress.  In axisymmetry, the horizontal stresses are radial and circumferential.
    The stresses are exact for level ground with level layers.  In other ground, the stresses are changed until they
    balance the weight, without motion of the points.  A warning is given if balancing changes a stress by more than 5 %
    of the largest initial stress, for example on slopes.  Another warning is given if the pore pressure exceeds the
    overburden, for example below open water without a surcharge.

    Parameters
    ----------
    ratio
        K0, >= 0: a number, or a function of the reference positions X (n, d), m.
    surcharge : number or callable x (n, d) -> (n,), Pa
        Pressure, >= 0, at positions x on the ground surface, for example the weight of standing water.
    """

    ratio: Field
    surcharge: float | Callable[[NDArray[np.float64]], ArrayLike] = 0.0

    def __post_init__(self):
        for name in ("ratio", "surcharge"):
            if not callable(getattr(self, name)):
                self._checked(name, getattr(self, name))

    def _checked(self, name: str, value, *shapes) -> NDArray[np.float64]:
        test = {"test": lambda v: (0 <= v) & (v < np.inf), "allowed": ">= 0 and finite, one value or one per position"}
        return numbers(f"K0: {name}", value, (), *shapes, **test)

    def values(self, name: str, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the parameter `name`, "ratio" or "surcharge", at positions x (n, d), in m."""
        value = getattr(self, name)
        given = at_places(f"K0: {name}", "one value per position", value, "x", x) if callable(value) else value
        return self._checked(name, given, (len(x),))


InitialStress = K0 | Callable[[NDArray[np.float64]], ArrayLike]


def hydrostatic(level: float, unit_weight: float | None = None) -> Callable[[NDArray], NDArray]:
    """Return the hydrostatic pressure below a phreatic level as a function of positions x (n, d).

    The result can be the `pressure` of a `Simulation`.  Above the level the pressure is negative (suction).

    Parameters
    ----------
    level
        Height of the phreatic level, m, along the last axis.
    unit_weight
        Unit weight of the fluid, N/m^3, > 0; by default the unit weight of the scene's fluid, or 9810 outside a scene.
        A warning is given if the value differs from the unit weight of the scene's fluid.
    """
    numbers("hydrostatic: level", level)
    if unit_weight is not None:
        allowed = {"test": lambda v: (0 < v) & (v < np.inf), "allowed": "> 0 and finite"}
        numbers("hydrostatic: unit_weight", unit_weight, **allowed)
    return Hydrostatic(level, unit_weight)


@dataclass(frozen=True)
class OfWater:
    """Base class of water pressures.  `given` is the unit weight, in N/m^3, or None for the standard value."""

    @property
    def unit_weight(self) -> float:
        """Unit weight, in N/m^3."""
        return 1000 * STANDARD_GRAVITY if self.given is None else self.given


@dataclass(frozen=True)
class Hydrostatic(OfWater):
    """Hydrostatic pressure below a level, as a function of position."""

    level: float
    given: float | None = None

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures, in Pa, at positions x (n, d), in m."""
        return self.unit_weight * (self.level - x[:, -1])


def by_body(given, bodies: Sequence[Body], later: Sequence[int]) -> dict[int, InitialStress]:
    """Return the initial stress of each body.  A single initial stress applies to all bodies present at the start."""
    allowed = "a K0, a function of x, or a dict of these, {index of a body: ...}"
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        given = {i: given for i in range(len(bodies)) if i not in later}
    for body, value in given.items():
        if body not in range(len(bodies)) or not (isinstance(value, K0) or callable(value)):
            raise ValueError(f"initial_stress: {line({body: value})}, must be {allowed}")
    return {int(body): value for body, value in given.items()}


class InitialStresses:
    """Initial stresses of the bodies of a scene.

    `given`: result of `by_body`.
    `pressure`: initial pore pressure, in Pa, as a number or a function of x.
    """

    def __init__(self, bodies: Sequence[Body], given: Mapping[int, InitialStress], pressure: float | Callable):
        self._bodies = bodies
        self.given = given
        self.pressure = pressure
        self._start = np.cumsum([0, *(len(body) for body in bodies)])

    def of(self, materials: SceneMaterials, points: MaterialPoints, present: Sequence[bool], gravity) -> MaterialPoints:
        """Return the points with the elastic strains of their initial stress.  All processes must call this method.

        `present`: whether each body is present.  Only the weight of present bodies acts on the soil below.
        `gravity` (d,), in m/s^2: acceleration of gravity, or None.
        """
        if not self.given:
            return points
        target = np.zeros((len(points), 3, 3))
        rows = np.zeros(len(points), dtype=bool)
        placed = points.placed(materials.grid.base)
        above = self._above(materials, points, present, gravity)

        def fill() -> None:
            for body, stress in self.given.items():
                own = (points.id >= self._start[body]) & (points.id < self._start[body + 1])
                if own.any():
                    target[own] = self._at(stress, body, placed.map(lambda v, own=own: v[own]), [a[own] for a in above])
                rows[own] = True

        together(materials.grid.comm, fill)
        return stressed(materials, points, rows, target)

    def lifted(self, materials: SceneMaterials, points: MaterialPoints) -> str:
        """Return a text: stress and position of a point where K0 gives vertical tension, or "" without tension.

        All processes must call this method.
        """
        kept = [body for body, stress in self.given.items() if isinstance(stress, K0)]
        own = np.isin(np.searchsorted(self._start, points.id, side="right") - 1, kept)
        d = points.x.shape[1]
        vertical, pore = materials.effective_stress_3d(points)[:, d - 1, d - 1], materials.pore_stress(points)
        rows = np.flatnonzero(own & (vertical > SAME * np.abs(pore)))[:1]  # above rounding errors
        where = points.x + materials.grid.base
        return first(materials.grid.comm, "".join(f"{vertical[i]:.4g} Pa at {where[i].tolist()}" for i in rows))

    def _at(self, stress: InitialStress, body: int, points: MaterialPoints, above: list[NDArray]) -> NDArray:
        """Return the initial effective stress (n, 3, 3), in Pa, at points of a body."""
        n, d = points.x.shape
        if not isinstance(stress, K0):
            name = f"initial_stress of body {body}: {line(stress)}"
            allowed = f"three normal stresses or a symmetric tensor (3, 3), finite, for each of {n} places"
            value = numbers(name, at_places(name, allowed, stress, "x", points.x), (n, 3), (n, 3, 3), allowed=allowed)
            value = value if value.ndim == 3 else value[:, :, None] * np.eye(3)
            wrong = np.abs(value - value.swapaxes(1, 2)).max(axis=(1, 2)) > SAME * np.abs(value).max(initial=0)
            if d == 2:
                wrong |= (value[:, :2, 2] != 0).any(axis=1)
            if wrong.any():
                raise ValueError(f"{name} = {value[wrong][0].tolist()}, must be {allowed}, without shear out of plane")
            return value
        weight, surface, pore = above
        on = np.concatenate([points.x[:, :-1], surface[:, None]], axis=1)
        X = self._bodies[body].centre_of(points.id - self._start[body])
        vertical = -(weight + stress.values("surcharge", on) - pore)
        horizontal = stress.values("ratio", X) * vertical
        normal = np.stack([horizontal] * 3, axis=1)
        normal[:, d - 1] = vertical
        return normal[:, :, None] * np.eye(3)

    def _above(self, materials: SceneMaterials, points: MaterialPoints, present, gravity) -> list[NDArray]:
        """Return the overburden (Pa), the height of the ground surface (m), and alpha chi p (Pa) at each point."""
        if not any(isinstance(stress, K0) for stress in self.given.values()):
            return [points.pressure] * 3
        if gravity is None or np.any(gravity[:-1]) or not gravity[-1] <= 0:
            g = None if gravity is None else np.asarray(gravity).tolist()
            raise ValueError(f"initial_stress: K0 with gravity = {g}, gravity must point down, along the last axis")
        surcharges = [stress.surcharge for stress in self.given.values() if isinstance(stress, K0)]
        if not np.any(gravity) and not any(callable(surcharge) or surcharge for surcharge in surcharges):
            raise ValueError("initial_stress: K0 has neither gravity at the start nor surcharge, must have one of them")
        grid, seeded = materials.grid, materials.seeded.of_bodies(present, self._start)
        weights = -gravity[-1] * materials.present_density(seeded)
        corners, weights = _in_columns(grid.comm, seeded.id, seeded.corners, weights, points.corners)
        weight, surface = overburden(corners, weights, points.x)
        return [weight, surface + grid.base[-1], materials.pore_stress(points)]


def _in_columns(
    comm: MPI.Intracomm,
    ids: NDArray[np.int64],
    corners: NDArray[np.float64],
    unit_weight: NDArray[np.float64],
    above: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return corners and unit weights of all particle domains in the vertical columns that contain the given domains.

    `ids` (n,), `corners` (n, 2^d, d), in m, and `unit_weight` (n,), in N/m^3, of this process's particle domains.
    `above` (k, 2^d, d), in m: corners of the given domains of this process.
    """
    ends = [above[..., :-1].min(axis=(0, 1), initial=np.inf), above[..., :-1].max(axis=(0, 1), initial=-np.inf)]
    low, high = corners[..., :-1].min(axis=1), corners[..., :-1].max(axis=1)
    rows = [((low <= most) & (high >= least)).all(axis=1).nonzero()[0] for least, most in comm.allgather(ends)]
    sent = np.concatenate(rows)
    exchange = Exchange(comm, np.arange(comm.size, dtype=np.int32).repeat(list(map(len, rows))))
    order = exchange.send(ids[sent]).argsort()
    return exchange.send(corners[sent])[order], exchange.send(unit_weight[sent])[order]


def stressed(
    materials: SceneMaterials, points: MaterialPoints, chosen: NDArray[np.bool_], target: NDArray[np.float64]
) -> MaterialPoints:
    """Return all points, with the target stresses (n, 3, 3), in Pa, at the chosen ones.  All processes must call this.

    In Modified Cam Clay the initial stress is a parameter.  In other laws, elastic strains cause the initial stress.
    ValueError is raised if a target stress is outside the yield surface.
    """
    comm = materials.grid.comm
    rows = np.flatnonzero(chosen)
    law = materials.law_of(points)
    part, target = points.map(lambda values: values[rows]), target[rows]
    given = np.isin(law[rows], [k for k, one in enumerate(materials.laws) if issubclass(one, ModifiedCamClay)])
    if message := first(comm, _no_constants(part.placed(materials.grid.base), target, given)):
        raise ValueError(message)
    if given.any():
        normal, kappa = np.diagonal(target, axis1=1, axis2=2), materials.table(part, _kappa)
        part = _with(part, given, initial_stress=normal, bulk=-normal.mean(axis=1) / kappa)
    plastic = np.isin(law[rows], [k for k, one in enumerate(materials.laws) if "plastic" in one.state])
    now, missed = _ElasticStrains(materials, part, target, given, plastic).solved()
    message = "".join(_outside_yield(materials, part, target, law[rows], i) for i in np.flatnonzero(missed)[:1])
    if message := first(comm, message):
        raise ValueError(message)
    if "plastic" in points.data:
        now = _with(now, plastic, **{"plastic" + AT_REST: now.data["plastic"]})
    data = {name: values.copy() for name, values in points.data.items()}
    for name, values in now.data.items():
        data[name][rows] = values
    return replace(points, data=data)


@dataclass(frozen=True, eq=False)
class _ElasticStrains:
    """Newton's method for the elastic (logarithmic) strains that cause target stresses."""

    materials: SceneMaterials
    points: MaterialPoints  # n points
    target: NDArray[np.float64]  # (n, 3, 3) stress, Pa
    given: NDArray[np.bool_]  # (n,) whether the initial stress is a parameter of the law
    plastic: NDArray[np.bool_]  # (n,) whether C_p^-1 is a state variable

    @property
    def components(self) -> tuple[tuple[int, int], ...]:
        """Indices of the components of a symmetric tensor."""
        return PLANE if self.points.x.shape[1] == 2 else SPACE

    @property
    def free(self) -> NDArray[np.bool_]:
        """Whether each strain component of each point (n, components) is unknown."""
        out = np.repeat(~self.given[:, None], len(self.components), axis=1)
        out[:, 2] &= self.materials.knows_across(self.points)
        return out

    def of(self, tensor: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the components of tensors (n, 3, 3), with zeros in place of known strains, see `free`."""
        i, j = np.array(self.components).T
        return np.where(self.free, tensor[:, i, j], 0.0)

    def moduli(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return bulk and shear moduli (n,), in Pa."""
        bulk, shear = (lambda m, name=name: getattr(m, name) for name in ("bulk", "shear"))
        return self.materials.table(self.points, bulk), self.materials.table(self.points, shear)

    def linear(self) -> NDArray[np.float64]:
        """Return the elastic strains that the target stresses cause in linear elasticity."""
        (bulk, shear) = self.moduli()
        target = self.target
        identity = np.eye(3)
        mean = np.trace(target, axis1=1, axis2=2) / 3
        elastic = (target - mean[:, None, None] * identity) / (2 * shear)[:, None, None]
        elastic += (mean / (3 * bulk))[:, None, None] * identity
        return self.of(elastic)

    def residual(self, strain: NDArray[np.float64]) -> tuple[MaterialPoints, NDArray[np.float64]]:
        """Return the points with elastic strains `strain`, and their stresses minus the target stresses, in Pa."""
        tensor = np.zeros((len(strain), 3, 3))
        for value, (i, j) in zip(strain.T, self.components, strict=True):
            tensor[:, i, j] = tensor[:, j, i] = value
        logs, vectors = np.linalg.eigh(tensor)
        elastic = (vectors * np.exp(2 * logs)[:, None]) @ vectors.swapaxes(1, 2)
        now = _with(self.points, self.plastic & ~self.given, plastic=elastic)
        stretch = (vectors * np.exp(logs)[:, None]) @ vectors.swapaxes(1, 2)
        now = _with(now, ~self.plastic & ~self.given, seeded_stretch=stretch)
        stress = self.materials.effective_stress_3d(now)
        return now, self.of(stress - self.target)

    def step(self, strain: NDArray[np.float64], missing: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the strains after a Newton step.  Finite differences give the tangent."""
        count = strain.shape[1]
        free = self.free
        (_, shear) = self.moduli()
        slopes = np.tile(np.eye(count) * (2 * shear)[:, None, None], (1, 1, 1))
        for k in range(count):
            change = (self.residual(strain + SAME * np.eye(count)[k])[1] - missing) / SAME
            slopes[:, :, k] = np.where(free & free[:, [k]], change, slopes[:, :, k])
        slopes, missing = (np.nan_to_num(values) for values in (slopes, missing))
        singular = ~(np.abs(np.linalg.det(slopes / shear[:, None, None])) > NEAR**2)
        slopes[singular] = np.eye(count) * (2 * shear[singular])[:, None, None]
        change = np.linalg.solve(slopes, missing[:, :, None])[:, :, 0].clip(-LARGEST, LARGEST)
        return np.clip(strain - change, -1, 1)

    def solved(self) -> tuple[MaterialPoints, NDArray[np.bool_]]:
        """Return the points with the elastic strains found, and a mask (n,) of points that miss the target stress."""
        comm, strain = self.materials.grid.comm, self.linear()
        largest = over_all(comm, float(np.abs(self.target).max(initial=0.0)), MPI.MAX)
        close = SAME * largest + ROUND_OFF * np.maximum(*self.moduli())  # the second term is for very small strains
        now, exact = self.points, False
        missed = np.ones(len(strain), dtype=bool)
        try:
            for _ in range(ITERATIONS):
                now, missing = self.residual(strain)
                missed = ~(np.abs(missing).max(axis=1, initial=0.0) <= close)
                if exact:
                    break
                most = float(np.nan_to_num(np.abs(missing), nan=np.inf).max(initial=0.0))
                exact = not over_all(comm, most, MPI.MAX) > SAME * largest  # the next step is the last
                strain = self.step(strain, missing)
        except NotConverged:
            missed = np.ones(len(strain), dtype=bool)
        return now, missed


def strained(materials: SceneMaterials, points: MaterialPoints, moved: MaterialPoints) -> MaterialPoints:
    """Return `points`, with the elastic strains that they have in the deformed state `moved`."""
    law = materials.law_of(points)
    own = {name: points.data[name] for name in MaterialPoints.INTERNAL if name in points.data}
    data = {**moved.data, **own}
    out = replace(points, data=data)
    whole = unstretched(moved.F_of_laws)
    if "seeded_stretch" in data:
        out = _with(out, np.ones(len(whole), dtype=bool), seeded_stretch=whole @ data["seeded_stretch"])
    if "plastic" in data:
        stretch = materials.table(points, _prestretch)
        whole = whole * (stretch[:, None, :] / stretch[:, :, None])  # D^-1 F D
        own = np.isin(law, [k for k, one in enumerate(materials.laws) if "plastic" in one.state])
        elastic = whole @ data["plastic"] @ whole.swapaxes(1, 2)
        out = _with(out, own, plastic=elastic, **{"plastic" + AT_REST: elastic})
    return out


def _with(points: MaterialPoints, chosen: NDArray[np.bool_], **values: NDArray) -> MaterialPoints:
    """Return a copy of `points` with new field values at the points where `chosen` is True."""
    data = dict(points.data)
    for name, new in values.items():
        if name in data and chosen.any():
            data[name] = data[name].copy()
            data[name][chosen] = np.broadcast_to(new, data[name].shape)[chosen]
    return replace(points, data=data)


def _kappa(m) -> NDArray[np.float64]:
    return m.kappa if isinstance(m, ModifiedCamClay) else np.ones(np.shape(m.bulk))


def _friction(m) -> NDArray[np.float64]:
    """Return the friction angle of a material, in degrees, or nan if its law has no friction angle."""
    return getattr(m, "friction", np.full(np.shape(m.bulk), np.nan))


def _prestretch(m) -> NDArray[np.float64]:
    return m.prestretch if isinstance(m, ModifiedCamClay) else np.ones((*np.shape(m.bulk), 3))


def _no_constants(points: MaterialPoints, target: NDArray[np.float64], given: NDArray[np.bool_]) -> str:
    """Return an error message if Modified Cam Clay does not allow a target stress, and an empty string otherwise."""
    shear = np.abs(target - np.diagonal(target, axis1=1, axis2=2)[:, :, None] * np.eye(3)).max(axis=(1, 2), initial=0.0)
    invalid = given & ((shear > 0) | ~(np.trace(target, axis1=1, axis2=2) < 0))
    what = "must have no shear and a compressive mean for ModifiedCamClay"
    first = np.flatnonzero(invalid)[:1]
    return "".join(f"initial_stress at {points.x[i]}: {target[i].tolist()} Pa, {what}" for i in first)


def _outside_yield(materials: SceneMaterials, points: MaterialPoints, target: NDArray, law: NDArray, i: int) -> str:
    name = materials.laws[law[i]].__name__
    allowed = f"inside the yield surface of {name}"
    tension = np.trace(target[i]) > 0  # the pore pressure exceeds the overburden
    more = "; K0 needs the weight of open water as surcharge" if tension and points.pressure[i] > 0 else ""
    friction = materials.table(points, _friction)[i]
    if np.isfinite(friction):
        ratio = np.tan(np.radians(45 + friction / 2)) ** 2
        allowed += (
            f" (without cohesion, friction = {friction:.4g} degrees allows K0 from {1 / ratio:.3g} to {ratio:.3g})"
        )
    stress = ", ".join(f"{value:.4g}" for value in np.linalg.eigvalsh(target[i]))
    where = points.x[i] + materials.grid.base
    hint = "; for soil too weak for this stress, omit initial_stress"
    return f"initial_stress at {where}: principal stresses {stress} Pa, must be {allowed}{more or hint}"
