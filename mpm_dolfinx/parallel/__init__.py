# SPDX-License-Identifier: MIT
"""Several processes: who owns which cells, and rows that travel between them."""
