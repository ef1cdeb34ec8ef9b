# SPDX-License-Identifier: MIT
"""Versions and solvers that a report of a bug should name."""

from __future__ import annotations

import argparse
import platform
from importlib.metadata import PackageNotFoundError, version

from mpi4py import MPI
from petsc4py import PETSc

import dolfinx
import numpy as np

import mpm_dolfinx

PACKAGES = ("fenics-basix", "fenics-ffcx", "fenics-ufl", "petsc4py", "mpi4py", "numpy", "scipy", "meshio", "tqdm")
SOLVERS = ("mumps", "superlu_dist", "superlu", "suitesparse", "strumpack", "mkl_pardiso", "hypre", "ml")


def info() -> dict[str, str]:
    """Return the versions of what the package rests on, and the solvers that PETSc was built with."""
    real = np.issubdtype(PETSc.ScalarType, np.floating)
    return {
        "mpm_dolfinx": mpm_dolfinx.__version__,
        "dolfinx": dolfinx.__version__,
        **{name: _version(name) for name in PACKAGES},
        "PETSc": f"{'.'.join(map(str, PETSc.Sys.getVersion()))}, {'real' if real else 'complex'} scalars",
        "solvers": ", ".join(["petsc", "gamg", *filter(PETSc.Sys.hasExternalPackage, SOLVERS)]),
        "MPI": MPI.Get_library_version().strip("\0").split(", ")[0],
        "Python": platform.python_version(),
        "platform": platform.platform(),
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not found"


def main(argv: list[str] | None = None) -> None:
    """Run `python -m mpm_dolfinx`."""
    parser = argparse.ArgumentParser(prog="python -m mpm_dolfinx", description=__doc__)
    parser.add_argument("command", choices=["info"], help="print versions and solvers")
    parser.parse_args(argv)
    if MPI.COMM_WORLD.rank == 0:
        print("\n".join(f"{name:14}{value}" for name, value in info().items()))


if __name__ == "__main__":
    main()
