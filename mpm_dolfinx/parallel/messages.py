# SPDX-License-Identifier: MIT
"""Messages of the package, once for all processes: log lines of a run, and warnings about its results."""

from __future__ import annotations

import logging
import sys
import warnings

from mpi4py import MPI

from tqdm import tqdm

logger = logging.getLogger("mpm_dolfinx")

WITHIN = {"mpm_dolfinx", "contextlib", "functools"}
"""Packages whose frames a warning passes by, to the line of the script that it is about."""


class ResultWarning(UserWarning):
    """A result may not be what it seems; all warnings of the package are of this kind."""


class ResolutionWarning(ResultWarning):
    """Grid, points or steps are too coarse for what they are to resolve."""


class ConditionWarning(ResultWarning):
    """Conditions, units, initial stresses or options contradict each other, or do nothing."""


def set_log_level(level: int | str) -> None:
    """Show the log lines of runs from a level on, such as "INFO": steps that are cut, checkpoints.

    They are shown on stderr, unless handlers of `logging` are there already.

    Parameters
    ----------
    level
        A level of `logging`, by its name or number; "WARNING" is the default.

    Raises
    ------
    ValueError
        There is no such level.
    """
    try:
        logger.setLevel(level)
    except (TypeError, ValueError) as error:
        raise ValueError(f"level = {level!r}, must be one of logging's, such as 'INFO'") from error
    if not logger.hasHandlers():
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("mpm_dolfinx: %(message)s"))
        logger.addHandler(handler)


def log(comm: MPI.Intracomm, message: str, *values, level: int = logging.INFO) -> None:
    """Log a message."""
    if comm.rank == 0:
        logger.log(level, message, *values)


def warn(comm: MPI.Intracomm, category: type[ResultWarning], message: str, *values) -> None:
    """Issue a warning on the first process, at the line outside of the package that has led to it.

    All processes call it together.  Where a filter turns it into an error, all of them raise it, with `told` unset:
    the caller has changed nothing so far.
    """
    raised = None
    if comm.rank == 0:
        try:
            with tqdm.external_write_mode(sys.stderr):  # above the bar, not into it
                warnings.warn(message % values, category, stacklevel=_outside())
        except Warning as error:
            raised = error
    if comm.size > 1:
        raised = comm.bcast(raised)
    if raised is not None:
        raise raised


def _outside() -> int:
    """Return how many calls outward, for the caller, the first frame is that is not of the package."""
    frame, level = sys._getframe(1), 1
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in WITHIN:
        frame, level = frame.f_back, level + 1
    return level
