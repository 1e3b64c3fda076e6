"""Python in a process of its own, run to its end."""

import subprocess
import sys
from typing import Any


def run_python(*words: object, code: int = 0, timeout: float = 600, **options: Any) -> subprocess.CompletedProcess[str]:
    """What ``python words ...`` says; fails where it does not exit with ``code``."""
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=timeout, **options)
    assert done.returncode == code, done.stdout + done.stderr
    return done
