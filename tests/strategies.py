# SPDX-License-Identifier: MIT
"""Random input of property tests, and numbers of examples, which are reproducible."""

from functools import cache

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st


def repeatable(examples):
    return settings(max_examples=examples, deadline=None, derandomize=True)


@cache
def lists(low, high, count):
    return st.lists(st.floats(low, high, allow_subnormal=False), min_size=count, max_size=count)


def numbers(draw, low, high, *shape):
    return np.reshape(draw(lists(low, high, int(np.prod(shape)))), shape)


def orders(draw, low, high, *shape):
    """Return powers of ten from 10^low to 10^high."""
    return 10.0 ** numbers(draw, low, high, *shape)


def turned(draw, y):
    """Return y (k, d), rotated at random or not rotated."""
    if draw(st.booleans()):
        return y
    q, _ = np.linalg.qr(numbers(draw, -1, 1, y.shape[1], y.shape[1]) + 1e-3 * np.eye(y.shape[1]))
    return y @ (q * [np.linalg.det(q), *[1] * (len(q) - 1)])
