# SPDX-License-Identifier: MIT
"""Newton's method, coupling of the two balances, and linear solvers."""
