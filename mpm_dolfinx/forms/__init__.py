# SPDX-License-Identifier: MIT
"""UFL forms at material points and in cells: compilation, packing of coefficients, sums over cells."""
