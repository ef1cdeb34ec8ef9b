# SPDX-License-Identifier: MIT
"""The background grid and its partition."""
