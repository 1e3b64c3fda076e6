"""Files that results are written to: whole or not at all, and never at the price of what was there before.

| the name leads to | the result |
| --- | --- |
| nothing, or a regular file | is written beside it and takes its name when it is whole; an old file keeps its mode |
| the same, through links | likewise, where the links lead; they stay |
| a device, a FIFO, an open descriptor such as ``/dev/stdout`` | waits in the temporary folder, then goes through it |
| a file in a folder that takes no new ones, or one that is mounted by itself | likewise, into the file as it is |

A result that is not whole, because its making was interrupted, does not replace a file that holds something: it is
kept beside it, as name.partial.suffix.  Two programs do not write the same file at the same time: the second is refused
when it begins.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_NO_NEW_FILES = (errno.EACCES, errno.EPERM, errno.EROFS)
_NOT_REPLACED = (errno.EBUSY, errno.EXDEV)
"""Errors for a file that is a mount of its own, as containers have them."""
_DESCRIPTORS = "/proc/"
"""Where /dev/stdout, /dev/fd/3 and a shell's >(command) lead."""


class OutputFile:
    """One result to be: write it to ``partial``, then :meth:`commit` or :meth:`discard` it, as a ``with`` block does.

    Parameters
    ----------
    path
        The name that it is to have.
    partial_name
        What ``partial`` is called beside it; a hidden name with the suffix of ``path`` by default.

    Attributes
    ----------
    path : Path
        As it was given.
    partial : Path
        A file of its own, empty at first; regular, so that one can seek in it.

    Raises
    ------
    OSError
        If the result could not be written, or another program is writing it; nothing is changed then.
    """

    def __init__(self, path: str | Path, partial_name: str | None = None) -> None:
        self.path = Path(path)
        if self.path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        self._target = self.path if is_stream(self.path) else Path(os.path.realpath(self.path))
        self._through = self._target is self.path
        if self._target.exists() and not os.access(self._target, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        if not self._through:
            self.partial = self._target.with_name(partial_name or _partial_name(self._target))
            try:
                self._descriptor = open_locked(self.partial, os.O_NOFOLLOW)
                os.ftruncate(self._descriptor, 0)
            except OSError as error:
                if error.errno not in _NO_NEW_FILES or not self._target.exists():
                    raise OSError(error.errno, error.strerror, str(path)) from error
                self._through = True
        if self._through:
            self._descriptor, name = tempfile.mkstemp(self.path.suffix, "sq_perception-")
            self.partial = Path(name)

    def __enter__(self) -> OutputFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.discard()

    def commit(self, whole: bool = True) -> Path:
        """Put the result where it belongs; returns where that is.

        Parameters
        ----------
        whole
            Whether it is all that was to be; if not, an old file that holds something stays and the result is put
            beside it.

        Raises
        ------
        OSError
            If that fails; what was there before stays, unless it was written through.
        """
        try:
            old = _status(self._target)
            if not whole and old is not None and stat.S_ISREG(old.st_mode) and old.st_size > 0:
                return self._beside()
            if not self._through and self._replace_target(old):
                return self.path
            stream = open_stream(self.path) if is_stream(self.path) else None
            with self.partial.open("rb") as source, open(self.path if stream is None else stream, "wb") as sink:
                shutil.copyfileobj(source, sink)
            return self.path
        finally:
            self.discard()

    def keep(self) -> Path:
        """Leave it where it is, for whoever can repair it; returns where that is."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
        return self.partial

    def discard(self) -> None:
        """Forget it; what was there before stays."""
        if self._descriptor >= 0:
            self.partial.unlink(missing_ok=True)
            self.keep()

    def _beside(self) -> Path:
        if self._through:  # no place there, or none that is not passed on
            return self.keep()
        beside = self._target.with_name(f"{self._target.stem}.partial{self._target.suffix}")
        self.partial.replace(beside)
        self.keep()
        return beside

    def _replace_target(self, old: os.stat_result | None) -> bool:
        """Whether the result has taken the name; not where that cannot be had."""
        if old is not None:
            self.partial.chmod(stat.S_IMODE(old.st_mode))
            with suppress(OSError):  # another's file stays theirs where we may give it
                os.chown(self.partial, old.st_uid, old.st_gid)
            with self.partial.open("rb") as file:  # not only the name must have reached the disk when the old one goes
                os.fsync(file.fileno())
        try:
            self.partial.replace(self._target)
        except OSError as error:
            if error.errno in _NOT_REPLACED and old is not None:
                return False
            raise
        self.keep()  # the name of the partial file is free again, and may be another program's by now
        return True


@contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Where to write a file that shall appear whole or not at all; raises OSError as :class:`OutputFile` does."""
    with OutputFile(path) as output, name_in_errors(path):
        yield output.partial
        output.commit()


def write(path: str | Path, data: bytes, whole: bool = True) -> Path:
    """Write a result at once; returns where it is, see :meth:`OutputFile.commit`."""
    with OutputFile(path) as output, name_in_errors(path):
        output.partial.write_bytes(data)
        return output.commit(whole)


@contextmanager
def name_in_errors(path: str | Path) -> Iterator[None]:
    """Within it an OSError that names no file, such as that of a full disk, names this one."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def check(path: str | Path) -> None:
    """Raise OSError where a result could not be written; changes nothing."""
    OutputFile(path).discard()


def check_folder(folder: str | Path) -> None:
    """Make a folder for results; raises OSError where it cannot be made or takes no files."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()


def free_name(name: str, taken: set[str]) -> str:
    """The name, or name_2, name_3 and so on where it is taken; it is taken then."""
    free, k = name, 2
    while free in taken:
        free, k = f"{name}_{k}", k + 1
    taken.add(free)
    return free


def open_locked(path: Path, flags: int = 0) -> int:
    """Descriptor of a file, made if need be, that no other caller has open.

    Raises
    ------
    OSError
        If it cannot be opened for reading and writing, or another program has it open.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | flags, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise OSError(errno.EBUSY, "another program is writing it", str(path)) from None
    except OSError:  # of a file system without locks
        pass
    if not os.path.samestat(os.fstat(descriptor), path.stat()):  # it took another name between the two calls
        os.close(descriptor)
        raise OSError(errno.EBUSY, "another program is writing it", str(path))
    return descriptor


def is_stream(path: Path) -> bool:
    """Whether what is written there goes elsewhere, so that a file of this name must not take its place."""
    status = _status(path)
    if status is None:
        return False
    return not stat.S_ISREG(status.st_mode) or any(
        os.path.realpath(link.parent).startswith(_DESCRIPTORS) for link in _links(path)
    )


def open_stream(path: Path) -> int:
    """Descriptor to write to where :func:`is_stream` is true: of this program's own ones a copy, with its place."""
    for link in _links(path):
        if os.path.realpath(link.parent) == f"{_DESCRIPTORS}{os.getpid()}/fd" and link.name.isdecimal():
            return os.dup(int(link.name))
    return os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)


def _links(path: Path) -> Iterator[Path]:
    """The path and, if it is a link, each one that it leads to."""
    while True:
        yield path
        if not path.is_symlink():
            return
        path = path.parent / path.readlink()


def _status(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except FileNotFoundError:
        return None


def _partial_name(target: Path) -> str:
    """Hidden, and no longer than a name may be."""
    most = 255 - len(os.fsencode(f"..partial{target.suffix}"))
    name = os.fsencode(target.name)
    cut = name[:most].decode(errors="ignore") if len(name) > most else target.name
    return f".{cut}.partial{target.suffix}"
