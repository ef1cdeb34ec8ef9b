# SPDX-License-Identifier: MIT
"""Foundations: checks of input, errors, caches, time integration, and the spellings of dolfinx's releases."""
