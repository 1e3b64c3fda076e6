"""recover.launch.py under the real launch: what it starts, with which words, and what it leaves when it cannot.

The programs are in a prefix that the test makes.  Most note their command line and wait; recover_node can be the real
one.  launch is in no wheel: it comes with a ROS installation.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("launch_ros", reason="launch comes with a ROS installation")

from sq_perception.nodes import process
from sq_perception.nodes.executables import PROGRAMS

PATIENCE = 120.0
SERVICE = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored, if this is in the background of a shell
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
path, *given = sys.argv[1:]
source = PythonLaunchDescriptionSource(path)
arguments = [one.split(":=", 1) for one in given]
service = LaunchService(argv=[])
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(source, launch_arguments=arguments)]))
sys.exit(service.run())
"""
NOTING = """#!{python}
import json, os, signal, sys
note = {{"arguments": sys.argv[1:], "pid": os.getpid(), "profile": os.environ.get({variable!r})}}
place = {folder!r} + "/" + os.path.basename(sys.argv[0])
with open(place + ".part", "w") as file:
    json.dump(note, file)
os.rename(place + ".part", place + ".json")
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
signal.pause()
"""
REAL = """#!/bin/sh
exec {python} -c 'import sys; from sq_perception.nodes import executables; sys.exit(executables.recover_node())' "$@"
"""


class Launch:
    """A launch of the file, in a process of its own, with programs that note what they are started with."""

    def __init__(self, repository: Path, folder: Path) -> None:
        self._repository, self._folder = repository, folder
        self.prefix = folder / "prefix"
        self.add_package("sq_perception", PROGRAMS)
        config = self.prefix / "share" / "sq_perception" / "config"
        config.parent.mkdir(parents=True)
        config.symlink_to(repository / "config")
        self._process: subprocess.Popen[str] | None = None

    def add_package(self, name: str, programs: tuple[str, ...]) -> None:
        marks = self.prefix / "share" / "ament_index" / "resource_index" / "packages"
        marks.mkdir(parents=True, exist_ok=True)
        (marks / name).touch()
        for program in programs:
            text = NOTING.format(python=sys.executable, folder=str(self._folder), variable=process.PROFILE)
            self.install(name, program, text)

    def install(self, package: str, program: str, text: str) -> None:
        path = self.prefix / "lib" / package / program
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)

    def start(self, *arguments: str) -> None:
        known = os.environ.get("AMENT_PREFIX_PATH", sys.prefix)
        environment = {name: value for name, value in os.environ.items() if name != process.PROFILE}
        environment |= {"PYTHONPATH": f"{self._repository}:{os.environ.get('PYTHONPATH', '')}", "PYTHONUNBUFFERED": "1"}
        environment |= {"AMENT_PREFIX_PATH": f"{self.prefix}:{known}", "ROS_LOG_DIR": str(self._folder / "log")}
        path = str(self._repository / "launch_scripts" / "recover.launch.py")
        self._process = subprocess.Popen(
            [sys.executable, "-c", SERVICE, path, *arguments], cwd=self._folder, env=environment,
            stdout=(self._folder / "output").open("w"), stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )

    @property
    def output(self) -> str:
        return (self._folder / "output").read_text()

    def until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, self.output
            time.sleep(0.02)

    def note(self, program: str) -> dict:
        """What a program has noted, once it has."""
        path = self._folder / f"{program}.json"
        self.until(path.exists)
        return json.loads(path.read_text())

    def started(self) -> set[str]:
        return {path.stem for path in self._folder.glob("*.json")}

    def end(self) -> int:
        """Interrupt the launch as Ctrl-C does, all processes of its group; its exit code."""
        assert self._process is not None
        os.killpg(self._process.pid, signal.SIGINT)
        return self._process.wait(PATIENCE)

    def exit_code(self) -> int:
        assert self._process is not None
        return self._process.wait(PATIENCE)

    def left(self) -> list[str]:
        """Command lines of the processes of its group that live."""
        assert self._process is not None
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            try:
                if os.getpgid(int(path.name)) == self._process.pid and (words := (path / "cmdline").read_bytes()):
                    found.append(words.replace(b"\0", b" ").decode())
            except (ProcessLookupError, FileNotFoundError):
                continue
        return found

    def close(self) -> None:
        if self._process is not None and self.left():
            os.killpg(self._process.pid, signal.SIGKILL)


@pytest.fixture
def launch(repository: Path, tmp_path: Path) -> Iterator[Launch]:
    one = Launch(repository, tmp_path)
    yield one
    one.close()


def remapped(arguments: list[str]) -> dict[str, str]:
    """The remappings of a command line."""
    return dict(one.split(":=", 1) for flag, one in pairwise(arguments) if flag == "-r")


def parameters(arguments: list[str]) -> list[str]:
    """The parameter files of a command line, those of launch as their lines without the head."""
    files = [one for flag, one in pairwise(arguments) if flag == "--params-file"]
    return [one if one.endswith("mine.yaml") else Path(one).read_text().split("\n", 2)[2].strip() for one in files]


def test_recover_is_wired_to_the_camera(launch: Launch, tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("/**:\n  ros__parameters:\n    s: 100.0\n")
    launch.start("depth:=/camera/depth", "camera_info:=/camera/info", f"params_file:={mine}", "autostart:=false",
                 "model:=supervised", "target_frame:=map", "use_sim_time:=true", "log_level:=debug", "fitter:=true",
                 "namespace:=wrist")  # fmt: skip
    noted = launch.note("recover_node")
    words = noted["arguments"]
    assert {"__node:=recover_node", "__ns:=/wrist"} <= set(words)
    assert (remapped(words)["depth/image"], remapped(words)["depth/camera_info"]) == ("/camera/depth", "/camera/info")
    assert words[words.index("--log-level") + 1] == "debug"
    assert parameters(words) == [
        str(mine), "model: supervised", "target_frame: map", "autostart: false", "use_sim_time: true",
    ]  # fmt: skip
    assert noted["profile"] == str(process.profile_path())
    assert parameters(launch.note("fitter_node")["arguments"])[-1] == "method: classic"
    assert (launch.end(), launch.left()) == (0, [])


def test_an_argument_that_is_not_given_overrides_nothing(launch: Launch) -> None:
    launch.start("points:=/camera/points")
    words = launch.note("recover_node")["arguments"]
    assert parameters(words) == ["image_transport: points"]
    assert remapped(words)["depth/points"] == "/camera/points"
    assert launch.started() == {"recover_node"}


def test_several_cameras_are_one_process_and_the_first_has_grasps_and_pictures(launch: Launch) -> None:
    launch.add_package("rviz2", ("rviz2",))
    launch.start("cameras:=front arm/wrist", "namespace:=robot", "depth:=camera/depth", "rviz:=true", "grasp:=true",
                 "gripper:=robotiq_2f_85", "rviz_frame:=front_optical", "use_sim_time:=true")  # fmt: skip
    words = launch.note("recover_cameras")["arguments"]
    assert words[:2] == ["robot/front", "robot/arm/wrist"]
    assert not [word for word in words if word.startswith(("__node:=", "__ns:="))], "they would be those of all cameras"
    grasps = launch.note("grasp_node")["arguments"]
    assert "__ns:=/robot/front" in grasps
    assert remapped(grasps)["superquadrics"] == "recover_node/superquadrics"
    assert remapped(grasps)["support_plane"] == "recover_node/support_plane"
    assert parameters(grasps) == [
        "tf_prefix: robot_front_superquadric_", "use_sim_time: true", "gripper: robotiq_2f_85",
    ]  # fmt: skip
    shown = launch.note("rviz2")["arguments"]
    assert shown[:2] == ["-d", str(launch.prefix / "share" / "sq_perception" / "config" / "superquadrics.rviz")]
    assert shown[2:4] == ["-f", "front_optical"]
    assert parameters(shown) == ["use_sim_time: true"], "by another time it takes every tf2 frame for an old one"
    topics = remapped(shown)
    assert topics["/depth/image"] == "/robot/front/camera/depth"
    assert topics["/grasp_node/markers"] == "/robot/front/grasp_node/markers"
    assert topics["/recover_node/markers"] == "/robot/front/recover_node/markers"


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("rviz:=true", "the package rviz2 is not installed: sudo apt install ros-$ROS_DISTRO-rviz2"),
        ("params_file:=nowhere/mine.yaml", "params_file: expected a YAML file, nowhere/mine.yaml is none"),
    ],
)
def test_what_is_missing_is_said_before_anything_starts(launch: Launch, argument: str, words: str) -> None:
    if argument == "rviz:=true" and any(
        (Path(one) / "share/ament_index/resource_index/packages/rviz2").exists()
        for one in os.environ.get("AMENT_PREFIX_PATH", sys.prefix).split(":")
    ):
        pytest.skip("rviz2 is installed here")
    launch.start(argument, "grasp:=true")
    assert launch.exit_code() == 1
    assert words in launch.output
    assert (launch.left(), launch.started()) == ([], set())


def test_the_real_node_starts_and_ends_with_the_launch(launch: Launch) -> None:
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    launch.install("sq_perception", "recover_node", REAL.format(python=sys.executable))
    launch.start("depth:=/camera/depth", "autostart:=false")
    launch.until(lambda: "ros2 lifecycle set /recover_node configure" in launch.output)
    assert (launch.end(), launch.left()) == (0, [])
    assert "Traceback" not in launch.output
    assert "process has died" not in launch.output
