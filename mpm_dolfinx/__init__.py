# SPDX-License-Identifier: MIT
"""Implicit, iteratively coupled material point / finite volume poromechanics on FEniCSx.

A scene is a `Simulation` of a `Grid`, bodies (`box`, `shape`, `mapped`, `from_mesh`, `polygon`), materials (`Hencky`,
`NeoHookean`, `LinearElastic`, `DruckerPrager`, `MohrCoulomb`, `ModifiedCamClay`, or your own `Skeleton`), a `Fluid` and
conditions on the sides of the bodies (`Traction`, `Pressure`, `Displacement`, `RigidPlate`, `Drained`, `Inflow`,
`water`).  Its `run` gives a `Result` with what `probes` record, and feeds a `Writer` and a `Checkpoint`, from which
`resume` goes on; `stage` changes the scene between two runs.  Terms and sources in UFL: see
`mpm_dolfinx.constitutive.user_functions`.

SI units throughout.  Stress is positive in tension, pore pressure in compression; 2D is plane strain, and forces
are those of a slice of 1 m, or axisymmetric (`Grid`), and forces are those all around.
"""

from mpm_dolfinx import _environment  # noqa: F401 - first: it says what is missing
from mpm_dolfinx.constitutive.cam_clay import ModifiedCamClay
from mpm_dolfinx.constitutive.drucker_prager import DruckerPrager
from mpm_dolfinx.constitutive.element_test import ElementTest, element_test
from mpm_dolfinx.constitutive.mohr_coulomb import MohrCoulomb
from mpm_dolfinx.constitutive.skeleton import (
    LAWS,
    Field,
    Fluid,
    Hencky,
    LinearElastic,
    NeoHookean,
    Skeleton,
    kozeny_carman,
)
from mpm_dolfinx.errors import GaveUp, LeftGrid, NotConverged
from mpm_dolfinx.io.checkpoint import Checkpoint, resume
from mpm_dolfinx.io.writer import Writer
from mpm_dolfinx.points.bodies import box, mapped, shape
from mpm_dolfinx.points.grid import Grid
from mpm_dolfinx.points.mesh_files import from_mesh
from mpm_dolfinx.points.polygon import polygon
from mpm_dolfinx.points.probes import probes
from mpm_dolfinx.problems.conditions import Displacement, Drained, Inflow, Pressure, RigidPlate, Traction
from mpm_dolfinx.problems.water import water
from mpm_dolfinx.result import Result
from mpm_dolfinx.simulation import Simulation
from mpm_dolfinx.solve.scheme import COUPLINGS
from mpm_dolfinx.state import State

__version__ = "0.1.0"
__all__ = [
    "COUPLINGS",
    "LAWS",
    "Checkpoint",
    "Displacement",
    "Drained",
    "DruckerPrager",
    "ElementTest",
    "Field",
    "Fluid",
    "GaveUp",
    "Grid",
    "Hencky",
    "Inflow",
    "LeftGrid",
    "LinearElastic",
    "ModifiedCamClay",
    "MohrCoulomb",
    "NeoHookean",
    "NotConverged",
    "Pressure",
    "Result",
    "RigidPlate",
    "Simulation",
    "Skeleton",
    "State",
    "Traction",
    "Writer",
    "box",
    "element_test",
    "from_mesh",
    "kozeny_carman",
    "mapped",
    "polygon",
    "probes",
    "resume",
    "shape",
    "water",
]
