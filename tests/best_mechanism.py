# SPDX-License-Identifier: MIT
"""Largest active thrust of Q1 velocities on a wall that slides away above a rough floor.

A linear program finds these velocities (kinematic theorem of limit analysis). At the quadrature points, sand with the
friction angle phi dilates by at least sin(phi) times its shear rate. The pressures on the wall, one for each cell, are
multipliers of the program. The sand does not slip on the floor. The program has no steps and no elasticity, so the
error of the thrust is due to the velocities alone.

    python -m tests.best_mechanism --cells 10 20
"""

import argparse

import numpy as np
import scipy.sparse as sparse
from scipy.optimize import linprog

PHI = np.radians(30.0)
SIDES = 24  # of the polygon that replaces the circle of shear rates: they are too small by at most 0.9 %
LENGTH = 1.5  # of the sand / height of the wall


def shapes(x, nodes):
    """Return linear shape functions (m, nodes) at positions x (m,), and their derivatives. Nodes are 1 apart."""
    off = x[:, None] - nodes
    inside = np.abs(off) < 1
    return inside * (1 - np.abs(off)), inside * -np.sign(off)


def means(x):
    """Return the matrix (cells, m) of the means over positions x (m,) in each cell. Cells end at half-integers."""
    cell = np.floor(x + 0.5).astype(int)
    out = (cell == np.unique(cell)[:, None]).astype(float)
    return out / out.sum(axis=1, keepdims=True)


def thrust(cells, share, free=0):
    """Return the error of the thrust on a wall, with `cells` cells over the height of the wall.

    Wall and floor lie in the middle of cells. Laws use the fraction `share` of the gradient's deviation from the cell
    mean. The floor is smooth in the first `free` cells.
    """
    at = [np.arange(0.25, cells * length, 0.5) for length in (LENGTH, 1)]
    nodes = [np.arange(-0.5, cells * length + 1) for length in (LENGTH, 1)]
    mean = [means(x) for x in at]
    middles = [(m > 0).T @ (m @ x) for m, x in zip(mean, at, strict=True)]
    places = [c + share * (x - c) for x, c in zip(at, middles, strict=True)]
    (Nx, Dx), (Ny, Dy) = (shapes(x, k) for x, k in zip(places, nodes, strict=True))
    along, across = sparse.kron(Dx, Ny), sparse.kron(Nx, Dy)
    volume = sparse.hstack([along, across])
    turns = 2 * np.pi * np.arange(SIDES) / SIDES
    stretch, shear = sparse.hstack([along, -across]), sparse.hstack([across, along])
    flow = [np.sin(PHI) * (np.cos(a) * stretch + np.sin(a) * shear) - volume for a in turns]
    over, up = (m @ shapes(x, k)[0] for m, x, k in zip(mean, at, nodes, strict=True))
    bottom, top = (shapes(np.array([y]), nodes[1])[0] for y in (0.0, float(cells)))
    floor = sparse.kron(over, bottom)
    left, right = (sparse.kron(shapes(np.array([x]), nodes[0])[0], up) for x in (0.0, cells * LENGTH))
    limits = sparse.vstack([*flow, sparse.hstack([0 * floor, -floor]), sparse.hstack([-left, 0 * left])])
    most = np.append(np.zeros(limits.shape[0] - len(up)), np.ones(len(up)))
    held = sparse.vstack([floor.tocsr()[free:], right])
    held = sparse.hstack([held, 0 * held])
    sinks = np.kron(shapes(at[0], nodes[0])[0].sum(axis=0) / 2, top[0])
    sinks = np.append(0 * sinks, sinks)
    found = linprog(sinks, limits, most, held, np.zeros(held.shape[0]), (None, None), method="highs-ipm")
    exact = (1 - np.sin(PHI)) / (1 + np.sin(PHI))
    return -found.fun / cells / exact - 1


def main():
    """Print the errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="*", default=[10, 20])
    for cells in parser.parse_args().cells:
        for share in (1.0, 0.5, 0.0):
            errors = ", ".join(f"{thrust(cells, share, free):+.1%}" for free in (0, 1, 2))
            print(f"{cells} cells, share {share:g}: error {errors} if the floor is smooth in 0, 1, 2 cells", flush=True)


if __name__ == "__main__":
    main()
