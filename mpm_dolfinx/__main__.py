# SPDX-License-Identifier: MIT
"""Print versions and solvers for a bug report, run laboratory tests of soil laws, or join the output files of a run."""

from __future__ import annotations

import argparse
import platform
import runpy
import sys
from collections.abc import Sequence
from dataclasses import MISSING, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mpi4py import MPI
from petsc4py import PETSc

import dolfinx
import numpy as np

import mpm_dolfinx

PACKAGES = ("fenics-basix", "fenics-ffcx", "fenics-ufl", "petsc4py", "mpi4py", "numpy", "scipy", "meshio", "tqdm")
SOLVERS = ("mumps", "superlu_dist", "superlu", "suitesparse", "strumpack", "mkl_pardiso", "hypre", "ml")


def info() -> dict[str, str]:
    """Return the versions of the package's dependencies, and the solvers of PETSc."""
    real = np.issubdtype(PETSc.ScalarType, np.floating)
    return {
        "mpm_dolfinx": mpm_dolfinx.__version__,
        "dolfinx": dolfinx.__version__,
        **{name: _version(name) for name in PACKAGES},
        "PETSc": f"{'.'.join(map(str, PETSc.Sys.getVersion()))}, {'real' if real else 'complex'} scalars",
        "solvers": ", ".join(["petsc", *filter(PETSc.Sys.hasExternalPackage, SOLVERS)]),
        "MPI": MPI.Get_library_version().strip("\0").split(", ")[0],
        "Python": platform.python_version(),
        "platform": platform.platform(),
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not found"


def number(name: str, text: str) -> float | list[float]:
    """Return the number in a text, or a list if the text contains several numbers separated by commas."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{name} = {text!r}, must be a number, or numbers separated by commas, in SI units") from None
    return values if len(values) > 1 else values[0]


def law_of(name: str) -> type[mpm_dolfinx.Skeleton]:
    """Return the law `name` of the package, or for `file.py:name` the law in the user's file `file.py`."""
    file, _, own = name.rpartition(":")
    if not file:
        found = getattr(mpm_dolfinx, name, None)
    elif not Path(file).is_file():
        raise ValueError(f"law = {name!r}: there is no file {file}")
    else:
        sys.path.insert(0, str(Path(file).parent))  # so that the file can import modules in its own folder
        found = runpy.run_path(file).get(own)
    if _is_law(found):
        return found
    known = [n for n in mpm_dolfinx.__all__ if _is_law(getattr(mpm_dolfinx, n)) and n != "Skeleton"]
    raise ValueError(f"law = {name!r}, must be one of {', '.join(known)}, or file.py:name for your own law")


def _is_law(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, mpm_dolfinx.Skeleton)


def constants_of(law: type[mpm_dolfinx.Skeleton], texts: Sequence[str]) -> dict[str, float | list[float]]:
    """Return the constants of a law, by name, from texts `name=value`.  No name may occur twice."""
    out, known = {}, [f.name for f in fields(law) if f.init]
    for text in texts:
        name, equals, value = text.partition("=")
        names = f"must be name=value, name one of {', '.join(known)}"
        if not equals or name not in known or name in out:
            wrong = "is given twice" if equals and name in out else names
            raise ValueError(f"{law.__name__}: {text!r} {wrong}")
        out[name] = number(f"{law.__name__}: {name}", value)
    for f in fields(law):
        if f.name not in out and f.init and f.default is MISSING and f.default_factory is MISSING:
            raise ValueError(f"{law.__name__}: {f.name} is not given")
    return out


def run_element_test(o: argparse.Namespace) -> None:
    """Compute a laboratory test of a law, print a table of results, and draw them if an image file is given."""
    if o.draw and not Path(o.draw).parent.is_dir():
        raise ValueError(f"--draw {o.draw}: there is no folder {Path(o.draw).parent}")
    law, strain = law_of(o.law), number("strain", o.strain)
    soil = law(**constants_of(law, o.constants))
    options = {name: getattr(o, name) for name in ("steps", "confinement", "rate", "cell_size", "suction")}
    r = mpm_dolfinx.element_test(soil, o.test, strain, **options)
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
    lab = commands.add_parser("element-test", help="compute a laboratory test of a soil law")
    lab.add_argument("law", help="name of the law, such as ModifiedCamClay, or file.py:name")
    lab.add_argument("test", help=", ".join(mpm_dolfinx.ElementTest.KINDS))
    lab.add_argument("strain", help="axial (compression positive) or shear strain; commas separate turning points")
    lab.add_argument("constants", nargs="*", metavar="name=value", help="constant, such as bulk=2e6; vectors: a,b,c")
    lab.add_argument("--steps", type=int, default=100, help="number of steps to each turning point (100)")
    lab.add_argument("--confinement", type=float, default=0.0, help="initial isotropic effective stress, Pa (0)")
    lab.add_argument("--suction", type=float, default=0.0, help="initial suction, Pa (0)")
    lab.add_argument("--rate", type=float, help="strain rate, 1/s, for rate-dependent laws")
    lab.add_argument("--cell-size", type=float, help="cell size, m, for laws that soften")
    lab.add_argument("--draw", help="image file for the results")
    one = commands.add_parser("one-file", help="write the points of a run to one file for ParaView, points.xdmf")
    one.add_argument("folder", help="folder of the Writer")
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
