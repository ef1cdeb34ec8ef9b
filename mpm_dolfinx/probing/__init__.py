# SPDX-License-Identifier: MIT
"""Results at points, cells and probes."""
