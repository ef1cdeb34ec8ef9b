# SPDX-License-Identifier: MIT
"""The points' domains as they move: cut by the grid, their gradients, and the pressures that they carry."""
