# SPDX-License-Identifier: MIT
"""Messages of the package: log lines and warnings, given once for all processes."""

from __future__ import annotations

import logging
import sys
import warnings

from mpi4py import MPI

from tqdm import tqdm

logger = logging.getLogger("mpm_dolfinx")

WITHIN = {"mpm_dolfinx", "contextlib", "functools"}
"""Packages whose stack frames a warning skips, so that it names a line of the user's script."""


class ResultWarning(UserWarning):
    """Base of all warnings of the package, which are given if a result may be misleading."""


class ResolutionWarning(ResultWarning):
    """Warning that the grid, the material points or the time steps are too coarse."""


class ConditionWarning(ResultWarning):
    """Warning that conditions, units, initial stresses or options contradict each other or have no effect."""


def set_log_level(level: int | str) -> None:
    """Show log lines at or above a level.  The level "INFO", for example, shows reduced steps and checkpoints.

    If Python's `logging` has no handlers, the lines are written to stderr.

    Parameters
    ----------
    level
        A level of `logging`, by name or number.  The default level is "WARNING".

    Raises
    ------
    ValueError
        The level is unknown.
    """
    try:
        logger.setLevel(level)
    except (TypeError, ValueError) as error:
        raise ValueError(f"level = {level!r}, must be a level of logging, such as 'INFO'") from error
    if not logger.hasHandlers():
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("mpm_dolfinx: %(message)s"))
        logger.addHandler(handler)


def log(comm: MPI.Intracomm, message: str, *values, level: int = logging.INFO) -> None:
    """Log a message on the first process."""
    if comm.rank == 0:
        logger.log(level, message, *values)


def warn(comm: MPI.Intracomm, category: type[ResultWarning], message: str, *values) -> None:
    """Give a warning on the first process, at the line of the script that caused it.  All processes must call this.

    If a filter of `warnings` makes the warning an error, all processes raise it.  Callers must warn before they change
    data.
    """
    raised = None
    if comm.rank == 0:
        try:
            with tqdm.external_write_mode(sys.stderr):  # prints the message above the progress bar
                warnings.warn(message % values, category, stacklevel=_outside())
        except Warning as error:
            raised = error
    if comm.size > 1:
        raised = comm.bcast(raised)
    if raised is not None:
        raise raised


def _outside() -> int:
    """Return the number of stack frames from the caller to the first frame outside the package."""
    frame, level = sys._getframe(1), 1
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in WITHIN:
        frame, level = frame.f_back, level + 1
    return level
