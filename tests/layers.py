# SPDX-License-Identifier: MIT
"""Exact contact of elastic layers with a parabola: Hertz's theory for layers of finite thickness and width.

The layers are in plane strain between smooth walls. Pressures cos(k x), with k a multiple of pi / width, cause
proportional displacements of the surface (Johnson 1985, Contact Mechanics, 5.8). The contact is the region of positive
pressures.
"""

import numpy as np
from scipy.optimize import brentq

TERMS = 1024


def compliance(width, height, young, poisson, rough):
    """Return the displacements under pressures cos(k x) on a layer with a rough, fixed base or with a smooth base."""
    wave = np.arange(1, TERMS) * np.pi / width
    a, kappa = np.minimum(wave * height, 300.0), 3 - 4 * poisson
    over = (2 * kappa * np.sinh(2 * a) - 4 * a, 2 * kappa * np.cosh(2 * a) + 4 * a**2 + 1 + kappa**2)
    above, below = over if rough else (np.cosh(2 * a) - 1, np.sinh(2 * a) + 2 * a)
    uniform = height * (1 + poisson) * (1 - 2 * poisson) / (young * (1 - poisson))
    return np.append(uniform, 2 * (1 - poisson**2) / (young * wave) * above / below)


def pressures(width, radius, compliances, force):
    """Return positions and pressures on half of the contact under a force, in N/m on both halves."""
    x = (np.arange(TERMS // 2) + 0.5) * width / TERMS
    waves = np.cos(np.outer(x, np.arange(TERMS) * np.pi / width))
    matrix = waves * (np.append(1.0, np.full(TERMS - 1, 2.0)) / TERMS * sum(compliances)) @ waves.T

    def under(depth):
        gap, p = depth - x**2 / (2 * radius), np.zeros(len(x))
        on, before = gap > 0, None
        while before is None or (on != before).any():
            p[:] = 0.0
            p[on] = np.linalg.solve(matrix[np.ix_(on, on)], gap[on])
            on, before = (on & (p > 0)) | (~on & (matrix @ p < gap)), on
        return p

    off = brentq(lambda depth: 2 * under(depth).sum() * width / TERMS - force, 1e-6 * width, 0.1 * width, rtol=1e-9)
    return x, under(off)


def errors(places, found, width, radius, compliances, force):
    """Return the largest error of the pressures over the inner 0.8 of the contact, and the error of the half-width.

    The half-width is the half-width of an ellipse that is fitted to these pressures.
    """
    x, p = pressures(width, radius, compliances, force)
    edge = 0.8 * x[p > 0].max()

    def half(at, of):
        slope, square = np.polyfit(at**2, of**2, 1)
        return np.sqrt(-square / slope)

    on, inside = (found > 0) & (places < edge), x < edge
    worst = np.abs(found[on] / np.interp(places[on], x, p) - 1).max()
    return worst, half(places[on], found[on]) / half(x[inside], p[inside]) - 1
