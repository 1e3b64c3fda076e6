"""The wheel: what it carries, and that `ros2 run` would find the nodes where pip put them."""

import ast
import email
import os
import re
import stat
import subprocess
import tarfile
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from python_process import run_python

import sq_perception

NODES = ("recover_node", "recover_cameras", "fitter_node", "grasp_node", "synthetic_depth_node")
PACKAGE = "sq_perception"


def pip(*arguments: str | Path) -> None:
    run_python("-m", "pip", "--disable-pip-version-check", *arguments)


@pytest.fixture(scope="module")
def wheel(source_copy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", folder, source_copy)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def prefix(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("prefix")
    pip("install", "--no-deps", "--no-index", "--ignore-installed", "--no-compile", "--prefix", folder, wheel)
    return folder


def ros2_run_lookup(package: str, executable: str, prefixes: str) -> Path:
    """The search of `ros2 run` (ros2pkg.api.get_executable_path): a marker, then an executable under lib/<package>."""
    for prefix in map(Path, prefixes.split(os.pathsep)):
        if (prefix / "share/ament_index/resource_index/packages" / package).is_file():
            path = prefix / "lib" / package / executable
            if path.is_file() and os.access(path, os.X_OK):
                return path
            raise LookupError("No executable found")
    raise LookupError(f"Package '{package}' not found")


def test_the_wheel_carries_every_module_and_file_nothing_else_and_no_machine_path(wheel, repository) -> None:
    """Weights are real files: the pointer of a large-file store, or an empty one, would only fail at a user's start."""
    entries = zipfile.ZipFile(wheel).infolist()
    names = {entry.filename for entry in entries}
    data = f"{PACKAGE}-0.3.0.data/data"
    shared = ("package.xml", "config/fast_dds.xml", "config/superquadrics.rviz", "launch/recover.launch.py")
    expected = {f"{data}/share/{PACKAGE}/{name}" for name in shared} | {f"{PACKAGE}/config/fast_dds.xml"}
    expected |= {f"{data}/share/ament_index/resource_index/packages/{PACKAGE}"}
    expected |= {f"{data}/lib/{PACKAGE}/{node}" for node in NODES}
    assert expected <= names
    weights = [entry.file_size for entry in entries if entry.filename.startswith(f"{PACKAGE}/weights/")]
    assert weights
    assert min(weights) > 100_000
    assert any(name.endswith(".yaml") and f"share/{PACKAGE}/config/" in name for name in names)
    carried = {name for name in zipfile.ZipFile(wheel).namelist() if name.endswith(".py") and ".data/" not in name}
    there = (path for package in (PACKAGE, "sq_msgs_py") for path in (repository / package).rglob("*.py"))
    assert carried == {path.relative_to(repository).as_posix() for path in there}
    with zipfile.ZipFile(wheel) as archive:
        for entry in archive.infolist():
            if entry.filename.endswith((".py", ".xml", ".yaml", "METADATA")) or "/lib/" in entry.filename:
                content = archive.read(entry)
                assert str(repository.parent).encode() + b"/" not in content, entry.filename
                assert b"/home/" not in content, entry.filename


def test_ros2_run_would_find_the_nodes_and_a_shell_the_command(prefix: Path) -> None:
    for node in NODES:
        path = ros2_run_lookup(PACKAGE, node, os.pathsep.join(["/opt/ros/none", str(prefix)]))
        assert path.stat().st_mode & stat.S_IXOTH
        assert (prefix / "bin" / node).is_file()
    assert os.access(prefix / "bin" / "sq-perception", os.X_OK)


@pytest.mark.parametrize("node", ["recover_cameras", "fitter_node", "grasp_node"])
def test_the_found_executable_starts_the_node(prefix: Path, node: str, tmp_path: Path) -> None:
    """From another working directory, through the wrapper: a bad parameter is refused by the node itself, code 1.

    test_colcon.py starts the other two.
    """
    pytest.importorskip("rclpy", reason="rclpy missing: install the extra 'ros' or source ROS 2")
    path = ros2_run_lookup(PACKAGE, node, str(prefix))
    (site,) = prefix.glob("lib/python3*/site-packages")
    python_path = os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    bad = "friction:=-1.0" if node == "grasp_node" else "max_objects:=0"
    cameras = ["front", "wrist"] if node == "recover_cameras" else []
    result = subprocess.run(
        [path, *cameras, "--ros-args", "-p", bad], cwd=tmp_path, env={**os.environ, "PYTHONPATH": python_path},
        capture_output=True, text=True, timeout=120,
    )
    said = result.stdout + result.stderr
    assert result.returncode == 1, said
    assert bad.split(":=")[0] in said
    assert "Traceback" not in said


def imported(paths: list[Path]) -> set[str]:
    """Top-level names that modules import, by statement or by importlib.import_module with a literal."""
    found: set[str] = set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {one.name for one in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module)
            elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module") and node.args:
                literal = node.args[0]
                found |= {literal.value} if isinstance(literal, ast.Constant) else set()
    return {name.partition(".")[0] for name in found}


def test_package_xml_names_every_ros_package_that_is_imported(repository: Path) -> None:
    """rosdep installs what is declared; packages for outputs that few ask for are named in a comment."""
    folders = [repository / name for name in (PACKAGE, "sq_msgs_py", "launch_scripts")]
    names = imported([path for folder in folders for path in folder.rglob("*.py")])
    ros = {one for one in names if one.endswith(("_msgs", "_srvs", "_interfaces"))} | (names & {"rclpy", "launch"})
    ros |= {"launch_ros"} & names | {"tf2_ros_py" for one in names if one == "tf2_ros"}
    text = (repository / "package.xml").read_text(encoding="utf-8")
    declared = set(re.findall(r"<exec_depend>(.*?)</exec_depend>", text))
    optional = {"vision_msgs", "moveit_msgs"}
    assert ros - optional <= declared
    assert not declared & optional
    assert all(one in text for one in optional)


def test_versions_and_addresses_are_those_of_package_xml(repository: Path, prefix: Path) -> None:
    about = ElementTree.parse(repository / "package.xml").getroot()  # noqa: S314 - our own
    version = about.findtext("version")
    assert sq_perception.__version__ == version
    assert f'version = "{version}"' in (repository / "sq_msgs_py" / "pyproject.toml").read_text()
    cited = yaml.safe_load((repository / "CITATION.cff").read_text())
    assert (cited["cff-version"], str(cited["version"]), cited["license"]) == ("1.2.0", version, "Apache-2.0")
    assert {"message", "title", "authors"} <= set(cited)
    assert cited["references"][0]["authors"] == [{"family-names": "Oblak", "given-names": "Tim"}]
    (path,) = prefix.glob(f"lib/python3*/site-packages/{PACKAGE}-*.dist-info/METADATA")
    metadata = email.message_from_string(path.read_text())
    maintainer = about.find("maintainer")
    assert maintainer is not None
    assert (metadata["Maintainer"], metadata["Maintainer-email"]) == (maintainer.text, maintainer.get("email"))
    assert (metadata["Version"], metadata["Home-page"]) == (version, about.findtext("url"))
    assert "superquadrics" in metadata["Keywords"]


def test_the_messages_install_alone_with_numpy_only(source_copy: Path, tmp_path: Path) -> None:
    """For a consumer of the cloud: no torch, no compiler; a cloud is read without ROS too."""
    pip("wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", tmp_path, source_copy / "sq_msgs_py")
    (wheel,) = tmp_path.glob("sq_msgs_py-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        (metadata,) = (archive.read(name).decode() for name in archive.namelist() if name.endswith("/METADATA"))
        archive.extractall(tmp_path / "alone")  # noqa: S202
    modules = {f"sq_msgs_py/{path.name}" for path in (source_copy / "sq_msgs_py").glob("*.py")}
    assert names == {*modules, "sq_msgs_py/py.typed"}
    assert re.findall("^Requires-Dist: (.*)$", metadata, re.MULTILINE) == ["numpy>=1.26"]
    code = (
        "import sys; from types import SimpleNamespace as made; from sq_msgs_py.superquadrics import *; "
        "types = lambda name: lambda **fields: made(**fields); "
        "assert len(from_message(to_message(SuperquadricArray.empty(), None, types))) == 0; "
        "import sq_msgs_py; print(sq_msgs_py.__file__); "
        "assert not {'rclpy', 'sensor_msgs', 'torch', 'sq_perception'} & set(sys.modules)"
    )
    said = run_python("-c", code, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(tmp_path / "alone")})
    assert said.stderr == ""
    assert str(tmp_path) in said.stdout


def test_the_source_archive_is_whole(source_copy: Path, tmp_path: Path) -> None:
    """What is in the tree is in the archive, so that it builds, tests and explains itself alone."""
    run_python("setup.py", "-q", "sdist", "--dist-dir", tmp_path, cwd=source_copy)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        carried = {name.partition("/")[2] for name in archive.getnames()}
        about = archive.extractfile(next(name for name in archive.getnames() if name.endswith("/PKG-INFO")))
        assert about is not None
        assert "Description-Content-Type: text/markdown" in about.read().decode()
    there = {path.relative_to(source_copy).as_posix() for path in source_copy.rglob("*") if path.is_file()}
    assert {name for name in there - carried if not re.search(r"(^|/)build/|\.egg-info/", name)} == set()
