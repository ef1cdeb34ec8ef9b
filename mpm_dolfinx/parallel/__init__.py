# SPDX-License-Identifier: MIT
"""Several processes: exchange of array rows between cell owners, and messages."""
