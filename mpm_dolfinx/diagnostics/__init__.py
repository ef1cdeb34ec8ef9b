# SPDX-License-Identifier: MIT
"""Warnings and refusals about a scene."""
