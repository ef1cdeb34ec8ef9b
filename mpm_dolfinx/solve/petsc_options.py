# SPDX-License-Identifier: MIT
"""PETSc options for the solvers.  Options of the user replace the defaults of the package.

The name of an option begins with the prefix of a solver, as in {"momentum_ksp_type": "bcgs"}.  On the command line,
"mpm_" precedes this name.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from petsc4py import PETSc

PREFIXES = {
    "momentum_": "factors of K",
    "momentum_multigrid_": "multigrid on K",
    "momentum_firmly_": "multigrid on K in nearly incompressible bodies, with three sweeps on each grid",
    "momentum_incomplete_": "multigrid on K in wet soil that may yield, with incomplete factors on each grid",
    "nodal_factors_": "factors of K in blocks",
    "storage_": "conjugate gradients or FGMRES on the Schur complement, with factors of the fixed-stress operator",
    "storage_gathered_": "these factors, if one of several processes holds them",
    "storage_multigrid_": "multigrid on the fixed-stress operator",
    "block_": "GMRES on displacements and pressures at once",
    "factors_": "factors of K that replace multigrid cycles",
    "storage_factors_": "factors of the fixed-stress operator that replace multigrid cycles",
}
"""For each prefix of option names: the solver that reads these options."""


def check(options: Mapping[str, Any]) -> None:
    """Raise ValueError for an option name without the prefix of a solver."""
    for name in options:
        if not isinstance(name, str) or not name.startswith(tuple(PREFIXES)):
            raise ValueError(f"petsc_options {name!r}: must begin with one of {', '.join(PREFIXES)}")


@contextmanager
def using(options: Mapping[str, Any], unread: set[str] | None = None) -> Iterator[None]:
    """Set PETSc options of the user in this context. Options that solvers read are removed from `unread`."""
    given, before = PETSc.Options(), {}
    for name, value in options.items():
        full = f"mpm_{name}"
        before[full] = given.getString(full) if given.hasName(full) else None
        given.delValue(full)  # the query above has marked this option as read
        given.setValue(full, value)
    try:
        yield
    finally:
        if unread:
            unread -= {name for name in unread if _read(f"mpm_{name}")}
        for full, value in before.items():
            given.delValue(full) if value is None else given.setValue(full, value)


def set_defaults(solver: PETSc.KSP, values: Mapping[str, Any]) -> None:
    """Set options of a solver, except options that the user has set."""
    options = PETSc.Options(solver.getOptionsPrefix())
    for name, value in values.items():
        if not options.hasName(name):
            options.setValue(name, value)


def _read(name: str) -> bool:
    """Return whether PETSc has read an option."""
    found = ctypes.c_int()
    ctypes.CDLL(PETSc.__file__).PetscOptionsUsed(None, name.encode(), ctypes.byref(found))
    return bool(found.value)
