# SPDX-License-Identifier: MIT
"""The simulation, its time loop, and its analyses."""
