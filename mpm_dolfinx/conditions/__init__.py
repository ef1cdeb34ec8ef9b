# SPDX-License-Identifier: MIT
"""Conditions of a scene, and the sides of bodies to which they apply."""
