# SPDX-License-Identifier: MIT
"""Pores: retention curves and pore water."""
