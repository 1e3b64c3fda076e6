"""Shared memory that killed processes have left behind: found and freed, before it fills /dev/shm.

Fast DDS keeps one segment per participant in /dev/shm, ``fastrtps_<16 hex digits>``; with this package's profile it is
17 MB.  Its owner holds an exclusive flock on ``fastrtps_<16 hex digits>_el`` for as long as it lives.  After kill -9
the kernel frees the lock, but nothing frees the segment: Fast DDS removes one only where a living process still has it
open, and no later start looks for the others.  A node that is killed and started again for weeks would fill the memory.

A segment is removed here if its lock can be taken, that is by the same test that Fast DDS and ``fastdds shm clean``
apply, if it belongs to this user, and if it is older than :data:`LEAST_AGE`: an owner locks its file a moment after
it has created it.  Ports (``fastrtps_port<number>``) are few, small, and taken over by the next process with the same
number; they stay.  Other middlewares have no such files, and nothing happens.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path("/dev/shm")  # noqa: S108 - where Fast DDS puts them
LEAST_AGE = 10.0
"""Seconds."""
_LOCK = re.compile(r"(fastrtps_[0-9a-f]{16})_el")


@dataclass(frozen=True)
class Freed:
    """What was removed: ``segments``, and the ``bytes`` of memory that they held."""

    segments: int = 0
    bytes: int = 0

    def __str__(self) -> str:
        plural = "" if self.segments == 1 else "s"
        return f"{self.segments} shared-memory segment{plural} of processes that were killed, {self.bytes / 1e6:.1f} MB"


def remove_orphans(folder: Path = FOLDER, least_age: float = LEAST_AGE) -> Freed:
    """Remove the segments of dead owners; what cannot be read or removed stays, and nothing is raised for it."""
    segments, held = 0, 0
    for name in _names(folder):
        found = _LOCK.fullmatch(name)
        if found is None:
            continue
        freed = _removed(folder / name, folder / found[1], least_age)
        if freed is not None:
            segments, held = segments + 1, held + freed
    return Freed(segments, held)


def orphans(folder: Path = FOLDER) -> tuple[str, ...]:
    """Names of the segments whose owner is dead, of any age and user; nothing is removed."""
    found = []
    for name in _names(folder):
        match = _LOCK.fullmatch(name)
        if match is not None and (folder / match[1]).exists() and not _is_locked(folder / name):
            found.append(match[1])
    return tuple(found)


def _names(folder: Path) -> list[str]:
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return []


def _opened(lock: Path) -> int:
    return os.open(lock, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)


def _is_locked(lock: Path) -> bool:
    try:
        descriptor = _opened(lock)
    except OSError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def _removed(lock: Path, segment: Path, least_age: float) -> int | None:
    """Bytes of a segment that was removed; None if it stays."""
    try:
        descriptor = _opened(lock)
    except OSError:
        return None
    try:
        about = os.fstat(descriptor)
        if about.st_uid != os.geteuid() or time.time() - about.st_mtime < least_age:
            return None
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Held until both names are gone: whoever asks meanwhile takes the owner for alive and leaves them alone.
        held = 512 * segment.stat().st_blocks if segment.exists() else 0
        segment.unlink(missing_ok=True)
        lock.unlink(missing_ok=True)
    except OSError:
        return None
    finally:
        os.close(descriptor)
    return held
