# SPDX-License-Identifier: MIT
"""Material points, pieces of their particle domains in the cells, and connected parts of the bodies."""
