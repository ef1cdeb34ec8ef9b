# SPDX-License-Identifier: MIT
"""A soft beam, alone or next to a separate body at rest, in motion, under load or during drainage."""

import numpy as np

import mpm_dolfinx as mpm

E = 1e3  # Pa, of the beam
THERE = ((2.0, -np.inf), (np.inf, np.inf))


def beside(
    kind: str | None, stiffer: float = 1.0, wet: bool = False, law=None, plate=False, **options
) -> mpm.Simulation:
    """Return the beam, with a second body of some kind, or alone.

    stiffer: modulus of the second body, divided by the modulus of the beam. law: law of the beam. plate: whether a
    rigid plate loads the beam.
    """
    grid = mpm.Grid([0, 0], [3.6, 1.2], [30, 10])
    soft, hard = (mpm.Hencky(bulk=f * E / 1.8, shear=f * E / 2.6, conductivity=1e-4) for f in (1, stiffer))
    bodies, materials = [mpm.box(grid, [0, 0.42], [1, 0.75])], [law or soft]
    at_beam = ((0.05, -np.inf), (1.01, np.inf))
    loads = [mpm.RigidPlate("top", lambda t: t, at_beam) if plate else mpm.Traction("top", lambda t: (0, -t), at_beam)]
    drained = [mpm.Drained("right", region=((-np.inf, -np.inf), (1.01, np.inf)))]
    if kind:
        bodies.append(mpm.box(grid, [2.52, 0.3], [3.0, 0.78], material=1))
        materials.append(hard)
        way = (lambda t, X: (0.1 * t, 0.05 * t)) if kind == "moves" else (0, 0)
        loads += [mpm.Displacement("bottom", way, region=THERE)]
    if kind in ("loaded", "drains"):
        loads.append(mpm.Traction("top", lambda t: (0, -0.05 * stiffer * E * t), region=THERE))
    if kind == "drains":
        drained.append(mpm.Drained("top", region=THERE))
    if wet:
        options.setdefault("fluid", mpm.Fluid())
        loads += drained
    return mpm.Simulation(grid, bodies, materials, walls={"left": "xy"}, conditions=loads, **options)
