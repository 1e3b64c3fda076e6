"""colcon builds the workspace, and what it installs is what ROS tools look for."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from python_process import run_python

pytest.importorskip("colcon_core", reason="colcon is missing: install the extra 'test'")
catkin_package = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is missing: install the extra 'test'")

PACKAGE = "sq_perception"
EXECUTABLES = ("recover_node", "recover_cameras", "fitter_node", "grasp_node", "synthetic_depth_node", "sq-perception")


def built(source: Path, workspace: Path, *options: str) -> Path:
    shutil.copytree(source, workspace / "src" / PACKAGE)
    environment = {**os.environ, "COLCON_HOME": str(workspace / "home"), "COLCON_LOG_LEVEL": "30"}
    environment["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    words = ("build", "--base-paths", "src", "--executor", "sequential", *options)
    result = run_python("-m", "colcon", *words, cwd=workspace, env=environment)
    assert f"Finished <<< {PACKAGE}" in result.stdout
    assert "Deprecat" not in result.stderr
    return workspace / "install"


@pytest.fixture(scope="module")
def install(source_copy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(source_copy, tmp_path_factory.mktemp("workspace"))


def sourced(install: Path, command: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}
    script = '. "$0/local_setup.sh" && exec "$@"'
    return subprocess.run(
        ["sh", "-c", script, str(install), *command], cwd=cwd,
        env={**environment, "COLCON_CURRENT_PREFIX": str(install)}, capture_output=True, text=True, timeout=120,
    )


def test_package_xml_is_well_formed(repository: Path) -> None:
    """An invalid e-mail makes colcon treat the package as plain Python, without a word."""
    package = catkin_package.parse_package(str(repository / "package.xml"))
    package.validate()
    assert (package.name, package.get_build_type(), package.licenses) == (PACKAGE, "ament_python", ["Apache-2.0"])
    assert all("@" in person.email for person in package.maintainers)


def test_what_is_installed_is_where_ros_tools_look(install: Path) -> None:
    for name in EXECUTABLES:
        path = install / PACKAGE / "lib" / PACKAGE / name
        assert os.access(path, os.X_OK), path
        assert path.read_text(encoding="utf-8").startswith("#!/usr/bin/env python3\n"), "misses virtual environments"
    share = install / PACKAGE / "share"
    assert (share / "ament_index/resource_index/packages" / PACKAGE).is_file()
    for name in ("package.xml", "launch/recover.launch.py", "config/fast_dds.xml", "config/superquadrics.rviz"):
        assert (share / PACKAGE / name).is_file(), name
    assert list((share / PACKAGE / "config").glob("*.yaml"))


def test_a_workspace_of_links_is_whole(source_copy: Path, tmp_path: Path) -> None:
    """There setup.py is a link in another folder, with the packages and data files beside it and nothing else."""
    prefix = built(source_copy, tmp_path, "--symlink-install") / PACKAGE
    assert (prefix / "share" / PACKAGE / "launch/recover.launch.py").samefile(
        tmp_path / "src" / PACKAGE / "launch_scripts/recover.launch.py"
    )
    assert all(os.access(prefix / "lib" / PACKAGE / name, os.X_OK) for name in EXECUTABLES)


def test_the_sourced_workspace_is_on_the_ament_path_and_its_package_is_the_one_that_runs(install, tmp_path) -> None:
    code = "import os, sq_perception as one, sq_msgs_py as other; print(os.environ['AMENT_PREFIX_PATH'])\n"
    result = sourced(install, ["python3", "-c", code + "print(one.__file__); print(other.__file__)"], tmp_path)
    path, one, other = result.stdout.splitlines()
    assert str(install / PACKAGE) in path.split(os.pathsep), result.stderr
    assert str(install) in one
    assert str(install) in other


def test_executables_run(install: Path, tmp_path: Path) -> None:
    library = install / PACKAGE / "lib" / PACKAGE
    result = sourced(install, [str(library / "sq-perception"), "--help"], tmp_path)
    assert result.returncode == 0, result.stderr
    assert "recover" in result.stdout
    pytest.importorskip("rclpy", reason="rclpy missing: install the extra 'ros' or source ROS 2")
    for node, bad in (("recover_node", "max_objects:=0"), ("synthetic_depth_node", "rate:=-1.0")):
        result = sourced(install, [str(library / node), "--ros-args", "-p", bad], tmp_path)
        said = result.stdout + result.stderr
        assert result.returncode == 1, said
        assert bad.split(":=")[0] in said
