# SPDX-License-Identifier: MIT
"""The step: scene, state, stages, and the algorithm."""
