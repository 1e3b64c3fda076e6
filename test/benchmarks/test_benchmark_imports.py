"""A benchmark read by another program changes nothing there: only the script itself asks for one thread."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

IMPORT = """
import os, sys
before = dict(os.environ)
sys.path.insert(0, sys.argv[1])
__import__(sys.argv[2])
changed = {name: value for name, value in os.environ.items() if before.get(name) != value and "THREADS" in name}
sys.exit(f"{changed} set by the import" if changed else 0)
"""


READ = ["constants", "frame_time", "real_scenes", "scanned_objects", "segmentation", "single_body", "speed", "tracking"]


@pytest.mark.parametrize("name", READ)
def test_an_import_leaves_the_number_of_threads_alone(name: str, repository: Path) -> None:
    # Numba refuses to compile once its threads run and NUMBA_NUM_THREADS names another number.
    done = subprocess.run(
        [sys.executable, "-c", IMPORT, str(repository / "benchmarks"), name],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
