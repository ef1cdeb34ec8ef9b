# SPDX-License-Identifier: MIT
"""Exact solutions, laboratory tests of laws, and the finite element reference solution."""
