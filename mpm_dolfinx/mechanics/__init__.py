# SPDX-License-Identifier: MIT
"""Balance of momentum, and loads and supports that act on it."""
