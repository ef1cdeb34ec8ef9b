# SPDX-License-Identifier: MIT
"""Contact by conditions, one a contact and cell: pressures, Coulomb friction and adhesion, of tools and of groups.

The normal pressure at a place with the gap g, and its energy by area, are

    p = <lambda - k g>,     psi = p^2 / (2 k).

k is no stiffer than lets a Q1 field follow curved surfaces, to which their places ask for more than it has nodes;
lambda, one value a contact and cell, is at first the pressure of the step before, and augmented (Uzawa) until the
cells' surfaces penetrate by less than `DEPTH` in the mean.  Friction acts on the mean slip s of the cell in the step,
from the traction t_n of the step before, which the points keep,

    t = P (t_n - k_t s),     |t| <= mu p + min(adhesion, 10 p)      by radial return,

P the projection on the tangent plane: what sticks is elastic with a stiffness k_t, and gives back what it took.
What slips is chosen after each Newton step (active sets): at first all sticks, whatever it would bear; what slips back
sticks again, as soon as the balance is near, and then for as long.  Decided in each residual anew all would slip to and
fro, for there is no stiffness in slip.  What sticks and leaves slips as well, the second time for good: where the mean
normal of a cell leans, under round tools that just touch, shear alone would push the surface away, to and fro.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.errors import NotConverged
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.grid.grid import Grid, sum_by
from mpm_dolfinx.parallel.exchange import Exchange, first, over_all
from mpm_dolfinx.points.material_points import MaterialPoints

STIFF = 100.0
"""k in units of (what resists) / (cell size)."""
GRIP = 6.0
"""k_t in units of (what resists) / (cell size): stiffer shears alternate from cell to cell, which displaces no node."""
DEPTH = 5e-4  # cells: mean penetration that is left
TOUCH = 1e-13  # of the grid: what is nearer touches, but for rounding; light bodies press no deeper than 1e-8 cells
SLIVER = 0.25  # of a cell's face: of what is smaller less penetration counts
ROUNDS = 20  # augmentations that are tried
CLOSE = 1e-6  # of the traction that slips: what is nearer stays what it is
LEAST = 1e-300
RAMP = 10.0  # adhesion over the normal pressure, at most


def pressure_name(name: str) -> str:
    """Return the name under which points have the pressure (n,), Pa, of a tool or contact on their faces."""
    return f"{name}_pressure"


def shear_name(name: str) -> str:
    """Return the name under which points keep the shear traction (n, d), Pa, of a tool or contact."""
    return f"{name}_shear"


def kept(contacts: Mapping[str, Resisting], n: int, dim: int) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return what n points keep of each contact, zero: pressures (n,) and, of what resists slip, tractions (n, d)."""
    return {
        name: {pressure_name(name): np.zeros(n), **({shear_name(name): np.zeros((n, dim))} if contact.grips else {})}
        for name, contact in contacts.items()
    }


def let_go(points: MaterialPoints, names: Iterable[str]) -> MaterialPoints:
    """Return points without what they keep under these names."""
    return replace(points, data={name: rows for name, rows in points.data.items() if name not in names})


def gripped(
    points: MaterialPoints, new: Mapping[str, NDArray[np.float64]], before: MaterialPoints | None
) -> MaterialPoints:
    """Return points with new data, or with what the same points kept of it `before`."""
    if before is not None:
        here, at = before.find(points.id)
        for name in new.keys() & before.data.keys():
            new[name][here] = before.data[name][at]
    return replace(points, data={**points.data, **new}) if new else points


class Resisting(Protocol):
    """A tool, or the contact of two groups: mu, adhesion, Pa, and whether it resists slip."""

    friction: float
    adhesion: float
    grips: bool


@dataclass(frozen=True, eq=False)
class Rows:
    """Points of integration where surfaces may touch; arrays over m rows in owned cells.

    number, cell : (m,) contact, local cell; area : (m,), m^(d-1); resistance : (m,), Pa, see `conditions`;
    pressure, shear : (m,) and (m, d), Pa, before the step.
    """

    number: NDArray[np.int64]
    cell: NDArray[np.int32]
    area: NDArray[np.float64]
    resistance: NDArray[np.float64]
    pressure: NDArray[np.float64]
    shear: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Touch:
    """The contact at some displacement: of m rows, and of k conditions, one a contact and cell.

    force : (m, d) on the rows, N; push : (m,) pressure, Pa; stiff : (m,) minus its derivative by the gap, Pa/m;
    pressure : (k,) mean of the pressure, Pa; sticks : (k,) what touches, and does not slip; trial, shear : (k, d)
    traction if all stuck, and as it is, Pa; most : (k,) what it may be, Pa; grip : (k, d, d) minus its derivative by
    the slip, Pa/m; rise : (k, d) that by the pressure.
    """

    force: NDArray[np.float64]
    push: NDArray[np.float64]
    stiff: NDArray[np.float64]
    pressure: NDArray[np.float64]
    sticks: NDArray[np.bool_]
    trial: NDArray[np.float64]
    shear: NDArray[np.float64]
    most: NDArray[np.float64]
    grip: NDArray[np.float64]
    rise: NDArray[np.float64]


class CellContact:
    """The conditions of contacts in a substep; lambda, and what slips, change as it is solved.

    Parameters
    ----------
    grid
        Background grid.
    names
        Their names.
    contacts
        The contacts.
    rows
        Points of integration, at the owners of their cells.
    back
        The way of the rows to the owners of their cells; and of each row before it: index of its material point on
        this process, contact, and area, m^(d-1).
    """

    def __init__(
        self,
        grid: Grid,
        names: Sequence[str],
        contacts: Sequence[Resisting],
        rows: Rows,
        back: tuple[Exchange, NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]],
    ):
        self.grid, self._names, self.contacts, self.rows, self._back = grid, names, contacts, rows, back
        key, self.of = np.unique(rows.number * grid.num_local + rows.cell, return_inverse=True)
        self.number, self.cell = np.divmod(key, grid.num_local)
        self.area = sum_by(self.of, rows.area, len(key))
        strength = np.array([(contact.friction, contact.adhesion) for contact in contacts], dtype=float)
        self.strength = strength[self.number]
        h = grid.h.min()
        self.stiffness, self._hold = STIFF / h * rows.resistance, GRIP / h * self.mean(rows.resistance)
        self.grips = any(contact.grips for contact in contacts)
        self.along = np.zeros((len(key), grid.dim))  # direction of the shear of what slips, else zero
        self._turned = np.zeros(len(key), dtype=bool)  # what has slipped, and stuck again
        self._left = np.zeros(len(key), dtype=bool)  # and then has left
        self._stuck = np.zeros((len(key), grid.dim))  # traction, Pa, of what stuck at the last choice
        self.pressure, self._rounds = self.mean(rows.pressure), np.zeros(1, dtype=np.int64)

    def total(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums (k, ...) of values (m, ...) in the conditions."""
        size = len(self.area)
        columns = values.reshape(len(values), int(np.prod(values.shape[1:], dtype=int))).T
        out = np.stack([sum_by(self.of, column, size) for column in columns], axis=1)
        return out.reshape(size, *values.shape[1:])

    def mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the means (k, ...) over the area of values (m, ...) in the conditions."""
        each = (slice(None), *(None,) * (values.ndim - 1))
        return self.total(self.rows.area[each] * values) / self.area[each]

    def touch(self, gap: NDArray[np.float64], n: NDArray[np.float64], slip: NDArray[np.float64]) -> Touch:
        """Return the contact for gaps (m,), m, normals (m, d) and slips (m, d), m, of the rows."""
        push = np.maximum(0.0, self.pressure[self.of] - self.stiffness * gap)
        touches = self.touches(push, gap)
        pressure, on, normal = self.mean(push), np.zeros(len(self.area), dtype=bool), self.mean(n)
        on[self.of[touches]] = True
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), LEAST)
        friction = _, _, shear, *_ = self._friction(normal, self.mean(slip), pressure, on)
        force = self.rows.area[:, None] * (push[:, None] * n + shear[self.of])
        return Touch(force, push, self.stiffness * touches, pressure, *friction)

    def touches(self, push: NDArray[np.float64], gap: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which rows (m,) touch, with pressures (m,), Pa, and gaps (m,), m."""
        return (push > 0) | (gap <= TOUCH * np.abs([self.grid.lower, self.grid.upper]).max())

    def _friction(self, n: NDArray, slip: NDArray, pressure: NDArray, on: NDArray) -> tuple:
        """Return what a `Touch` has from `sticks` on; n, slip : (k, d), normals and means."""
        P = np.eye(n.shape[1]) - n[:, :, None] * n[:, None, :]
        hold = np.where(self.strength.any(axis=1), self._hold, 0.0) * on
        (mu, adhesion), slips = self.strength.T, self._slips
        trial = np.einsum("kij,kj->ki", P, self.mean(self.rows.shear) * on[:, None] - hold[:, None] * slip)
        size, ramp = np.maximum(np.linalg.norm(trial, axis=1), LEAST), RAMP * pressure < adhesion
        most = mu * pressure + np.minimum(adhesion, RAMP * pressure)
        onward = slips & (np.einsum("kd,kd->k", trial, self.along) > 0)  # what turns back keeps its shear for now
        along = np.where(onward[:, None], trial / size[:, None], self.along)
        turns = hold * np.where(slips, onward * most / size, 1.0)
        grip = turns[:, None, None] * (P - along[:, :, None] * along[:, None, :])
        rise = (mu + RAMP * ramp)[:, None] * along
        shear = np.where(slips[:, None], most[:, None] * along, trial)
        return ~slips & on, trial, shear, most, grip, rise

    @property
    def _slips(self) -> NDArray[np.bool_]:
        return self.along.any(axis=1)

    def choose(self, touch: Touch, sticks: bool) -> bool:
        """Choose what slips, and if asked for what sticks again; return whether that is another choice."""
        before = self._slips
        left = ~before & ~touch.sticks & self._stuck.any(axis=1)
        self._left[:] |= left & self._turned
        bears = np.where(left[:, None], self._stuck, touch.trial)
        size = np.linalg.norm(bears, axis=1)
        goes_on = (size > (1 - CLOSE) * touch.most) & (np.einsum("kd,kd->k", bears, self.along) > 0)
        exceeds = (size > (1 + CLOSE) * touch.most) & (sticks | ~self._turned)
        slips = np.where(before, goes_on | self._left if sticks else True, exceeds | left)
        self._turned[:] |= before & ~slips
        self._stuck[:] = touch.trial * touch.sticks[:, None]
        new = (slips & (goes_on | ~before))[:, None]
        self.along[:] = np.where(new, bears / np.maximum(size, LEAST)[:, None], slips[:, None] * self.along)
        return over_all(self.grid.comm, int((slips != before).sum())) > 0

    def augmented(self, touch: Touch, x: NDArray[np.float64], why: str) -> float:
        """Take the present pressures for lambda where means penetrate too deep; return how deep, in cells, or zero.

        Parameters
        ----------
        touch
            The contact at present.
        x : (m, d), m
            Where the rows are.
        why
            What the error asks.

        Raises
        ------
        NotConverged
            They still do after as many rounds as are tried.
        """
        # what is a sliver of a cell has too little area to be pushed out by itself, and goes with its neighbours
        plane = self.total(self.rows.area / self.grid.around(x))
        whole = np.minimum(1.0, plane / (SLIVER * self.grid.cell_volume / self.grid.h.max()))
        off = whole * np.abs(touch.pressure - self.pressure) / self.mean(self.stiffness) / self.grid.h.min()
        most = over_all(self.grid.comm, float(off.max(initial=0.0)), MPI.MAX)
        if most <= DEPTH:
            return 0.0
        self._rounds[0] += 1
        if self._rounds[0] > ROUNDS:
            worst = np.flatnonzero(off == most)[:1]
            where = [f"{line(self.contacts[self.number[k]])}: at {x[self.of == k][0] + self.grid.base}" for k in worst]
            message = f"{''.join(where)} penetrates by {most:.2g} cells: {why}"
            raise NotConverged(first(self.grid.comm, message if where else ""))
        self.pressure[:] = touch.pressure
        return most

    @property
    def rounding(self) -> NDArray[np.float64]:
        """What rounding of coordinates makes of the forces (m,), N, of the rows."""
        return 1e-15 * self.stiffness * self.rows.area * self._reach

    @property
    def _reach(self) -> NDArray[np.float64] | float:
        """Largest coordinate of what gaps are measured from, m; of the rows (m,), or of all."""
        return self.grid.reach

    def summed(self, force: NDArray[np.float64], arm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return forces and moments (contacts, d + 1) or, in 3D, (contacts, 6), N and N m, of all processes.

        force, arm : (m, d), N and m, of the rows.  In axisymmetry moments are zero, and the radial force is the sum of
        what acts outward.
        """
        arm = arm * (not self.grid.axisymmetric)
        cross = np.cross(arm, force) if arm.shape[1] == 3 else arm[:, :1] * force[:, 1:] - arm[:, 1:] * force[:, :1]
        sums = [sum_by(self.rows.number, column, len(self.contacts)) for column in np.hstack([force, cross]).T]
        return over_all(self.grid.comm, np.stack(sums, axis=1))

    def carried(self, touch: Touch, points: MaterialPoints) -> MaterialPoints:
        """Return the points with the pressures and shear tractions that contacts have on them.

        What sticks keeps how it differs from the mean of its cell: averaged anew in every step it would creep.
        """
        travel, at, of, area = self._back
        off = (self.rows.shear - self.mean(self.rows.shear)[self.of]) * touch.sticks[self.of, None]
        shear, push = travel.back(touch.shear[self.of] + off), travel.back(touch.push)
        data, n = dict(points.data), len(points)
        for number, contact in enumerate(self.contacts):
            rows = np.flatnonzero(of == number)
            whole = np.maximum(sum_by(at[rows], area[rows], n), LEAST)
            means = [sum_by(at[rows], area[rows] * column, n) / whole for column in (push[rows], *shear[rows].T)]
            data[pressure_name(self._names[number])] = means[0]
            if contact.grips:
                data[shear_name(self._names[number])] = np.stack(means[1:], axis=1)
        return replace(points, data=data)
