# SPDX-License-Identifier: MIT
"""The two balances, momentum and storage, with their boundaries and stabilisation."""
