# SPDX-License-Identifier: MIT
"""Pores: laws of retention, and the water that pores hold."""
