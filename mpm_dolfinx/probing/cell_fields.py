# SPDX-License-Identifier: MIT
"""Fields of the cells at the present time: centroids, displacements, pressures and stresses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.fluid_content import mass_potential
from mpm_dolfinx.grid.grid import means_of_rows
from mpm_dolfinx.stepping.scene import Scene
from mpm_dolfinx.stepping.state import State


@dataclass(frozen=True)
class CellFields:
    """Fields of the n cells of this process that contain material.

    Means are volume averages over the material in a cell.  They approximate values at its centroid `x` to second order.
    If grid lines move, cells refer to the lines of the next step.

    Attributes
    ----------
    cell : (n,)
        Local index of the cell in the grid's mesh.
    x : (n, d), m
        Centroid of the material in the cell.
    volume : (n,), m^d
        Volume of the material in the cell.
    displacement : (n, d), m
        Mean displacement since the start, or since a stage that reset all displacements.
    effective_stress, stress : (n, d, d), in axisymmetry (n, 3, 3), Pa
        Mean effective Cauchy stress and mean total Cauchy stress, positive in tension.
    pressure : (n,), Pa
        Pore pressure, positive in compression; None without fluid.
    water : (n,), m^d
        Volume that the pore fluid would have at zero pressure, minus the volume defect of the points.  None without
        fluid.
    """

    cell: NDArray[np.int64]
    x: NDArray[np.float64]
    volume: NDArray[np.float64]
    displacement: NDArray[np.float64]
    effective_stress: NDArray[np.float64]
    stress: NDArray[np.float64]
    pressure: NDArray[np.float64] | None
    water: NDArray[np.float64] | None


def cell_fields(scene: Scene, state: State) -> CellFields:
    """Return the fields of the cells in a state.  All processes must call this function."""
    scene.rests_at(state.stage, state.t)
    state = scene.followed(state)
    state = state if state.stays else state.at_owners(scene.grid)
    points = state.points
    on_grid = scene.on_grid(state.as_cut)  # cached for the next step
    cut, places = on_grid.cut, on_grid.data.pieces.places
    weight = cut.shares(points.volume0 * points.J)
    volume = places.total(weight)

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the volume-weighted mean, in each cell, of the values of its pieces."""
        return means_of_rows(places.slots, weight, values, len(volume))

    effective = mean(cut.to_cells(scene.materials.effective_stress(points)))
    moved = mean(cut.pieces_to_cells(cut.total_displacement(points)))
    stress = effective
    pressure = None
    water = None
    if scene.fluid is not None:
        pressure = on_grid.pressures(state)
        share = cut.to_cells(scene.materials.table(points, lambda m: m.biot))
        store, pores = (cut.to_cells(values(points)) for values in (scene.materials.storage, scene.materials.porosity))
        volumes = pores + store * mass_potential(pressure, scene.fluid.bulk)[places.slots]
        if scene.materials.retentions is not None:
            at = cut.to_pieces(pressure[places.slots] + on_grid.heads)
            full, _, chi, _ = scene.materials.saturation(points, at, cut.pieces.point)
            share, full = share * cut.pieces_to_cells(chi), cut.pieces_to_cells(full)
            volumes -= (1 - full) * pores * np.exp(pressure / scene.fluid.bulk)[places.slots]
        defect = cut.to_cells(points.data["owed"] / points.J)
        water = places.total(weight * (volumes - defect))
        stress = effective - (mean(share) * pressure)[:, None, None] * np.eye(scene.grid.stretches)
    x = mean(cut.x) + cut.grid.base
    return CellFields(places.filled, x, volume, moved, effective, stress, pressure, water)
