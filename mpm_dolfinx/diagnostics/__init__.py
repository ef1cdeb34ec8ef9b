# SPDX-License-Identifier: MIT
"""Warnings and errors about a scene."""
