# SPDX-License-Identifier: MIT
"""Fields at points, cells and probes."""
