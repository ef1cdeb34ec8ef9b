# SPDX-License-Identifier: MIT
"""Contact: rigid tools, and groups of bodies that slide and separate."""
