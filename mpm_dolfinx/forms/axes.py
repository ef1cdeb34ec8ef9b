# SPDX-License-Identifier: MIT
"""Second-order tensors with a principal third axis, which is out of plane or circumferential."""

from __future__ import annotations

import ufl


def block(T):
    """Return a UFL tensor (3, 3) whose out-of-plane shear components are explicit zeros."""
    return ufl.as_matrix([[T[0, 0], T[0, 1], 0], [T[1, 0], T[1, 1], 0], [0, 0, T[2, 2]]])


def planar(F) -> bool:
    """Return whether the third axis of a UFL deformation gradient is principal.

    Tensors (2, 2) and results of `block` give True, and all other tensors give False.
    """
    if isinstance(F, ufl.classes.Variable):
        F = F.ufl_operands[0]
    if F.ufl_shape == (2, 2):
        return True
    if not isinstance(F, ufl.classes.ListTensor):
        return False
    beside = (F.ufl_operands[i].ufl_operands[j] for i, j in ((0, 2), (1, 2), (2, 0), (2, 1)))
    return all(isinstance(part, ufl.classes.Zero) for part in beside)


def embedded(F, across=1):
    """Return a deformation gradient as a UFL tensor (3, 3).

    `across`: in plane strain, the out-of-plane stretch.
    """
    if F.ufl_shape == (3, 3):
        return F
    return ufl.as_matrix([[F[0, 0], F[0, 1], 0], [F[1, 0], F[1, 1], 0], [0, 0, across]])
