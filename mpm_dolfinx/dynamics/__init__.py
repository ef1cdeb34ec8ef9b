# SPDX-License-Identifier: MIT
"""Waves and shaking: quiet sides, energies."""
