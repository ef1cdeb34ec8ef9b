# SPDX-License-Identifier: MIT
"""Constitutive laws, and their evaluation at points and pieces."""
