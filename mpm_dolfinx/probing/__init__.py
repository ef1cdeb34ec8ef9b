# SPDX-License-Identifier: MIT
"""Results at material points, cells and probes."""
