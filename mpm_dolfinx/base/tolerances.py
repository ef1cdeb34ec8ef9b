# SPDX-License-Identifier: MIT
"""The tolerances of rounding, in the place of numbers of their own: all follow from the format of numbers."""

import numpy as np

EPSILON = float(np.finfo(float).eps)
"""Relative distance between neighbouring numbers.  Source: machine epsilon of double precision (IEEE 754)."""
ROUND_OFF = 64 * EPSILON
"""Relative error of a sum of some tens of numbers.  Source: gamma_n = n epsilon, n = 64 (Higham 2002, eq. 3.1)."""
SAME = EPSILON**0.5
"""Relative distance within which numbers are equal but for rounding: half of their digits.

Also the step of one-sided differences, and a step of Newton's method after which only rounding is left, for its error
is squared.  Source: Dennis and Schnabel (1983), sections 5.4 and 2.4.
"""
CENTRAL = EPSILON ** (1 / 3)
"""Step of central differences, relative to the size of what changes.  Source: Dennis and Schnabel (1983), 5.6."""
SECOND = EPSILON**0.25
"""Step of second differences.  Source: Dennis and Schnabel (1983), 5.6."""
NEAR = 8 * float(np.finfo(np.float32).eps)
"""Relative distance within which places are one, 1e-6: meshes come with seven digits, and are moved on with more.

Source: epsilon of single precision (IEEE 754), for a few operations.
"""
TINY = float(np.finfo(float).tiny) / EPSILON
"""Added to divisors that may be zero: quotients of numbers below 1 / epsilon are finite.  Source: IEEE 754."""
FOREVER = 1 / EPSILON**2
"""A time, s, in which rates are lost in rounding.  Source: epsilon, for seconds and what is divided."""
