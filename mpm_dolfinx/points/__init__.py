# SPDX-License-Identifier: MIT
"""Material points, the cutting of their domains, and the parts that hang together."""
