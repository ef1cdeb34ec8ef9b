# SPDX-License-Identifier: MIT
"""UFL forms at material points and in cells: compiled, packed, summed."""
