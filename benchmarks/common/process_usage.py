"""What a process holds, read from /proc."""

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Usage:
    """What a process holds: resident memory, MB, and counts; segments are the files of Fast DDS that it maps."""

    rss: float
    threads: int
    files: int
    segments: int


def usage(pid: int) -> Usage:
    """Read from /proc; OSError if there is no such process."""
    place = Path("/proc") / str(pid)
    lines = (line.split(":", 1) for line in (place / "status").read_text().splitlines())
    status = {key: value.split() for key, value in lines}
    maps = (place / "maps").read_text().splitlines()
    mapped = {line.rsplit("/", 1)[1] for line in maps if "/fastrtps_" in line}
    return Usage(
        rss=int(status["VmRSS"][0]) / 1024, threads=int(status["Threads"][0]), files=len(os.listdir(place / "fd")),
        segments=len(mapped),
    )
