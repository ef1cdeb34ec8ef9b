# SPDX-License-Identifier: MIT
"""A step: the scene, its state, stages, and the algorithm."""
