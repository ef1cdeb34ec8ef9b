# SPDX-License-Identifier: MIT
"""Files, checkpoints, and what a scene is made of."""
