# SPDX-License-Identifier: MIT
"""Units and meaning of the fields in the output files."""

from __future__ import annotations

FIELDS = {
    "points.pvd: the domains of the material points": {
        "id, material": "identifier of the point; index of its material",
        "displacement": "m, since the start, or since the last reset by a stage",
        "F, J": "-, deformation gradient, by components F_xy in plane strain; its determinant, the volume ratio",
        "pressure": "Pa, pore pressure, positive in compression",
        "effective_stress": "Pa, Cauchy stress of the skeleton, tension positive; zz: out of plane, or circumferential",
        "stress": "Pa, Cauchy stress of skeleton and fluid together",
        "mean_effective_stress": "Pa, p' = -(xx + yy + zz) / 3, positive in compression",
        "deviatoric_stress": "Pa, q = sqrt(3/2 s : s), s the deviator of the stress",
        "porosity": "-, current volume fraction of the pores",
        "saturation": "-, volume fraction of water in the pores, of unsaturated soil",
        "owed, due": "-, volume defect divided by reference volume; the part of it that the next step corrects",
        "softness": "-, ratio of elastic to tangent shear modulus, where a law yields, 1 to 100",
        "tool_pressure, tool_shear": "Pa, contact pressure and shear of the tool `tool` on the surface of the domain",
        "others": "state of the law (see its documentation), constants that vary in space, data of the user",
    },
    "tools.pvd: the parts of the grid's cells inside the tools": {
        "tool": "index of the tool",
        "force": "N, in plane strain N/m, on the bodies",
    },
    "grid.pvd: the cells of the grid": {
        "fill": "-, volume fraction of the cell that bodies fill",
        "x": "m, centroid of the filled part, by components",
    },
    "history.csv: one row for each output time": {
        "t, wall": "s, time in the scene; wall time so far",
        "steps, newton, coupling": "numbers of steps, of Newton iterations and of coupling iterations so far",
        "cuts, reinitialised": "numbers of steps that had to be reduced, and of inverted domains re-initialised from F",
        "balance, residual": "-, largest relative error so far: of the fluid balance; of the equations",
        "p_min, p_max": "Pa, smallest and largest pore pressure of the material points",
        "x_0, y_0, z_0": "m, current position of probe 0; likewise for the other probes",
        "ux_0, uy_0, uz_0": "m, displacement of probe 0",
        "p_0": "Pa, pore pressure at probe 0",
        "sxx_0, syy_0, szz_0, sxy_0, sxz_0, syz_0": "Pa, effective stress at probe 0, tension positive",
        "reaction_x_NAME, _y_, _z_": "N, in plane strain N/m, force of the prescribed displacement NAME on the bodies",
        "wall_reaction_x_WALL, _y_, _z_": "N, in plane strain N/m, force of a wall of the grid on the bodies",
        "tool_force_x_NAME, _y_, _z_": "N, in plane strain N/m, force of the tool or contact NAME on the bodies",
        "tool_force_moment_NAME": "N m, in plane strain N, moment about the tool's centre; in 3D _x, _y, _z",
        "tool_travel_NAME": "m, displacement of the tool NAME under its load; of a free tool _x, _y, _z",
        "tool_velocity_x_NAME, _y_, _z_": "m/s, velocity of the free tool NAME",
        "tool_rotation_NAME": "rad, counterclockwise rotation of the free tool NAME, in 2D",
        "tool_spin_NAME": "rad/s, angular velocity of the free tool NAME, in 2D",
        "energy_NAME": "J, in plane strain J/m, see `Result.energies`",
        "outflow_NAME": "m^3/s, in plane strain m^2/s, outflow through the open side NAME",
    },
}
"""For each output file: the unit and the meaning of each field, or of each column."""


def text() -> str:
    """Return the table of fields and units as text."""
    out = []
    for file, rows in FIELDS.items():
        width = max(map(len, rows))
        out += [file, *(f"  {name:{width}}  {meaning}" for name, meaning in rows.items()), ""]
    return "\n".join(out)


def unit(name: str) -> str:
    """Return the unit of a field of the points, or an empty string if the field is unknown."""
    for names, meaning in FIELDS["points.pvd: the domains of the material points"].items():
        for each in names.split(", "):
            if each not in ("id", "material", "others") and (name == each or name.startswith(f"{each}_")):
                return meaning.split(",")[0]
    return ""
