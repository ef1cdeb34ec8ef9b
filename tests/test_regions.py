# SPDX-License-Identifier: MIT
"""Regions are compared by value, in any form of input."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

from mpm_dolfinx.bodies.faces import limits

SAME = {
    "tuples": ((0, -1), (2, 0.5)),
    "nested lists": [[0, -1], [2, 0.5]],
    "an array": np.array([[0, -1], [2, 0.5]]),
    "an array in columns": np.asfortranarray([[0, -1], [2, 0.5]]),
    "a transposed view": np.array([[0, 2], [-1, 0.5]]).T,
    "arrays in a tuple": (np.array([0, -1]), np.array([2, 0.5], dtype=np.float32)),
    "a minus before zero": ((-0.0, -1), (2, 0.5)),
    "other kinds of numbers": ((Fraction(0), np.int8(-1)), (np.float32(2), Decimal("0.5"))),
}


@pytest.mark.parametrize("region", SAME.values(), ids=SAME)
def test_equal_regions_have_equal_bytes(region):
    assert limits(region, 2).tobytes() == limits(((0.0, -1.0), (2.0, 0.5)), 2).tobytes()


def test_regions_that_differ_in_the_last_digit_have_other_bytes():
    one = np.array([[0.0, -1.0], [2.0, 0.5]])
    other = one.copy()
    other[1, 0] = np.nextafter(2.0, 3.0)
    assert str(one) == str(other) and limits(one, 2).tobytes() != limits(other, 2).tobytes()
    assert limits(None, 2).tobytes() == limits(((-np.inf, -np.inf), (np.inf, np.inf)), 2).tobytes()
