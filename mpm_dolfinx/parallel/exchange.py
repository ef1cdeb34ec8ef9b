# SPDX-License-Identifier: MIT
"""Transfer of array rows to other processes, and of answers back to the senders.

A row contains values of one domain piece, one corner or one loaded point in a cell.  The process that owns the cell
receives the row, and assembles the integrals of the cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


@dataclass
class Traffic:
    """Numbers of transfers, non-empty messages and bytes that this process has sent so far."""

    transfers: int = 0
    messages: int = 0
    bytes: int = 0


traffic = Traffic()


@cache
def _lasting(handle: int) -> PETSc.Vec:
    """Return a PETSc object that keeps PETSc's duplicate of the communicator alive."""
    return PETSc.Vec().create(MPI.Comm.f2py(handle))


class Exchange:
    """A fixed assignment of array rows to processes, for any number of transfers.

    `comm`: processes of the exchange.
    `destination` (n,): rank of the process that receives each row.
    """

    def __init__(self, comm: MPI.Intracomm, destination: NDArray[np.int32]):
        self.comm = comm
        if comm.size == 1:
            return
        order = np.argsort(destination, kind="stable")
        sent = np.bincount(destination, minlength=comm.size).astype(np.int32)
        received, first_there = np.empty_like(sent), np.empty_like(sent)
        comm.Alltoall(sent, received)
        comm.Alltoall((np.cumsum(received) - received).astype(np.int32), first_there)
        place = np.empty(len(destination), dtype=np.int32)  # index of each row among all rows that its receiver gets
        place[order] = np.arange(len(destination)) + np.repeat(first_there - (np.cumsum(sent) - sent), sent)
        self._counts = len(destination), int(received.sum())
        self._away = tuple(np.delete(counts, comm.rank) for counts in (sent, received))
        _lasting(comm.py2f())
        self._sf = PETSc.SF().create(comm)  # communicates only with processes that receive rows
        self._sf.setGraph(self._counts[1], None, np.column_stack([destination, place]).astype(PETSc.IntType))

    def send(self, rows: NDArray) -> NDArray:
        """Return the rows that this process receives, ordered by sender."""
        if self.comm.size == 1:
            return rows
        return self._transfer(rows, 1, self._sf.reduceBegin, self._sf.reduceEnd)

    def back(self, rows: NDArray) -> NDArray:
        """Send one row in answer to each received row.  Return the answers to all rows that this process sent."""
        if self.comm.size == 1:
            return rows
        return self._transfer(rows, 0, self._sf.bcastBegin, self._sf.bcastEnd)

    def _transfer(self, rows: NDArray, to: int, begin: Callable, end: Callable) -> NDArray:
        rows = np.ascontiguousarray(rows)
        out = np.empty((self._counts[to], *rows.shape[1:]), dtype=rows.dtype)
        width = int(np.prod(rows.shape[1:], dtype=int))
        row = MPI._typedict[rows.dtype.char].Create_contiguous(width).Commit()  # the entries may be too many for an int
        away = self._away[1 - to]
        traffic.transfers += 1
        traffic.messages += int(np.count_nonzero(away))
        traffic.bytes += int(away.sum()) * row.size
        begin(row, rows, out, MPI.REPLACE)
        end(row, rows, out, MPI.REPLACE)
        row.Free()
        return out


def over_all(comm: MPI.Intracomm, value: T, op: MPI.Op = MPI.SUM) -> T:
    """Return the sum of a number, or of each entry of an array, over all processes.  `op`: operation, if not a sum."""
    if comm.size == 1:
        return value
    if not isinstance(value, np.ndarray):
        return comm.allreduce(value, op=op)
    out = np.empty_like(value)
    comm.Allreduce(value, out, op=op)
    return out


def to_root(comm: MPI.Intracomm, rows: int) -> Exchange:
    """Return the exchange that sends all rows of this process to rank 0."""
    return Exchange(comm, np.zeros(rows, dtype=np.int32))


def evenly(comm: MPI.Intracomm, numbers: NDArray[np.int64]) -> NDArray[np.int32]:
    """Assign the ascending numbers (n,) >= 0 to ranks, so that all ranks get equally many.  Return the ranks (n,).

    All numbers of all processes are distinct.  The smallest numbers get rank 0, larger numbers rank 1, and so on.
    """
    below = over_all(comm, len(numbers)) * np.arange(1, comm.size) // comm.size
    low, high = np.zeros_like(below), np.full_like(below, over_all(comm, int(numbers.max(initial=0)), MPI.MAX) + 1)
    while (low < high).any():  # bisection for the smallest numbers of the ranks from 1
        middle = (low + high) // 2
        enough = over_all(comm, numbers.searchsorted(middle)) >= below
        low, high = np.where(enough, low, middle + 1), np.where(enough, middle, high)
    return low.searchsorted(numbers, side="right").astype(np.int32)


def first(comm: MPI.Intracomm, message: str) -> str:
    """Return the first non-empty message of all processes, so that all processes can raise the same error."""
    return next(filter(None, comm.allgather(message)), "") if comm.size > 1 else message


def together(comm: MPI.Intracomm, action: Callable[[], T]) -> T:
    """Return the result of an action on this process.  If the action fails on any process, all processes raise the
    first error.
    """
    if comm.size == 1:
        return action()
    value = error = None
    try:
        value = action()
    except Exception as raised:
        error = raised
    for rank, one in enumerate(comm.allgather(error)):
        if one is not None:
            raise error if rank == comm.rank else one
    return value


def at_root(comm: MPI.Intracomm, action: Callable[[], T]) -> T:
    """Call `action` on rank 0, and return its result on every process.  If `action` fails, all raise its error."""
    return comm.bcast(together(comm, lambda: action() if comm.rank == 0 else None))


def by_user(comm: MPI.Intracomm, name: str, action: Callable[[], T]) -> T:
    """Return the result of a user's function `name`.  If it fails on one process, all processes raise an error.

    The process where it fails or is interrupted raises the original error.  All other processes raise a RuntimeError.
    """
    value = raised = None
    try:
        value = action()
    except BaseException as error:
        raised = error
    where = first(comm, "" if raised is None else f"process {comm.rank}: {raised}")
    if raised is not None:
        raise raised
    if where:
        raise RuntimeError(f"{name} raised an error on {where}")
    return value
