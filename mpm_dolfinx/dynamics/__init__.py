# SPDX-License-Identifier: MIT
"""Waves and shaking: quiet boundaries, energies, and the error of a step with inertia."""
