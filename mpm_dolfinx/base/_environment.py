# SPDX-License-Identifier: MIT
"""Check of required packages, before other imports.  An error names missing packages and how to install them."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

PACKAGES = {"dolfinx": "fenics-dolfinx", "scipy": "scipy", "tqdm": "tqdm", "meshio": "meshio"}
"""Python names of required packages, and their names on conda-forge.  Debian's names begin with python3-."""
BROUGHT = ("mpi4py", "petsc4py", "basix", "ffcx", "ufl")  # installed with dolfinx
SUPPORTED = ((0, 5), (0, 9), (0, 10), (0, 11))


def _check() -> None:
    missing = [name for name in (*PACKAGES, *BROUGHT) if find_spec(name) is None]
    if missing:
        where = f", nor in PETSC_DIR = {os.environ['PETSC_DIR']}" if os.environ.get("PETSC_DIR") else ""
        get = dict.fromkeys("dolfinx" if name in BROUGHT else name for name in missing)
        raise ImportError(
            f"{', '.join(missing)}: not found by {sys.executable}{where}; must be installed: on Debian, with "
            f"/usr/bin/python3, `apt install {' '.join(f'python3-{name}' for name in get)}`, "
            f"elsewhere `conda install -c conda-forge {' '.join(map(PACKAGES.get, get))}`",
            name=missing[0],
        )
    try:
        Path.home()
    except RuntimeError as error:  # without HOME Open MPI fails, and so does dolfinx
        raise ImportError("HOME is not set, but dolfinx needs it; set HOME to a folder that can be written") from error

    from mpi4py import MPI  # noqa: F401 - initialises MPI before PETSc does
    from petsc4py import PETSc

    import numpy as np

    if np.issubdtype(PETSc.ScalarType, np.complexfloating):
        raise ImportError(
            "PETSc has complex numbers, but mpm_dolfinx needs real ones: on Debian, PETSC_DIR must be unset or end in "
            "-real: `apt install python3-dolfinx-real`; elsewhere `conda install -c conda-forge 'petsc=*=real*'`"
        )
    root, show = logging.getLogger(), warnings.showwarning
    level, handlers = root.level, root.handlers[:]
    import dolfinx  # looks for libraries of PETSc's scalar type

    # ffcx of dolfinx 0.5 adds a root handler, which would disable the user's `logging.basicConfig`
    root.setLevel(level)
    root.handlers[:] = handlers
    if warnings.showwarning is not show:  # ffcx of dolfinx 0.5 also sends all warnings to that handler
        logging.captureWarnings(False)
    if tuple(map(int, dolfinx.__version__.split(".")[:2])) not in SUPPORTED:
        raise ImportError(f"dolfinx {dolfinx.__version__} is not supported; mpm_dolfinx needs 0.5.2, 0.9, 0.10 or 0.11")


_check()
