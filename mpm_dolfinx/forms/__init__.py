# SPDX-License-Identifier: MIT
"""UFL forms at material points and in cells: compilation, coefficients, and sums over cells."""
