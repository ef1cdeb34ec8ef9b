# SPDX-License-Identifier: MIT
"""Versions and solvers that a report of a bug should name, laboratory tests of soil laws, and files of a run as one."""

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


def number(text: str) -> float | list[float]:
    """Return a number, or several with commas between them."""
    values = [float(part) for part in text.split(",")]
    return values if len(values) > 1 else values[0]


def run_element_test(o: argparse.Namespace) -> None:
    """Drive a law through a laboratory test, print a table of it and draw it."""
    law = getattr(mpm_dolfinx, o.law, None)
    if not (isinstance(law, type) and issubclass(law, mpm_dolfinx.Skeleton)):
        raise ValueError(f"law = {o.law!r}, must be the name of a law, such as ModifiedCamClay")
    constants = dict(text.split("=", 1) for text in o.constants)
    soil = law(**{name: number(value) for name, value in constants.items()})
    options = {name: getattr(o, name) for name in ("steps", "confinement", "rate", "cell_size")}
    r = mpm_dolfinx.element_test(soil, o.test, number(o.strain), **options)
    print(f"{'strain':>10} {'p (Pa)':>12} {'q (Pa)':>12} {'pore p. (Pa)':>12} {'volume strain':>13}")
    for k in np.unique(np.linspace(0, len(r.strain) - 1, 21, dtype=int)):
        print(f"{r.strain[k]:10.5f} {r.p[k]:12.5g} {r.q[k]:12.5g} {r.pressure[k]:12.5g} {r.volume_strain[k]:13.5g}")
    if o.draw:
        r.draw(o.draw, f"{o.law}, {o.test}")


def main(argv: list[str] | None = None) -> None:
    """Run `python -m mpm_dolfinx`."""
    parser = argparse.ArgumentParser(prog="python -m mpm_dolfinx", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("info", help="print versions and solvers")
    lab = commands.add_parser("element-test", help="drive a soil law through a laboratory test")
    lab.add_argument("law", help="name of the law, such as ModifiedCamClay")
    lab.add_argument("test", help=", ".join(mpm_dolfinx.ElementTest.KINDS))
    lab.add_argument("strain", help="axial strain, compression positive, or shear; turning points with commas")
    lab.add_argument("constants", nargs="*", metavar="name=value", help="of the law; vectors with commas")
    lab.add_argument("--steps", type=int, default=100, help="to each turning point (100)")
    lab.add_argument("--confinement", type=float, default=0.0, help="isotropic effective stress before, Pa (0)")
    lab.add_argument("--rate", type=float, help="strain in a second, of laws that depend on it, 1/s")
    lab.add_argument("--cell-size", type=float, help="size of cells, of laws that soften, m")
    lab.add_argument("--draw", help="file of a picture")
    one = commands.add_parser("one-file", help="write the points of a run as one file of ParaView's, points.xdmf")
    one.add_argument("folder", help="that of the Writer")
    o = parser.parse_args(argv)
    if MPI.COMM_WORLD.rank > 0:
        return
    if o.command == "info":
        print("\n".join(f"{name:14}{value}" for name, value in info().items()))
        return
    try:
        if o.command == "one-file":
            print(mpm_dolfinx.one_file(o.folder))
        else:
            run_element_test(o)
    except (ValueError, TypeError, OSError, mpm_dolfinx.NotConverged) as error:
        {"one-file": one, "element-test": lab}[o.command].error(" ".join(str(error).split()))


if __name__ == "__main__":
    main()
