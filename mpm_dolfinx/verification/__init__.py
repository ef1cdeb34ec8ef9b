# SPDX-License-Identifier: MIT
"""Exact solutions, and the finite element reference."""
