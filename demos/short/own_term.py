# SPDX-License-Identifier: MIT
"""Your own term in UFL: the springs of a Winkler foundation support a raft under 30 kPa."""

import ufl

import mpm_dolfinx as mpm

STIFFNESS = 2e6  # N/m^3


def springs(points, u):  # energy of the springs; its derivative is added to the balance of momentum
    displacement = points.displacement + points.value(u)  # since the start, including this step
    return STIFFNESS / 2 * ufl.inner(displacement, displacement) * points.dx


grid = mpm.Grid(lower=[-1, -1], upper=[11, 2], cells=[24, 6])  # m
raft = mpm.box(grid, [0, 0], [10, 1])
concrete = mpm.LinearElastic(bulk=2e10, shear=1e10)
simulation = mpm.Simulation(
    grid,
    [raft],
    [concrete],
    walls={},
    conditions=[mpm.Traction("top", (0, -3e4))],
    terms=[mpm.OnSide("bottom", springs)],
)
result = simulation.run(t_end=1, dt=1, probes=mpm.probes([raft], [[5, 0]]))
print(f"settlement: {-1000 * result.displacement[-1, 0, 1]:.2f} mm")
