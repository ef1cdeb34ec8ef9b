# SPDX-License-Identifier: MIT
"""Compilation of dolfinx's forms and function spaces into libraries, with errors in one line.

Before FFCx compiles a library, it marks the library by a `.c` file in the cache.  Other programs wait ten seconds for a
marked library, and then fail.  The mark of an aborted run would therefore stop all later runs.  This module therefore
compiles each library in a separate folder, and moves the complete library into the cache.  Incomplete or broken
libraries in the cache are compiled again.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from uuid import uuid4

from mpi4py import MPI

import cffi
import ffcx
from dolfinx import jit
from ffcx.codegeneration import jit as libraries

from mpm_dolfinx.base.validation import line_of
from mpm_dolfinx.parallel.exchange import at_root, first

WORKSHOP = ".mpm_dolfinx-"
"""Prefix of the folders in which libraries are compiled."""
ABANDONED = 600.0
"""Age, in s, above which a mark is ignored.  A mark is a `.c` file without a `.c.cached` file."""
DAY = 86400.0  # Source: definition
logger = logging.getLogger("mpm_dolfinx")
_settings = jit.get_options if hasattr(jit, "get_options") else jit.get_parameters  # OLD
_ffcx_settings = ffcx.get_options if hasattr(ffcx, "get_options") else ffcx.get_parameters  # OLD
_warnings: dict[Path, str] = {}
"""For each temporary folder: the warning that the first compilation in this folder issues."""


@contextmanager
def compiler(comm: MPI.Intracomm) -> Iterator[None]:
    """Context in which dolfinx finds or compiles libraries of forms, on all processes of `comm`.

    Raises
    ------
    OSError
        dolfinx's settings are unreadable, no folder is writable, or the C compiler fails.  All processes raise it.
    """
    folder = at_root(comm, _folder)
    messages = [""]
    raised = None
    makers = {name: _complete(getattr(libraries, name), folder, messages) for name in MAKERS}
    try:
        with _quiet(), _replaced(**makers):
            yield
    except Exception as error:
        raised = error
    message = first(comm, messages[-1])  # dolfinx does not report the cause to the other processes
    if message:
        raise OSError(message) from raised
    if raised is not None:
        raise raised


MAKERS = [name for name in ("compile_forms", "compile_elements") if hasattr(libraries, name)]


@cache
def _folder() -> Path:
    """Return the folder for libraries in this run: dolfinx's cache, or a temporary folder if it is not writable."""
    try:
        _ffcx_settings()
        folder = _settings()["cache_dir"]
    except (OSError, ValueError) as error:  # ValueError: not JSON
        file, why = getattr(error, "filename", None), getattr(error, "strerror", None)
        what = f"{file}: {why}" if file else f"dolfinx_jit_*.json or ffcx_*.json: {line_of(error)}"
        allowed = "must be absent, or JSON that can be read; set HOME or XDG_CONFIG_HOME to another folder"
        raise OSError(f"{what}; settings of dolfinx {allowed}") from error
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=WORKSHOP, dir=folder):
            return folder
    except OSError as error:
        return _of_this_run(folder, error)


def _of_this_run(cache: Path, why: OSError) -> Path:
    """Return a new folder for libraries.  The folder is deleted at the end of the run."""
    allowed = "must be a folder that can be written; set XDG_CACHE_HOME to another folder"
    what = f"cache folder of dolfinx's compiled forms, {cache}: {why.strerror}"
    try:
        folder = Path(tempfile.mkdtemp(prefix="mpm_dolfinx-"))
    except OSError as error:
        raise OSError(f"{what}, and {line_of(error)}, {allowed}") from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    _warnings[folder] = f"{what}, {allowed}; until then each run compiles all forms again, in {folder}"
    return folder


def _complete(make: Callable, folder: Path, messages: list[str]) -> Callable:
    """Return FFCx's function `make`, changed so that `folder` only contains complete libraries.

    Errors of the compiler and of the disk are appended to `messages`.
    """

    def find_or_make(*objects, cache_dir, **settings):
        workshop, find = folder / f"{WORKSHOP}{uuid4().hex}", libraries.get_cached_module
        missing = []

        def look(name: str, names, workshop, timeout):
            for place in dict.fromkeys((Path(cache_dir), folder)):
                with suppress(OSError, ImportError, AttributeError):  # unreadable, or another file of this name
                    module = _loaded(name, place)
                    return [getattr(module.lib, one) for one in names], module
            missing.append(name)
            return find(name, names, workshop, timeout)  # finds nothing and creates the workshop

        try:
            with _replaced(get_cached_module=look):
                out = make(*objects, cache_dir=workshop, **settings)
            if missing:
                if folder in _warnings:
                    logger.warning(_warnings.pop(folder))
                with suppress(OSError):  # the library is already loaded; a later run compiles it again
                    _publish(workshop, folder)
            return out
        except cffi.VerificationError as error:
            allowed = "must be able to make Python extensions: on Debian, apt install gcc libc6-dev python3-dev"
            messages.append(f"C compiler: {line_of(error)}, {allowed}")
            raise
        except OSError as error:
            allowed = "must be a folder that can be written, with free space, or set XDG_CACHE_HOME to another one"
            messages.append(f"{folder}: {line_of(error)}, {allowed}")
            raise
        finally:
            if missing:
                shutil.rmtree(workshop, ignore_errors=True)

    return find_or_make


@cache
def _loaded(name: str, place: Path) -> ModuleType:
    """Return a complete library as a module, or raise ImportError.  FFCx's loader is slower: it lists the cache."""
    if not _is_complete(place, name):
        raise ImportError(name)
    spec = spec_from_file_location(name, _library(place, name))
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _library(place: Path, name: str) -> Path | None:
    """Return the file that Python would load for a library, or None if no file exists."""
    return next(filter(Path.exists, (place / (name + suffix) for suffix in EXTENSION_SUFFIXES)), None)


def _is_complete(place: Path, name: str) -> bool:
    """Return whether the cache contains a complete library and its files `.c` and `.c.cached`.

    Python's loader does not detect a truncated library, whose use would end the run with a bus error.
    """
    library = _library(place, name)
    if library is None or not all((place / f"{name}{end}").exists() for end in (".c", ".c.cached")):
        return False
    with open(library, "rb") as f:
        head = f.read(64)
    if len(head) < 64 or head[:5] != b"\x7fELF\x02":  # not a Linux library: loaders of other systems may check the file
        return len(head) == 64
    (table,), (size, count) = struct.unpack_from("=Q", head, 0x28), struct.unpack_from("=2H", head, 0x3A)
    return library.stat().st_size >= table + size * count  # linkers write the section table last


def _publish(workshop: Path, folder: Path) -> None:
    """Move a library into the cache, unless another program is compiling it there."""
    (source,) = workshop.glob("*.c")
    mark, name = folder / source.name, source.stem
    ready = mark.with_suffix(".c.cached")
    try:
        open(mark, "x").close()  # FFCx marks libraries in the same way
    except FileExistsError:
        if not ready.exists() and time.time() - mark.stat().st_mtime < ABANDONED:
            return
    for file in (_library(workshop, name), source, workshop / ready.name):
        os.replace(file, folder / file.name)
    for remains in folder.glob(f"{WORKSHOP}*"):  # left by killed runs
        if time.time() - remains.stat().st_mtime > DAY:
            shutil.rmtree(remains, ignore_errors=True)


@contextmanager
def _replaced(**functions: Callable) -> Iterator[None]:
    """Context that replaces functions of FFCx's module by the given functions."""
    before = {name: getattr(libraries, name) for name in functions}
    for name, function in functions.items():
        setattr(libraries, name, function)
    try:
        yield
    finally:
        for name, function in before.items():
            setattr(libraries, name, function)


@contextmanager
def _quiet() -> Iterator[None]:
    """Context in which setuptools does not log the calls of the compiler."""
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    root.addFilter(_is_wanted)
    try:
        yield
    finally:
        root.removeFilter(_is_wanted)
        root.setLevel(level)
        root.handlers[:] = handlers


def _is_wanted(record: logging.LogRecord) -> bool:
    return record.levelno > logging.INFO or "distutils" not in record.pathname
