# SPDX-License-Identifier: MIT
"""Retention curves, and the water in unsaturated pores."""
