# SPDX-License-Identifier: MIT
"""Ctrl-C at a chosen line of the package, which is the same line in every run."""

import sys
from contextlib import contextmanager, suppress
from pathlib import Path

import mpm_dolfinx

PACKAGE = str(Path(mpm_dolfinx.__file__).parent)


@contextmanager
def interrupted(after: int):
    """Raise KeyboardInterrupt once, after `after` lines of the package, and continue after the block.

    The context is a function that returns the number of executed lines.
    """
    left = after

    def in_package(frame, event, arg):
        nonlocal left
        left -= event == "line"
        if left < 0:
            sys.settrace(None)
            raise KeyboardInterrupt
        return in_package

    def trace(frame, event, arg):
        return in_package if frame.f_code.co_filename.startswith(PACKAGE) else None

    before = sys.gettrace()
    with suppress(KeyboardInterrupt):
        sys.settrace(trace)
        try:
            yield lambda: after - left
        finally:
            sys.settrace(before)
