# SPDX-License-Identifier: MIT
"""Large-deformation poromechanics on FEniCSx, with material points for the skeleton and finite volumes for the fluid.

A `Simulation` has these parts:

* a `Grid`, and bodies from `box`, `shape`, `mapped`, `from_mesh` or `polygon`;
* materials: `Hencky`, `NeoHookean`, `LinearElastic`, `DruckerPrager`, `SofteningDruckerPrager`, `MohrCoulomb`,
  `ModifiedCamClay`, `BarcelonaBasic`, or your own `Skeleton`;
* a pore `Fluid`, and conditions on sides: `Traction`, `Pressure`, `Displacement`, `RigidPlate`, `Drained`, `Inflow`;
* rigid tools (`Tool`) with the shape `HalfSpace`, `Ball`, `Convex`, `Cone` or `SurfaceMesh`.

`Simulation.run` returns a `Result`, with records at `probes`.  A `Writer` writes results to files, and `one_file` joins
these files.  `resume` continues a run from a `Checkpoint`.  `Simulation.stage` changes the scene between two runs.
`factor_of_safety` divides the strength of the soil until the bodies fail.  `mpm_dolfinx.materials.user_functions`
describes user-defined terms in UFL.

Units are SI units, or other consistent units (see `Fluid`).  Stress is positive in tension, and pore pressure is
positive in compression.  In plane strain, forces refer to a thickness of 1 m.  In axisymmetry, forces refer to the full
circumference.
"""

from mpm_dolfinx.base import _environment  # noqa: F401 - first: it reports missing dependencies
from mpm_dolfinx.base.errors import LeftGrid, NotConverged, Report
from mpm_dolfinx.bodies.bodies import Body, Later, Moving, mapped
from mpm_dolfinx.bodies.boxes import box, shape
from mpm_dolfinx.bodies.mesh_files import from_mesh
from mpm_dolfinx.bodies.meshes import MeshBody
from mpm_dolfinx.bodies.polygon import polygon
from mpm_dolfinx.conditions.acting import Acting, Loads
from mpm_dolfinx.conditions.conditions import (
    Displacement,
    Drained,
    Inflow,
    OnSide,
    Pressure,
    Quiet,
    Rain,
    RigidPlate,
    Source,
    Through,
    Tied,
    Traction,
)
from mpm_dolfinx.conditions.jumps import Stepwise
from mpm_dolfinx.conditions.record import Record
from mpm_dolfinx.conditions.water import water
from mpm_dolfinx.contact.groups import Contact
from mpm_dolfinx.contact.shapes import Ball, Cone, Convex, HalfSpace, Shape
from mpm_dolfinx.contact.surface_mesh import SurfaceMesh
from mpm_dolfinx.contact.tool import Pose, Tool
from mpm_dolfinx.flow.feeding import Feeding, Feeds, Leaving
from mpm_dolfinx.grid.grid import Grid
from mpm_dolfinx.grid.lines import graded
from mpm_dolfinx.io.checkpoint import Checkpoint, resume
from mpm_dolfinx.io.one_file import one_file
from mpm_dolfinx.io.plots import plot
from mpm_dolfinx.io.writer import Writer
from mpm_dolfinx.materials.cam_clay import BarcelonaBasic, ModifiedCamClay
from mpm_dolfinx.materials.drucker_prager import DruckerPrager
from mpm_dolfinx.materials.initial_stress import K0, hydrostatic
from mpm_dolfinx.materials.mohr_coulomb import MohrCoulomb
from mpm_dolfinx.materials.skeleton import (
    Field,
    Fluid,
    Hencky,
    LinearElastic,
    NeoHookean,
    Skeleton,
    kozeny_carman,
    unsaturated,
)
from mpm_dolfinx.materials.softening import SofteningDruckerPrager
from mpm_dolfinx.parallel.messages import ConditionWarning, ResolutionWarning, ResultWarning, set_log_level
from mpm_dolfinx.points.material_points import MaterialPoints
from mpm_dolfinx.pores.retention import BrooksCorey, Gardner, Retention, VanGenuchten
from mpm_dolfinx.probing.cell_fields import CellFields
from mpm_dolfinx.probing.point_fields import PointFields
from mpm_dolfinx.probing.probes import Probes, probes
from mpm_dolfinx.simulation.simulation import Simulation
from mpm_dolfinx.simulation.step_size import Adaptive
from mpm_dolfinx.simulation.strength_reduction import Safety, factor_of_safety
from mpm_dolfinx.simulation.tangent import Tangent
from mpm_dolfinx.solve.numerics import Numerics
from mpm_dolfinx.solve.scheme import COUPLINGS, Scheme
from mpm_dolfinx.stepping.result import GaveUp, Result
from mpm_dolfinx.stepping.state import State
from mpm_dolfinx.verification.element_test import ElementTest, element_test

__version__ = "0.1.0"
__all__ = [
    "COUPLINGS",
    "K0",
    "Acting",
    "Adaptive",
    "Ball",
    "BarcelonaBasic",
    "Body",
    "BrooksCorey",
    "CellFields",
    "Checkpoint",
    "ConditionWarning",
    "Cone",
    "Contact",
    "Convex",
    "Displacement",
    "Drained",
    "DruckerPrager",
    "ElementTest",
    "Feeding",
    "Feeds",
    "Field",
    "Fluid",
    "Gardner",
    "GaveUp",
    "Grid",
    "HalfSpace",
    "Hencky",
    "Inflow",
    "Later",
    "Leaving",
    "LeftGrid",
    "LinearElastic",
    "Loads",
    "MaterialPoints",
    "MeshBody",
    "ModifiedCamClay",
    "MohrCoulomb",
    "Moving",
    "NeoHookean",
    "NotConverged",
    "Numerics",
    "OnSide",
    "PointFields",
    "Pose",
    "Pressure",
    "Probes",
    "Quiet",
    "Rain",
    "Record",
    "Report",
    "ResolutionWarning",
    "Result",
    "ResultWarning",
    "Retention",
    "RigidPlate",
    "Safety",
    "Scheme",
    "Shape",
    "Simulation",
    "Skeleton",
    "SofteningDruckerPrager",
    "Source",
    "State",
    "Stepwise",
    "SurfaceMesh",
    "Tangent",
    "Through",
    "Tied",
    "Tool",
    "Traction",
    "VanGenuchten",
    "Writer",
    "box",
    "element_test",
    "factor_of_safety",
    "from_mesh",
    "graded",
    "hydrostatic",
    "kozeny_carman",
    "mapped",
    "one_file",
    "plot",
    "polygon",
    "probes",
    "resume",
    "set_log_level",
    "shape",
    "unsaturated",
    "water",
]
