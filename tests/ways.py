# SPDX-License-Identifier: MIT
"""Modules that a value passes, and arrays of the pressure: `python -m tests.ways` prints them for a small wet column.

A room is a module with a function that has the value among its arguments or results: as the condition, the number, or
an array of it, alone or in a list, tuple or dictionary. The sum of nodal forces is the traction's value, because the
column is 1 m wide. A home is an array that stores the pressures between two steps, of cells, pieces or points.
"""

import gc
import sys
from pathlib import Path
from types import FunctionType, ModuleType

import numpy as np
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.base.fluid_content import mass_potential
from mpm_dolfinx.forms.point_forms import Rows

ROOT = Path(mpm.__file__).parent
LOAD, PRESSURE = 1234.5678, 8765.4321  # Pa


class Followed:
    """Rooms of a value until the first matrices are assembled: modules, with their functions that have the value."""

    def __init__(self, known):
        self.known, self.rooms, self.over = known, {}, False

    def within(self, value) -> bool:
        inner = tuple(value.values()) if isinstance(value, dict) else value
        return self.known(inner) or (type(inner) in (list, tuple) and any(map(self.known, inner)))

    def __call__(self, frame, event, value):
        code, file = frame.f_code, frame.f_code.co_filename
        if event not in ("call", "return") or self.over or not file.startswith(str(ROOT)):
            return
        self.over = code.co_name == "linearise"
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        if any(map(self.within, [value] if event == "return" else map(frame.f_locals.get, names))):
            self.rooms.setdefault(str(Path(file).relative_to(ROOT)), {})[code.co_name] = None

    def during(self, action) -> dict[str, dict[str, None]]:
        """Return the rooms of the value during an action."""
        sys.setprofile(self)
        try:
            action()
        finally:
            sys.setprofile(None)
        return self.rooms


def column(pressure) -> mpm.Simulation:
    """Return a wet column under a traction."""
    grid = mpm.Grid([0, 0], [1, 1.3], [1, 5])
    soil = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-5)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    conditions = [mpm.Traction("top", (0, -LOAD)), mpm.Drained("top")]
    options = {"walls": walls, "conditions": conditions, "fluid": mpm.Fluid(), "pressure": pressure}
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 1])], [soil], **options)


def numbers(value) -> bool:
    """Return whether a value is a small, nonempty array of finite numbers."""
    return (
        isinstance(value, np.ndarray)
        and value.dtype == float
        and value.ndim > 0
        and value.size > 0
        and bool(np.isfinite(value).all())
    )


def is_load(value) -> bool:
    """Return whether a value is the traction, its number, an array of it, or an array of forces with this sum."""
    if isinstance(value, mpm.Traction) or (isinstance(value, float) and abs(value) == LOAD):
        return True
    return numbers(value) and bool((abs(value) == LOAD).any() or abs(abs(value.sum()) / LOAD - 1) < 1e-9)


def is_pressure(value) -> bool:
    """Return whether a value is the initial pressure, or an array of it."""
    return (
        value == PRESSURE
        if isinstance(value, float)
        else numbers(value) and bool((abs(value / PRESSURE - 1) < 1e-9).any())
    )


def rooms() -> dict[str, dict[str, dict[str, None]]]:
    """Return the rooms of a traction, from its creation on, and of an initial pressure."""
    loaded = Followed(is_load).during(lambda: column(0.0).step(1e-3))
    return {
        "a traction": loaded,
        "an initial pressure": Followed(is_pressure).during(lambda: column(PRESSURE).step(1e-3)),
    }


def homes() -> list[str]:
    """Return names and shapes of the arrays of pressures that a simulation stores between two steps."""
    s, seen = column(0.0), set()
    for _ in range(2):
        s.step(0.7)
        for p in (s.scene.storage.p.x.array, s.points.pressure):
            seen.update(p.tolist(), mass_potential(p, s.scene.fluid.bulk).tolist())
    found, done, queue = {}, set(), [(s, "simulation")]
    while queue:
        one, name = queue.pop(0)
        if id(one) in done or isinstance(one, type | ModuleType | FunctionType):
            continue
        done.add(id(one))
        array = one.x.array if isinstance(one, fem.Function) else one
        if not numbers(array):
            own = vars(one) if hasattr(one, "__dict__") and not isinstance(one, Rows) else {}
            queue += [(value, f"{name}.{key}") for key, value in own.items()]
            # buffers of kernels, which each assembly overwrites, are no homes
            queue += [] if own or isinstance(one, Rows) else [(value, name) for value in gc.get_referents(one)]
        elif any(np.isin(c[c != 0], list(seen)).all() and (c != 0).sum() > 3 for c in array.reshape(len(array), -1).T):
            found.setdefault(array.__array_interface__["data"][0], f"{name} {array.shape}")
    return list(found.values())


def measures() -> dict[str, list[str]]:
    """Return the rooms with their functions, and the homes."""
    each = {
        f"rooms of {name}": [f"{room}: {', '.join(functions)}" for room, functions in of.items()]
        for name, of in rooms().items()
    }
    return each | {"homes of the pressure": homes()}


def main(arguments: list[str]) -> None:
    """Print the numbers of rooms and homes. With --list, also print their names."""
    for name, found in measures().items():
        print(f"{len(found):4d}  {name}")
        if "--list" in arguments:
            print(*(f"      {one}" for one in found), sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
