# SPDX-License-Identifier: MIT
"""Histories of a run as tables: columns with names and units, pandas data frames, or xarray data sets."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

SYMMETRIC = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
"""Indices of the components of a symmetric tensor.  Tables in plane strain and axisymmetry omit xz and yz."""

Outcome = Mapping[str, Mapping[str, NDArray[np.float64]]]


class Histories(Protocol):
    """Results at one output time, or at all output times.  In the second case, arrays have the time as first axis."""

    t: Any
    displacement: NDArray[np.float64]
    pressure: NDArray[np.float64]
    position: NDArray[np.float64]
    probe_pressure: NDArray[np.float64]
    probe_stress: NDArray[np.float64]


def components(tensors: NDArray[np.float64], dim: int) -> dict[str, NDArray[np.float64]]:
    """Return the components of symmetric tensors (..., 3, 3) by name, in 2D without xz and yz."""
    return {name: tensors[..., i, j] for name, (i, j) in list(SYMMETRIC.items())[: 4 if dim == 2 else 6]}


def columns(of: Histories, outcome: Outcome) -> dict[str, tuple[Any, str]]:
    """Return a dictionary from the name of each column to its values and its unit."""
    dim, rank = of.displacement.shape[-1], np.ndim(of.t)
    out = {"t": (of.t, "s")}
    for k, name in enumerate(("p_min", "p_max")[: of.pressure.shape[-1]]):
        out[name] = of.pressure[..., k], "Pa"
    for i in range(of.displacement.shape[-2]):
        out |= {f"{axis}_{i}": (of.position[..., i, k], "m") for k, axis in enumerate("xyz"[:dim])}
        out |= {f"u{axis}_{i}": (of.displacement[..., i, k], "m") for k, axis in enumerate("xyz"[:dim])}
        if of.probe_pressure.shape[-1]:
            out[f"p_{i}"] = of.probe_pressure[..., i], "Pa"
        if of.probe_stress.shape[-3]:
            stress = components(of.probe_stress[..., i, :, :], dim)
            out |= {f"s{name}_{i}": (values, "Pa") for name, values in stress.items()}
    for quantity, names in outcome.items():
        for name, values in names.items():
            singular, values = quantity.removesuffix("s"), np.asarray(values)
            if values.ndim == rank:
                out[f"{singular}_{name}"] = values, unit_of(quantity, dim)
            else:
                axes = _axes(dim, values.shape[-1])
                units = [unit_of(quantity, dim, k >= dim) for k in range(len(axes))]
                out |= {f"{singular}{a}_{name}": (values[..., k], units[k]) for k, a in enumerate(axes)}
    return out


def _axes(dim: int, size: int) -> list[str]:
    """Return suffixes of column names for the components of a force, and for its moment if it has one."""
    axes = ["_x", "_y", "_z"][:dim]
    return axes + {0: [], 1: ["_moment"], 3: [f"_moment{axis}" for axis in axes]}[size - dim]


def unit_of(quantity: str, dim: int, moment: bool = False) -> str:
    """Return the unit of a quantity, or of its moments if `moment` is True; in plane strain per metre of depth."""
    units = {"tool_travel": "m", "tool_velocity": "m/s", "tool_rotation": "rad", "tool_spin": "rad/s"}
    units |= {"energy": "J"} | dict.fromkeys(("outflows", "rain", "runoff"), "m^3/s")
    units |= dict.fromkeys(("flowed", "rained", "ran_off", "ponded"), "m^3")
    units |= dict.fromkeys(("impulse", "wall_impulse"), "N m s" if moment else "N s")
    whole = units.get(quantity, "N m" if moment else "N")
    of_slice = {"N": "N/m", "N m": "N", "N s": "N s/m", "N m s": "N s", "m^3/s": "m^2/s", "m^3": "m^2", "J": "J/m"}
    return f"{of_slice[whole]}, in axisymmetry {whole}" if dim == 2 and whole in of_slice else whole


def data_frame(of: Histories, outcome: Outcome):
    """Return all histories as a pandas data frame, see `Result`."""
    found = columns(of, outcome)
    frame = _library("pandas").DataFrame({name: values for name, (values, _) in found.items()})
    frame.attrs["units"] = {name: unit for name, (_, unit) in found.items()}
    return frame


def data_set(of: Histories, outcome: Outcome, about: dict[str, Any]):
    """Return all histories as an xarray data set with the attributes `about`, see `Result`."""
    dim, out = of.displacement.shape[-1], {}
    axes = list("xyz"[:dim])
    out["displacement"] = ("time", "probe", "axis"), of.displacement, "m"
    out["position"] = ("time", "probe", "axis"), of.position, "m"
    for k, name in enumerate(("p_min", "p_max")[: of.pressure.shape[1]]):
        out[name] = "time", of.pressure[:, k], "Pa"
    if of.probe_pressure.shape[1]:
        out["probe_pressure"] = ("time", "probe"), of.probe_pressure, "Pa"
    if of.probe_stress.shape[1]:
        out["probe_stress"] = ("time", "probe", "row", "column"), of.probe_stress, "Pa"
    for quantity, names in outcome.items():
        for name, values in names.items():
            singular = f"{quantity.removesuffix('s')}_{name}"
            if values.ndim == 1:
                out[singular] = "time", values, unit_of(quantity, dim)
                continue
            out[singular] = ("time", "axis"), values[:, :dim], unit_of(quantity, dim)
            if values.shape[1] > dim:
                moments = ("time", values[:, dim]) if dim == 2 else (("time", "axis"), values[:, dim:])
                out[f"{singular}_moment"] = *moments, unit_of(quantity, dim, True)
    data = {name: (dims, values, {"units": unit}) for name, (dims, values, unit) in out.items()}
    coords = {"time": ("time", of.t, {"units": "s"}), "axis": axes, "probe": np.arange(of.displacement.shape[1])}
    if "probe_stress" in out:
        coords |= {"row": list("xyz"), "column": list("xyz")}
    return _library("xarray").Dataset(data, coords, about)


def _library(name: str) -> ModuleType:
    """Import an optional library, or raise ImportError with a message of one line."""
    try:
        return import_module(name)
    except ImportError as error:
        what = f"{name}: {error}; must be installed: apt-get install python3-{name}, or conda-forge's {name}"
        raise ImportError(what) from error
