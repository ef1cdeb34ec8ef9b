# SPDX-License-Identifier: MIT
"""Several processes: exchange of array entries between owners of cells, and messages."""
