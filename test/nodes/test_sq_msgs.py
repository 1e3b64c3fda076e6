"""The interface package sq_msgs: built with the rosidl generators, and what nodes and a peer do with it then.

A stand-in for the package of yolo_ros is built beside it, for masks of detections.

What is built is found only by processes that start with its folders in their environment: the tests that use it are in
``sq_msgs_built.py``, which is run by a pytest of its own.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

HERE = Path(__file__).parent


def run(command: list[str], environment: dict[str, str]) -> None:
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-4000:]


def test_the_interfaces_are_built_and_nodes_use_them(repository: Path, tmp_path: Path) -> None:
    prefixes = os.environ.get("AMENT_PREFIX_PATH", sys.prefix).split(os.pathsep)
    if shutil.which("cmake") is None or not any(Path(one, "share/ament_cmake").is_dir() for one in prefixes):
        pytest.skip("ament_cmake or cmake is missing: install the extra 'interfaces'")
    modules = [f"lib/python3.{sys.version_info.minor}/site-packages"]
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    found = {"AMENT_PREFIX_PATH": os.pathsep.join(prefixes), "CMAKE_PREFIX_PATH": os.pathsep.join(prefixes)}
    own = os.environ.get("PYTHONPATH", "")
    python = [own, *(str(Path(prefix, one)) for prefix in prefixes for one in modules)]
    environment = {**os.environ, **found, "PATH": path, "PYTHONPATH": os.pathsep.join(filter(None, python))}
    build, built = tmp_path / "build", tmp_path / "install"
    options = ["-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Debug", f"-DCMAKE_INSTALL_PREFIX={built}"]
    options += [f"-DPython3_EXECUTABLE={sys.executable}", f"-DCMAKE_PROJECT_INCLUDE={HERE / 'wheels.cmake'}"]
    for source in (repository / "sq_msgs", HERE / "detector_interfaces"):
        run(["cmake", "-S", str(source), "-B", str(build / source.name), *options], environment)
        run(["cmake", "--build", str(build / source.name), "--target", "install", "--parallel", "2"], environment)

    after = {
        "AMENT_PREFIX_PATH": os.pathsep.join([str(built), *prefixes]),
        "LD_LIBRARY_PATH": os.pathsep.join([str(built / "lib"), os.environ.get("LD_LIBRARY_PATH", "")]),
        "PYTHONPATH": os.pathsep.join(filter(None, [str(built / modules[0]), own])),
    }
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(HERE / "sq_msgs_built.py")]
    run([*tests, f"--rootdir={repository}", "-c", str(repository / "pyproject.toml")], {**environment, **after})
