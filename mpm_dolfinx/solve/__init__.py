# SPDX-License-Identifier: MIT
"""Newton's method, the coupling of both balances, and linear solvers."""
