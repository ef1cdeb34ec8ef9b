# SPDX-License-Identifier: MIT
"""What everything else stands on: checks of input, errors, caches, and the spellings of dolfinx's releases."""
