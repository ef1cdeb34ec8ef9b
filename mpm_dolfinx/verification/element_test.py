# SPDX-License-Identifier: MIT
"""Laboratory tests of a law at a single point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.tolerances import CENTRAL, FOREVER, ITERATIONS, ROUND_OFF
from mpm_dolfinx.base.validation import instance, numbers, whole
from mpm_dolfinx.materials.evaluate import LawAtPoints
from mpm_dolfinx.materials.skeleton import DRIED, Skeleton
from mpm_dolfinx.pores.retention import chi_at

WETTING = ("wetting isotropic", "wetting oedometer")
KINDS = (
    "isotropic",
    "oedometer",
    "triaxial drained",
    "triaxial undrained",
    "shear drained",
    "shear undrained",
    *WETTING,
)
AXIAL, LATERAL, SHEAR = (2, 2), ((0, 0), (1, 1)), (0, 1)
CUTS = 12  # largest number of halvings of a step


@dataclass(frozen=True)
class ElementTest:
    """Results of an element test, as arrays with one row for the start, and one row for each step.

    F, stress : (n, 3, 3)
        Deformation gradient F, and effective Cauchy stress in Pa, tension positive.
    strain : (n,)
        Prescribed quantity: F_xy in shear, and the suction, Pa, in wetting.  In all other tests it is the logarithmic
        axial strain, compression positive.
    pressure : (n,), Pa
        Excess pore pressure; zero in drained tests.
    state
        Values (n, ...) of the law's state variables, by name.
    """

    KINDS: ClassVar = KINDS

    F: NDArray[np.float64]
    stress: NDArray[np.float64]
    strain: NDArray[np.float64]
    pressure: NDArray[np.float64]
    state: dict[str, NDArray[np.float64]]

    @property
    def p(self) -> NDArray[np.float64]:
        """Mean effective stress p' (n,), in Pa, compression positive."""
        return -np.trace(self.stress, axis1=1, axis2=2) / 3

    @property
    def q(self) -> NDArray[np.float64]:
        """Deviatoric stress q (n,), sqrt(3/2) times the norm of the stress deviator, in Pa."""
        s = self.stress + self.p[:, None, None] * np.eye(3)
        return np.sqrt(1.5 * (s * s).sum(axis=(1, 2)))

    @property
    def volume_strain(self) -> NDArray[np.float64]:
        """Logarithmic volume strain -ln J (n,), compression positive."""
        return -np.log(np.linalg.det(self.F))

    def draw(self, file: str | Path, title: str = "") -> None:
        """Write an image of the stress path, the stress-strain curve, and the volume strain or pore pressure."""
        from matplotlib.figure import Figure

        fig = Figure(figsize=(12, 3.6), layout="constrained")
        path, curve, third = fig.subplots(1, 3)
        path.plot(self.p / 1e3, self.q / 1e3)
        path.set(xlabel="p' (kPa)", ylabel="q (kPa)", title=title)
        curve.plot(self.strain, self.q / 1e3)
        curve.set(xlabel="strain (-)", ylabel="q (kPa)")
        wet = np.any(self.pressure != 0)
        third.plot(self.strain, self.pressure / 1e3 if wet else self.volume_strain)
        third.set(xlabel="strain (-)", ylabel="excess pore pressure (kPa)" if wet else "volume strain (-)")
        for ax in (path, curve, third):
            ax.grid(alpha=0.3)
        fig.savefig(file, dpi=120)


def element_test(
    material: Skeleton,
    test: str,
    strain: float | Sequence[float],
    *,
    steps: int = 100,
    confinement: float = 0.0,
    rate: float | None = None,
    cell_size: float | None = None,
    suction: float = 0.0,
) -> ElementTest:
    """Compute the response of a law in a laboratory test.

    Parameters
    ----------
    material
        The soil; its constants must be numbers, not functions of position.
    test
        One of `ElementTest.KINDS`: "isotropic", "oedometer" (no lateral strain), "triaxial drained" (constant lateral
        stress), "triaxial undrained" (constant volume and lateral total stress), "shear drained" (simple shear at
        constant normal stress, F_xx = F_zz = 1), "shear undrained" (simple shear at constant volume), "wetting
        isotropic" (constant net stresses), "wetting oedometer" (constant axial net stress, no lateral strain).
    strain
        Final value, or successive turning points, of the prescribed quantity.  This quantity is F_xy in shear, and the
        suction, Pa, >= 0, in wetting.  In all other tests it is the logarithmic axial strain, compression positive.  In
        an isotropic test, the strain is the same along all axes.
    steps
        Number of equal steps to each turning point.
    confinement
        Isotropic effective stress before the test, Pa, >= 0, applied slowly and drained.  If it is 0, the test starts
        from the initial stress of the law.
    rate
        Strain rate, 1/s, > 0, for rate-dependent laws.
    cell_size
        Cell size, m, > 0, for laws that depend on it.
    suction
        Initial suction, Pa, >= 0, for laws that depend on suction.  The suction changes in wetting tests only.

    Raises
    ------
    ValueError
        An argument is invalid.
    NotConverged
        No strain gives the prescribed stress, even in short steps.
    """
    instance("material", material, Skeleton)
    if test not in KINDS:
        raise ValueError(f"test = {test!r}, must be one of {', '.join(KINDS)}")
    wets = test in WETTING
    ends = numbers("strain", strain, None, allowed="a finite number, or several").ravel()
    suction = float(numbers("suction", suction, allowed=">= 0 Pa and finite", test=_not_negative))
    if wets:
        numbers("strain", ends, (len(ends),), allowed="suctions >= 0 Pa in wetting", test=_not_negative)
        if material.retention is None:
            raise ValueError(f"{type(material).__name__}: retention = None, must be a retention curve in wetting")
    confinement = float(numbers("confinement", confinement, allowed=">= 0 Pa and finite", test=_not_negative))
    for name, value in (("rate", rate), ("cell_size", cell_size)):
        if value is not None:
            numbers(name, value, allowed="> 0 and finite", test=lambda v: (0 < v) & (v < np.inf))
        elif {"rate": "dt", "cell_size": "cell_size"}[name] in material.by_scene:
            raise ValueError(f"{name} is not given, must be > 0: {type(material).__name__} depends on it")
    if cell_size is not None:
        material.check_cells(cell_size)
    steps, point = whole("steps", steps), _Point(material, rate, cell_size, suction)
    start = point.compressed(confinement) if confinement else point.at_rest()
    first = suction if wets else 0.0
    start = replace(start, strain=first)
    path = np.concatenate([np.linspace(a, b, steps + 1)[1:] for a, b in zip([first, *ends], ends, strict=False)])
    out = [start]
    for goal in path:
        out.append(point.moved(out[-1], test, start, goal))
    states = {name: np.array([s.state[name] for s in out]) for name in material.state}
    F, stress = (np.array([getattr(s, name) for s in out]) for name in ("F", "stress"))
    # undrained tests keep the lateral total stress constant, shear tests the normal total stress
    pressure = (stress - stress[0])[:, 1, 1] * test.endswith("undrained")
    return ElementTest(F, stress, np.array([first, *path]), pressure, states)


def _not_negative(v) -> NDArray[np.bool_]:
    return (0 <= v) & (v < np.inf)


@dataclass(frozen=True)
class _At:
    """State of the sample in an element test."""

    F: NDArray[np.float64]  # (3, 3)
    stress: NDArray[np.float64]  # effective Cauchy stress (3, 3), Pa
    strain: float  # as in `ElementTest`
    state: dict[str, NDArray[np.float64]]  # state variables of the law


class _Point:
    """A law at a single point, without a mesh."""

    def __init__(self, material: Skeleton, rate: float | None, cell_size: float | None, suction: float):
        self._rate, law = rate or 1.0, type(material)
        self._material = material
        for field in fields(material):
            if callable(getattr(material, field.name)) and field.name not in ("conductivity_law", "retention"):
                raise ValueError(f"{law.__name__}: {field.name} is a function, must be a number in an element test")
        self._parameters = {name: np.asarray(getattr(material, name), dtype=float) for name in law.parameters}
        self._rest = {name: np.asarray(value, dtype=float) for name, value in law.state.items()}
        self._rest |= {name: np.asarray(suction) for name in DRIED if name in law.state}
        shapes = {name: value.shape for name, value in (self._parameters | self._rest).items()}
        self._law = LawAtPoints(None, law, shapes, cell_size=cell_size)
        self._bulk = float(material.bulk)

    def _data(self, F: NDArray[np.float64], state: dict[str, NDArray[np.float64]]):
        """Return points with the given deformation gradients, all with the same state of the law."""
        m, grid = len(F), self._law.grid
        inputs = {name: np.tile(v, (m, *[1] * v.ndim)) for name, v in (self._parameters | state).items()}
        cells = np.arange(m, dtype=np.int32) % 8
        return self._law.points.at(cells, grid.midpoints[cells], np.ones(m), F=F, **inputs)

    def _stress(
        self, F: NDArray[np.float64], state: dict[str, NDArray[np.float64]], dt: float = 0.0
    ) -> NDArray[np.float64]:
        return self._law.stress(self._data(F, state), dt)

    def _updated(self, F: NDArray[np.float64], strain: float, before: _At, dt: float) -> _At:
        new = {name: values[0] for name, values in self._law.new_state(self._data(F[None], before.state), dt)}
        return _At(F, self._stress(F[None], before.state, dt)[0], strain, before.state | new)

    def at_rest(self) -> _At:
        """Return the sample before the test, with the initial state of the law."""
        return _At(np.eye(3), self._stress(np.eye(3)[None], self._rest)[0], 0.0, self._rest)

    def compressed(self, confinement: float) -> _At:
        """Return the sample after gradual loading to an isotropic effective stress, in Pa."""
        at = self.at_rest()
        first = -np.trace(at.stress) / 3
        for share in np.linspace(0, 1, 21)[1:]:
            goal = -(first + share * (confinement - first)) * np.ones(3)
            at = self._balanced(at, at.F, [(0, 0), (1, 1), (2, 2)], goal, 0.0, FOREVER)
        return at

    def moved(self, at: _At, test: str, start: _At, strain: float) -> _At:
        """Return the sample at a new strain.  A step that fails is halved."""
        parts, done = [strain], 0
        while parts:
            try:
                at = self._step(at, test, start, parts[-1])
                parts.pop()
            except NotConverged:
                done += 1
                if done > CUTS:
                    raise
                parts.append((at.strain + parts[-1]) / 2)
        return at

    def _step(self, at: _At, test: str, start: _At, strain: float) -> _At:
        kind, _, drainage = test.partition(" ")
        F, dt = at.F.copy(), abs(strain - at.strain) / self._rate
        if kind == "wetting":
            return self._wetted(at, start, strain, [*LATERAL, AXIAL] if drainage == "isotropic" else [AXIAL], dt)
        if kind == "shear":
            F[SHEAR] = start.F[1, 1] * strain
            free = [(1, 1)] if drainage == "drained" else []
            return self._balanced(at, F, free, start.stress[[1], [1]], strain, dt)
        stretch = np.exp(-strain)
        F[AXIAL] = start.F[AXIAL] * stretch
        if kind == "isotropic":
            F = start.F * stretch
        elif drainage == "undrained":
            for axis in LATERAL:
                F[axis] = start.F[axis] / np.sqrt(stretch)
        free = list(LATERAL) if drainage == "drained" else []
        return self._balanced(at, F, free, start.stress[[0, 1], [0, 1]], strain, dt)

    def _wetted(self, at: _At, start: _At, suction: float, free: Sequence, dt: float) -> _At:
        """Return the sample at a new suction, with constant net stresses along the `free` axes."""
        m = self._material
        effective, before = (m.biot * chi_at(m.retention, -s) * s for s in (suction, start.strain))
        goal = [start.stress[i] + before - effective for i in free]
        state = at.state | ({DRIED[0]: np.asarray(suction)} if DRIED[0] in at.state else {})
        return self._balanced(replace(at, state=state), at.F, free, goal, suction, dt)

    def _balanced(
        self, at: _At, F: NDArray[np.float64], free: Sequence, goal: ArrayLike, strain: float, dt: float
    ) -> _At:
        """Return the sample after a step of dt, in s.  The stress components `free` reach the values `goal`, in Pa."""
        if not free:
            return self._updated(F, strain, at, dt)
        F, rows, columns = F.copy(), *np.array(free).T
        nudges = np.zeros((1 + 2 * len(free), 3, 3))
        for k, (i, j) in enumerate(free):
            nudges[1 + 2 * k, i, j], nudges[2 + 2 * k, i, j] = CENTRAL, -CENTRAL
        near = CENTRAL**2 * np.abs(goal).max() + ROUND_OFF * self._bulk  # errors of the slope, and round-off
        for _ in range(ITERATIONS):
            found = self._stress(F + nudges, at.state, dt)[:, rows, columns]
            error = found[0] - goal
            if not np.isfinite(found).all():
                break
            slope = (found[1::2] - found[2::2]).T / (2 * CENTRAL)
            step = np.linalg.lstsq(slope, error, rcond=ROUND_OFF)[0]
            F[rows, columns] -= step
            if np.abs(error).max() <= near:  # after one more step, only rounding errors remain
                return self._updated(F, strain, at, dt)
        raise NotConverged(f"element test: no stretch was found for the prescribed stress at a strain of {strain:g}")
