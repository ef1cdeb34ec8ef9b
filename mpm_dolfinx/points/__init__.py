# SPDX-License-Identifier: MIT
"""Material points, the cutting of their particle domains by the grid, and connected parts of the bodies."""
