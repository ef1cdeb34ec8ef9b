# SPDX-License-Identifier: MIT
"""Balance of momentum: stresses, inertia, loads and supports."""
