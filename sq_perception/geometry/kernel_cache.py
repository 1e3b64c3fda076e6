"""Compiling kernels and keeping them, also for a user without a home on a read-only installation.

numba keeps machine code in ``NUMBA_CACHE_DIR``, beside the modules, or in the user's cache folder, and
otherwise refuses to compile at all.  Service users and containers often have none of these.  For them there is a folder
of the user's own among the temporary files: numba reads machine code with pickle, so that nobody else may write there.

The first kernel that a process has to compile is announced in the log: a first start takes a minute or two.  numba
compiles on one core; commands and nodes may have others compiled by a second process meanwhile, and find them on disk.
"""

from __future__ import annotations

import logging
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.event import Event, Listener, register

_F = TypeVar("_F", bound=Callable[..., Any])
_log = logging.getLogger(__name__)
_BESIDE = ("-m", "sq_perception", "warm-up", "--only", "segmentation", "network")
"""Arguments of Python that compile what a first recovery needs after the fit."""
_is_shared = False
_beside: list[subprocess.Popen[bytes]] = []  # the process that compiles beside this one, once it was started


def compile_beside() -> None:
    """From now on start a second process as soon as a kernel has to be compiled, if there is a second core.  It
    compiles the later kernels of a recovery while this one is at those of the fit."""
    global _is_shared
    _is_shared = True


def compile_kernel(function: _F, options: dict[str, Any]) -> _F:
    """Compile by numba's ``njit`` with these options, and cache the machine code wherever possible."""
    settings: Any = numba.config
    named = settings.CACHE_DIR
    try:
        kept: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba knows no place
        kept = None
    if named and (kept is None or not Path(kept.stats.cache_path).is_relative_to(named)):
        _warn_unwritable(named)
    if kept is not None:
        return cast(_F, kept)
    folder = temporary_folder()
    if folder is None:
        return cast(_F, numba.njit(**options)(function))
    settings.CACHE_DIR = str(folder)  # read when a function is decorated; other packages keep theirs where they did
    try:
        return cast(_F, numba.njit(cache=True, **options)(function))
    finally:
        settings.CACHE_DIR = named


class _Compiling(Listener):
    """Log handler for kernels that are compiled because they are not on disk."""

    def on_start(self, event: Event) -> None:
        if event.data["dispatcher"].py_func.__module__.startswith(__package__.partition(".")[0]):
            _announce()

    def on_end(self, event: Event) -> None:
        pass


@cache
def _announce() -> None:
    _log.warning("compiling, once for this installation: all kernels take a minute or two")
    if _is_shared and len(os.sched_getaffinity(0)) > 1:
        quiet = subprocess.DEVNULL
        _beside.append(subprocess.Popen([sys.executable, *_BESIDE], stdin=quiet, stdout=quiet, stderr=quiet))


@cache
def _warn_unwritable(named: str) -> None:
    """Warn once of a NUMBA_CACHE_DIR that cannot be written, as numba does not."""
    _log.warning(
        "NUMBA_CACHE_DIR: %s cannot be written: compiled kernels are kept elsewhere, `sq-perception doctor` says where",
        named,
    )


register("numba:compile", _Compiling())


@cache
def temporary_folder() -> Path | None:
    """Return a folder of this user alone that outlives the process, or None; log once what that means."""
    try:
        path = Path(tempfile.gettempdir()) / f"sq_perception-kernels-{os.geteuid()}"
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
            raise PermissionError(f"{path}: expected a folder of this user alone")
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        _log.warning("kernels are compiled at every start (minutes), NUMBA_CACHE_DIR names a place for them: %s", error)
        return None
    _log.warning("compiled kernels are kept in %s; NUMBA_CACHE_DIR names a place that lasts", path)
    return path
