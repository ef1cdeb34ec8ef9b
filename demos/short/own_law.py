# SPDX-License-Identifier: MIT
"""Your own constitutive law in UFL: a tissue that stiffens exponentially is compressed by a tenth."""

from dataclasses import dataclass

import ufl

import mpm_dolfinx as mpm


@dataclass(frozen=True)
class Fung(mpm.NeoHookean):
    stiffening: mpm.Field = 0.0  # a new constant of the law, -

    @staticmethod
    def energy(F, shear, stiffening):  # Pa; F: deformation gradient; the stress is the derivative of the energy
        E = (F.T * F - ufl.Identity(2)) / 2
        return shear / stiffening * (ufl.exp(stiffening * ufl.inner(E, E)) - 1)


grid = mpm.Grid(lower=[0, 0], upper=[1, 1.2], cells=[10, 12])  # m
block = mpm.box(grid, [0, 0], [1, 1])
tissue = Fung(bulk=1e4, shear=1e4, stiffening=20.0)
press = mpm.Displacement("top", lambda t: (0, -0.1 * t), "y", name="press")
walls = {"left": "x", "right": "x", "bottom": "y"}
simulation = mpm.Simulation(grid, [block], [tissue], walls=walls, conditions=[press])
simulation.run(t_end=1, dt=0.25)
print(f"force: {-simulation.reactions['press'][1]:.1f} N/m")
mpm.plot(simulation, "displacement").figure.savefig("own_law.png", bbox_inches="tight")
