# SPDX-License-Identifier: MIT
"""Foundations: checks of input, errors, caches, time integration, and differences between dolfinx's releases."""
