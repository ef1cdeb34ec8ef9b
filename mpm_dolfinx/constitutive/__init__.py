# SPDX-License-Identifier: MIT
"""Laws of the skeleton and the fluid, in UFL, and their values at the points."""
