# SPDX-License-Identifier: MIT
"""Pictures of a scene: the particle domains, coloured by a field."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.base.validation import flag, instance, line
from mpm_dolfinx.io.units import unit
from mpm_dolfinx.io.writer import VTK_CELLS, fields_of_points
from mpm_dolfinx.parallel.exchange import to_root
from mpm_dolfinx.simulation.simulation import Simulation


def plot(simulation: Simulation, field: str = "pressure", ax=None, *, bar: bool = True, label: str = "", **style):
    """Draw the particle domains, coloured by a field, and return the axes of matplotlib.

    All processes must call this function.  Only the first process draws the picture, and all others return None.

    Parameters
    ----------
    simulation
        A scene in plane strain or axisymmetry.
    field
        Name of the field, for example "pressure", "displacement" (the magnitude), "displacement_x", "stress_xx",
        "effective_stress_xy", "mean_effective_stress", "deviatoric_stress", "porosity" or "J".  In unsaturated soil
        "saturation" and "suction" are fields too.  Any scalar in `points.pvd` or `points.data` is a field.
    ax
        Axes for the picture; by default new axes.
    bar
        Whether to draw a colour bar.
    label
        Label of the colour bar; by default the name and the unit of the field.
    **style
        Arguments of matplotlib's PolyCollection, such as cmap and clim.

    Raises
    ------
    ValueError
        The scene is in 3D, or the field is unknown.  The message lists all fields.
    ImportError
        matplotlib is not installed.
    """
    instance("plot: simulation", simulation, Simulation)
    flag("plot: bar", bar)
    if simulation.grid.dim == 3:
        raise ValueError("plot: a scene in 3D, must be in plane strain or axisymmetry; for ParaView use `Writer`")
    values, points, comm = _values(simulation, field), simulation.points, simulation.grid.comm
    send = to_root(comm, len(points)).send
    corners, values = send(points.corners), send(values)
    if comm.rank:
        return None
    try:
        import matplotlib.pyplot as plt
        from matplotlib.collections import PolyCollection
    except ImportError as error:
        what = f"plot: {error}; must be installed: apt-get install python3-matplotlib, or conda-forge's matplotlib"
        raise ImportError(what) from error
    ax = plt.subplots()[1] if ax is None else ax
    style = {"edgecolors": "face", "linewidth": 0.5} | style
    drawn = ax.add_collection(PolyCollection(corners[:, VTK_CELLS[2][1]], array=values, **style))
    ax.autoscale_view()
    radius = "r" if simulation.grid.axisymmetric else "x"
    ax.set(aspect="equal", xlabel=f"{radius} (m)", ylabel="y (m)")
    if bar:
        known = unit("pressure" if field == "suction" else field)
        label = label or field.replace("_", " ") + (f" ({known})" if known else "")
        cax = ax.inset_axes(bounds=(1.03, 0, 0.04, 1))  # as high as the axes, which may be flat
        if ax.figure.get_layout_engine() is None:  # all other layouts make room for the bar and its numbers
            ax.figure.subplots_adjust(right=min(ax.figure.subplotpars.right, 0.75))
        ax.figure.colorbar(drawn, cax=cax).ax.set_title(label, loc="right", fontsize="medium")
    return ax


def _values(simulation: Simulation, field: str) -> NDArray[np.float64]:
    """Return the values (n,) of a field at the points of this process."""
    points, fields = simulation.points, {}
    if str(field).startswith(("porosity", "saturation", "effective_", "stress", "mean_", "deviatoric_")):
        fields = fields_of_points(simulation)  # all processes call this
    known: dict[str, Callable[[], Any]] = {
        "displacement": lambda: np.linalg.norm(points.displacement, axis=1),
        "displacement_x": lambda: points.displacement[:, 0],
        "displacement_y": lambda: points.displacement[:, 1],
        "J": lambda: points.J,
    }
    if simulation.scene.fluid is not None:
        known["pressure"] = lambda: points.pressure
    if simulation.scene.materials.retentions is not None:
        known["suction"] = lambda: np.maximum(-points.pressure, 0.0)
    known |= {name: lambda rows=rows: rows for name, rows in {**points.data, **fields}.items() if rows.ndim == 1}
    if simulation.scene.fluid is None:  # the effective stress is the stress
        known |= {name.removeprefix("effective_"): known[name] for name in known if name.startswith("effective_")}
    if not isinstance(field, str) or field not in known:
        names = ", ".join(
            name for name in {**known, **(fields or fields_of_points(simulation))} if name not in points.INTERNAL
        )
        raise ValueError(f"plot: field = {line(field)}, must be one of {names}")
    return np.asarray(known[field](), dtype=np.float64)
