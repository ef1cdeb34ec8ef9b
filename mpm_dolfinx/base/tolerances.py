# SPDX-License-Identifier: MIT
"""Rounding tolerances, derived from the floating-point format."""

import numpy as np

EPSILON = float(np.finfo(float).eps)
"""Relative spacing of floating-point numbers.  Source: machine epsilon of double precision (IEEE 754)."""
ROUND_OFF = 64 * EPSILON
"""Relative error of a sum of up to 64 terms.  Source: gamma_n = n epsilon, n = 64 (Higham 2002, eq. 3.1)."""
SAME = EPSILON**0.5
"""Numbers with a smaller relative difference are considered equal.  The value corresponds to half of the digits.

SAME is also the increment of one-sided differences.  After a Newton step of this relative size, only rounding errors
remain, because Newton's method squares the error.  Source: Dennis and Schnabel (1983), sections 5.4 and 2.4.
"""
CENTRAL = EPSILON ** (1 / 3)
"""Increment of central differences, relative to the variable.  Source: Dennis and Schnabel (1983), 5.6."""
SECOND = EPSILON**0.25
"""Increment of second differences, relative to the variable.  Source: Dennis and Schnabel (1983), 5.6."""
NEAR = 8 * float(np.finfo(np.float32).eps)
"""Relative distance, 1e-6, below which positions coincide.  Mesh files have seven digits; mapping adds errors.

Source: epsilon of single precision (IEEE 754), for a few operations.
"""
TINY = float(np.finfo(float).tiny) / EPSILON
"""Lower bound of divisors, or a number added to divisors.  Quotients of numbers below 1 / epsilon then stay finite.
Source: IEEE 754."""
FOREVER = 1 / EPSILON**2
"""Time step, s, so long that rates of quantities below 1 / epsilon are below epsilon.  Source: epsilon squared."""
