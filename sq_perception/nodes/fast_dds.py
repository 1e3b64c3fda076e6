"""Fast DDS: the profile that keeps large images from getting lost.

Fast DDS 2, that of Jazzy, reads FASTRTPS_DEFAULT_PROFILES_FILE when the first participant of a process is created, so
that the variable must be set before rclpy.init.  A file that the user has chosen is left alone.  Its successor's name,
FASTDDS_DEFAULT_PROFILES_FILE, means nothing to it.
"""

from __future__ import annotations

import os
from pathlib import Path

VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
_FILE = "fast_dds.xml"


def profile_path() -> Path:
    """The shipped profile: beside the package's modules where it is installed, ``config/`` in a source tree."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "config", package.parent / "config"):
        if (folder / _FILE).is_file():
            return folder / _FILE
    raise FileNotFoundError(f"{_FILE} is missing beside {package}: install the package again")


def additions() -> dict[str, str]:
    """What the environment lacks: the variable of the shipped profile, or nothing if it names one."""
    return {} if os.environ.get(VARIABLE) else {VARIABLE: str(profile_path())}
