# SPDX-License-Identifier: MIT
"""A body from a mesh of gmsh: a quarter of a thick-walled pipe under an inner pressure."""

import gmsh

import mpm_dolfinx as mpm

INNER, OUTER, PRESSURE = 0.5, 1.0, 1e4  # m, m, Pa
gmsh.initialize()
gmsh.option.setNumber("General.Verbosity", 0)
gmsh.option.setNumber("Mesh.RecombineAll", 1)  # quadrilaterals
gmsh.option.setNumber("Mesh.MeshSizeMax", 0.03)
shape = gmsh.model.geo
centre, *ends = (shape.addPoint(x, y, 0) for x, y in [(0, 0), (INNER, 0), (OUTER, 0), (0, OUTER), (0, INNER)])
inside = shape.addCircleArc(ends[3], centre, ends[0])
outside = shape.addCircleArc(ends[1], centre, ends[2])
edges = [inside, shape.addLine(ends[0], ends[1]), outside, shape.addLine(ends[2], ends[3])]
pipe = shape.addPlaneSurface([shape.addCurveLoop(edges)])
shape.synchronize()
gmsh.model.setPhysicalName(1, gmsh.model.addPhysicalGroup(1, [inside]), "inside")  # these names become names of sides
gmsh.model.addPhysicalGroup(2, [pipe])
gmsh.model.mesh.generate(2)
gmsh.write("pipe.msh")
gmsh.finalize()

grid = mpm.Grid(lower=[0, 0], upper=[1.1, 1.1], cells=[22, 22])  # m
body = mpm.from_mesh(grid, "pipe.msh")
rubber = mpm.LinearElastic(bulk=2e6, shear=1e6)
load = mpm.Pressure("inside", PRESSURE)
simulation = mpm.Simulation(grid, [body], [rubber], walls={"left": "x", "bottom": "y"}, conditions=[load])
result = simulation.run(t_end=1, dt=1, probes=mpm.probes([body], [[INNER, 0]]))
print(f"displacement of the inner wall: {1000 * result.displacement[-1, 0, 0]:.3f} mm")
mpm.plot(simulation, "stress_yy").figure.savefig("mesh_from_gmsh.png", bbox_inches="tight")
