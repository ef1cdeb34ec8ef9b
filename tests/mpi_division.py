# SPDX-License-Identifier: MIT
"""Press wet soil with a disc and a load while the finest cells move, on any number of processes; write the state."""

import sys

import numpy as np
from helpers import gathered

import mpm_dolfinx as mpm

SOIL = mpm.Hencky(2e6, 1e6, porosity=0.4, conductivity=1e-6)
GRAVITY = (2.0, -9.81)


def fine_about(low, high, count, middle, width=0.15, times=6):
    """Return lines from low to high, with cells at `middle` that are `times` + 1 times finer than cells far away."""
    x = np.linspace(low, high, 1601)
    density = 1 + times * np.exp(-(((x - middle) / width) ** 2))
    share = np.append(0.0, np.cumsum((density[1:] + density[:-1]) / 2))
    return np.interp(np.linspace(0, 1, count + 1), share / share[-1], x)


DISC = mpm.Tool(mpm.Ball((1.0, 1.25), 0.25), lambda t: (0.001 * t, -0.002 * t), friction=0.3)


def pressed(loaded=True, soil=SOIL, disc=DISC, axisymmetric=False):
    """Return a block under a sinking disc and under a load, with fine cells that move to the right and back."""
    y = fine_about(0, 1.2, 9, 0.9, 0.2, 2)
    lines = lambda t: [fine_about(0, 2, 18, 0.4 + 1.2 * np.sin(2 * t) ** 2), y]  # noqa: E731
    grid = mpm.Grid(lines=lines(0), follow=lines, axisymmetric=axisymmetric)
    load = mpm.Pressure("top", lambda t, X: 1e4 * t * (X[:, 0] < 0.5), region=([0, 0], [0.7, 2]))
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    acting = {"conditions": [disc, mpm.Drained("top"), *[load] * loaded], "fluid": mpm.Fluid()}
    acting["gravity"] = GRAVITY if not axisymmetric else (0, -9.81)
    numerics = mpm.Numerics(renewal=True, tolerance=1e-11)
    return mpm.Simulation(grid, [mpm.box(grid, [0, 0], [2, 1])], [soil], walls=walls, numerics=numerics, **acting)


def pressed_in_3d():
    """Return a block under a sinking rough ball, with fine cells that move to the right and back."""
    others = np.linspace(0, 0.9, 4), fine_about(0, 1.1, 5, 0.8, 0.2, 2)
    lines = lambda t: [fine_about(0, 2, 8, 0.4 + 1.2 * np.sin(2 * t) ** 2, 0.2), *others]  # noqa: E731
    grid = mpm.Grid(lines=lines(0), follow=lines)
    ball = mpm.Tool(mpm.Ball((1.05, 0.45, 1.3), 0.3), lambda t: (0.001 * t, 0, -0.004 * t), friction=0.3)
    walls = {"left": "x", "right": "x", "front": "y", "back": "y", "bottom": "xyz"}
    acting = {"conditions": [ball, mpm.Drained("top")], "fluid": mpm.Fluid(), "gravity": (2.0, 0.5, -9.81)}
    numerics, block = mpm.Numerics(renewal=True, tolerance=1e-11), mpm.box(grid, [0, 0, 0], [2, 0.9, 1.0])
    return mpm.Simulation(grid, [block], [SOIL], walls=walls, numerics=numerics, **acting)


if __name__ == "__main__":
    simulation, solid = pressed(), pressed_in_3d()
    result, other = (s.run(1.0, 0.5, progress=False) for s in (simulation, solid))
    state, in_3d = gathered(simulation), gathered(solid)
    if state:
        in_3d = {f"{name} in 3D": rows for name, rows in in_3d.items() if name != "counts"}
        balance, renewed = max(result.balance, other.balance), [result.renewed, other.renewed]
        np.savez(sys.argv[1], **state, **in_3d, balance=balance, renewed=renewed)
