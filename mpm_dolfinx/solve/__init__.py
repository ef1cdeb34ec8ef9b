# SPDX-License-Identifier: MIT
"""Newton, the coupling of both balances, and linear solvers."""
