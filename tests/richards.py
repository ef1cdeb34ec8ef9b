# SPDX-License-Identifier: MIT
"""Independent solution of Richards' equation in a rigid column, in numpy: finite volumes and backward Euler."""

import numpy as np
from scipy.linalg import solve_banded

GROWS, LIMIT = 1.5, 20


def curves(h, soil):
    """Return water content and conductivity (m/s) at the heads h (m): van Genuchten and Mualem with an air entry."""
    alpha, n, air = (soil[name] for name in ("alpha", "n", "air_entry"))
    m, x, least = 1 - 1 / n, alpha * np.maximum(-h, air), alpha * air
    S = ((1 + x**n) / (1 + least**n)) ** -m
    wide = lambda x: x ** (n - 1) * (1 + x**n) ** -m  # noqa: E731
    k = soil["conductivity"] * S**0.5 * ((1 - wide(x)) / (1 - wide(least))) ** 2
    return soil["porosity"] * (soil["residual"] + (1 - soil["residual"]) * S), k


def infiltration(soil, height, head, periods, driest, cells=120, longest=400.0):
    """Return the water (m) that has entered through the top at the end of each period.  The base is closed.

    `head`: initial hydraulic head, m.  `periods`: pairs of end (s) and rate (m/s), negative for evaporation.
    `driest`: lowest head at the surface, m.  `longest`: longest step, s.
    """
    edges = height * (1 - np.linspace(1, 0, cells + 1) ** 2)  # finest at the top
    z, dz = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    colours, place = np.arange(cells) % 3, np.arange(cells)

    def through(h, outer):
        k = (curves(h[-1:], soil)[1][0] + curves(np.array([outer]), soil)[1][0]) / 2
        return k * ((outer - h[-1]) / (dz[-1] / 2) + 1)

    def balance(h, old, dt, rate):
        content, k = curves(h, soil)
        enters = max(min(rate, through(h, 0.0)), through(h, driest))
        up = np.concatenate([[0.0], -(k[1:] + k[:-1]) / 2 * (np.diff(h) / np.diff(z) + 1), [-enters]])
        return dz * (content - old) + dt * np.diff(up), enters

    def stepped(old, dt, rate):
        h, content = old, curves(old, soil)[0]
        for count in range(LIMIT):
            r, enters = balance(h, content, dt, rate)
            if np.abs(r).max() < 1e-11:
                return h, dt * enters, count
            eps = 1e-7 * (0.01 + np.abs(h))
            moved = np.stack([balance(h + eps * (colours == c), content, dt, rate)[0] - r for c in range(3)])
            J = np.zeros((3, cells))
            for off in (-1, 0, 1):
                j = place[(place + off >= 0) & (place + off < cells)]
                J[1 + off, j] = moved[colours[j], j + off] / eps[j]
            most = 0.05 + np.abs(h) / 2
            h = h - np.clip(solve_banded((1, 1), J, r), -most, most)
        return None, 0.0, LIMIT

    t, h, entered, out, dt = 0.0, head - z, 0.0, [], 1.0
    for end, rate in periods:
        dt = min(dt, 1.0)
        while t < end * (1 - 1e-12):
            step = min(dt, end - t, longest)
            new, more, count = stepped(h, step, rate)
            if new is None:
                dt = step / 3
                continue
            t, h, entered = t + step, new, entered + more
            dt = step * (GROWS if count < LIMIT // 3 else 1.0)
        out.append(entered)
    return np.array(out)
