# SPDX-License-Identifier: MIT
"""The simulation, its time loop, and analyses of a scene."""
