# SPDX-License-Identifier: MIT
"""Conditions that users give, and the sides of bodies that they act on."""
