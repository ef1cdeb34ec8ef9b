# SPDX-License-Identifier: MIT
"""The method step by step: first one particle domain, cut by the grid, and at the end a consolidating column.

Readers need to know FEniCSx, but not this package.  Each part prints its result and ends with an assertion.  The demo
runs on one process.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from petsc4py import PETSc

import numpy as np
import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.base import _compat
from mpm_dolfinx.forms.point_forms import FormPoints, PointForm
from mpm_dolfinx.forms.unknowns import Unknowns, matrix
from mpm_dolfinx.points.cutting import cut, volumes
from mpm_dolfinx.verification.exact import terzaghi_pressure

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--out", type=Path, default=Path("out/tutorial"), help="folder for the picture")
out = parser.parse_known_args()[0].out  # a notebook has other options

# 1. A domain, cut by the grid.
#
# The grid is a box of equal cells, a dolfinx mesh.  A material point represents a quadrilateral, its domain.  The
# package tracks the corners of the domain, in the order (0, 0), (1, 0), (0, 1), (1, 1): 0 is the lower end and 1 the
# upper end along each axis.

grid = mpm.Grid(lower=[0, 0], upper=[0.4, 1.2], cells=[4, 12])
domain = np.array([[[0.07, 0.22], [0.25, 0.26], [0.04, 0.36], [0.25, 0.46]]])
pieces = cut(grid, domain)
print(f"1. a domain of {volumes(domain)[0]:.5f} m^2 has {len(pieces.cell)} pieces; their fractions add up to one")
assert abs(pieces.fraction.sum() - 1) < 1e-14

# 2. A form over this domain.
#
# Each piece is integrated at its centroid.  A Q1 function equals its Taylor polynomial about the midpoint of its cell.
# The value of the function at the centroid is therefore an expression in UFL, with the offset from the midpoint as a
# DG0 coefficient.  The list of integration entities contains a cell once for each of its pieces, and each piece has its
# own coefficients.  `points.value`, `points.grad` and `points.dx` hide these details.  Linear functions are integrated
# exactly for any cut.

points = FormPoints(grid)
cells = grid.locals[grid.number(grid.index(pieces.x))]
data = points.at(cells, pieces.x, pieces.fraction * volumes(domain)[pieces.point])

V = _compat.function_space(grid.mesh, "Lagrange", 1)
w, one = fem.Function(V), ufl.TestFunction(_compat.function_space(grid.mesh, "DG", 0))
w.interpolate(lambda x: 1 + 2 * x[0] - 3 * x[1])
per_cell = np.zeros(grid.num_owned)
PointForm(points.value(w) * one * points.dx, points).assemble_vector(per_cell, data)
centroid = pieces.fraction @ pieces.x
exact = volumes(domain)[0] * (1 + 2 * centroid[0] - 3 * centroid[1])
print(f"2. the integral of 1 + 2 x - 3 y over the domain is {per_cell.sum():.8f}, exact {exact:.8f}")
assert abs(per_cell.sum() - exact) < 1e-15

# 3. The balance of momentum, by hand.
#
# A soft column of 0.4 m x 0.95 m stands on the floor between smooth walls and settles under its weight.  Its top lies
# in the middle of a cell: a body need not fit the grid.  The energy of the step is the energy of the skeleton
# minus the work of the weight.  UFL derives residual and tangent.

BULK, SHEAR, WEIGHT = 1e5, 6e4, 1e4  # Pa, Pa, N/m^3
corners = mpm.box(grid, [0, 0], [0.4, 0.95], per_cell=2).corners()
pieces, volume = cut(grid, corners), volumes(corners)
cells = grid.locals[grid.number(grid.index(pieces.x))]

points = FormPoints(grid, F=(2, 2))
u = fem.Function(_compat.function_space(grid.mesh, "Lagrange", 1, (2,)))
F = (ufl.Identity(2) + points.grad(u)) * points.F
energy = mpm.NeoHookean.energy(F, BULK, SHEAR) / ufl.det(points.F) * points.dx
energy -= ufl.dot(points.value(u), ufl.as_vector((0, -WEIGHT))) * points.dx
residual = ufl.derivative(energy, u)
residual_form, tangent_form = (PointForm(form, points) for form in (residual, ufl.derivative(residual, u)))

F_n = np.tile(np.eye(2), (len(corners), 1, 1))
data = points.at(cells, pieces.x, pieces.fraction * volume[pieces.point], F=F_n[pieces.point])

# Nodes without soil in their cells have no equation, and walls fix displacement components of their nodes.  Newton's
# method solves the other equations.

active = np.zeros(len(grid.node_x), dtype=bool)
active[grid.cell_nodes[cells]] = True
free = np.stack([active & ~grid.wall_nodes("left") & ~grid.wall_nodes("right"), active & ~grid.wall_nodes("bottom")], 1)
unknowns = Unknowns(u, np.flatnonzero(free))
for iteration in range(8):
    b, K = np.zeros_like(u.x.array), matrix(unknowns, unknowns, 18)
    residual_form.assemble_vector(b, data)
    tangent_form.assemble_matrix(K, data)
    K.assemble()
    size = np.abs(b[free.reshape(-1)]).max()
    print(f"3. Newton step {iteration}: the largest unbalanced nodal force is {size:.1e} N")
    if size < 1e-8:
        break
    solver = PETSc.KSP().create()
    solver.setOperators(K)
    solver.setType("preonly")
    solver.getPC().setType("lu")
    rhs, change = unknowns.gather(b, unknowns.vector()), unknowns.vector()
    solver.solve(rhs, change)
    unknowns.add(u.x, -1.0, change)
assert size < 1e-8

# 4. The points move, and the grid is reset.
#
# Corners move by the displacement u of the grid.  F is multiplied by 1 + grad u, here with the mean gradient over the
# pieces of each domain.  Then u is set to zero, and the next step starts on the undeformed grid.

nodal, x = u.x.array.reshape(-1, 2), corners.reshape(-1, 2)
at = grid.locals[grid.number(grid.index(x))]
moved = corners + np.einsum("nk,nka->na", grid.shape_values(at, x), nodal[grid.cell_nodes[at]]).reshape(corners.shape)
gradient = np.einsum("mka,mkb->mab", nodal[grid.cell_nodes[cells]], grid.shape_gradients(cells, pieces.x))
Delta = np.tile(np.eye(2), (len(corners), 1, 1))
np.add.at(Delta, pieces.point, pieces.fraction[:, None, None] * gradient)
F_n = Delta @ F_n
u.x.array[:] = 0.0
settlement = corners[:, :, 1].max() - moved[:, :, 1].max()
apart = np.abs(np.linalg.det(F_n) * volume / volumes(moved) - 1).max()
print(f"4. the column has sunk by {settlement:.5f} m; det F and the volume ratio of the corners differ by {apart:.0e}")
assert apart < 1e-3

# 5. The same column, computed by the package.
#
# The package also moves corners by second differences of u, and computes F from the corners.  The package also treats
# nearly empty cells, locking, surfaces, water, time integration and several processes.

soil = mpm.NeoHookean(bulk=BULK, shear=SHEAR, porosity=0.5, grain_density=WEIGHT / 9.81 / 0.5)  # dry
column = mpm.box(grid, [0, 0], [0.4, 0.95], per_cell=2)
walls = {"left": "x", "right": "x", "bottom": "y"}
simulation = mpm.Simulation(grid, [column], [soil], walls=walls, gravity=(0, -9.81))
result = simulation.run(t_end=1, dt=1, probes=mpm.probes([column], [[0.2, 0.95]]))
print(f"5. the package: {-result.displacement[-1][0, 1]:.5f} m")
assert abs(-result.displacement[-1][0, 1] / settlement - 1) < 5e-3

# 6. With water: Terzaghi's column, loaded at once, drained at its top.

height, load = 1.0, 100.0
soil = mpm.LinearElastic(bulk=1e7 / 3, shear=5e6, conductivity=1e-4)
water = mpm.Fluid(bulk=np.inf)
consolidation = soil.conductivity / water.unit_weight * soil.oedometric / height**2  # T_v after one second
grid = mpm.Grid([0, 0], [0.05, height], [1, 20])
column = mpm.box(grid, [0, 0], [0.05, height])
simulation = mpm.Simulation(
    grid,
    [column],
    [soil],
    fluid=water,
    walls=walls,
    conditions=[mpm.Traction("top", (0, -load)), mpm.Drained("top")],
)
simulation.run(t_end=0.1 / consolidation, rtol=1e-3)
held = simulation.cells()
error = np.abs(held.pressure / load - terzaghi_pressure(1 - held.x[:, 1], 0.1, 1.0, 1.0)).max()
print(f"6. Terzaghi's pressures at T_v = 0.1, in {simulation.result.steps} steps: error {error:.2%} of the load")
assert error < 5e-3

# The picture: the cut domain of part 1.

import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.patches import Polygon  # noqa: E402

pieces = cut(mpm.Grid(lower=[0, 0], upper=[0.4, 1.2], cells=[4, 12]), domain)
figure, ax = plt.subplots(figsize=(6, 4.2), layout="constrained")
ax.add_patch(Polygon(domain[0][[0, 1, 3, 2]], facecolor="#cce3f0", edgecolor="black"))
for x, share in zip(pieces.x, pieces.fraction, strict=True):
    ax.plot(*x, "o", color="#D55E00", ms=4 + 16 * share**0.5)
    ax.annotate(f"{share:.0%}", x, xytext=(9, 5), textcoords="offset points", fontsize=9)
ax.plot(*domain[0].T, "s", color="black", ms=5, label="corners of the particle domain")
ax.plot([], [], "o", color="#D55E00", label="centroids of its parts, with fractions of the volume")
ax.set(xlim=(0, 0.3), ylim=(0.2, 0.5), aspect="equal", xlabel="x (m)", ylabel="y (m)")
ax.set_xticks(np.arange(4) / 10)
ax.set_yticks([0.2, 0.3, 0.4, 0.5])
ax.grid(color="0.4", lw=1)
ax.set_axisbelow(False)
ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.01), fontsize=9)
out.mkdir(parents=True, exist_ok=True)
figure.savefig(out / "cut_domain.png", dpi=130)
print(f"picture: {out}/cut_domain.png")
