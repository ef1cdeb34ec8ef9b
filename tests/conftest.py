# SPDX-License-Identifier: MIT
"""Tests import the demos' scenes."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "demos"))
