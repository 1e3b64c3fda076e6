"""A benchmark read by another program changes nothing there; those that share helpers with the tests find them."""

from pathlib import Path

import pytest
from python_process import run_python

IMPORT = """
import os, sys
before = dict(os.environ)
sys.path.insert(0, sys.argv[1])
for module in sys.argv[2:]:
    __import__(module)
    changed = {name: value for name, value in os.environ.items() if before.get(name) != value and "THREADS" in name}
    if changed:
        sys.exit(f"{changed} set by the import of {module}")
"""
READ = "constants", "frame_time", "real_scenes", "segmentation", "single_body", "speed", "tracking"


def test_an_import_leaves_the_number_of_threads_alone(repository: Path) -> None:
    # Numba refuses to compile once its threads run and NUMBA_NUM_THREADS names another number.
    run_python("-c", IMPORT, repository / "benchmarks", *READ)


@pytest.mark.parametrize("name", ["hostile", "kills", "soak"])
def test_helpers_of_the_tests_are_found(name: str, repository: Path) -> None:
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    run_python(repository / "benchmarks" / f"{name}.py", "--help")
