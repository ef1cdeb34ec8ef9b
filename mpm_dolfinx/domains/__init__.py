# SPDX-License-Identifier: MIT
"""Moving particle domains: their cut by the grid, their deformation gradients and their pore pressures."""
