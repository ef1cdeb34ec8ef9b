# SPDX-License-Identifier: MIT
"""Scene, state and stages, and the algorithm of a step."""
