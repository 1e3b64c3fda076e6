"""Files of results, each whole or not at all: written as ``name.partial.suffix`` and renamed at the end.

A result whose making was interrupted keeps the partial name where an older file holds something.  Links are followed
and stay.  A device, a FIFO or an open descriptor is written through at the end.  Two programs cannot write one file at
the same time: the second is refused when it begins.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class OutputFile:
    """A result: write it to ``partial``, then :meth:`commit` or :meth:`discard` it, as a ``with`` block does.  Raises
    OSError if it could not be written, or another program is writing it; nothing is changed then."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        check(path)
        self._is_stream = is_stream(self.path)
        if self._is_stream:
            self._descriptor, name = tempfile.mkstemp(self.path.suffix)
            self.partial = Path(name)
        else:
            self._target = Path(os.path.realpath(self.path))
            self.partial = self._target.with_name(f"{self._target.stem}.partial{self._target.suffix}")
            self._descriptor = open_locked(self.partial, os.O_NOFOLLOW)
            os.ftruncate(self._descriptor, 0)

    def __enter__(self) -> OutputFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.discard()

    def commit(self, whole: bool = True) -> Path:
        """Put the result where it belongs and return that; one that is not ``whole`` spares an older file."""
        try:
            if self._is_stream:
                with self.partial.open("rb") as source, self.path.open("ab") as sink:
                    shutil.copyfileobj(source, sink)
                return self.path
            exists = self._target.exists()
            if not whole and exists and self._target.stat().st_size:
                return self.keep()
            if exists:
                shutil.copymode(self._target, self.partial)
            try:
                self.partial.replace(self._target)
                self.keep()
            except OSError as error:
                if error.errno not in (errno.EBUSY, errno.EXDEV):
                    raise
                shutil.copyfile(self.partial, self._target)  # a file that is mounted by itself, as into a container
            return self.path
        finally:
            self.discard()

    def keep(self) -> Path:
        """Leave the result under its partial name; return that."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
        return self.partial

    def discard(self) -> None:
        """Delete the result; what was there before stays."""
        if self._descriptor >= 0:
            self.partial.unlink(missing_ok=True)
            self.keep()


@contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Yield the name under which to write a result that is committed at the end of the block."""
    with OutputFile(path) as output, name_in_errors(path):
        yield output.partial
        output.commit()


def write(path: str | Path, data: bytes, whole: bool = True) -> Path:
    """Write a result at once; return where it is, see :meth:`OutputFile.commit`."""
    with OutputFile(path) as output, name_in_errors(path):
        output.partial.write_bytes(data)
        return output.commit(whole)


@contextmanager
def name_in_errors(path: str | Path) -> Iterator[None]:
    """Add the file to an OSError that names none, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def check(path: str | Path) -> None:
    """Raise OSError where a result could not be written; change nothing."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    if not is_stream(path):
        check_folder(Path(os.path.realpath(path)).parent, make=False)


def check_folder(folder: str | Path, make: bool = True) -> None:
    """Make a folder for results; raise OSError where it cannot be made or takes no files."""
    if make:
        Path(folder).mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()


def free_name(name: str, taken: set[str]) -> str:
    """Return the name, or name_2, name_3 and so on where it is taken; it is taken then."""
    free, k = name, 2
    while free in taken:
        free, k = f"{name}_{k}", k + 1
    taken.add(free)
    return free


def open_locked(path: Path, flags: int = 0) -> int:
    """Open a file for reading and writing, made if need be; OSError if another program has it open."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | flags, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise OSError(errno.EBUSY, "another program is writing it", str(path)) from None
    except OSError:  # of a file system without locks
        pass
    return descriptor


def is_stream(path: Path) -> bool:
    """Return whether what is written there goes elsewhere, so that a file of this name must not take its place."""
    return str(path).startswith("/dev/") or (path.exists() and not path.is_file())
