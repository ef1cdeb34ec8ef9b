# SPDX-License-Identifier: MIT
"""Contact of bodies with rigid tools, and between groups of bodies that slide and separate."""
