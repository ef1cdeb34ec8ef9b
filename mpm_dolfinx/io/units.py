# SPDX-License-Identifier: MIT
"""What the files of a run hold, and its units: a text that lies beside them."""

from __future__ import annotations

FIELDS = {
    "points.pvd: the domains of the material points": {
        "id, material": "number of the point; index of its material",
        "displacement": "m, since the start, or since a stage reset it",
        "F, J": "-, deformation gradient, by components F_xy in plane strain; its determinant, the volume ratio",
        "pressure": "Pa, pore pressure, positive in compression",
        "effective_stress": "Pa, Cauchy stress of the skeleton, tension positive; zz: across the plane, or along hoops",
        "stress": "Pa, Cauchy stress of skeleton and fluid together",
        "mean_effective_stress": "Pa, p' = -(xx + yy + zz) / 3, positive in compression",
        "deviatoric_stress": "Pa, q = sqrt(3/2 s : s), s the deviator of the stress",
        "porosity": "-, present volume fraction of the pores",
        "saturation": "-, share of the pores that is full of water, of soil that drains under suction",
        "owed, due": "-, volume that the fluid has yet to fill, over that at rest; what of it the next step takes in",
        "softness": "-, elastic over present shear stiffness where a law yields, 1 to 100",
        "tool_pressure, tool_shear": "Pa, pressure and shear traction of the tool `tool` on the surface of the domain",
        "others": "state of the law (see its documentation), constants that differ from point to point, the user's own",
    },
    "tools.pvd: what tools fill of the grid's cells": {
        "tool": "number of the tool",
        "force": "N, in plane strain N/m, by which it acts on the bodies",
    },
    "grid.pvd: what the cells hold": {
        "fill": "-, filled share of the cell",
        "x": "m, centroid of what it holds, by components",
        "step_displacement": "m, of the nodes in the last step",
    },
    "history.csv: a row an output time": {
        "t, wall": "s, time of the scene, and of the clock so far",
        "steps, newton, coupling, cuts, rederived": "numbers so far: steps, iterations, steps cut, domains mended",
        "balance, residual": "-, worst relative error so far of the fluid's balance, and of the two problems",
        "p_min, p_max": "Pa, least and largest pore pressure of the material points",
        "x_0, y_0, z_0": "m, present position of probe 0; and so on for the others",
        "ux_0, uy_0, uz_0": "m, its displacement",
        "p_0": "Pa, pore pressure there",
        "sxx_0, syy_0, szz_0, sxy_0, sxz_0, syz_0": "Pa, effective stress there, tension positive",
        "reaction_x_NAME, _y_, _z_": "N, in plane strain N/m, force of the given displacement NAME on the bodies",
        "wall_reaction_x_WALL, _y_, _z_": "N, in plane strain N/m, force of a wall of the grid on the bodies",
        "tool_force_x_NAME, _y_, _z_": "N, in plane strain N/m, force of the tool or contact NAME on the bodies",
        "tool_force_moment_NAME": "N, plane strain: moment about its centre for each m; in 3D _x, _y, _z, N m",
        "tool_travel_NAME": "m, how far a load has pushed the tool NAME; of a free one _x, _y, _z",
        "tool_velocity_x_NAME, _y_, _z_": "m/s, velocity of the free tool NAME",
        "energy_NAME": "J, in plane strain J/m, see `Result.energies`",
        "outflow_NAME": "m^3/s, in plane strain m^2/s, what leaves through the open side NAME",
    },
}
"""Names, units and meaning of what is written, by file."""


def text() -> str:
    """Return the table as text."""
    out = []
    for file, rows in FIELDS.items():
        width = max(map(len, rows))
        out += [file, *(f"  {name:{width}}  {meaning}" for name, meaning in rows.items()), ""]
    return "\n".join(out)


def unit(name: str) -> str:
    """Return the unit of a field of points, or of a component of one; none where it is not known."""
    for names, meaning in FIELDS["points.pvd: the domains of the material points"].items():
        for each in names.split(", "):
            if each not in ("id", "material", "others") and (name == each or name.startswith(f"{each}_")):
                return meaning.split(",")[0]
    return ""
