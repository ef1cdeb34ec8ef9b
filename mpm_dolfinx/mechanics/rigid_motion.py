# SPDX-License-Identifier: MIT
"""The rigid motion nearest to prescribed displacements: initial guess of Newton's method for bodies that rotate.

A linearised rotation by an angle a stretches a body by a^2 / 2.  Without this guess, the first Newton step is such a
rotation, and soil may yield.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mpm_dolfinx.base.tolerances import NEAR, SAME, TINY
from mpm_dolfinx.forms.point_forms import PointData
from mpm_dolfinx.parallel.exchange import over_all


def rigid_motion(
    comm: MPI.Intracomm, holds: PointData, x: NDArray[np.float64], counts: NDArray[np.bool_]
) -> NDArray[np.float64] | None:
    """Return the displacements, in m, of positions x in the rigid motion nearest to prescribed displacements.

    The result is None for small rotations, and for displacements that are far from a rigid motion.  All processes must
    call this function.

    `holds`: penalties of prescribed displacements, with direction, gap (m), and stiffness (weight in the fit).
    `counts` (k,): whether each penalty is used.
    """
    d = x.shape[1]
    e = holds["direction"]
    gap = holds["gap"][:, 0]
    weight = holds["stiffness"] * counts[:, None]
    moments = over_all(comm, np.concatenate([[weight.sum()], (weight * holds.x).sum(axis=0)]))
    if not moments[0] > 0:
        return None
    centre = moments[1:] / moments[0]
    arm = holds.x - centre
    shift = np.zeros(d)
    turn = Rotation.identity()
    size = np.sqrt(over_all(comm, float((weight[:, 0] * (arm**2).sum(axis=1)).sum())) / moments[0])
    left = []  # sums of squared gaps: second entry for the best translation, last entry for the best rigid motion
    while len(left) < 3 or left[-1] < (1 - SAME) * left[-2]:  # Gauss-Newton iterations
        rotated = _apply(turn, arm)
        off = gap - np.einsum("nd,nd->n", e, shift + rotated - arm)
        left.append(over_all(comm, float(weight[:, 0] @ off**2)))
        slope = np.concatenate([e, _spin(rotated, e) / max(size, TINY)], axis=1)
        normal = over_all(comm, np.concatenate([slope.T @ (weight * slope), [slope.T @ (weight[:, 0] * off)]]))
        part = slice(None) if left[1:] else slice(d)  # first without rotation
        step = np.zeros(len(normal) - 1)
        step[part] = np.linalg.lstsq(normal[:-1][part, part] / moments[0], normal[-1][part] / moments[0], rcond=SAME)[0]
        shift = shift + step[:d]
        angles = step[d:] / max(size, TINY)
        turn = Rotation.from_rotvec(angles if d == 3 else [0.0, 0.0, angles[0]]) * turn
    if turn.magnitude() ** 2 / 2 < NEAR or not left[-1] < left[1] / 2:
        return None
    return shift + _apply(turn, x - centre) - (x - centre)


def rotated(
    comm: MPI.Intracomm, weight: NDArray[np.float64], x: NDArray[np.float64], to: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the rotation that best maps positions x to the positions `to`, with weights (Kabsch 1976).

    The result is the identity for small rotations, and for motions that are far from rigid.  All processes must call
    this function.
    """
    d = x.shape[1]
    sums = over_all(comm, np.concatenate([[weight.sum()], weight @ x, weight @ to]))
    if not sums[0] > 0:
        return np.eye(d)
    arm, goal = x - sums[1 : 1 + d] / sums[0], to - sums[1 + d :] / sums[0]
    left, _, right = np.linalg.svd(over_all(comm, goal.T @ (weight[:, None] * arm)))
    left[:, -1] *= np.linalg.det(left) * np.linalg.det(right)
    R = left @ right
    off = np.array([weight @ ((goal - arm @ by.T) ** 2).sum(axis=1) for by in (R, np.eye(d))])
    less, most = over_all(comm, off)
    return R if less < most / 2 and np.linalg.norm(R - np.eye(d)) ** 2 / 4 > NEAR else np.eye(d)


def _apply(turn: Rotation, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotated vectors (n, d).  2D vectors rotate in the plane."""
    d = x.shape[1]
    return x @ turn.as_matrix()[:d, :d].T


def _spin(x: NDArray[np.float64], e: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the velocities of positions x along directions e, for a unit angular velocity about each axis."""
    if x.shape[1] == 2:
        return (x[:, :1] * e[:, 1:] - x[:, 1:] * e[:, :1]).copy()
    return np.cross(x, e)
