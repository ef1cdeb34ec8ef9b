# SPDX-License-Identifier: MIT
"""Ctrl-C at any line of the package, the same line in every run."""

import sys
from contextlib import contextmanager, suppress
from pathlib import Path

import mpm_dolfinx

PACKAGE = str(Path(mpm_dolfinx.__file__).parent)


@contextmanager
def interrupted(after: int):
    """Raise KeyboardInterrupt once so many lines of the package have been run, and go on behind the block.

    Gives a function that returns how many lines have been run.
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
