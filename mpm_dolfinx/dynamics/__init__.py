# SPDX-License-Identifier: MIT
"""Waves and shaking: quiet boundaries, energies, error of a step."""
