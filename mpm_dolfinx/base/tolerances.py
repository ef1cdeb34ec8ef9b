# SPDX-License-Identifier: MIT
"""Rounding tolerances, derived from the floating-point format."""

import numpy as np

EPSILON = float(np.finfo(float).eps)
"""Relative spacing of floating-point numbers.  Source: machine epsilon of double precision (IEEE 754)."""
ROUND_OFF = 64 * EPSILON
"""Largest relative error of a sum of 64 terms.  Source: gamma_n = n epsilon, n = 64 (Higham 2002, equation 3.1)."""
SAME = EPSILON**0.5
"""Relative difference below which two numbers are considered equal: half of their digits agree.

`SAME` is also the increment of one-sided differences.  Newton's method squares the relative error, so a step of
relative size `SAME` leaves only rounding errors.  Source: Dennis and Schnabel (1983), sections 5.4 and 2.4.
"""
ITERATIONS = 60
"""Largest number of Newton iterations for a few unknowns, such as the unknowns of a material law at a point."""
CENTRAL = EPSILON ** (1 / 3)
"""Increment of central differences, relative to the variable.  Source: Dennis and Schnabel (1983), 5.6."""
SECOND = EPSILON**0.25
"""Increment of second differences, relative to the variable.  Source: Dennis and Schnabel (1983), 5.6."""
NEAR = 8 * float(np.finfo(np.float32).eps)
"""Distance below which positions are considered equal, divided by a length such as the cell size: 1e-6.

Source: epsilon of single precision (IEEE 754), as in mesh files, times 8 for a few operations.
"""
TINY = float(np.finfo(float).tiny) / EPSILON
"""Lower bound of a divisor, or term added to a divisor.  Quotients with a numerator below (1 / epsilon) are then
finite.  Source: IEEE 754.
"""
FOREVER = 1 / EPSILON**2
"""Very long time step, in s: changes by (1 / epsilon) then have only the rate epsilon.  Source: epsilon squared."""
