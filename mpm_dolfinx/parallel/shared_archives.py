# SPDX-License-Identifier: MIT
"""Numpy archives (.npz) whose arrays several processes write and read together, by rows.

Each process writes its own rows, and reads an equal share of all rows.  No process has an array of all rows in memory.
The file does not depend on the number of processes that wrote it.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Mapping
from functools import cache
from io import BytesIO
from pathlib import Path
from struct import Struct
from typing import NamedTuple
from zipfile import ZIP_STORED, ZipFile, ZipInfo

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.parallel.exchange import at_root, over_all, together

LOCAL = Struct("<26xHH")  # lengths of name and extra field in the header of a member.  Source: format of zip archives
CRC_32 = 0xEDB88320  # polynomial of the checksum, lowest power first.  Source: format of zip archives
ONE = 1 << 31  # the polynomial 1, lowest power first.  Source: definition


class Member(NamedTuple):
    """An array in an archive: type, shape, position of the entries in the file, and checksums."""

    dtype: np.dtype
    shape: tuple[int, ...]
    start: int  # offset of the first entry, bytes
    head: int  # checksum of the bytes of the member before the first entry
    crc: int  # checksum of the member


def write(comm: MPI.Intracomm, file: Path, arrays: Mapping[str, NDArray], rows: Mapping[str, NDArray]) -> int:
    """Write an archive, and return its size in bytes.  An older file is replaced when the archive is complete.

    If a process cannot write, all processes raise its error.

    `arrays`: on rank 0, the arrays that are not distributed, by name.
    `rows`: this process's rows (n, ...) of distributed arrays, by name.  The file contains the rows of all processes,
    in the order of the ranks.
    """
    part = file.with_name(file.name + ".part")
    rows = {name: np.ascontiguousarray(of) for name, of in rows.items()}
    count = np.array([len(of) for of in rows.values()], dtype=np.int64)
    first, total = comm.scan(count) - count, over_all(comm, count)
    placed, end = [], 0
    for (name, of), length in zip(rows.items(), total.tolist(), strict=True):
        info, head = ZipInfo(f"{name}.npy"), _head(of.dtype, (length, *of.shape[1:]))
        size = length * _row_bytes(of.dtype, of.shape)
        info.CRC = 0  # replaced when the checksum is known
        info.file_size = info.compress_size = len(head) + size
        info.header_offset = end
        start = end + len(info.FileHeader(zip64=True)) + len(head)
        placed.append((info, head, start))
        end = start + size
    sums = comm.gather([(zlib.crc32(of), of.nbytes) for of in rows.values()])

    def create() -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(b"")

    def add() -> None:
        # not opened to read: a network file system would write whole pages, with rows of other processes
        with open(part, "wb", opener=lambda path, _: os.open(path, os.O_WRONLY)) as f:
            for of, before, (_, _, start) in zip(rows.values(), first.tolist(), placed, strict=True):
                f.seek(start + before * _row_bytes(of.dtype, of.shape))
                f.write(of)
            if sums is not None:
                for (info, head, _), own in zip(placed, zip(*sums, strict=True), strict=True):
                    info.CRC = _joined(zlib.crc32(head), own)
                    f.seek(info.header_offset)
                    f.write(info.FileHeader(zip64=True) + head)
                f.seek(end)
                with ZipFile(f, "w") as archive:
                    archive.infolist().extend(info for info, *_ in placed)
                    for name, array in arrays.items():
                        with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                            np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
            f.flush()
            os.fsync(f.fileno())

    at_root(comm, create)
    together(comm, add)

    def complete() -> int:
        os.replace(part, file)
        return file.stat().st_size

    return at_root(comm, complete)


def members(file: Path, names: Iterable[str]) -> dict[str, Member]:
    """Return the `Member` of each named array.  Raise ValueError if an array is compressed or incomplete."""
    out = {}
    with open(file, "rb") as f, ZipFile(f) as archive:
        for name in names:
            info = archive.getinfo(f"{name}.npy")
            with archive.open(info) as member:
                np.lib.format.read_magic(member)
                shape, by_columns, dtype = np.lib.format.read_array_header_1_0(member)
                length = member.tell()
            f.seek(info.header_offset)
            start = info.header_offset + LOCAL.size + sum(LOCAL.unpack(f.read(LOCAL.size)))
            f.seek(start)
            head = zlib.crc32(f.read(length))
            whole = info.file_size == length + int(np.prod(shape)) * dtype.itemsize
            if info.compress_type != ZIP_STORED or by_columns or not shape or not whole:
                raise ValueError(f"{name}: is compressed, in column-major order, or incomplete")
            out[name] = Member(dtype, shape, start + length, head, info.CRC)
    return out


def some_rows(file: Path, member: Member, first: int, last: int) -> NDArray:
    """Return the rows from `first` to `last` - 1 of an array in an archive."""
    shape = last - first, *member.shape[1:]
    offset = member.start + first * _row_bytes(member.dtype, shape)
    return np.fromfile(file, member.dtype, int(np.prod(shape)), offset=offset).reshape(shape)


def read(
    comm: MPI.Intracomm, file: Path, of: Mapping[str, Member], ranges: Mapping[str, tuple[int, int]]
) -> dict[str, NDArray]:
    """Return the rows that this process reads from each array in an archive, by name of the array.

    Raise ValueError on all processes if an array differs from its checksum.

    `of`: result of `members`.
    `ranges`: for each array name, the first row that this process reads, and the last row plus one.  Together, the
    processes read all rows.
    """
    rows = together(comm, lambda: {name: some_rows(file, of[name], *ranges[name]) for name in of})
    sums = comm.gather([(zlib.crc32(found), found.nbytes) for found in rows.values()])

    def check() -> None:
        for (name, member), own in zip(of.items(), zip(*sums, strict=True), strict=True):
            if _joined(member.head, own) != member.crc:
                raise ValueError(f"{name}: differs from its checksum")

    at_root(comm, check)
    return rows


def _head(dtype: np.dtype, shape: tuple[int, ...]) -> bytes:
    """Return numpy's header of an array in a file."""
    out = BytesIO()
    form = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(out, form)
    return out.getvalue()


def _row_bytes(dtype: np.dtype, shape: tuple[int, ...]) -> int:
    return int(np.prod(shape[1:], dtype=int)) * dtype.itemsize


def _joined(crc: int, parts: Iterable[tuple[int, int]]) -> int:
    """Return the checksum of joined blocks, from the checksum of the first, and checksums and lengths of the others."""
    for more, length in parts:
        for k in range(length.bit_length()):
            crc = _product(_power(k), crc) if length >> k & 1 else crc
        crc ^= more
    return crc


@cache
def _power(k: int) -> int:
    """Return the polynomial `x^(8 2^k)`, by which a checksum is multiplied if 2^k bytes follow."""
    return _product(_power(k - 1), _power(k - 1)) if k else ONE >> 8


def _product(a: int, b: int) -> int:
    """Return the product of two binary polynomials modulo the polynomial of the checksum."""
    out = 0
    while a:
        out ^= b if a & ONE else 0
        a = (a & ~ONE) << 1
        b = b >> 1 ^ (CRC_32 if b & 1 else 0)
    return out
