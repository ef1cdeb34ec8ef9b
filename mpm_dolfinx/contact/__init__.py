# SPDX-License-Identifier: MIT
"""Rigid tools and contact between groups of bodies."""
