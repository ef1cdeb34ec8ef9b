# SPDX-License-Identifier: MIT
"""Messages of the package, once for all processes."""

from __future__ import annotations

import logging

from mpi4py import MPI

logger = logging.getLogger("mpm_dolfinx")


def log(comm: MPI.Intracomm, message: str, *values) -> None:
    """Log a message."""
    if comm.rank == 0:
        logger.info(message, *values)


def warn(comm: MPI.Intracomm, message: str, *values) -> None:
    """Log a warning."""
    if comm.rank == 0:
        logger.warning(message, *values)
