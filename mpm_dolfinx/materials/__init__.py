# SPDX-License-Identifier: MIT
"""Constitutive laws, and their evaluation at material points and pieces of particle domains."""
