# SPDX-License-Identifier: MIT
"""Arrays with one copy on each machine, in a temporary file that all processes of the machine map into memory.

A process loads only those parts of the file that it reads, and the operating system may remove them from memory again.
The name of the file is removed as soon as all processes have opened it.  The disk space is freed when the last array is
deleted.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import ExitStack
from mmap import ACCESS_READ, mmap
from tempfile import NamedTemporaryFile

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.parallel.exchange import at_root, together

ALIGNED = np.dtype(np.float64).itemsize


def once_a_machine(comm: MPI.Intracomm, make: Callable[[], dict[Hashable, NDArray]]) -> dict[Hashable, NDArray]:
    """Call `make` on rank 0, and return its arrays on every process.  On several processes the arrays are read-only.

    If `make` raises an error, all processes raise this error.  Empty arrays are not allowed.
    """
    made: dict[Hashable, NDArray] = {}

    def form() -> dict[Hashable, tuple[tuple[int, ...], np.dtype]]:
        made.update(make())
        return {name: (array.shape, array.dtype) for name, array in made.items()}

    forms = at_root(comm, form)
    if comm.size == 1:
        return made
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED, comm.rank)
    leaders = comm.Split(MPI.UNDEFINED if machine.rank else 0, comm.rank)
    with ExitStack() as files:
        written, mapped = [], []

        def create() -> None:
            written.append(files.enter_context(NamedTemporaryFile(prefix="mpm_dolfinx_")))

        def write() -> None:
            failed = None
            for name, (shape, dtype) in forms.items():
                rows = np.ascontiguousarray(made.pop(name)) if comm.rank == 0 else np.empty(shape, dtype)
                row = MPI.BYTE.Create_contiguous(rows[0].nbytes).Commit()  # the bytes may be too many for an int
                leaders.Bcast([rows, len(rows), row])
                row.Free()
                try:
                    written[0].writelines((rows.data, bytes(-rows.nbytes % ALIGNED)))
                    written[0].flush()
                except OSError as error:  # such as a full disk; other machines still expect the next array
                    failed = error
            if failed is not None:
                raise failed

        def read() -> None:
            with open(path, "rb") as opened:
                mapped.append(mmap(opened.fileno(), 0, access=ACCESS_READ))

        for action in (create, write):
            together(comm, action if machine.rank == 0 else lambda: None)
        path = machine.bcast([file.name for file in written])[0]
        together(comm, read)
    for one in (machine, leaders):
        if one != MPI.COMM_NULL:
            one.Free()
    out, start = {}, 0
    for name, (shape, dtype) in forms.items():
        count = int(np.prod(shape))
        out[name] = np.frombuffer(mapped[0], dtype, count, start).reshape(shape)
        start += count * dtype.itemsize + -count * dtype.itemsize % ALIGNED
    return out
