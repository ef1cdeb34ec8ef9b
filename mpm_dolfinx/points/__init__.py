# SPDX-License-Identifier: MIT
"""Grid, bodies, material points: how domains are cut by the cells, and how points and pressures move on."""
