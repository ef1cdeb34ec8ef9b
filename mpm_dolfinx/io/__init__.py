# SPDX-License-Identifier: MIT
"""Output files, checkpoints and units."""
