"""Fast DDS: the profile that prevents the loss of large images, and the shared memory that killed processes leave.

Fast DDS 2 of Jazzy reads FASTRTPS_DEFAULT_PROFILES_FILE when the first participant of a process is created, so the
variable must be set before rclpy.init.  A user's file is kept.  It ignores its successor's variable,
FASTDDS_DEFAULT_PROFILES_FILE.

It keeps one segment per participant in /dev/shm, ``fastrtps_<16 hex digits>``, 17 MB with this profile, whose owner
holds a lock on ``fastrtps_<16 hex digits>_el`` while it lives.  After kill -9 the kernel frees the lock, but nothing
frees the segment (docs/nodes.md).  :func:`remove_orphans` deletes such segments, by the test of ``fastdds shm clean``;
since they belong to the middleware, nodes call it only with ``free_shared_memory``.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from pathlib import Path

VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
_FILE = "fast_dds.xml"
FOLDER = Path("/dev/shm")  # noqa: S108 - where Fast DDS puts them
LEAST_AGE = 10.0
"""Seconds; an owner locks its file a moment after it has created it."""
_LOCK = re.compile(r"(fastrtps_[0-9a-f]{16})_el")


def configuration_file(name: str) -> Path:
    """Return a shipped file: beside the modules if installed, in ``config/`` of a source tree."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "config", package.parent / "config"):
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"{name} is missing beside {package}: install the package again")


def profile_path() -> Path:
    """Return the path of the shipped profile."""
    return configuration_file(_FILE)


def additions() -> dict[str, str]:
    """Return what to add to the environment: the variable of the shipped profile, or nothing if a profile is set."""
    return {} if os.environ.get(VARIABLE) else {VARIABLE: str(profile_path())}


def remove_orphans(folder: Path = FOLDER) -> tuple[str, ...]:
    """Delete this user's segments of dead owners older than :data:`LEAST_AGE`; return their names.

    What cannot be read or removed stays, and nothing is raised for it.  Ports (``fastrtps_port<number>``) stay too:
    they are few, small, and taken over by the next process with the same number.
    """
    try:
        names = sorted(os.listdir(folder))
    except OSError:
        return ()
    found = (match for match in map(_LOCK.fullmatch, names) if match is not None)
    return tuple(match[1] for match in found if _remove(folder / match[0], folder / match[1]))


def _remove(lock: Path, segment: Path) -> bool:
    try:
        descriptor = os.open(lock, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        about = os.fstat(descriptor)
        if about.st_uid != os.geteuid() or time.time() - about.st_mtime < LEAST_AGE:
            return False
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Held until both names are gone: whoever asks meanwhile takes the owner for alive and leaves them alone.
        segment.unlink(missing_ok=True)
        lock.unlink(missing_ok=True)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True
